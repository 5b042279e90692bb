"""The page's header: the active tool, compensation on or off, tare, and the worst of all nodes."""

from __future__ import annotations

import time

from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.messages.states import compensates, overall
from galen_panel.page.elements import LOOKS, pick_class, set_prop
from galen_panel.page.page import Page
from galen_panel.snapshot import LoadedTool, SuiteState

_FILE_STATES = {
    "changed": "Its file has changed since: activate it again.",
    "gone": "Its file is gone.",
}
_ABSENT = "gravcomp is not running"
# A gravcomp that falls silent changes nothing in the state; only time tells.
_PERIOD_S = 1.0


def build_compensation(page: Page) -> None:
    """Draw it into the header."""
    _active_tool(page)
    _enable(page)
    _tare(page)


def _active_tool(page: Page) -> None:
    with ui.column().classes("panel-active gap-0").props("role=status data-testid=active"):
        ui.label("Active tool").classes("panel-quiet")
        name = ui.label().classes("panel-name")
        details = ui.label().classes("panel-number")

    def update(state: SuiteState) -> None:
        active_tool = state.active_tool
        if active_tool is None:
            name.set_text("unknown")
            details.set_text(_ABSENT)
        elif not active_tool.tool:
            name.set_text("no tool")
            details.set_text("Choose one below.")
        else:
            name.set_text(active_tool.tool)
            changed = _FILE_STATES.get(active_tool.file_state)
            details.set_text(changed or texts.mass(active_tool.mass_kg))

    page.on_change(update)


def _enable(page: Page) -> None:
    async def switch() -> None:
        active_tool = page.suite.state.active_tool
        if active_tool is not None:
            await page.ask(page.suite.set_enabled(not active_tool.enabled), button)

    button = ui.button(on_click=switch, color=None).classes("panel-switch")
    button.props('unelevated no-caps role=switch data-testid=enable aria-label="Compensation"')

    def update(state: SuiteState) -> None:
        switched_on = state.active_tool is not None and state.active_tool.enabled
        text, word = _shown(state)
        button.set_text(text)
        button.set_icon("toggle_on" if switched_on else "toggle_off")
        set_prop(button, "aria-checked", "true" if switched_on else "false")
        pick_class(button, "panel-switch-", word)
        page.allow(button, hints.missing(state, "gravcomp/enable"))

    page.on_change(update)
    ui.timer(_PERIOD_S, lambda: update(page.suite.state))


def _shown(state: SuiteState) -> tuple[str, str]:
    """The switch's text and look: what is published, not what is wished."""
    if state.active_tool is None:
        return "Compensation: unknown", "unknown"
    if not state.active_tool.enabled:
        return "Compensation off", "off"
    if compensates(state, time.monotonic()):
        return "Compensation on", "on"
    return "No compensation (switched on)", "off"


def _tare(page: Page) -> None:
    async def tare() -> None:
        await page.ask(page.suite.tare(), button)

    with ui.row().classes("items-center gap-3 no-wrap"):
        button = ui.button("Tare", on_click=tare, color=None)
        button.classes("panel-tare").props("unelevated data-testid=tare")
        with ui.column().classes("gap-0"):
            ui.label("No contact with the tool meanwhile.").classes("panel-quiet")
            taken = ui.label().classes("panel-number").props("data-testid=tare-value")

    def update(state: SuiteState) -> None:
        taken.set_text(_tare_text(state.active_tool))
        page.allow(button, hints.missing(state, "gravcomp/tare"))

    page.on_change(update)


def _tare_text(active_tool: LoadedTool | None) -> str:
    if active_tool is None:
        return _ABSENT
    if active_tool.tare is None:
        return "Tare: none."
    force, torque = texts.norm(active_tool.tare[:3]), texts.norm(active_tool.tare[3:])
    return f"Tare: subtracts {texts.size(force, torque)}."


# Nodes that fall silent change nothing in the state; only time tells.
_PERIOD_S = 1.0


def build_lamp(page: Page) -> None:
    """Draw it."""
    with ui.row().classes("panel-lamp") as lamp:
        lamp.props("role=status aria-live=polite data-testid=lamp")
        icon = ui.icon("help").props("aria-hidden=true")
        text = ui.label()

    def look() -> None:
        level, sentence = overall(page.suite.state, time.monotonic())
        word = level.name.lower()
        icon.set_name(LOOKS[level][0])
        text.set_text(sentence)
        pick_class(lamp, "panel-lamp-", word)
        set_prop(lamp, "data-level", word)

    page.on_change(lambda _state: look())
    ui.timer(_PERIOD_S, look)
