# SPDX-License-Identifier: Apache-2.0
"""The behaviours: a card each, to start one, to see what it rejects, and how it ended."""

from __future__ import annotations

import math
from collections.abc import Callable

from galen_model.errors import GalenError
from galen_model.files.calibration_file import check_tool_name
from nicegui import ui

from galen_panel.messages import programs, texts
from galen_panel.page.outcome import OutcomeView
from galen_panel.page.page import Page, confirmed, heading
from galen_panel.state.snapshot import BehaviourKind, Goal, SuiteState

AREA_CLEAR = "Area clear: calibrate"

_SERVICE = "attach_tool"
_FARTHEST_MM = 2000.0
_ACTIVE = ""
_ACTIVE_TEXT = "the active one"
_REASONS = 4


def build(page: Page) -> None:
    """Draw a card for each behaviour.

    Args:
        page: the browser's, that it is drawn on.

    """
    with ui.element("section").classes("panel-section").props("aria-label=Behaviours"):
        with ui.row().classes("panel-head"):
            heading("Behaviours")
        for kind, (name, title, icon, purpose, form) in _CARDS.items():
            _Card(page, kind, name, title, icon, purpose, form)


_Form = tuple[Callable[[SuiteState], None], Callable[[], Goal | None]]
"""What follows the state; what was chosen, None where a field complains."""


class _Card:
    """Title, fields, start; then what is rejected; then the outcome."""

    def __init__(
        self,
        page: Page,
        kind: BehaviourKind,
        name: str,
        title: str,
        icon: str,
        purpose: str,
        form: Callable[[Page], _Form],
    ) -> None:
        self._page = page
        self._kind = kind
        self._outcome: OutcomeView | None = None
        self._number = -1
        with ui.card().classes("panel-card").props(f"flat bordered data-testid=card-{name}"):
            with ui.row().classes("panel-card-head"):
                ui.icon(icon).props("aria-hidden=true")
                heading(title, 3)
            self._rejected = ui.label().classes("panel-lines").props(f"data-testid={name}-rejected")
            self._place = ui.column().classes("panel-run")
            with ui.column().classes("panel-form") as self._whole_form:
                ui.label(purpose)
                self._update_form, self._goal = form(page)
                self._start = ui.button(title, icon="play_arrow", on_click=self._begin)
                self._start.props(f"unelevated data-testid={name}")
                self._why_not = ui.label().classes("panel-note").props("role=status")
        page.on_change(self._update)

    async def _begin(self) -> None:
        goal = self._goal()
        if goal is None:
            return
        if goal.kind is BehaviourKind.CALIBRATE:
            await _start_calibration(self._page, goal, self._start)
        else:
            await self._page.ask(self._page.suite.start(goal), self._start)

    def _update(self, state: SuiteState) -> None:
        self._update_form(state)
        why_not = programs.cannot_start(state, self._kind)
        self._why_not.set_text(why_not)
        self._why_not.set_visibility(bool(why_not))
        self._page.allow(self._start, why_not)
        behaviour = state.behaviours.get(self._kind)
        running = behaviour is not None and behaviour.running
        self._whole_form.set_visibility(not running)
        rejected = behaviour.rejected if behaviour is not None and running else ()
        more = [f"and {len(rejected) - _REASONS} before"] if len(rejected) > _REASONS else []
        self._rejected.set_text("\n".join(["Not still enough:", *rejected[-_REASONS:], *more]))
        self._rejected.set_visibility(bool(rejected))
        ended = behaviour if behaviour is not None and not behaviour.running else None
        number = -1 if ended is None else ended.number
        if number != self._number:
            self._number, self._outcome = number, None
            self._place.clear()
        if ended is None or ended.outcome is None:
            return
        if self._outcome is None:
            with self._place:
                self._outcome = OutcomeView(self._page, self._kind, ended.outcome)
        self._outcome.update(state)


def _calibrate(page: Page) -> _Form:
    tool = _tool_select("calibrate")
    with ui.expansion("Options").classes("w-full").props("dense data-testid=calibrate-options"):
        options = CalibrationOptions("calibrate")

    def update(state: SuiteState) -> None:
        _set_tools(tool, state)
        options.update(state)

    def goal() -> Goal | None:
        if not tool.value:
            page.complain("Choose a tool, or press New tool.")
            return None
        return options.goal(str(tool.value))

    return update, goal


def _check(_page: Page) -> _Form:
    tool = _tool_select("check")

    def goal() -> Goal | None:
        return Goal(BehaviourKind.CHECK, str(tool.value or _ACTIVE))

    return lambda state: _set_tools(tool, state, _ACTIVE_TEXT), goal


def _collect(page: Page) -> _Form:
    with ui.row().classes("panel-fields"):
        tool = _tool_select("collect")
        name = ui.input("Name of the recording", validation=_name_problem)
        name.without_auto_validation().props("outlined data-testid=collect-name")
    by_hand = ui.switch("A person pushes as the page says", value=True)
    by_hand.props("data-testid=collect-by-hand")

    def goal() -> Goal | None:
        if not tool.value:
            page.complain("Choose the tool that is on.")
            return None
        if not name.validate():
            return None
        kind, chosen = BehaviourKind.COLLECT, str(tool.value)
        return Goal(kind, chosen, name=name.value or "", by_hand=bool(by_hand.value))

    return lambda state: _set_tools(tool, state), goal


