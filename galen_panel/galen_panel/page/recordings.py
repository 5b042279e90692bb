# SPDX-License-Identifier: Apache-2.0
"""Recordings: find one, have it evaluated or diagnosed, read the reports.

The queue and the reports are the same in every browser.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.messages import texts
from galen_panel.page.page import LOOKS, Page, heading, set_prop
from galen_panel.recordings.jobs import QueuedJob
from galen_panel.recordings.recordings import BESIDE, Details, FoundRecording, line_of
from galen_panel.recordings.reports import (
    EVALUATION_PAGE,
    KINDS,
    PICTURE,
    REPORTS_PATH,
    StoredReport,
)
from galen_panel.state.snapshot import CallAnswer

_STYLE = Path(__file__).with_suffix(".css")
_LISTED = 30
"""Recordings that are drawn at most; a part of the name finds the others."""
_EVALUATE = "It says whether the calibration file still fits the recording."
_DIAGNOSE = (
    "It looks for what makes arm and model differ. That takes about half a minute, longer while the"
    " computer has other work, and as long again for each recording to compare with."
)
_SPECIFICATION = (
    "What the data sheets of the arm and of its sensor allow: what stays within is no fault. Choose"
    " one of each; where both have a number, the first one's counts. Without a choice: the"
    " recording's own specification.json, else what is usual for such an arm."
)
_REFERENCE = (
    "Earlier recordings of the same arm and tool, made when all was well: the result is what has"
    " changed since. Without a choice the arm is compared with its model alone."
)
_PERIOD_S = 0.5
_MOST = 10
_STAGES = {
    "waiting": ("hourglass_empty", "waits"),
    "running": ("sync", "runs"),
    "done": ("check_circle", "done"),
    "failed": ("error", "failed"),
    "canceled": ("cancel", "canceled"),
}
Open = Callable[[str], Awaitable[None]]


def build(page: Page) -> None:
    """Draw the list and, beside it, the picked recording, the queue and the reports.

    Args:
        page: the browser's, that it is drawn on.

    """
    ui.add_css(_STYLE)
    with ui.element("div").classes("panel-recordings"):
        picked = _Picked(page)
        found = _List(page, picked)
        with ui.column().classes("gap-4 w-full"):
            picked.draw()
            build_queue(page, lambda report_id: reports.open(report_id))
            reports = ReportList(page, lambda: picked.id)
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
                with ui.column().classes("w-full gap-2") as self._of_diagnosis:
                    self._specification = _several("What is still healthy", _SPECIFICATION)
                    self._specification.props("data-testid=bag-specification")
                    self._reference = _several("Compare with", _REFERENCE)
                    self._reference.props("data-testid=bag-reference")
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
        self._of_diagnosis.set_visibility(bool(recording.parts))
        recordings = self._page.recordings
        healthy = list(recordings.specification) if recording.parts else []
        self._specification.set_options(recordings.specifications(), value=healthy)
        references = {one.id: one.name for one in recordings.references(recording.id)}
        self._reference.set_options(references, value=[])
        self._start.set_text("Diagnose" if recording.parts else "Evaluate")
        self._actions.set_visibility(not details.problem)
        why_not = "" if choices else "No calibration file was found: calibrate the tool first."
        self._page.allow(self._start, why_not)
        self._hint.set_text(why_not or (_DIAGNOSE if recording.parts else _EVALUATE))

    async def _begin(self) -> None:
        tool = str(self._tool.value or "")
        chosen = list(self._specification.value), list(self._reference.value)
        work = run_in_threadpool(self._page.recordings.start, self.id, tool, *chosen)
        await self._page.ask(work, self._start)

    def _favourite(self, choices: dict[str, str]) -> str | None:
        """Choose the file beside the recording, else the active tool, else the first."""
        active_tool = self._page.suite.state.active_tool
        name = "" if active_tool is None else active_tool.tool
        wanted = (BESIDE, f"tools:{name}", f"bags:{name}", *choices)
        return next((one for one in wanted if one in choices), None)


def _several(label: str, tooltip: str) -> ui.select:
    """Draw a choice of several, none at first."""
    chosen = ui.select([], label=label, multiple=True, value=[], clearable=True)
    chosen.props("outlined use-chips").classes("w-full")
    with chosen:
        # Above: below is the list that opens.
        ui.tooltip(tooltip).props("anchor='top middle' self='bottom middle'")
    return chosen


def _status(total: int, text: str, problem: str) -> str:
    if problem:
        return texts.sentence(problem)
    if not total:
        return f"None has '{text}' in its name." if text else "There are none."
    if total > _LISTED:
        return f"The newest {_LISTED} of {total} recordings. Type a part of a name to find others."
    return texts.count(total, "recording")


# The queue and the reports


class ReportList:
    """The newest reports on the picked recording, else on all; and a dialog that shows one."""

    def __init__(self, page: Page, picked: Callable[[], str]) -> None:
        self._page = page
        self._picked = picked
        self._shown: list[str] = []
        with ui.dialog().props("maximized aria-label=Report") as self._dialog, ui.card() as card:
            card.props("data-testid=report").classes("w-full")
            self._body = ui.column().classes("panel-report gap-4")
        with ui.card().classes("w-full gap-2"):
            self._title = heading("Newest reports")
            self._rows = ui.column().classes("w-full gap-1")
            self._nothing = ui.label("None yet.")
        ui.timer(_PERIOD_S, self._look)

    async def open(self, report_id: str) -> None:
        """Show a report over the whole page.

        Args:
            report_id: the report's; one that is gone is an error on the page.

        """
        reports = self._page.recordings.reports
        report = reports.get(report_id)
        files = [] if report is None else list(await run_in_threadpool(reports.files, report))
        if report is None or not files:
            self._page.complain("That report is not there any more.")
            return
        self._body.clear()
        with self._body:
            _draw(report, files, self._dialog)
        self._dialog.open()

    def _look(self) -> None:
        picked = self._picked()
        reports = [
            report
            for report in self._page.recordings.reports.all()
            if not picked or report.recording_id == picked
        ][:_MOST]
        self._title.set_text("Reports on it" if picked else "Newest reports")
        self._nothing.set_visibility(not reports)
        ids = [report.id for report in reports]
        if ids == self._shown:
            return
        self._shown = ids
        self._rows.clear()
        with self._rows:
            for report in reports:
                self._row(report)

    def _row(self, report: StoredReport) -> None:
        async def show() -> None:
            await self.open(report.id)

        level, word = report.verdict_words
        icon, colour = LOOKS[level]
        button = ui.button(on_click=show, color=None).classes("panel-recording")
        button.props(f"flat no-caps align=left data-testid=report-{report.id}")
        with button:
            ui.icon(icon, size="1.8rem").classes(colour).props("aria-hidden=true")
            with ui.column().classes("gap-0"):
                ui.label(f"{report.recording}: {word}").classes("panel-recording-name")
                about = f"{KINDS[report.kind]} with {_about(report)}"
                ui.label(about).classes("panel-lines")


def _about(report: StoredReport) -> str:
    since = f", compared with {report.since}" if report.since else ""
    return f"{report.tool}{since}, {texts.date(report.made_at)}"


def _draw(report: StoredReport, files: list[str], dialog: ui.dialog) -> None:
    place = f"{REPORTS_PATH}/{report.id}"
    level, word = report.verdict_words
    icon, colour = LOOKS[level]
    with ui.row().classes("w-full items-start no-wrap"):
        about = f"{report.recording}, with {_about(report)}"
        ui.label(about).classes("panel-quiet panel-lines")
        ui.space()
        close = ui.button("Close", icon="close", on_click=dialog.close)
        close.props("flat no-caps autofocus data-testid=report-close").classes("text-inherit")
    with ui.row().classes("items-center no-wrap"):
        ui.icon(icon, size="2.5rem").classes(colour).props("aria-hidden=true")
        verdict = ui.label(word).classes("panel-verdict")
        verdict.props("role=heading aria-level=2 data-testid=report-verdict")
    ui.label(report.sentence).classes("panel-sentence").props("data-testid=report-sentence")
    pages = [name for name in files if name.endswith(".html")]
    for name in pages:
        frame = ui.element("iframe").classes("panel-page")
        # Empty: no script runs in it, and it can't reach the panel.
        frame.props["sandbox"] = ""
        frame.props["src"] = f"{place}/{name}"
        frame.props["title"] = "The evaluation" if name == EVALUATION_PAGE else "The diagnosis"
    if PICTURE in files:
        image = ui.element("img").classes("panel-picture")
        image.props["src"] = f"{place}/{PICTURE}"
        image.props["alt"] = f"The residual over time and by pose. {report.sentence}"
    with ui.row().classes("gap-6"):
        for name in pages:
            ui.link("Open the page in a tab of its own", f"{place}/{name}", new_tab=True)
        for name in files:
            if name.endswith((".json", ".yaml")):
                ui.link(f"Save {name}", f"{place}/{name}")


def build_queue(page: Page, open_report: Open) -> None:
    """Draw the jobs that run, wait or have ended.

    Args:
        page: the browser's, that it is drawn on.
        open_report: shows the report of an id.

    """
    jobs = page.recordings.jobs
    seen = -1
    lines: dict[int, _JobLine] = {}
    with ui.card().classes("w-full gap-2").props("data-testid=jobs") as card:
        heading("Evaluations and diagnoses")
        rows = ui.column().classes("w-full gap-3").props("role=status")

    def look() -> None:
        nonlocal seen
        revision = jobs.revision
        if revision == seen:
            return
        seen, now = revision, jobs.jobs
        card.set_visibility(bool(now))
        if [job.id for job in now] != list(lines):
            rows.clear()
            lines.clear()
            with rows:
                lines.update((job.id, _JobLine(page, job.id, open_report)) for job in now)
        for job in now:
            lines[job.id].show(job)

    ui.timer(_PERIOD_S, look)


class _JobLine:
    """One job: progress, cancel, its report."""

    def __init__(self, page: Page, job_id: int, open_report: Open) -> None:
        self._page = page
        self._job_id = job_id
        self._report = ""

        async def show_report() -> None:
            await open_report(self._report)

        with ui.column().classes("w-full gap-1"):
            with ui.row().classes("w-full items-center no-wrap"):
                self._icon = ui.icon("sync", size="1.6rem").props("aria-hidden=true")
                self._text = ui.label().classes("panel-lines")
                ui.space()
                self._show = ui.button("Report", on_click=show_report)
                self._show.props(f"flat no-caps data-testid=job-{job_id}-report")
                self._cancel = ui.button("Cancel", icon="cancel", on_click=self._on_cancel)
                self._cancel.props(f"flat no-caps data-testid=job-{job_id}-cancel")
                for button in (self._show, self._cancel):
                    button.classes("text-inherit")
            self._bar = ui.linear_progress(0.0, show_value=False).classes("w-full")
            self._bar.props('size=0.6rem aria-label="Progress"')

    def show(self, job: QueuedJob) -> None:
        """Set what differs."""
        icon, word = _STAGES[job.stage]
        self._icon.set_name(icon)
        self._text.set_text(_job_text(job, word))
        running = job.stage == "running"
        self._bar.set_visibility(running)
        if running:
            self._bar.set_value(job.share or 0.0)
            set_prop(self._bar, "indeterminate", None if job.share is not None else "true")
        self._cancel.set_visibility(not job.ended)
        self._page.allow(self._cancel, "It is being canceled." if job.canceling else "")
        self._report = job.report
        self._show.set_visibility(bool(job.report))

    async def _on_cancel(self) -> None:
        async def cancel() -> CallAnswer:
            return self._page.recordings.jobs.cancel(self._job_id)

        await self._page.ask(cancel(), self._cancel)


def _job_text(job: QueuedJob, word: str) -> str:
    name = f"{KINDS[job.wanted.kind]} of {job.wanted.recording}"
    if job.wanted.reference:
        name += f", compared with {', '.join(path.name for path in job.wanted.reference)},"
    if job.stage == "running":
        share = "" if job.share is None else f", {job.share:.0%}"
        return f"{name} {word}: {job.doing}{share}"
    return f"{name} {word}{f'. {job.text}' if job.text else ''}"
