"""The file that a calibration wrote, beside the one before: keep it, or discard it."""

from __future__ import annotations

from nicegui import ui

from galen_panel.messages import hints
from galen_panel.messages import results as result_words
from galen_panel.messages.results import Fate
from galen_panel.page import comparison
from galen_panel.page.dialogs import confirmed
from galen_panel.page.page import Page
from galen_panel.state.snapshot import Answer, Outcome, State

_FATES = {
    Fate.HERE: "The new file is written. Keep it to compensate with it now, or discard it.",
    Fate.IN_FORCE: "The new file is active.",
    Fate.REPLACED: "The tool's file is another one by now: this one was discarded or replaced.",
}
_GONE = "This calibration's file is no longer the tool's."


class FileNotice:
    """Of one calibration that came to its end."""

    def __init__(self, page: Page, outcome: Outcome) -> None:
        self._page = page
        self._outcome = outcome
        self._listed = False
        self._beside = ui.column().classes("w-full gap-2").props("data-testid=beside")
        self._fate = ui.label().classes("panel-lead").props("role=status data-testid=fate")
        with ui.row():
            self._keep = ui.button("Keep", icon="check", on_click=self._on_keep)
            self._keep.props("unelevated data-testid=keep")
            self._discard = ui.button("Discard", icon="undo", on_click=self._on_discard)
            self._discard.props("outline color=negative data-testid=discard")
        ui.timer(0.0, self._look, once=True)

    def update(self, state: State) -> None:
        """Follow the state: another browser may have kept or discarded it."""
        fate = result_words.fate(self._outcome, state)
        if fate is Fate.REPLACED and not self._listed:
            # The list is from before the calibration until it has been read again.
            self._fate.set_text("Reading the new file.")
            self._page.allow(self._keep, "The new file is being read.")
            self._page.allow(self._discard, "The new file is being read.")
            return
        self._fate.set_text(_FATES[fate])
        gone = _GONE if fate is Fate.REPLACED else ""
        kept = _FATES[Fate.IN_FORCE] if fate is Fate.IN_FORCE else ""
        way_back = "gravcomp/remove_tool" if self._outcome.new else "gravcomp/revert_tool"
        self._page.allow(self._keep, gone or kept or hints.missing(state, "gravcomp/set_tool"))
        self._page.allow(self._discard, gone or hints.missing(state, way_back))

    async def _look(self) -> None:
        suite = self._page.suite
        listed = await suite.list_tools()
        self._listed = listed.ok
        self.update(suite.state)
        if not listed.ok:
            self._page.tell(listed)
        if self._outcome.new:
            with self._beside:
                ui.label("The tool had no file before.")
            return
        found = await suite.compare(self._outcome.tool)
        with self._beside:
            if isinstance(found, Answer):
                ui.label(found.text)
            else:
                comparison.draw(found, "before", "new")

    async def _on_keep(self) -> None:
        await self._page.ask(self._page.suite.activate(self._outcome.tool), self._keep)

    async def _on_discard(self) -> None:
        outcome = self._outcome
        sure = await confirmed(
            self._page,
            "Discard this calibration?",
            result_words.discard_sentences(outcome),
            "Discard it",
            "undo",
        )
        if not sure:
            return
        suite = self._page.suite
        back = suite.remove_tool if outcome.new else suite.revert_tool
        await self._page.ask(back(outcome.tool), self._discard)
