"""In a real browser: a page whose panel is gone does not look as if it were live."""

import signal
from urllib.parse import urlsplit

import pytest
from panel_processes import PanelWorld

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

LARGE_PX = 40.0
# What is in the middle of the page, and how large the headline is.
LOOK = """
const at = document.elementFromPoint(innerWidth / 2, innerHeight / 2);
return [at.closest('[data-testid]')?.dataset.testid ?? at.id,
        parseFloat(getComputedStyle(document.querySelector('#panel-lost h1')).fontSize),
        getComputedStyle(document.querySelector('#panel-lost'), '::backdrop').backdropFilter];
"""


@pytest.fixture
def world(tmp_path):
    with PanelWorld(tmp_path) as world:
        yield world


def open_page(browser, link):
    browser.open(link)
    browser.find("tab-operate")
    browser.wait(lambda: browser.script("return window.socket?.connected"), "the page's socket")
    assert not browser.all("lost")


def test_page_of_a_panel_that_is_gone_is_grey_and_comes_back(browser, world):
    link = world.start_panel(fake=True)
    open_page(browser, link)
    world.kill("panel")
    browser.says("lost", "connection to the panel is lost", "Nothing shown here is current")
    in_the_middle, size_px, backdrop = browser.script(LOOK)
    assert in_the_middle == "lost" and size_px >= LARGE_PX and "grayscale" in backdrop
    # No key reaches the page behind, nor closes what hides it.
    for key in ("\ue004", "\ue00c", "\ue00c", "\ue007"):  # Tab, Escape twice, Enter
        browser.press(key)
    browser.find("lost")
    assert browser.focus() in ("", "lost")
    world.start_panel(fake=True, port=urlsplit(link).port)
    browser.wait(lambda: not browser.all("lost") and browser.all("tab-operate"), "the page")
    browser.forgive("ERR_CONNECTION_REFUSED")


def test_page_of_a_panel_that_hangs_is_grey_until_it_goes_on(browser, world):
    """Nothing ends the connection then: as with a network's cable that is pulled."""
    open_page(browser, world.start_panel(fake=True))
    world.processes["panel"].send_signal(signal.SIGSTOP)
    try:
        browser.find("lost")
    finally:
        world.processes["panel"].send_signal(signal.SIGCONT)
    browser.wait(lambda: not browser.all("lost") and browser.all("tab-operate"), "the page")
    browser.forgive("")
