"""The behaviours: a card each, to start one, to follow its poses, and to see how it ended."""

from __future__ import annotations

from galen_model.errors import GalenError
from galen_model.files.calibration_file import check_tool_name
from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.page.calibration_options import CalibrationOptions, start_calibration
from galen_panel.page.elements import heading
from galen_panel.page.outcome import OutcomeView
from galen_panel.page.page import Page
from galen_panel.page.poses import PosesView
from galen_panel.snapshot import (
    BehaviourKind,
    CalibrateGoal,
    CheckGoal,
    CollectGoal,
    Goal,
    SuiteState,
)

_ACTIVE = ""
_ACTIVE_TEXT = "the active one"


def build(page: Page) -> None:
    """Draw it."""
    with ui.element("section").classes("panel-section").props("aria-label=Behaviours"):
        with ui.row().classes("panel-head"):
            heading("Behaviours")
        _Calibrate(page)
        _Check(page)
        _Collect(page)


class _Card:
    """What the three have in common: title, fields, start; then poses; then the outcome."""

    kind: BehaviourKind
    name: str
    title: str
    icon: str
    purpose: str
    start_text: str

    def __init__(self, page: Page) -> None:
        self.page = page
        self._poses: PosesView | None = None
        self._outcome: OutcomeView | None = None
        self._number = -1
        with ui.card().classes("panel-card") as card:
            card.props(f"flat bordered data-testid=card-{self.name}")
            with ui.row().classes("panel-card-head"):
                ui.icon(self.icon).props("aria-hidden=true")
                heading(self.title, 3)
            self._place = ui.column().classes("panel-run")
            self._form = ui.column().classes("panel-form")
            with self._form:
                ui.label(self.purpose)
                self.draw_fields()
                self._start = ui.button(self.start_text, icon="play_arrow", on_click=self._begin)
                self._start.props(f"unelevated data-testid={self.name}")
                self._why_not = ui.label().classes("panel-note").props("role=status")
        page.on_change(self._update)

    def draw_fields(self) -> None:
        """Draw what is to be chosen."""
        raise NotImplementedError

    def update_fields(self, state: SuiteState) -> None:
        """Follow the state with it."""
        raise NotImplementedError

    def goal(self) -> Goal | None:
        """What was chosen, or None where a field is wrong, which then says so."""
        raise NotImplementedError

    async def _begin(self) -> None:
        goal = self.goal()
        if isinstance(goal, CalibrateGoal):
            await start_calibration(self.page, goal, self._start)
        elif goal is not None:
            await self.page.ask(self.page.suite.start(goal), self._start)

    def _update(self, state: SuiteState) -> None:
        self.update_fields(state)
        why_not = hints.cannot_start(state, self.kind)
        self._why_not.set_text(why_not)
        self._why_not.set_visibility(bool(why_not))
        self.page.allow(self._start, why_not)
        behaviour = state.behaviours.get(self.kind)
        number = -1 if behaviour is None else behaviour.number
        if number != self._number:
            self._number = number
            self._poses = self._outcome = None
            self._place.clear()
        self._form.set_visibility(behaviour is None or not behaviour.running)
        self._place.set_visibility(behaviour is not None)
        if behaviour is None:
            return
        if behaviour.outcome is None:
            if self._poses is None:
                with self._place:
                    self._poses = PosesView(behaviour)
            self._poses.update(behaviour)
            return
        if self._outcome is None:
            self._place.clear()
            with self._place:
                self._outcome = OutcomeView(self.page, self.kind, behaviour.outcome)
        self._outcome.update(state)


class _Calibrate(_Card):
    kind = BehaviourKind.CALIBRATE
    name = "calibrate"
    title = "Calibrate"
    icon = "balance"
    purpose = "The arm turns the tool through its poses and finds its mass and centre. Keep off it."
    start_text = "Calibrate"

    def draw_fields(self) -> None:
        self._tool = _tool_select("Tool", self.name)
        with ui.expansion("Options").classes("w-full").props("dense data-testid=calibrate-options"):
            self._options = CalibrationOptions(self.name)

    def update_fields(self, state: SuiteState) -> None:
        _set_tools(self._tool, state, None)
        self._options.update(state)

    def goal(self) -> Goal | None:
        if not self._tool.value:
            self.page.complain("Choose a tool, or press New tool.")
            return None
        return self._options.goal(str(self._tool.value))


class _Check(_Card):
    kind = BehaviourKind.CHECK
    name = "check"
    title = "Quick check"
    icon = "fact_check"
    purpose = "Goes to a few poses and says whether a calibration still fits. Keep off the tool."
    start_text = "Check"

    def draw_fields(self) -> None:
        self._tool = _tool_select("Tool", self.name)

    def update_fields(self, state: SuiteState) -> None:
        _set_tools(self._tool, state, _ACTIVE_TEXT)

    def goal(self) -> Goal | None:
        tool = str(self._tool.value or _ACTIVE)
        why_not = hints.cannot_check(self.page.suite.state, tool)
        if why_not:
            self.page.complain(why_not)
            return None
        return CheckGoal(tool)


class _Collect(_Card):
    kind = BehaviourKind.COLLECT
    name = "collect"
    title = "Collect pushes"
    icon = "touch_app"
    purpose = "Records pushes on the tool's tip, which the deflection is learned from."
    start_text = "Collect"

    def draw_fields(self) -> None:
        with ui.row().classes("panel-fields"):
            self._tool = _tool_select("Tool", self.name)
            self._name = ui.input("Name of the recording", validation=_name_problem)
            self._name.without_auto_validation()
            self._name.props("outlined data-testid=collect-name")
        self._by_hand = ui.switch("A person pushes as the page says", value=True)
        self._by_hand.props("data-testid=collect-by-hand")

    def update_fields(self, state: SuiteState) -> None:
        _set_tools(self._tool, state, None)

    def goal(self) -> Goal | None:
        if not self._tool.value:
            self.page.complain("Choose the tool that is on.")
            return None
        if not self._name.validate():
            return None
        by_hand = bool(self._by_hand.value)
        return CollectGoal(self._name.value or "", str(self._tool.value), by_hand)


def _tool_select(label: str, name: str) -> ui.select:
    chosen = ui.select({}, label=label, with_input=True)
    return chosen.props(f"outlined data-testid={name}-tool").classes("panel-select")


def _set_tools(chosen: ui.select, state: SuiteState, none: str | None) -> None:
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
