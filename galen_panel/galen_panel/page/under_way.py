"""A strip for each behaviour that runs, on every tab: how far it is, what it asks, and cancel."""

from __future__ import annotations

import math
import time
from collections import deque
from statistics import median

from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.page.page import Page, set_prop
from galen_panel.snapshot import Asked, Behaviour, BehaviourKind, SuiteState

_UNITS = {
    BehaviourKind.CALIBRATE: "poses",
    BehaviourKind.CHECK: "poses",
    BehaviourKind.COLLECT: "pushes",
}


def build(page: Page) -> None:
    """Draw it; there is nothing of it while nothing runs."""
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
        self._pace = Pace()
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
        self._count.set_text(
            count(behaviour, self._pace.left_s(behaviour.done, behaviour.total, time.monotonic()))
        )
        self._bar.set_value(behaviour.done / behaviour.total if behaviour.total else 0.0)
        set_prop(self._bar, "aria-valuetext", self._count.text)
        self._cancel.set_text("Canceling" if behaviour.canceling else "Cancel")
        self._page.allow(self._cancel, "It is being canceled." if behaviour.canceling else "")
        self._question.set_visibility(behaviour.asked is not None and not behaviour.canceling)
        if behaviour.asked is not None:
            sentence, answer = question(behaviour.asked, behaviour.tool)
            self._asked.set_text(sentence)
            self._confirm.set_text(answer)
        self._page.allow(self._confirm, hints.missing(state, "calibration/confirm"))

    async def _on_cancel(self) -> None:
        await self._page.ask(self._page.suite.cancel(self._kind), self._cancel)

    async def _on_confirm(self) -> None:
        await self._page.ask(self._page.suite.confirm(), self._confirm)


def title(behaviour: Behaviour) -> str:
    """Title a behaviour, such as "Calibration of pointer: sweep with tool"."""
    text = hints.title(behaviour)
    if not behaviour.ours:
        text += " (started elsewhere)"
    return f"{text}: {behaviour.phase}" if behaviour.phase else text


def count(behaviour: Behaviour, left_s: float) -> str:
    """Write "12 of 112 poses, about 3 min left"; empty before the number is known."""
    if not behaviour.total:
        return ""
    text = f"{behaviour.done} of {behaviour.total} {_UNITS[behaviour.kind]}"
    return text if math.isnan(left_s) else f"{text}, about {texts.duration(left_s)} left"


def question(asked: Asked, tool: str) -> tuple[str, str]:
    """Return what a person is asked to do, and the answer's button."""
    if asked is Asked.REMOVE_TOOL:
        return "Take the tool off, then press.", "The tool is off"
    return f"Put {tool or 'the tool'} on, then press.", "The tool is on"


_LAST = 16
_ENOUGH = 3


class Pace:
    """Follows one goal's count, by the median of its last steps: a person's pause is none."""

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=_LAST)
        self._done: int | None = None
        self._at_s = 0.0

    def left_s(self, done: int, total: int, now_s: float) -> float:
        """Return the seconds left, NaN while unknown. now_s: of a monotonic clock."""
        if self._done is None or done < self._done:
            self._steps.clear()
            self._done, self._at_s = done, now_s
        elif done > self._done:
            step = (now_s - self._at_s) / (done - self._done)
            self._steps.extend([step] * (done - self._done))
            self._done, self._at_s = done, now_s
        if len(self._steps) < _ENOUGH:
            return math.nan
        return max(0.0, (total - done) * median(self._steps) - (now_s - self._at_s))