_CARDS = {
    BehaviourKind.CALIBRATE: (
        "calibrate",
        "Calibrate",
        "balance",
        "The arm turns the tool through its poses and finds its mass and centre. Keep off it.",
        _calibrate,
    ),
    BehaviourKind.CHECK: (
        "check",
        "Quick check",
        "fact_check",
        "Goes to a few poses and tests whether a calibration still fits. Keep off the tool.",
        _check,
    ),
    BehaviourKind.COLLECT: (
        "collect",
        "Collect pushes",
        "touch_app",
        "Records pushes on the tool's tip, which the deflection is learned from.",
        _collect,
    ),
}


def _tool_select(name: str) -> ui.select:
    chosen = ui.select({}, label="Tool", with_input=True)
    return chosen.props(f"outlined data-testid={name}-tool").classes("panel-select")


def _set_tools(chosen: ui.select, state: SuiteState, none: str | None = None) -> None:
    """Offer the tools; at first the active one. none: the text of an entry for no name."""
    options = {} if none is None else {_ACTIVE: none}
    options |= {tool.name: tool.name for tool in state.tools or ()}
    value = chosen.value
    if value not in options:
        active_tool = state.active_tool.tool if state.active_tool else ""
        value = _ACTIVE if none is not None else active_tool if active_tool in options else None
    if options != chosen.options:
        chosen.set_options(options, value=value)
    elif value != chosen.value:
        chosen.set_value(value)


def _name_problem(name: str | None) -> str | None:
    try:
        check_tool_name(name or "", "recording")
    except GalenError as error:
        return texts.sentence(str(error))
    return None


class CalibrationOptions:
    """Fields for it; `name` begins their test ids. The owner calls `update` with the state."""

    def __init__(self, name: str) -> None:
        self._can_choose = True
        self._by_hand = ui.switch("A person takes the tool off and puts it on")
        self._by_hand.props(f"data-testid={name}-by-hand")
        self._guided = ui.switch("An operator moves the arm, by freedrive or pendant")
        self._guided.props(f"data-testid={name}-hand-guided")
        self._one_sweep = ui.switch("One sweep only, with the tool on")
        self._one_sweep.props(f"data-testid={name}-one-sweep")
        ui.label(
            "One sweep takes half the time; the weights of tool and adapter are then not fully"
            " distinguished."
        ).classes("panel-quiet")
        ui.label("Tip, from the sensor, in mm. Empty: as in the calibration file.").classes("mt-2")
        with ui.row().classes("panel-tip no-wrap"):
            self._tip = [
                ui.number(
                    axis,
                    format="%.1f",
                    min=-_FARTHEST_MM,
                    max=_FARTHEST_MM,
                    validation=_number_problem,
                ).props(f'outlined data-testid={name}-tip-{axis} aria-label="Tip {axis}, mm"')
                for axis in "xyz"
            ]

    def goal(self, tool: str) -> Goal | None:
        """Return what was chosen.

        Args:
            tool: the tool's name.

        Returns:
            The goal; None where a field shows an error.

        """
        values = [field.value for field in self._tip]
        given = [value is not None for value in values]
        if any(given):
            for field in self._tip:
                if field.value is None:
                    field.error = "all three, or none"
            if not all(given) or not all(field.validate() for field in self._tip):
                return None
        return Goal(
            BehaviourKind.CALIBRATE,
            tool,
            tip_m=tuple(1e-3 * float(value) for value in values) if all(given) else None,
            one_sweep=bool(self._one_sweep.value),
            by_hand=bool(self._by_hand.value),
            hand_guided=bool(self._guided.value),
        )

    def before(self, state: SuiteState) -> list[str]:
        """List what a person must know before the arm moves.

        Args:
            state: as for `programs.before_calibration`.

        Returns:
            Sentences, for what is chosen now.

        """
        return programs.before_calibration(
            state,
            one_sweep=bool(self._one_sweep.value),
            by_hand=bool(self._by_hand.value),
            hand_guided=bool(self._guided.value),
        )

    def update(self, state: SuiteState) -> None:
        """Choose by hand where no driver changes the tool by itself.

        One that is out of sight for a moment, on a busy machine, still does: nobody would look
        for the question to take the tool off.

        Args:
            state: with what is available, and the driver's report.

        """
        heard = state.report_of(programs.DRIVER.node) is not None
        can_choose = heard or _SERVICE in state.available
        if can_choose != self._can_choose:
            self._can_choose = can_choose
            self._by_hand.set_value(not can_choose)
            self._by_hand.set_enabled(can_choose)


async def _start_calibration(page: Page, goal: Goal, button: ui.button) -> None:
    """Start it once a person has said that the area is clear."""
    before = programs.before_calibration(
        page.suite.state,
        one_sweep=goal.one_sweep,
        by_hand=goal.by_hand,
        hand_guided=goal.hand_guided,
    )
    title = f"Calibrate {goal.tool}?"
    if not await confirmed(page, title, before, AREA_CLEAR, "play_arrow", "primary"):
        return
    why_not = programs.cannot_start(page.suite.state, BehaviourKind.CALIBRATE)
    if why_not:
        page.complain(why_not)
    else:
        await page.ask(page.suite.start(goal), button)


def _number_problem(value: float | None) -> str | None:
    if value is None or (math.isfinite(value) and abs(value) <= _FARTHEST_MM):
        return None
    return f"within ±{_FARTHEST_MM:.0f}"
