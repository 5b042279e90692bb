# SPDX-License-Identifier: Apache-2.0
"""A suite on ROS; and for the browser's tests a Chromium a file, looked over after each test."""

import pytest
from browser import CHROMEDRIVER, CHROMIUM, Browser
from panel_ros_world import panel_world


@pytest.fixture
def world(monkeypatch):
    """A suite that has started, and no node yet."""
    with panel_world(monkeypatch) as world:
        yield world


@pytest.fixture(scope="module")
def start_browser(tmp_path_factory):
    """Start one more Chromium; all end with the file."""
    if CHROMIUM is None or CHROMEDRIVER is None:
        pytest.skip("there is no chromium with its chromedriver: `make browser`")
    started = []

    def start(**options):
        started.append(Browser(tmp_path_factory.mktemp("browser"), **options))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture(scope="module")
def chromium(start_browser, request):
    """The file's Chromium; it draws in three dimensions where the file says WEBGL = True."""
    return start_browser(webgl=getattr(request.module, "WEBGL", False))


@pytest.fixture(scope="module")
def second_chromium(start_browser):
    """Another one, beside it."""
    return start_browser()


@pytest.fixture
def browser(chromium):
    """A Chromium that must have asked nobody but the panel, and have no errors in its console."""
    yield from _looked_over(chromium)


@pytest.fixture
def second_browser(second_chromium):
    """Another one, as of another person."""
    yield from _looked_over(second_chromium)


def _looked_over(chromium):
    chromium.forget()
    yield chromium
    assert chromium.foreign_requests() == []
    assert chromium.console_errors() == []
