"""One browser's page: how its parts follow the state, and how they ask for something."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from nicegui import ui

from galen_panel.options import Options
from galen_panel.recordings import Recordings
from galen_panel.state import Answer, State
from galen_panel.suite import Suite

LOOK_PERIOD_S = 0.2
_READING_S_PER_CHARACTER = 0.06


class Page:
    """What each section gets. Made inside a page function of NiceGUI, once a browser."""

    def __init__(self, suite: Suite, options: Options, recordings: Recordings) -> None:
        self.suite = suite
        self.options = options
        self.recordings = recordings
        self._updates: list[Callable[[State], None]] = []
        self._seen = -1
        ui.timer(LOOK_PERIOD_S, self._look)

    def on_change(self, update: Callable[[State], None]) -> None:
        """Call it now, and whenever the state is another one.

        It is called some times a second: it sets texts and properties that differ, and makes
        elements anew only where a list has changed, or the keyboard's focus would be lost.
        """
        self._updates.append(update)
        update(self.suite.state)

    async def ask(self, work: Awaitable[Answer], *elements: ui.element) -> Answer:
        """Wait for an answer and show it; the elements are disabled meanwhile."""
        for element in elements:
            element.props("loading disable") if isinstance(element, ui.button) else element.props(
                "disable"
            )
        try:
            answer = await work
        finally:
            for element in elements:
                element.props(remove="loading disable")
        self.tell(answer)
        return answer

    def tell(self, answer: Answer) -> None:
        """Show an answer for as long as it takes to read it; an error until it is closed."""
        ui.notify(
            answer.text,
            type="positive" if answer.ok else "negative",
            timeout=1000 * (3 + _READING_S_PER_CHARACTER * len(answer.text)) if answer.ok else 0,
            close_button="Close",
            multi_line=True,
            position="bottom",
        )

    def _look(self) -> None:
        state = self.suite.state
        if state.revision != self._seen:
            self._seen = state.revision
            for update in self._updates:
                update(state)
