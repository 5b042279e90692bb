"""How a calibration is to be done: one sweep or two, by hand or not, the tool's tip."""

from __future__ import annotations

import math

from nicegui import ui

from galen_panel.messages import hints
from galen_panel.page.page import Page, confirmed
from galen_panel.snapshot import BehaviourKind, Goal, SuiteState

AREA_CLEAR = "Area clear: calibrate"

_SERVICE = "attach_tool"
_FARTHEST_MM = 2000.0


class CalibrationOptions:
    """Fields for it; `name` begins their test ids. The owner calls `update` with the state."""

    def __init__(self, name: str) -> None:
        self._can_choose = True
        self._by_hand = ui.switch("A person takes the tool off and puts it on")
        self._by_hand.props(f"data-testid={name}-by-hand")
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
        """Return what was chosen, for a tool; None where a field is wrong, which then says so."""
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
        )

    def before(self, state: SuiteState) -> list[str]:
        """List what a person must know before the arm moves."""
        return hints.before_calibration(
            state, one_sweep=bool(self._one_sweep.value), by_hand=bool(self._by_hand.value)
        )

    def update(self, state: SuiteState) -> None:
        """Choose by hand where no driver changes the tool by itself."""
        can_choose = _SERVICE in state.available
        if can_choose != self._can_choose:
            self._can_choose = can_choose
            self._by_hand.set_value(not can_choose)
            self._by_hand.set_enabled(can_choose)


async def start_calibration(page: Page, goal: Goal, button: ui.button) -> None:
    """Start it once a person has said that the area is clear."""
    before = hints.before_calibration(
        page.suite.state, one_sweep=goal.one_sweep, by_hand=goal.by_hand
    )
    title = f"Calibrate {goal.tool}?"
    if not await confirmed(page, title, before, AREA_CLEAR, "play_arrow", "primary"):
        return
    why_not = hints.cannot_start(page.suite.state, BehaviourKind.CALIBRATE)
    if why_not:
        page.complain(why_not)
    else:
        await page.ask(page.suite.start(goal), button)


def _number_problem(value: float | None) -> str | None:
    if value is None or (math.isfinite(value) and abs(value) <= _FARTHEST_MM):
        return None
    return f"within ±{_FARTHEST_MM:.0f}"
