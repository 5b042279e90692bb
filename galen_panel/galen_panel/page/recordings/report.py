"""One report, over the whole page: the verdict big, then sentences, tables, pictures."""

from __future__ import annotations

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.messages import texts
from galen_panel.page.elements import LOOKS, heading, table
from galen_panel.page.page import Page
from galen_panel.recordings.index import VERBS
from galen_panel.recordings.recordings import REPORTS_PATH
from galen_panel.recordings.report_files import EFFECT, StoredReport, StoredReportError
from galen_panel.recordings.report_view import ReportView, verdict_of, view_of
from galen_panel.snapshot import CallAnswer


class ReportDialog:
    """A dialog that is there once a page, and shows one report after the other."""

    def __init__(self, page: Page) -> None:
        self._page = page
        with ui.dialog().props("maximized aria-label=Report") as dialog, ui.card() as card:
            card.props("data-testid=report").classes("w-full")
            self._body = ui.column().classes("panel-report gap-4")
        self._dialog = dialog

    async def show(self, report_id: str) -> None:
        """Read a report and show it, or tell why not."""
        reports = self._page.recordings.reports
        report = reports.get(report_id)
        if report is None:
            self._page.tell(CallAnswer(False, "That report is not there any more."))
            return
        try:
            content = await run_in_threadpool(reports.content, report)
            files = list(await run_in_threadpool(reports.files, report))
            view = view_of(report, content, files)
        except StoredReportError as error:
            self._page.tell(CallAnswer(False, str(error)))
            return
        self._body.clear()
        with self._body:
            _draw(report, view, files, self._dialog)
        self._dialog.open()


def _draw(report: StoredReport, view: ReportView, files: list[str], dialog: ui.dialog) -> None:
    place = f"{REPORTS_PATH}/{report.id}"
    with ui.row().classes("w-full items-start no-wrap"):
        ui.label(view.about).classes("panel-quiet panel-lines")
        ui.space()
        close = ui.button("Close", icon="close", on_click=dialog.close)
        close.props("flat no-caps autofocus data-testid=report-close").classes("text-inherit")
    icon, colour = LOOKS[view.level]
    with ui.row().classes("items-center no-wrap"):
        ui.icon(icon, size="2.5rem").classes(colour).props("aria-hidden=true")
        word = ui.label(view.word).classes("panel-verdict")
        word.props("role=heading aria-level=2 data-testid=report-verdict")
    ui.label(view.sentence).classes("panel-sentence").props("data-testid=report-sentence")
    for title, lines in view.lists:
        heading(title, 3)
        with ui.element("ul").classes("list-disc pl-6"):
            for line in lines:
                with ui.element("li"):
                    ui.label(line).classes("panel-lines")
    for one in view.tables:
        heading(one.title, 3)
        with ui.element("div").classes("panel-scroll").props("tabindex=0"):
            table(one.headers, one.rows)
    if view.picture:
        heading("Picture", 3)
        image = ui.element("img").classes("panel-picture")
        image.props["src"] = f"{place}/{view.picture}"
        image.props["alt"] = f"The residual over time and by pose. {view.sentence}"
    if view.page:
        heading("The whole report, with pictures", 3)
        frame = ui.element("iframe").classes("panel-page")
        # Empty: no script runs in it, and it can't reach the panel.
        frame.props["sandbox"] = ""
        frame.props["src"] = f"{place}/{view.page}"
        frame.props["title"] = "The diagnosis as a page with pictures"
    with ui.row().classes("gap-6"):
        if view.page:
            ui.link("Open this page in a tab of its own", f"{place}/{view.page}", new_tab=True)
        for name in files:
            if name.endswith((".json", ".yaml")):
                text = "parameters for the simulated arm" if EFFECT.endswith(name) else "numbers"
                ui.link(f"Save {name} ({text})", f"{place}/{name}")


_PERIOD_S = 0.5
_MOST = 10


class ReportButtons:
    """A button a report; made anew only when there are others."""

    def __init__(self, dialog: ReportDialog) -> None:
        self._dialog = dialog
        self._rows = ui.column().classes("w-full gap-1")
        self._nothing = ui.label("None yet.")
        self._shown: list[str] = []

    def show(self, reports: list[StoredReport], of_one: bool = False) -> None:
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


def _report_button(report: StoredReport, dialog: ReportDialog, of_one: bool) -> None:
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
