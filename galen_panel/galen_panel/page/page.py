# SPDX-License-Identifier: Apache-2.0
"""One browser's page: how its parts follow the state, ask for something, and ask a person."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from nicegui import ui
from nicegui.elements.mixins.disableable_element import DisableableElement

from galen_panel.recordings.recordings import Recordings
from galen_panel.state.snapshot import CallAnswer, NodeLevel, SuiteState

if TYPE_CHECKING:
    from galen_panel.ros.suite import RosSuite

LOOK_PERIOD_S = 0.2
_READING_S_PER_CHARACTER = 0.06
_ASKED_ALREADY = CallAnswer(False, "That is under way already.")
_log = logging.getLogger(__name__)

LOOKS = {
    NodeLevel.OK: ("check_circle", "text-positive"),
    NodeLevel.WARN: ("warning", "text-warning"),
    NodeLevel.ERROR: ("error", "text-negative"),
    NodeLevel.STALE: ("help", "text-warning"),
}
"""A level's icon, and its colour's class; to be shown with a word."""


class Page:
    """What each section gets. Made inside a page function of NiceGUI, once a browser.

    client: NiceGUI's name for the browser's page; `with page.client` puts what is drawn on it.
    """

    def __init__(self, suite: RosSuite, recordings: Recordings) -> None:
        self.suite = suite
        self.recordings = recordings
        self.client = ui.context.client
        self._updates: list[Callable[[SuiteState], None]] = []
        self._seen = -1
        self._waiting: set[int] = set()
        self._rejected: dict[int, str] = {}
        ui.timer(LOOK_PERIOD_S, self._look)

    def on_change(self, update: Callable[[SuiteState], None]) -> None:
        """Call a function now, and whenever the state is another one.

        It is called some times a second: it sets texts and properties that differ, and makes
        elements anew only where a list has changed, or the keyboard's focus would be lost.

        Args:
            update: takes the newest state.

        """
        self._updates.append(update)
        update(self.suite.state)

    def allow(self, element: DisableableElement, why_not: str = "") -> None:
        """Enable an element, or disable it with the reason as its title.

        What waits for an answer takes no second click until that has come, nevertheless.

        Args:
            element: a button or a field.
            why_not: the reason; empty: it is enabled.

        """
        if self._rejected.get(element.id) == why_not:
            return
        self._rejected[element.id] = why_not
        if why_not:
            element.props["title"] = why_not
        else:
            element.props.pop("title", None)
        waits = element.id in self._waiting and not isinstance(element, ui.button)
        element.set_enabled(not why_not and not waits)

    @contextmanager
    def waiting(self, *elements: DisableableElement) -> Iterator[bool]:
        """Let elements take no input within it, and buttons turn.

        Two clicks may be on their way before the browser hears of it. A button isn't disabled: it
        would lose the keyboard's focus.

        Args:
            *elements: buttons and fields.

        Yields:
            False where one of them waits already, and nothing is to be done.

        """
        if any(element.id in self._waiting for element in elements):
            yield False
            return
        for element in elements:
            self._waiting.add(element.id)
            if isinstance(element, ui.button):
                element.props("loading")
            else:
                element.disable()
        try:
            yield True
        finally:
            for element in elements:
                self._waiting.discard(element.id)
                if element.is_deleted:
                    continue
                if isinstance(element, ui.button):
                    element.props(remove="loading")
                else:
                    element.set_enabled(not self._rejected.get(element.id))

    async def ask(self, work: Awaitable[CallAnswer], *elements: DisableableElement) -> CallAnswer:
        """Wait for an answer and show it; the elements take no input meanwhile.

        A failure of the panel itself is an answer, too.

        Args:
            work: to be awaited; not done where one of the elements waits for an answer already.
            *elements: buttons and fields.

        Returns:
            The answer.

        """
        with self.waiting(*elements) as free:
            if not free:
                if inspect.iscoroutine(work):
                    work.close()
                return _ASKED_ALREADY
            try:
                answer = await work
            except Exception as error:
                _log.exception("the panel failed to ask")
                answer = CallAnswer(False, f"The panel failed ({error!r}). Its terminal says more.")
        self.tell(answer)
        return answer

    def tell(self, answer: CallAnswer) -> None:
        """Show an answer for as long as it takes to read it; an error until it is closed.

        Nothing is shown where the browser has gone meanwhile.

        Args:
            answer: of the suite, or of the panel itself.

        """
        if self.client.is_deleted:
            return
        # What asked may be gone from the page by now, such as a removed tool's row.
        with self.client:
            ui.notify(
                answer.text,
                type="positive" if answer.ok else "negative",
                timeout=1000 * (3 + _READING_S_PER_CHARACTER * len(answer.text))
                if answer.ok
                else 0,
                close_button="Close",
                multi_line=True,
                position="bottom-left",
            )

    def complain(self, text: str) -> None:
        """Show what is missing before something can be asked for.

        Args:
            text: a sentence.

        """
        self.tell(CallAnswer(False, text))

    def _look(self) -> None:
        state = self.suite.state
        if state.revision == self._seen:
            return
        self._seen = state.revision
        for update in self._updates:
            try:
                update(state)
            except Exception:
                # One part that fails must not keep the others from what is new.
                _log.exception("a part of the page failed to follow the state")


@contextmanager
def dialog(page: Page, title: str) -> Iterator[ui.dialog]:
    """Draw a dialog with a title, gone from the page when it is left.

    Args:
        page: the browser's, that it is drawn on.
        title: also the dialog's name for a screen reader.

    Yields:
        The dialog, to be awaited: what it is submitted with, None where Escape or Cancel closes it.

    """
    with page.client, ui.dialog() as shown, ui.card().classes("panel-dialog"):
        shown.props["aria-label"] = title
        heading(title)
        try:
            yield shown
        finally:
            if not shown.is_deleted:
                shown.delete()


def buttons(shown: ui.dialog, text: str, icon: str, color: str = "primary") -> ui.button:
    """Draw a dialog's last line: cancel, and the button that goes on.

    Args:
        shown: the dialog, which cancel closes.
        text: of the button that goes on.
        icon: of that button.
        color: of that button.

    Returns:
        That button, which has no handler yet.

    """
    with ui.row().classes("panel-actions"):
        ui.button("Cancel", on_click=shown.close).props("flat data-testid=dialog-cancel")
        return ui.button(text, icon=icon, color=color).props("unelevated data-testid=dialog-ok")


async def confirmed(
    page: Page, title: str, sentences: list[str], text: str, icon: str, color: str = "negative"
) -> bool:
    """Ask a person whether to do something.

    Args:
        page: the browser's, that the dialog is drawn on.
        title: the question.
        sentences: what to know before.
        text: of the button that agrees.
        icon: of that button.
        color: of that button.

    Returns:
        Whether it was pressed.

    """
    with dialog(page, title) as shown:
        for sentence in sentences:
            ui.label(sentence)
        buttons(shown, text, icon, color).on_click(lambda: shown.submit(True))
        return bool(await shown)


def set_prop(element: ui.element, name: str, value: str | None) -> None:
    """Set an attribute, or remove it; nothing is sent where it is so already.

    Args:
        element: that has it.
        name: of the attribute.
        value: its text; None: to be removed.

    """
    if element.props.get(name) == value:
        return
    if value is None:
        del element.props[name]
    else:
        element.props[name] = value


def pick_class(element: ui.element, prefix: str, word: str) -> None:
    """Give an element one CSS class of a family, and remove the others of it.

    Args:
        element: that has the class.
        prefix: with which the family's classes begin.
        word: the rest of the class's name.

    """
    wanted = prefix + word
    if wanted not in element.classes:
        others = [name for name in element.classes if name.startswith(prefix)]
        element.classes(add=wanted, remove=" ".join(others))


def heading(text: str, level: int = 2) -> ui.label:
    """Draw a title that a screen reader finds.

    Args:
        text: the title.
        level: of the heading, as in HTML.

    Returns:
        The label.

    """
    return ui.label(text).classes("panel-title").props(f'role=heading aria-level="{level}"')


def table(headers: list[str], rows: list[list[str]]) -> ui.element:
    """Draw a plain table of texts; the first column names its row.

    Args:
        headers: of the columns; empty: none is drawn.
        rows: texts by row and column.

    Returns:
        The table.

    """
    with ui.element("table").classes("panel-table") as drawn:
        if headers:
            with ui.element("thead"), ui.element("tr"):
                for text in headers:
                    with ui.element("th").props("scope=col"):
                        ui.label(text)
        with ui.element("tbody"):
            for row in rows:
                with ui.element("tr"):
                    for index, text in enumerate(row):
                        with ui.element("td" if index else "th") as cell:
                            ui.label(text)
                        if not index:
                            cell.props("scope=row")
    return drawn
