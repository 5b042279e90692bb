"""How a behaviour ended, and what a person may do about it."""

from __future__ import annotations

from nicegui import ui

from galen_panel.messages import results as result_words
from galen_panel.messages import texts
from galen_panel.messages.results import Todo
from galen_panel.page.behaviours.calibration_file import FileNotice
from galen_panel.page.behaviours.calibration_options import start_calibration
from galen_panel.page.elements import pick_class, table
from galen_panel.page.page import Page
from galen_panel.state.snapshot import CalibrateGoal, CheckGoal, Kind, Outcome, State

_ICONS = {"positive": "check_circle", "warning": "warning", "negative": "error"}


class OutcomeView:
    """One outcome; drawn once, then its buttons follow the state."""

    def __init__(self, page: Page, kind: Kind, outcome: Outcome) -> None:
        self._page = page
        self._outcome = outcome
        self._file: FileNotice | None = None
        title, level = result_words.ended(kind, outcome)
        todo = Todo.NOTHING
        if kind is Kind.CHECK and not outcome.error:
            title, level, todo = result_words.verdict(outcome)
        with ui.column().classes("panel-outcome") as self._element:
            self._element.props("role=status data-testid=outcome")
            pick_class(self._element, "panel-level-", level)
            with ui.row().classes("panel-outcome-head no-wrap"):
                ui.icon(_ICONS[level]).props("aria-hidden=true").classes(f"text-{level}")
                ui.label(f"{title} · {outcome.tool}" if outcome.tool else title)
                ui.space()
                close = ui.button(
                    icon="close", on_click=lambda: self._element.set_visibility(False)
                )
                close.props('flat round aria-label="Close the result" data-testid=outcome-close')
            ui.label(result_words.told(outcome)).props("data-testid=outcome-text")
            _warnings(outcome)
            if kind is Kind.CALIBRATE and not outcome.error:
                if outcome.new:
                    table([], result_words.load_rows(outcome))
                ui.label(result_words.residual(outcome)).classes("panel-number")
                self._file = FileNotice(page, outcome)
            elif kind is Kind.COLLECT and not outcome.error:
                ui.label(result_words.collection_sentence(outcome))
            if kind is Kind.COLLECT and outcome.file:
                ui.label(f"The recording is {outcome.file}").classes("panel-path")
            if todo is not Todo.NOTHING:
                self._offer(todo)
            _rest(outcome)

    def update(self, state: State) -> None:
        """Follow the state with the buttons."""
        if self._file is not None:
            self._file.update(state)

    def _offer(self, todo: Todo) -> None:
        async def do() -> None:
            suite = self._page.suite
            if todo is Todo.CALIBRATE:
                by_hand = "attach_tool" not in suite.state.available
                goal = CalibrateGoal(self._outcome.tool, by_hand=by_hand)
                await start_calibration(self._page, goal, button)
                return
            check = CheckGoal(self._outcome.tool)
            await self._page.ask(suite.tare() if todo is Todo.TARE else suite.start(check), button)

        button = ui.button(todo.value, icon="arrow_forward", on_click=do)
        button.props("unelevated data-testid=outcome-do")


def _warnings(outcome: Outcome) -> None:
    for warning in outcome.warnings:
        with ui.row().classes("no-wrap items-start"):
            ui.icon("warning").classes("text-warning panel-icon").props("aria-hidden=true")
            ui.label(texts.sentence(warning))


def _rest(outcome: Outcome) -> None:
    """How it went; what was left out can be unfolded."""
    for note in outcome.notes:
        ui.label(texts.sentence(note)).classes("panel-quiet")
    left_out = result_words.left_out(outcome)
    if left_out:
        with ui.expansion(f"{len(left_out)} not used").props("dense").classes("w-full"):
            ui.label("\n".join(left_out)).classes("panel-lines")
