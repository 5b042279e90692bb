"""How a behaviour ended, what a new calibration changes, and what a person may do about it."""

from __future__ import annotations

from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.messages import results as result_words
from galen_panel.messages.results import Fate, Todo
from galen_panel.page.calibration_options import start_calibration
from galen_panel.page.page import Page, confirmed, pick_class, table
from galen_panel.snapshot import (
    BehaviourKind,
    BehaviourOutcome,
    CallAnswer,
    Goal,
    QuantityDifference,
    SuiteState,
    ToolComparison,
)

_ICONS = {"positive": "check_circle", "warning": "warning", "negative": "error"}


class OutcomeView:
    """One outcome; drawn once, then its buttons follow the state."""

    def __init__(self, page: Page, kind: BehaviourKind, outcome: BehaviourOutcome) -> None:
        self._page = page
        self._outcome = outcome
        self._file: FileNotice | None = None
        title, level = result_words.ended(kind, outcome)
        todo = Todo.NOTHING
        if kind is BehaviourKind.CHECK and not outcome.error:
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
            ui.label(result_words.sentence_of(outcome)).props("data-testid=outcome-text")
            _warnings(outcome)
            if kind is BehaviourKind.CALIBRATE and not outcome.error:
                if outcome.new:
                    table([], result_words.load_rows(outcome))
                ui.label(result_words.residual(outcome)).classes("panel-number")
                self._file = FileNotice(page, outcome)
            elif kind is BehaviourKind.COLLECT and not outcome.error:
                ui.label(result_words.collection_sentence(outcome))
            if kind is BehaviourKind.COLLECT and outcome.file:
                ui.label(f"The recording is {outcome.file}").classes("panel-path")
            if todo is not Todo.NOTHING:
                self._offer(todo)
            _rest(outcome)

    def update(self, state: SuiteState) -> None:
        """Follow the state with the buttons."""
        if self._file is not None:
            self._file.update(state)

    def _offer(self, todo: Todo) -> None:
        async def do() -> None:
            suite = self._page.suite
            if todo is Todo.CALIBRATE:
                by_hand = "attach_tool" not in suite.state.available
                goal = Goal(BehaviourKind.CALIBRATE, self._outcome.tool, by_hand=by_hand)
                await start_calibration(self._page, goal, button)
                return
            check = Goal(BehaviourKind.CHECK, self._outcome.tool)
            await self._page.ask(suite.tare() if todo is Todo.TARE else suite.start(check), button)

        button = ui.button(todo.value, icon="arrow_forward", on_click=do)
        button.props("unelevated data-testid=outcome-do")


def _warnings(outcome: BehaviourOutcome) -> None:
    for warning in outcome.warnings:
        with ui.row().classes("no-wrap items-start"):
            ui.icon("warning").classes("text-warning panel-icon").props("aria-hidden=true")
            ui.label(texts.sentence(warning))


def _rest(outcome: BehaviourOutcome) -> None:
    """How it went; what was left out can be unfolded."""
    for note in outcome.notes:
        ui.label(texts.sentence(note)).classes("panel-quiet")
    left_out = result_words.left_out(outcome)
    if left_out:
        with ui.expansion(f"{len(left_out)} not used").props("dense").classes("w-full"):
            ui.label("\n".join(left_out)).classes("panel-lines")


_FATES = {
    Fate.HERE: "The new file is written. Keep it to compensate with it now, or discard it.",
    Fate.ACTIVE: "The new file is active.",
    Fate.REPLACED: "The file is another one by now: this calibration was discarded or replaced.",
}
_GONE = "This calibration's file is no longer the tool's."


class FileNotice:
    """Of one calibration that came to its end."""

    def __init__(self, page: Page, outcome: BehaviourOutcome) -> None:
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

    def update(self, state: SuiteState) -> None:
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
        kept = _FATES[Fate.ACTIVE] if fate is Fate.ACTIVE else ""
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
            if isinstance(found, CallAnswer):
                ui.label(found.text)
            else:
                draw_comparison(found, "before", "new")

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


_LOAD = ("mass", "com_x", "com_y", "com_z")
_THE_SAME = "the same"


def draw_comparison(comparison: ToolComparison, before: str, after: str) -> None:
    """Draw what differs. before, after: what the two files, a and b, are called here."""
    ui.label(worst_case(comparison)).classes("panel-lead")
    ui.label(same_load(comparison))
    headers = ["", before, after, "difference", "σ"]
    with ui.element("div").classes("panel-scroll"):
        table(headers, [_row(row) for row in comparison.differences if row.quantity in _LOAD])
    others = [row for row in comparison.differences if differs_beside(row)]
    if others:
        with (
            ui.expansion(f"{len(others)} other numbers differ").props("dense").classes("w-full"),
            ui.element("div").classes("panel-scroll"),
        ):
            table(headers, [_row(row) for row in others])


def differs_beside(row: QuantityDifference) -> bool:
    """Whether a quantity that is neither mass nor centre is another one."""
    return row.quantity not in _LOAD and not row.text.startswith(_THE_SAME)


def _row(row: QuantityDifference) -> list[str]:
    return [
        texts.quantity_name(row.quantity),
        texts.quantity(row.a, row.unit),
        texts.quantity(row.b, row.unit),
        texts.change(row.b - row.a, row.unit),
        texts.sigmas(row.b - row.a, row.std_dev),
    ]


def worst_case(comparison: ToolComparison) -> str:
    """Say what the difference means at the tool."""
    size = texts.size(comparison.worst_force_n, comparison.worst_torque_nm)
    return f"What is compensated differs by at most {size}, over all poses."


def same_load(comparison: ToolComparison) -> str:
    """Say whether it may be the same tool."""
    if comparison.same_load:
        return "Mass and centre are the same as far as both calibrations can tell."
    return "Mass or centre differ by more than both calibrations' uncertainty."
