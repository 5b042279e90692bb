# SPDX-License-Identifier: Apache-2.0
"""The tools: a button for each one, which activates it."""

from __future__ import annotations

from galen_model.errors import GalenError
from galen_model.files.calibration_file import check_tool_name
from nicegui import ui

from galen_panel.messages import programs, texts
from galen_panel.page.behaviours import AREA_CLEAR, CalibrationOptions
from galen_panel.page.outcome import draw_comparison
from galen_panel.page.page import (
    LOOK_PERIOD_S,
    Page,
    buttons,
    confirmed,
    dialog,
    heading,
    pick_class,
    set_prop,
)
from galen_panel.state.snapshot import BehaviourKind, CallAnswer, ListedTool, LoadedTool, SuiteState


def build(page: Page) -> None:
    """Draw the tools.

    Args:
        page: the browser's, that it is drawn on.

    """
    with ui.element("section").classes("panel-section").props("aria-label=Tools"):
        _Tools(page)


class _Tools:
    """One browser's list."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._rows: dict[str, _Row] = {}
        with ui.row().classes("panel-head"):
            heading("Tools")
            ui.space()
            self._new = ui.button("New tool", icon="add", on_click=self._new_tool)
            self._new.props("outline data-testid=new-tool")
        self._note = ui.label().classes("panel-note").props("role=status data-testid=tools-note")
        self._none = ui.button("No tool", icon="block", on_click=self._put_none, color=None)
        self._none.props("flat align=left data-testid=no-tool").classes("panel-tool panel-none")
        self._list_of_rows = ui.column().classes("panel-tools").props("role=list")
        page.on_change(lambda _state: self._draw())

    async def _new_tool(self) -> None:
        await new_tool(self._page)

    async def _put_none(self) -> None:
        await self._page.ask(self._page.suite.activate(""), self._none)

    def _draw(self) -> None:
        state = self._page.suite.state
        tools = state.tools or ()
        # The active one goes first.
        found = sorted(tools, key=lambda tool: not tool.active_tool)
        self._note.set_text(_note(state))
        self._note.set_visibility(bool(self._note.text))
        none = state.active_tool is not None and not state.active_tool.tool
        pick_class(self._none, "panel-tool-", "active" if none else "other")
        set_prop(self._none, "aria-pressed", "true" if none else "false")
        self._none.set_text("No tool (active)" if none else "No tool")
        set_tool = programs.missing(state, "gravcomp/set_tool")
        self._page.allow(self._none, set_tool)
        self._page.allow(self._new, programs.missing(state, "calibrate_tool"))
        self._place(found)
        for tool in found:
            self._rows[tool.name].update(tool, state, set_tool)

    def _place(self, tools: list[ListedTool]) -> None:
        """Rows for these tools in this order; those that stay are kept, and their focus with it."""
        names = [tool.name for tool in tools]
        if list(self._rows) == names:
            return
        for name in set(self._rows) - set(names):
            self._rows.pop(name).element.delete()
        rows = {}
        for index, name in enumerate(names):
            if name not in self._rows:
                with self._list_of_rows:
                    self._rows[name] = _Row(self._page, name)
            row = rows[name] = self._rows[name]
            if self._list_of_rows.default_slot.children[index] is not row.element:
                row.element.move(self._list_of_rows, index)
        self._rows = rows


class _Row:
    """One tool: what it weighs, the button that activates it, and what else can be done."""

    def __init__(self, page: Page, name: str) -> None:
        self._page = page
        self._name = name
        with ui.row().classes("panel-tool-row").props("role=listitem") as self.element:
            self._button = ui.button(on_click=self._activate, color=None).classes("panel-tool")
            self._button.props("flat align=left")
            self._button.props["data-testid"] = f"tool-{name}"
            with self._button, ui.column().classes("panel-tool-text"):
                with ui.row().classes("panel-tool-line"):
                    ui.label(name).classes("panel-tool-name")
                    self._mark = ui.row().classes("panel-mark")
                    with self._mark:
                        ui.icon("check_circle").props("aria-hidden=true")
                        ui.label("active")
                    self._not_active = ui.label("not active yet").classes("text-warning panel-lead")
                    ui.space()
                    self._mass = ui.label().classes("panel-number panel-tool-mass")
                self._centre = ui.label().classes("panel-number")
                self._residual = ui.label().classes("panel-number")
                self._made = ui.label().classes("panel-quiet")
                self._problem = ui.label().classes("text-negative")
                self._compensated = ui.label().classes("panel-lead")
            self._revert = ui.button(icon="history", on_click=self._revert_tool)
            self._revert.props("flat round")
            set_prop(self._revert, "aria-label", f"Go back to the calibration of {name} before")
            self._revert.props["data-testid"] = f"tool-{name}-revert"
            self._remove = ui.button(icon="delete_outline", on_click=self._remove_tool)
            self._remove.props("flat round")
            set_prop(self._remove, "aria-label", f"Remove {name}")
            self._remove.props["data-testid"] = f"tool-{name}-remove"

    def update(self, tool: ListedTool, state: SuiteState, set_tool: str) -> None:
        """Show it as it is now. set_tool: why none can be activated, or empty."""
        compensated = _compensated_instead(tool, state.active_tool)
        active = tool.active_tool and not compensated
        self._mark.set_visibility(active)
        self._not_active.set_visibility(bool(compensated))
        self._compensated.set_text(compensated)
        self._compensated.set_visibility(bool(compensated))
        pick_class(self._button, "panel-tool-", "active" if active else "other")
        set_prop(self._button, "aria-pressed", "true" if active else "false")
        self._problem.set_text(f"Can't be used: {tool.problem}")
        self._problem.set_visibility(bool(tool.problem))
        for label in (self._mass, self._centre, self._residual, self._made):
            label.set_visibility(not tool.problem)
        self._mass.set_text(texts.mass(tool.mass_kg, tool.mass_std_kg))
        self._centre.set_text(f"Centre {texts.centre(tool.com_m)}")
        force, torque = texts.norm(tool.rmse_force_n), texts.norm(tool.rmse_torque_nm)
        self._residual.set_text(f"Residual {texts.size(force, torque)}")
        self._made.set_text(_made(tool))
        # Its place stays, so that the buttons of all rows stand below each other.
        self._revert.classes(
            add="" if tool.has_previous else "invisible",
            remove="invisible" if tool.has_previous else "",
        )
        self._page.allow(self._button, "Its file can't be used." if tool.problem else set_tool)
        self._page.allow(self._revert, programs.missing(state, "gravcomp/revert_tool"))
        active_tool = "It is active: activate another one first." if tool.active_tool else ""
        missing = programs.missing(state, "gravcomp/remove_tool")
        self._page.allow(self._remove, missing or active_tool)

    async def _activate(self) -> None:
        await self._page.ask(self._page.suite.activate(self._name), self._button)

    async def _revert_tool(self) -> None:
        await _revert_tool(self._page, self._name, self._revert)

    async def _remove_tool(self) -> None:
        await _remove_tool(self._page, self._name, self._remove)


def _compensated_instead(tool: ListedTool, loaded: LoadedTool | None) -> str:
    """Say what is compensated where the active tool's file is another one by now; else empty."""
    if not tool.active_tool or loaded is None:
        return ""
    if loaded.file_state == "as loaded" and loaded.calibrated_at == tool.calibrated_at:
        return ""
    now = f"Compensated now: {texts.mass(loaded.mass_kg)}"
    if loaded.calibrated_at:
        now += f", calibrated {texts.date(loaded.calibrated_at)}"
    return f"{now}." if tool.problem else f"{now}. Press to load this file."


