# SPDX-License-Identifier: Apache-2.0
"""The guided calibration: what is done, what is missing, and the button of the next step."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable

from nicegui import ui

from galen_panel.messages import programs
from galen_panel.messages.steps import Step, current, steps
from galen_panel.page.page import Page, confirmed, pick_class
from galen_panel.page.tools import new_tool
from galen_panel.state.snapshot import BehaviourKind, CallAnswer, Goal, SuiteState

_PERIOD_S = 1.0
_NUMBER = 5
_ICONS = {"done": "check_circle", "now": "arrow_circle_right", "later": "radio_button_unchecked"}
_BUTTONS = {"Calibrate": "Calibrate a tool", "Verify": "Check the tool", "Use": "Switch it on"}


def build(page: Page) -> None:
    """Draw the guide; it is open until a wrench was compensated once, then folds by itself.

    Args:
        page: the browser's, that it is drawn on.

    """
    with ui.element("section").classes("panel-section").props("aria-label=Guide"):
        _Guide(page)


class _Guide:
    def __init__(self, page: Page) -> None:
        self._page = page
        self._folded = False
        self._seen: tuple[tuple[Step, ...], int] | None = None
        with ui.expansion("Guide", icon="route", value=True) as self._whole:
            self._whole.classes("w-full panel-guide").props("data-testid=guide")
            with ui.column().classes("w-full").props("role=list"):
                self._rows = [_Row(number, self._act) for number in range(_NUMBER)]
        page.on_change(lambda _state: self._update())
        ui.timer(_PERIOD_S, self._update)

    def _update(self) -> None:
        state = self._page.suite.state
        found = steps(state, time.monotonic())
        now = current(found)
        if (found, now) != self._seen:
            self._seen = found, now
            for number, (row, step) in enumerate(zip(self._rows, found, strict=True)):
                row.show(step, number, number == now)
            done = sum(step.done for step in found)
            self._whole.set_text(f"Guide: {done} of {_NUMBER} steps done")
        if found[-1].done and not self._folded:
            self._folded = True
            self._whole.set_value(False)
        for row, step in zip(self._rows, found, strict=True):
            self._page.allow(row.button, _why_not(state, step))

    async def _act(self, name: str, button: ui.button) -> None:
        page = self._page
        tool = _tool(page.suite.state)
        if name == "Calibrate":
            await new_tool(page)
        elif name == "Verify":
            if await confirmed(
                page, f"Check {tool}?", _CHECK, _CHECK_CLEAR, "play_arrow", "primary"
            ):
                await page.ask(page.suite.start(Goal(BehaviourKind.CHECK, tool)), button)
        else:
            await page.ask(_switch_on(page, tool), button)


_CHECK_CLEAR = "Area clear: check"
_CHECK = [
    "The arm moves to a few poses near the present one, with the tool on.",
    "Look whether the area around the arm is clear. Keep off the tool until it has ended.",
]


def _tool(state: SuiteState) -> str:
    """Return the active tool, or the one calibrated last, or any that can be used."""
    usable = [tool.name for tool in state.tools or () if not tool.problem]
    behaviour = state.behaviours.get(BehaviourKind.CALIBRATE)
    active = "" if state.active_tool is None else state.active_tool.tool
    last = "" if behaviour is None else behaviour.tool
    return next((name for name in (active, last, *usable) if name in usable), "")


def _switch_on(page: Page, tool: str) -> Awaitable[CallAnswer]:
    active = page.suite.state.active_tool
    if active is not None and active.tool and not active.enabled:
        return page.suite.set_enabled(True)
    return page.suite.activate(tool)


def _why_not(state: SuiteState, step: Step) -> str:
    if step.name == "Calibrate":
        return programs.cannot_start(state, BehaviourKind.CALIBRATE)
    if step.name == "Verify":
        return programs.cannot_start(state, BehaviourKind.CHECK)
    if not _tool(state):
        return "Calibrate a tool first."
    return programs.missing(state, "gravcomp/set_tool")


class _Row:
    """One step; its button is there while it is the next one and a button does it."""

    def __init__(self, number: int, act: Callable[[str, ui.button], Awaitable[None]]) -> None:
        self._name = ""
        with ui.row().classes("panel-guide-row").props("role=listitem") as self._whole:
            self._whole.props(f"data-testid=step-{number + 1}")
            self._icon = ui.icon("radio_button_unchecked").props("aria-hidden=true")
            with ui.column().classes("gap-0 panel-guide-text"):
                self._title = ui.label().classes("panel-lead")
                self._doing = ui.label()
                self._todo = ui.label().classes("panel-lines panel-path")
            self.button: ui.button = ui.button()
            self.button.on_click(lambda: act(self._name, self.button))
            self.button.props(f"unelevated data-testid=step-{number + 1}-go")

    def show(self, step: Step, number: int, now: bool) -> None:
        """Show it; now: whether it is the next one."""
        self._name = step.name
        word = "done" if step.done else "now" if now else "later"
        self._icon.set_name(_ICONS[word])
        pick_class(self._whole, "panel-guide-", word)
        self._title.set_text(f"{number + 1}. {step.name}{', done' if step.done else ''}")
        self._doing.set_text(step.doing)
        self._todo.set_text(step.todo)
        self._todo.set_visibility(now and bool(step.todo))
        self.button.set_text(_BUTTONS.get(step.name, ""))
        self.button.set_visibility(now and step.name in _BUTTONS)
