# SPDX-License-Identifier: Apache-2.0
"""The page as a whole: tabs below a header.

The header has the active tool, compensation, tare, the worst of all nodes, and what runs.
"""

from __future__ import annotations

import time
from pathlib import Path

from nicegui import ui

from galen_panel.messages import programs, texts
from galen_panel.messages.programs import compensates, overall
from galen_panel.page import behaviours, guide, live, nodes, recordings, tools
from galen_panel.page.page import LOOK_PERIOD_S, LOOKS, Page, pick_class, set_prop
from galen_panel.state.snapshot import Behaviour, BehaviourKind, LoadedTool, SuiteState

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
_ANSWER_S = 5.0
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
    """Draw the page.

    Args:
        page: the browser's, that it is drawn on.

    """
    ui.add_css(STYLE)
    ui.add_body_html(_LOST)
    ui.dark_mode(None)  # as the browser's own setting
    with ui.header().classes("panel-header"):
        with ui.row().classes("panel-bar"):
            build_compensation(page)
        with ui.row().classes("panel-second"):
            with ui.tabs().classes("panel-tabs") as tabs:
                tabs.props('align=left inline-label no-caps aria-label="Parts of the panel"')
                for name, icon in _TABS:
                    ui.tab(name, icon=icon).props(f"data-testid=tab-{name.lower()}")
            build_lamp(page)
        build_running(page)
    with ui.tab_panels(tabs, value="Operate").classes("panel-panels"):
        with ui.tab_panel("Operate"):
            guide.build(page)
            with ui.element("main").classes("panel-columns"):
                tools.build(page)
                behaviours.build(page)
        with ui.tab_panel("Live"), ui.element("main").classes("panel-wide"):
            live.build(page, lambda: tabs.value == "Live")
        with ui.tab_panel("Recordings"), ui.element("main").classes("panel-wide"):
            recordings.build(page)
        with ui.tab_panel("Nodes"), ui.element("main").classes("panel-wide"):
            nodes.build(page)
    _keep_tab(tabs)


def _keep_tab(tabs: ui.tabs) -> None:
    """Keep the chosen tab in the address, so that it lasts over a reload."""
    names = {name.lower(): name for name, _ in _TABS}

    async def restore() -> None:
        chosen = await ui.run_javascript("location.hash", timeout=_ANSWER_S)
        tabs.set_value(names.get(str(chosen).removeprefix("#"), tabs.value))

    # In the browser alone: a reload right after the click finds it there.
    keep = "(name) => history.replaceState(null, '', '#' + name.toLowerCase())"
    tabs.on("update:model-value", js_handler=keep)
    ui.timer(0.0, restore, once=True)


def build_compensation(page: Page) -> None:
    """Draw the active tool, the switch of the compensation, and tare.

    Args:
        page: the browser's, that it is drawn on.

    """
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
        page.allow(button, programs.missing(state, "gravcomp/enable"))

    page.on_change(update)
    # A node that falls silent changes nothing in the state; only time tells.
    ui.timer(LOOK_PERIOD_S, lambda: update(page.suite.state))


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
        page.allow(button, programs.missing(state, "gravcomp/tare"))

    page.on_change(update)


def _tare_text(active_tool: LoadedTool | None) -> str:
    if active_tool is None:
        return _ABSENT
    if active_tool.tare is None:
        return "Tare: none."
    force, torque = texts.norm(active_tool.tare[:3]), texts.norm(active_tool.tare[3:])
    return f"Tare: subtracts {texts.size(force, torque)}."


def build_lamp(page: Page) -> None:
    """Draw the worst report of all nodes, in plain words.

    Args:
        page: the browser's, that it is drawn on.

    """
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
    ui.timer(LOOK_PERIOD_S, look)


def build_running(page: Page) -> None:
    """Draw a strip for each behaviour that runs: how far it is, what it asks, and cancel.

    Args:
        page: the browser's, that it is drawn on.

    """
    strips: dict[int, _Strip] = {}
    with ui.column().classes("panel-strips") as place:
        place.set_visibility(False)

    def update(state: SuiteState) -> None:
        running = {b.number: b for b in state.behaviours.values() if b.running}
        for number in set(strips) - set(running):
            strips.pop(number).element.delete()
        for number, behaviour in sorted(running.items()):
            if number not in strips:
                with place:
                    strips[number] = _Strip(page, behaviour)
            strips[number].update(behaviour, state)
        place.set_visibility(bool(strips))

    page.on_change(update)


class _Strip:
    """One goal under way."""

    def __init__(self, page: Page, behaviour: Behaviour) -> None:
        self._page = page
        self._kind = behaviour.kind
        with ui.column().classes("panel-strip") as self.element:
            self.element.props(f"data-testid=running data-kind={behaviour.kind.value}")
            with ui.row().classes("panel-strip-line"):
                with ui.column().classes("gap-0 panel-strip-text").props("role=status"):
                    self._title = ui.label().classes("panel-strip-title")
                    self._message = ui.label().props("data-testid=message")
                ui.space()
                self._count = ui.label().classes("panel-number").props("data-testid=count")
                self._cancel = ui.button("Cancel", icon="stop", on_click=self._on_cancel)
                self._cancel.props("unelevated color=negative data-testid=cancel")
            self._bar = ui.linear_progress(0.0, show_value=False, size="0.75rem")
            self._bar.props('data-testid=progress aria-label="Progress"')
            self._question = ui.row().classes("panel-question").props("role=alert")
            with self._question:
                ui.icon("pan_tool").props("aria-hidden=true")
                self._asked = ui.label().props("data-testid=asked")
                self._confirm = ui.button(icon="check", on_click=self._on_confirm)
                self._confirm.props("unelevated size=lg data-testid=confirm")

    def update(self, behaviour: Behaviour, state: SuiteState) -> None:
        """Show how far it is."""
        self._title.set_text(title(behaviour))
        self._message.set_text(texts.sentence(behaviour.message))
        self._count.set_text(count(behaviour))
        self._bar.set_value(behaviour.done / behaviour.total if behaviour.total else 0.0)
        set_prop(self._bar, "aria-valuetext", self._count.text)
        self._cancel.set_text("Canceling" if behaviour.canceling else "Cancel")
        self._page.allow(self._cancel, "It is being canceled." if behaviour.canceling else "")
        self._question.set_visibility(behaviour.asked is not None and not behaviour.canceling)
        if behaviour.asked is not None:
            sentence, answer = programs.question(behaviour.asked, behaviour.tool)
            self._asked.set_text(sentence)
            self._confirm.set_text(answer)
        self._page.allow(self._confirm, programs.missing(state, "calibration/confirm"))

    async def _on_cancel(self) -> None:
        await self._page.ask(self._page.suite.cancel(self._kind), self._cancel)

    async def _on_confirm(self) -> None:
        await self._page.ask(self._page.suite.confirm(), self._confirm)


def title(behaviour: Behaviour) -> str:
    """Title a behaviour, such as "Calibration of pointer: sweep with tool".

    Args:
        behaviour: under way.

    Returns:
        Its kind, tool and phase.

    """
    text = programs.title(behaviour)
    if not behaviour.ours:
        text += " (started elsewhere)"
    return f"{text}: {behaviour.phase}" if behaviour.phase else text


def count(behaviour: Behaviour) -> str:
    """Write "12 of 112 poses".

    Args:
        behaviour: under way.

    Returns:
        The text; empty before the number is known.

    """
    units = "pushes" if behaviour.kind is BehaviourKind.COLLECT else "poses"
    return f"{behaviour.done} of {behaviour.total} {units}" if behaviour.total else ""
