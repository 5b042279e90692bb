# SPDX-License-Identifier: Apache-2.0
"""One browser's page without a browser: NiceGUI's own simulation of a user, on the fake suite."""

import asyncio
import functools
import inspect
import logging
import re
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from fake_suite import FakeSuite
from galen_panel.page import behaviours, tools
from galen_panel.page.layout import build_compensation, build_lamp, build_running
from galen_panel.page.page import Page
from galen_panel.recordings.recordings import Recordings
from nicegui import app
from nicegui.storage import Storage
from nicegui.testing.user_interaction import UserInteraction
from nicegui.testing.user_simulation import user_simulation

PATIENCE_S = 10.0


def _operate(page):
    builders = (build_compensation, build_lamp, build_running, tools.build, behaviours.build)
    for build in builders:
        build(page)


def on_page(suite, story, build=_operate):
    """Run `story(PageUser)`, a coroutine function, on a page; an error in a log fails it.

    `build(page)` draws it.
    """
    errors = _Errors()
    with _own_storage():
        asyncio.run(_tell(suite, story, errors, build))
    assert not errors.texts, "\n".join(errors.texts)


def page_test(build=_operate, **changes):
    """Make a test of a coroutine function `story(user, suite, ...)`, on a page of a FakeSuite.

    build: as of `on_page`. changes: of the suite's state, before the page is drawn.
    """

    def decorate(story):
        @functools.wraps(story)
        def test(**arguments):
            suite = FakeSuite()
            suite.put(**changes)
            on_page(suite, lambda user: story(user, suite, **arguments), build)

        own = list(inspect.signature(story).parameters.values())[2:]
        test.__signature__ = inspect.Signature(own)
        return test

    return decorate


@contextmanager
def _own_storage():
    """NiceGUI's simulation empties and removes its storage's directory: never a shared one."""
    before = Storage.path, app.storage
    with tempfile.TemporaryDirectory(prefix="panel-page-", ignore_cleanup_errors=True) as directory:
        Storage.path = Path(directory) / "storage"
        app.storage = Storage()
        try:
            yield
        finally:
            Storage.path, app.storage = before


async def _tell(suite, story, errors, build):
    def draw():
        nowhere = Path("/nonexistent")
        build(Page(suite, Recordings(nowhere, nowhere, nowhere)))

    async with user_simulation(root=draw) as user:
        logging.getLogger().addHandler(errors)
        try:
            await user.open("/")
            await story(PageUser(user))
        finally:
            logging.getLogger().removeHandler(errors)
            if user.client is not None and not user.client.is_deleted:
                user.client.delete()


class _Errors(logging.Handler):
    def __init__(self):
        super().__init__(logging.ERROR)
        self.texts = []

    def emit(self, record):
        self.texts.append(self.format(record))


class PageUser:
    """Sees what is visible, and acts on it by the names that tests have for it."""

    def __init__(self, user):
        self._user = user

    def all(self, test_id):
        return [
            element
            for element in self._user.client.elements.values()
            if element.props.get("data-testid") == test_id and _seen(element)
        ]

    def get(self, test_id):
        (element,) = self.all(test_id)
        return element

    def click(self, test_id):
        UserInteraction(self._user, {self.get(test_id)}, None).click()

    async def answer(self, test_id, button="dialog-ok"):
        """Press what asks a question first, and answer it; returns what was asked."""
        self.click(test_id)
        await self.until(lambda: self.all(button))
        (card,) = (one for one in self.get(button).ancestors() if "panel-dialog" in one.classes)
        asked = "\n".join(getattr(element, "text", "") for element in card.descendants())
        self.click(button)
        await self.until(lambda: not self.all(button))
        return asked

    def enter(self, test_id, value):
        with self._user.client:
            self.get(test_id).set_value(value)

    def text(self, test_id):
        """All visible text in it."""
        parts = [
            getattr(element, "text", "") or getattr(element, "content", "")
            for element in self.get(test_id).descendants(include_self=True)
            if _seen(element)
        ]
        return "\n".join(part for part in parts if part)

    def answers(self, pattern, answer):
        """From now on `answer(match)` is what the browser answers to a script of this pattern."""
        self._user.javascript_rules[re.compile(pattern, re.DOTALL)] = answer

    def trigger(self, test_id, event, arguments=None):
        """As if this event of the element came from the browser."""
        UserInteraction(self._user, {self.get(test_id)}, None).trigger(event, arguments)

    def downloads(self):
        """Contents of the files that were offered."""
        return [response.content for response in self._user.download.http_responses]

    def vanish(self):
        """As a browser that loses its network; `come_back` undoes it."""
        client = self._user.client
        client.handle_disconnect(next(iter(client._socket_to_document_id)))

    async def come_back(self):
        await self._user.client.handle_handshake("again", self._user.tab_id, None, "again", None)

    def notices(self):
        """What was told so far."""
        return list(self._user.notify.messages)

    async def until(self, what):
        """Wait for a predicate; what can't be found yet is false."""
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            try:
                if what():
                    return
            except ValueError:
                pass
            await asyncio.sleep(0.02)
        raise AssertionError("it did not come true in time")


def _seen(element):
    """A dialog's content is there while the dialog is; all else may be hidden."""
    while element is not None:
        if not element.visible or "invisible" in element.classes:
            return False
        element = element.parent_slot.parent if element.parent_slot else None
    return True
