"""Buttons that open reports."""

from __future__ import annotations

from nicegui import ui

from galen_panel.messages import texts
from galen_panel.page.elements import LOOKS, heading
from galen_panel.page.page import Page
from galen_panel.page.recordings.report import ReportDialog
from galen_panel.recordings.report_files import Report
from galen_panel.recordings.report_view import verdict_of
from galen_panel.recordings.words import VERBS

_PERIOD_S = 0.5
_MOST = 10


class ReportButtons:
    """A button a report; made anew only when there are others."""

    def __init__(self, dialog: ReportDialog) -> None:
        self._dialog = dialog
        self._rows = ui.column().classes("w-full gap-1")
        self._nothing = ui.label("None yet.")
        self._shown: list[str] = []

    def show(self, reports: list[Report], of_one: bool = False) -> None:
        """Show the first of these."""
        reports = reports[:_MOST]
        self._nothing.set_visibility(not reports)
        ids = [report.id for report in reports]
        if ids == self._shown:
            return
        self._shown = ids
        self._rows.clear()
        with self._rows:
            for report in reports:
                _report_button(report, self._dialog, of_one)


def _report_button(report: Report, dialog: ReportDialog, of_one: bool) -> None:
    async def show() -> None:
        await dialog.show(report.id)

    level, word = verdict_of(report)
    icon, colour = LOOKS[level]
    button = ui.button(on_click=show, color=None).classes("panel-recording")
    button.props(f"flat no-caps align=left data-testid=report-{report.id}")
    name = "" if of_one else f"{report.recording}: "
    with button:
        ui.icon(icon, size="1.8rem").classes(colour).props("aria-hidden=true")
        with ui.column().classes("gap-0"):
            ui.label(f"{name}{word}").classes("panel-recording-name")
            about = f"{VERBS[report.kind]} with {report.tool}, {texts.date(report.made_at)}"
            ui.label(about).classes("panel-lines")


class AllReports:
    """The newest reports on whatever recording, also of before the panel was started."""

    def __init__(self, page: Page, dialog: ReportDialog) -> None:
        self._page = page
        with ui.card().classes("w-full gap-2"):
            heading("Newest reports")
            self._buttons = ReportButtons(dialog)
        ui.timer(_PERIOD_S, self._look)

    def _look(self) -> None:
        self._buttons.show(self._page.recordings.reports.all())
