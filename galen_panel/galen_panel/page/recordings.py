"""Recordings: find one, have it evaluated or diagnosed, read the reports."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.messages import texts
from galen_panel.page.page import Page, heading, set_prop
from galen_panel.page.reports import ReportList, build_queue
from galen_panel.recordings.recordings import BESIDE, Details, FoundRecording, line_of

_STYLE = Path(__file__).with_suffix(".css")
_LISTED = 30
"""Recordings that are drawn at most; a part of the name finds the others."""
_EVALUATE = "It says whether the calibration file still fits the recording."
_DIAGNOSE = (
    "It looks for what makes arm and model differ. That takes about half a minute, longer while the"
    " computer has other work."
)


def build(page: Page) -> None:
    """Draw the list, the picked recording, the queue and the reports."""
    ui.add_css(_STYLE)
    with ui.element("div").classes("panel-recordings"):
        picked = _Picked(page)
        found = _List(page, picked)
        with ui.column().classes("gap-4 w-full"):
            picked.draw()
            reports = ReportList(page, lambda: picked.id)
            build_queue(page, reports.open)
    ui.timer(0.1, found.show, once=True)  # searched in the background


class _List:
    """The newest recordings, or those of a name."""

    def __init__(self, page: Page, picked: _Picked) -> None:
        self._page = page
        self._picked = picked
        self._shown: list[tuple[FoundRecording, Details]] | None = None
        self._asked = 0
        self._buttons: dict[str, ui.button] = {}
        with ui.card().classes("w-full gap-2"):
            with ui.row().classes("w-full items-center no-wrap"):
                heading("Recordings")
                ui.space()
                self._again = ui.button("Look again", icon="refresh", on_click=self._look_again)
                self._again.props("flat no-caps data-testid=bags-again").classes("text-inherit")
            ui.label(f"In {page.recordings.bags_dir}").classes("panel-quiet panel-lines")
            self._filter = ui.input("Find by name", on_change=self.show)
            self._filter.props("outlined clearable debounce=300 data-testid=bags-filter").classes(
                "w-full"
            )
            self._status = ui.label("Looks for recordings.").props("role=status")
            self._status.props("data-testid=bags-status")
            self._rows = ui.column().classes("w-full gap-1")

    async def show(self) -> None:
        """Read the metadata of those that match, and draw them."""
        self._asked += 1
        asked, text, recordings = self._asked, str(self._filter.value or ""), self._page.recordings

        def look() -> tuple[int, list[tuple[FoundRecording, Details]]]:
            matching = recordings.matching(text)
            return len(matching), [(one, recordings.details(one)) for one in matching[:_LISTED]]

        total, shown = await run_in_threadpool(look)
        # An answer that took longer than the next question is no answer to it.
        if asked != self._asked or self._rows.is_deleted:
            return
        self._status.set_text(_status(total, text, recordings.problem))
        if shown == self._shown:
            return
        self._shown = shown
        self._rows.clear()
        with self._rows:
            self._buttons = {
                recording.id: self._row(number, recording, details)
                for number, (recording, details) in enumerate(shown)
            }
        self._mark()

    async def _look_again(self) -> None:
        with self._page.waiting(self._again) as free:
            if free:
                await run_in_threadpool(self._page.recordings.search, True)
                await self.show()

    def _row(self, number: int, recording: FoundRecording, details: Details) -> ui.button:
        async def pick() -> None:
            await self._picked.pick(recording, details)
            self._mark()

        button = ui.button(on_click=pick, color=None).classes("panel-recording")
        button.props(f"flat no-caps align=left data-testid=bag-{number}")
        icon = "error" if details.problem else "troubleshoot" if recording.parts else "timeline"
        with button:
            mark = ui.icon(icon, size="1.8rem").props("aria-hidden=true")
            mark.classes("text-negative" if details.problem else "")
            with ui.column().classes("gap-0"):
                ui.label(recording.name).classes("panel-recording-name")
                ui.label(line_of(recording, details)).classes("panel-lines")
                if details.problem:
                    ui.label(f"Can't be used. {details.problem}").classes("panel-lines")
        return button

    def _mark(self) -> None:
        for key, button in self._buttons.items():
            set_prop(button, "aria-pressed", "true" if key == self._picked.id else "false")


class _Picked:
    """The picked recording, and what can be done with it."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._recording: FoundRecording | None = None

    @property
    def id(self) -> str:
        """The picked recording's id; empty for none."""
        return "" if self._recording is None else self._recording.id

    def draw(self) -> None:
        """Draw it, with nothing picked."""
        with ui.card().classes("w-full gap-2").props("data-testid=bag-picked"):
            self._title = heading("No recording is picked").classes("panel-lines")
            self._facts = ui.label("Pick one of the list.").classes("panel-lines")
            with ui.column().classes("w-full gap-2") as self._actions:
                self._tool = ui.select({}, label="Calibration file").classes("w-full")
                self._tool.props("outlined data-testid=bag-tool")
                self._start = ui.button("Evaluate", icon="fact_check", on_click=self._begin)
                self._start.props("no-caps unelevated data-testid=bag-start")
                self._hint = ui.label().classes("panel-lines")
            self._actions.set_visibility(False)

    async def pick(self, recording: FoundRecording, details: Details) -> None:
        """Show another recording."""
        self._recording = recording
        tools = await run_in_threadpool(self._page.recordings.tools, recording.id)
        if self._recording is not recording or self._title.is_deleted:
            return
        self._title.set_text(recording.name)
        problem = f"\nIt can't be used. {details.problem}" if details.problem else ""
        self._facts.set_text(line_of(recording, details) + problem)
        choices = {tool.id: tool.label for tool in tools}
        self._tool.set_options(choices, value=self._favourite(choices))
        self._start.set_text("Diagnose" if recording.parts else "Evaluate")
        self._actions.set_visibility(not details.problem)
        why_not = "" if choices else "No calibration file was found: calibrate the tool first."
        self._page.allow(self._start, why_not)
        self._hint.set_text(why_not or (_DIAGNOSE if recording.parts else _EVALUATE))

    async def _begin(self) -> None:
        tool = str(self._tool.value or "")
        work = run_in_threadpool(self._page.recordings.start, self.id, tool)
        await self._page.ask(work, self._start)

    def _favourite(self, choices: dict[str, str]) -> str | None:
        """Choose the file beside the recording, else the active tool, else the first."""
        active_tool = self._page.suite.state.active_tool
        name = "" if active_tool is None else active_tool.tool
        wanted = (BESIDE, f"tools:{name}", f"bags:{name}", *choices)
        return next((one for one in wanted if one in choices), None)


def _status(total: int, text: str, problem: str) -> str:
    if problem:
        return texts.sentence(problem)
    if not total:
        return f"None has '{text}' in its name." if text else "There are none."
    if total > _LISTED:
        return f"The newest {_LISTED} of {total} recordings. Type a part of a name to find others."
    return texts.count(total, "recording")
