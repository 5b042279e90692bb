"""The recording that is picked: what it is, what can be done with it, the reports on it."""

from __future__ import annotations

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.page.elements import heading
from galen_panel.page.page import Page
from galen_panel.page.recordings.report import ReportButtons, ReportDialog
from galen_panel.recordings.index import Details, FoundRecording, RecordingKind, facts_of

_PERIOD_S = 0.5
_HINTS = {
    RecordingKind.BAG: "It says whether the calibration file still fits the recording.",
    RecordingKind.DIAGNOSIS: "It looks for what makes arm and model differ. That takes about half a"
    " minute, longer while the computer has other work.",
}


class Picked:
    """What one recording is, and what can be done with it."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._recording: FoundRecording | None = None

    @property
    def id(self) -> str:
        """Of the recording that is picked; empty for none."""
        return "" if self._recording is None else self._recording.id

    def draw(self, dialog: ReportDialog) -> None:
        """Draw it, with nothing picked."""
        with ui.card().classes("w-full gap-2").props("data-testid=bag-picked"):
            self._title = heading("No recording is picked").classes("panel-lines")
            self._facts = ui.label("Pick one of the list.").classes("panel-lines")
            self._actions = ui.column().classes("w-full gap-2")
            with self._actions:
                self._tool = ui.select({}, label="Calibration file").classes("w-full")
                self._tool.props("outlined data-testid=bag-tool")
                with ui.row():
                    self._evaluate = self._action("Evaluate", "fact_check", "evaluate")
                    self._diagnose = self._action("Diagnose", "troubleshoot", "diagnose")
                self._hint = ui.label().classes("panel-lines")
            self._actions.set_visibility(False)
            with ui.column().classes("w-full gap-1") as own:
                heading("Reports on it", 3)
                self._reports = ReportButtons(dialog)
            self._own = own
            own.set_visibility(False)
        ui.timer(_PERIOD_S, self._look)

    async def pick(self, recording: FoundRecording, details: Details) -> None:
        """Show another recording."""
        self._recording = recording
        tools = await run_in_threadpool(self._page.recordings.tools, recording.id)
        if self._recording is not recording or self._title.is_deleted:
            return
        self._title.set_text(recording.name)
        self._facts.set_text(facts_of(recording, details))
        choices = {tool.id: tool.label for tool in tools}
        self._tool.set_options(choices, value=self._favourite(recording, choices))
        diagnosis = recording.kind is RecordingKind.DIAGNOSIS
        self._evaluate.set_visibility(not diagnosis)
        self._diagnose.set_visibility(diagnosis)
        self._actions.set_visibility(not details.problem)
        why_not = "" if choices else "No calibration file was found: calibrate the tool first."
        for button in (self._evaluate, self._diagnose):
            self._page.allow(button, why_not)
        self._hint.set_text(why_not or _HINTS[recording.kind])
        self._own.set_visibility(True)
        self._look()

    def _action(self, text: str, icon: str, testid: str) -> ui.button:
        button = ui.button(text, icon=icon)
        button.on_click(lambda: self._start(button))
        button.props(f"no-caps unelevated data-testid={testid}")
        return button

    async def _start(self, button: ui.button) -> None:
        if self._recording is not None:
            work = run_in_threadpool(
                self._page.recordings.start, self._recording.id, str(self._tool.value or "")
            )
            await self._page.ask(work, button)

    def _favourite(self, recording: FoundRecording, choices: dict[str, str]) -> str | None:
        """Choose the file beside the recording, else the active tool, else the first."""
        active_tool = self._page.suite.state.active_tool
        wanted = ["beside"]
        if active_tool is not None:
            wanted += [f"tools:{active_tool.tool}", f"bags:{active_tool.tool}"]
        return next((one for one in (*wanted, *choices) if one in choices), None)

    def _look(self) -> None:
        if self._recording is not None:
            self._reports.show(
                [
                    report
                    for report in self._page.recordings.reports.all()
                    if report.recording_id == self._recording.id
                ],
                of_one=True,
            )
