"""What is evaluated and diagnosed now, what waits, and how it ended; the same in every browser."""

from __future__ import annotations

from nicegui import ui

from galen_panel.page.elements import heading, set_prop
from galen_panel.page.page import Page
from galen_panel.page.recordings.report import ReportDialog
from galen_panel.recordings.index import VERBS
from galen_panel.recordings.jobs import JobStage, QueuedJob
from galen_panel.snapshot import CallAnswer

_PERIOD_S = 0.5
_STAGES = {
    JobStage.WAITING: ("hourglass_empty", "waits"),
    JobStage.RUNNING: ("sync", "runs"),
    JobStage.DONE: ("check_circle", "done"),
    JobStage.FAILED: ("error", "failed"),
    JobStage.CANCELED: ("cancel", "canceled"),
}


class Queue:
    """What runs, what waits, how it ended; the same in every browser."""

    def __init__(self, page: Page, dialog: ReportDialog) -> None:
        self._page = page
        self._dialog = dialog
        self._revision = -1
        self._lines: dict[int, _JobLine] = {}
        with ui.card().classes("w-full gap-2").props("data-testid=jobs") as card:
            heading("At work")
            self._rows = ui.column().classes("w-full gap-3").props("role=status")
        self._card = card
        ui.timer(_PERIOD_S, self._look)

    def _look(self) -> None:
        jobs = self._page.recordings.jobs
        revision = jobs.revision
        if revision == self._revision:
            return
        self._revision = revision
        now = jobs.jobs
        self._card.set_visibility(bool(now))
        if [job.id for job in now] != list(self._lines):
            self._rows.clear()
            with self._rows:
                self._lines = {job.id: _JobLine(self._page, job.id, self._dialog) for job in now}
        for job in now:
            self._lines[job.id].show(job)


class _JobLine:
    """One job's."""

    def __init__(self, page: Page, job_id: int, dialog: ReportDialog) -> None:
        self._page = page
        self._job_id = job_id
        self._report = ""
        with ui.column().classes("w-full gap-1") as box:
            box.props(f"data-testid=job-{job_id}")
            with ui.row().classes("w-full items-center no-wrap"):
                self._icon = ui.icon("sync", size="1.6rem").props("aria-hidden=true")
                self._text = ui.label().classes("panel-lines")
                ui.space()
                self._show = ui.button("Report", on_click=lambda: dialog.show(self._report))
                self._show.props(f"flat no-caps data-testid=job-{job_id}-report")
                self._cancel = ui.button("Cancel", icon="cancel", on_click=self._on_cancel)
                self._cancel.props(f"flat no-caps data-testid=job-{job_id}-cancel")
                for button in (self._show, self._cancel):
                    button.classes("text-inherit")
            self._bar = ui.linear_progress(0.0, show_value=False).classes("w-full")
            self._bar.props('size=0.6rem aria-label="Progress"')
            self._bar.props(f"data-testid=job-{job_id}-progress")

    def show(self, job: QueuedJob) -> None:
        """Set what differs."""
        icon, word = _STAGES[job.stage]
        self._icon.set_name(icon)
        self._text.set_text(_job_text(job, word))
        running = job.stage is JobStage.RUNNING
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
    name = f"{VERBS[job.wanted.kind]} of {job.wanted.recording}"
    if job.stage is JobStage.RUNNING:
        share = "" if job.share is None else f", {job.share:.0%}"
        return f"{name} {word}: {job.doing}{share}"
    return f"{name} {word}{f'. {job.text}' if job.text else ''}"
