"""The page's header: the tool in force, compensation on or off, and tare."""

from __future__ import annotations

from nicegui import ui

from galen_panel import hints, texts
from galen_panel.page import Page
from galen_panel.sections.elements import pick_class, set_prop
from galen_panel.state import InForce, State

_FILE_STATES = {
    "changed": "Its file has changed since: put it in force again.",
    "gone": "Its file is gone.",
}
_ABSENT = "gravcomp is not running"


def build(page: Page) -> None:
    """Draw it into the header."""
    _tool_in_force(page)
    _enable(page)
    _tare(page)


def _tool_in_force(page: Page) -> None:
    with ui.column().classes("panel-in-force gap-0").props("role=status data-testid=in-force"):
        ui.label("Tool in force").classes("panel-quiet")
        name = ui.label().classes("panel-name")
        details = ui.label().classes("panel-number")

    def update(state: State) -> None:
        in_force = state.in_force
        if in_force is None:
            name.set_text("unknown")
            details.set_text(_ABSENT)
        elif not in_force.tool:
            name.set_text("no tool")
            details.set_text("Choose one below.")
        else:
            name.set_text(in_force.tool)
            changed = _FILE_STATES.get(in_force.file_state)
            details.set_text(changed or texts.mass(in_force.mass_kg))

    page.on_change(update)


def _enable(page: Page) -> None:
    async def switch() -> None:
        in_force = page.suite.state.in_force
        if in_force is not None:
            await page.ask(page.suite.set_enabled(not in_force.enabled), button)

    button = ui.button(on_click=switch, color=None).classes("panel-switch")
    button.props('unelevated no-caps role=switch data-testid=enable aria-label="Compensation"')

    def update(state: State) -> None:
        on = state.in_force is not None and state.in_force.enabled
        button.set_text(_enabled_text(state.in_force))
        button.set_icon("toggle_on" if on else "toggle_off")
        set_prop(button, "aria-checked", "true" if on else "false")
        word = "unknown" if state.in_force is None else "on" if on else "off"
        pick_class(button, "panel-switch-", word)
        page.allow(button, hints.missing(state, "gravcomp/enable"))

    page.on_change(update)


def _enabled_text(in_force: InForce | None) -> str:
    if in_force is None:
        return "Compensation: unknown"
    return "Compensation on" if in_force.enabled else "Compensation off"


def _tare(page: Page) -> None:
    async def tare() -> None:
        await page.ask(page.suite.tare(), button)

    with ui.row().classes("items-center gap-3 no-wrap"):
        button = ui.button("Tare", on_click=tare, color=None)
        button.classes("panel-tare").props("unelevated data-testid=tare")
        with ui.column().classes("gap-0"):
            ui.label("Nobody touches the tool meanwhile.").classes("panel-quiet")
            taken = ui.label().classes("panel-number").props("data-testid=tare-value")

    def update(state: State) -> None:
        taken.set_text(_tare_text(state.in_force))
        page.allow(button, hints.missing(state, "gravcomp/tare"))

    page.on_change(update)


def _tare_text(in_force: InForce | None) -> str:
    if in_force is None:
        return _ABSENT
    if in_force.tare is None:
        return "Takes nothing off now."
    force, torque = texts.norm(in_force.tare[:3]), texts.norm(in_force.tare[3:])
    return f"Takes off {texts.size(force, torque)} now."
