"""The page as a whole: header (active tool, compensation, tare, the worst of all nodes), tabs."""

from __future__ import annotations

import time
from pathlib import Path

from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.messages.states import compensates, overall
from galen_panel.page import behaviours, live, nodes, recordings, tools, under_way
from galen_panel.page.page import LOOKS, Page, pick_class, set_prop
from galen_panel.snapshot import LoadedTool, SuiteState

STYLE = Path(__file__).with_name("panel.css")
_TABS = (
    ("Operate", "construction"),
    ("Live", "show_chart"),
    ("Recordings", "folder_open"),
    ("Nodes", "hub"),
)
_FILE_STATES = {
    "changed": "Its file has changed since: activate it again.",
    "gone": "Its file is gone.",
}
_ABSENT = "gravcomp is not running"
# A node that falls silent changes nothing in the state; only time tells.
_PERIOD_S = 1.0
# A modal dialog of the browser's own: nothing behind it takes a click or a key, which would be
# kept and sent later, and no other dialog or message lies above it. NiceGUI shows and hides its
# own note of a lost connection, a small one, which says when.
_LOST = """\
<dialog id="panel-lost" closedby="none" role="alertdialog" aria-labelledby="panel-lost-title"
  data-testid="lost">
  <h1 id="panel-lost-title">The connection to the panel is lost</h1>
  <p>Nothing shown here is current, and no button acts. The arm may be moving.</p>
  <p>The page comes back by itself when the panel answers. If it does not, start the panel again
  and open the link that it prints.</p>
</dialog>
<script>
addEventListener("DOMContentLoaded", () => {
  const note = document.getElementById("popup");
  const lost = document.getElementById("panel-lost");
  const follow = () => {
    if (note.ariaHidden === "true") lost.close();
    else if (!lost.open) lost.showModal();
  };
  new MutationObserver(follow).observe(note, { attributeFilter: ["aria-hidden"] });
  // Escape closes it where the browser does not know closedby.
  lost.addEventListener("close", follow);
});
</script>
"""


def build(page: Page) -> None:
    """Draw the page."""
    ui.add_css(STYLE)
    ui.add_body_html(_LOST)
    with ui.header().classes("panel-header"):
        with ui.row().classes("panel-bar"):
            build_compensation(page)
        with ui.row().classes("panel-second"):
            with ui.tabs().classes("panel-tabs") as tabs:
                tabs.props('align=left inline-label no-caps aria-label="Parts of the panel"')
                for name, icon in _TABS:
                    ui.tab(name, icon=icon).props(f"data-testid=tab-{name.lower()}")
            build_lamp(page)
            _dark()
        under_way.build(page)
    with ui.tab_panels(tabs, value="Operate").classes("panel-panels"):
        with ui.tab_panel("Operate"), ui.element("main").classes("panel-columns"):
            tools.build(page)
            behaviours.build(page)
        with ui.tab_panel("Live"), ui.element("main").classes("panel-wide"):
            live.build(page, lambda: tabs.value == "Live")
        with ui.tab_panel("Recordings"), ui.element("main").classes("panel-wide"):
            recordings.build(page)
        with ui.tab_panel("Nodes"), ui.element("main").classes("panel-wide"):
            nodes.build(page)


def build_compensation(page: Page) -> None:
    """Draw the active tool, the switch of the compensation, and tare."""
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
    # What is published, not what is wished.
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


def build_lamp(page: Page) -> None:
    """Draw the worst report of all nodes, in plain words."""
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


def _dark() -> None:
    """Draw the button for dark or light; at first it is as the browser's own setting."""
    dark = ui.dark_mode(None)

    async def switch() -> None:
        now = dark.value
        if now is None:
            now = await ui.run_javascript("Quasar.Dark.isActive", timeout=5.0)
        dark.set_value(not now)

    button = ui.button(icon="contrast", on_click=switch, color=None)
    button.props('flat round aria-label="Dark or light" data-testid=dark')
