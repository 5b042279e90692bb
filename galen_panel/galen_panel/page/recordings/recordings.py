"""Recordings: find one, have it evaluated or diagnosed, read the reports."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui
from starlette.concurrency import run_in_threadpool

from galen_panel.messages import texts
from galen_panel.page.elements import heading, set_prop
from galen_panel.page.page import Page
from galen_panel.page.recordings.jobs import Queue
from galen_panel.page.recordings.picked import Picked
from galen_panel.page.recordings.report import AllReports, ReportDialog
from galen_panel.recordings.index import Details, FoundRecording, RecordingKind, line_of
from galen_panel.recordings.recordings import ListEntry, ListPage

_STYLE = Path(__file__).with_suffix(".css")


def build(page: Page) -> None:
    """Draw the list, the recording that is picked, the queue and the reports."""
    ui.add_css(_STYLE)
    dialog = ReportDialog(page)
    with ui.element("div").classes("panel-recordings"):
        picked = Picked(page)
        found = _List(page, picked)
        with ui.column().classes("gap-4 w-full"):
            picked.draw(dialog)
            Queue(page, dialog)
            AllReports(page, dialog)
    found.begin()


class _List:
    """The recordings, a page of them at a time."""

    def __init__(self, page: Page, picked: Picked) -> None:
        self._page = page
        self._picked = picked
        self._number = 0
        self._shown: ListPage | None = None
        self._asked = 0
        with ui.card().classes("w-full gap-2"):
            with ui.row().classes("w-full items-center no-wrap"):
                heading("Recordings")
                ui.space()
                self._again = ui.button("Look again", icon="refresh", on_click=self._look_again)
                self._again.props("flat no-caps data-testid=bags-again").classes("text-inherit")
            ui.label(f"In {page.recordings.bags_dir}").classes("panel-quiet panel-lines")
            self._filter = ui.input("Find by name", on_change=self._on_filter)
            self._filter.props("outlined clearable debounce=300 data-testid=bags-filter").classes(
                "w-full"
            )
            self._status = ui.label("Looks for recordings.").props("role=status")
            self._status.props("data-testid=bags-status")
            self._rows = ui.column().classes("w-full gap-1")
            with ui.row().classes("items-center"):
                self._before = ui.button("Newer", icon="chevron_left", on_click=self._to_newer)
                self._place = ui.label()
                self._after = ui.button("Older", icon="chevron_right", on_click=self._to_older)
                for button in (self._before, self._after):
                    button.props("flat no-caps").classes("text-inherit")
            self._before.props("data-testid=bags-newer")
            self._after.props("data-testid=bags-older")
        self._buttons: dict[str, ui.button] = {}

    def begin(self) -> None:
        """Search in the background; the page is there meanwhile."""
        ui.timer(0.1, self._show, once=True)

    async def _look_again(self) -> None:
        with self._page.waiting(self._again) as free:
            if free:
                await run_in_threadpool(self._page.recordings.search, True)
                await self._show()

    async def _on_filter(self) -> None:
        self._number = 0
        await self._show()

    async def _to_newer(self) -> None:
        self._number -= 1
        await self._show()

    async def _to_older(self) -> None:
        self._number += 1
        await self._show()

    async def _show(self) -> None:
        self._asked += 1
        asked = self._asked
        text = str(self._filter.value or "")
        shown = await run_in_threadpool(self._page.recordings.page, text, self._number)
        # An answer that took longer than the next question is no answer to it.
        if asked != self._asked or self._rows.is_deleted:
            return
        self._number = shown.number
        self._status.set_text(_status(shown, text))
        self._place.set_text(f"Page {shown.number + 1} of {shown.pages}")
        for element in (self._before, self._place, self._after):
            element.set_visibility(shown.pages > 1)
        self._before.set_enabled(shown.number > 0)
        self._after.set_enabled(shown.number + 1 < shown.pages)
        if self._shown is None or shown.listed != self._shown.listed:
            self._draw(shown)
        self._shown = shown

    def _draw(self, shown: ListPage) -> None:
        self._rows.clear()
        self._buttons = {}
        with self._rows:
            for listed in shown.listed:
                self._buttons[listed.recording.id] = self._row(listed)
        self._mark()

    def _row(self, listed: ListEntry) -> ui.button:
        recording, details = listed.recording, listed.details

        async def pick() -> None:
            await self._picked.pick(recording, details)
            self._mark()

        button = ui.button(on_click=pick, color=None).classes("panel-recording")
        button.props(f"flat no-caps align=left data-testid=bag-{listed.number}")
        with button:
            icon, colour = _icon(recording, details)
            ui.icon(icon, size="1.8rem").classes(colour).props("aria-hidden=true")
            with ui.column().classes("gap-0"):
                ui.label(recording.name).classes("panel-recording-name")
                ui.label(line_of(recording, details)).classes("panel-lines")
                if details.problem:
                    ui.label(f"Can't be used. {details.problem}").classes("panel-lines")
        return button

    def _mark(self) -> None:
        for key, button in self._buttons.items():
            set_prop(button, "aria-pressed", "true" if key == self._picked.id else "false")


def _status(shown: ListPage, text: str) -> str:
    if shown.problem:
        return texts.sentence(shown.problem)
    if not shown.total:
        return f"None has '{text}' in its name." if text else "There are none."
    return texts.count(shown.total, "recording")


def _icon(recording: FoundRecording, details: Details) -> tuple[str, str]:
    if details.problem:
        return "error", "text-negative"
    if recording.kind is RecordingKind.DIAGNOSIS:
        return "troubleshoot", ""
    return "timeline", ""
