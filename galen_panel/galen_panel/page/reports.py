"""What is evaluated and diagnosed now, how it ended, and the reports; the same in every browser."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.messages import texts
from galen_panel.page.page import LOOKS, Page, heading, set_prop
from galen_panel.recordings.jobs import QueuedJob
from galen_panel.recordings.reports import (
    EVALUATION_PAGE,
    KINDS,
    PICTURE,
    REPORTS_PATH,
    StoredReport,
)
from galen_panel.snapshot import CallAnswer

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
        """Show a report over the whole page."""
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
                about = f"{KINDS[report.kind]} with {report.tool}, {texts.date(report.made_at)}"
                ui.label(about).classes("panel-lines")


def _draw(report: StoredReport, files: list[str], dialog: ui.dialog) -> None:
    place = f"{REPORTS_PATH}/{report.id}"
    level, word = report.verdict_words
    icon, colour = LOOKS[level]
    with ui.row().classes("w-full items-start no-wrap"):
        about = f"{report.recording}, with {report.tool}, {texts.date(report.made_at)}"
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
    """Draw the jobs that run, wait or have ended."""
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
    if job.stage == "running":
        share = "" if job.share is None else f", {job.share:.0%}"
        return f"{name} {word}: {job.doing}{share}"
    return f"{name} {word}{f'. {job.text}' if job.text else ''}"