def _made(tool: ListedTool) -> str:
    parts = [f"Calibrated {texts.date(tool.calibrated_at)}"]
    if tool.poses_used:
        parts.append(texts.count(tool.poses_used, "pose"))
    if tool.parts:
        parts.append("with " + ", ".join(tool.parts))
    return " · ".join(parts)


def _note(state: SuiteState) -> str:
    """Say what is wrong with the list as a whole; empty where nothing is."""
    missing = programs.missing(state, "gravcomp/list_tools")
    if missing:
        return missing if state.tools is None else f"The list may be old: {missing}"
    if state.tools_problem:
        return texts.sentence(state.tools_problem)
    if state.tools is None:
        return "Reading the list."
    if not state.tools:
        return f"There is no tool in {state.tools_dir} yet. New tool calibrates one."
    return ""


async def _remove_tool(page: Page, name: str, button: ui.button) -> None:
    """Remove it, once a person has read what becomes of its file."""
    sure = await confirmed(
        page,
        f"Remove {name}?",
        [
            "Its file is not deleted: it is kept beside the others, under another name.",
            "The active tool can't be removed.",
        ],
        "Remove it",
        "delete_outline",
    )
    if sure:
        await page.ask(page.suite.remove_tool(name), button)


async def _revert_tool(page: Page, name: str, button: ui.button) -> None:
    """Bring back the calibration before, once a person has read what that changes."""
    with page.waiting(button) as free:
        if not free:
            return
        found = await page.suite.compare(name)
    if isinstance(found, CallAnswer):
        page.tell(found)
        return
    with dialog(page, f"Go back to the calibration of {name} before?") as shown:
        ui.label("The present calibration is kept: going back once more brings it again.")
        ui.label("If the tool is active, activate it again afterwards.")
        draw_comparison(found, "before", "now")
        buttons(shown, "Go back", "history").on_click(lambda: shown.submit(True))
        sure = bool(await shown)
    if sure:
        await page.ask(page.suite.revert_tool(name), button)


async def new_tool(page: Page) -> None:
    """Ask for a name and a tip, and start the calibration.

    Args:
        page: the browser's, that the dialog is drawn on.

    """
    with dialog(page, "New tool") as shown:
        name = ui.input("Name", validation=lambda text: _name_problem(page, text or "") or None)
        name.props("outlined autofocus data-testid=new-tool-name").classes("w-full")
        name.without_auto_validation()
        options = CalibrationOptions("new-tool")
        before = ui.label().props("data-testid=new-tool-before")

        def look() -> None:
            options.update(page.suite.state)
            before.set_text(" ".join(options.before(page.suite.state)))

        look()
        ui.timer(LOOK_PERIOD_S, look)
        reason = ui.label().classes("text-negative").props("role=status")
        start = buttons(shown, AREA_CLEAR, "play_arrow")

        async def begin() -> None:
            goal = options.goal(name.value or "") if name.validate() else None
            if goal is None:
                return
            why_not = programs.cannot_start(page.suite.state, BehaviourKind.CALIBRATE)
            reason.set_text(why_not)
            if not why_not and (await page.ask(page.suite.start(goal), start)).ok:
                shown.submit(True)

        start.on_click(begin)
        name.on("keydown.enter", begin)
        await shown


def _name_problem(page: Page, name: str) -> str:
    """Why a new tool can't be called so; empty where it can."""
    try:
        check_tool_name(name)
    except GalenError as error:
        return texts.sentence(str(error))
    if any(tool.name == name for tool in page.suite.state.tools or ()):
        return "There is a tool of this name. Choose another one, or calibrate that tool again."
    return ""
