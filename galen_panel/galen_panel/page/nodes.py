# SPDX-License-Identifier: Apache-2.0
"""Each node of the suite: what it is doing, what to do about it, and its numbers."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from nicegui import ui

from galen_panel.messages.programs import PROGRAMS, Words, others, words_of, words_of_other
from galen_panel.page.page import LOOKS, Page
from galen_panel.state.snapshot import NodeLevel

# Nodes tell their state once a second; one that falls silent is seen by time alone.
_PERIOD_S = 1.0
_STYLE = Path(__file__).with_suffix(".css")
_WORDS = {
    NodeLevel.OK: "OK",
    NodeLevel.WARN: "Look at it",
    NodeLevel.ERROR: "Trouble",
    NodeLevel.STALE: "Silent",
}
_LAMPS = {level: (*LOOKS[level], word) for level, word in _WORDS.items()}
_NOT_RUNNING = ("power_settings_new", "panel-quiet", "Not running")
_COLOURS = " ".join({colour for _, colour, _ in (*_LAMPS.values(), _NOT_RUNNING)})


def build(page: Page) -> None:
    """Draw a card for each program, and one for each other node that reports its state.

    Args:
        page: the browser's, that it is drawn on.

    """
    ui.add_css(_STYLE)
    ui.label("What each node is doing").classes("text-h5")
    with ui.element("div").classes("panel-columns"):
        cards = {one.node: _Card(one.node, one.title, one.purpose) for one in PROGRAMS}
    rest = ui.element("div").classes("panel-columns")
    other_cards: dict[str, _Card] = {}

    def look() -> None:
        state, now_s = page.suite.state, time.monotonic()
        for program in PROGRAMS:
            report = state.report_of(program.node)
            words = words_of(state, program, now_s)
            cards[program.node].show(words, {} if report is None else report.values)
        reports = others(state)
        if [report.name for report in reports] != list(other_cards):
            rest.clear()
            other_cards.clear()
            with rest:
                other_cards.update((one.name, _Card(one.name, one.name, "")) for one in reports)
        for report in reports:
            other_cards[report.name].show(words_of_other(report, now_s), report.values)

    look()
    ui.timer(_PERIOD_S, look)


class _Card:
    """One node's."""

    def __init__(self, name: str, title: str, purpose: str) -> None:
        testid = name.replace("/", "-")
        with ui.card().classes("panel-node gap-2"):
            with ui.row().classes("items-center no-wrap gap-3"):
                self._icon = ui.icon("help", size="2rem").props("aria-hidden=true")
                with ui.column().classes("gap-0"):
                    heading = ui.label(title).classes("text-h6")
                    heading.props("role=heading aria-level=3")
                    if purpose:
                        ui.label(purpose).classes("panel-quiet")
            with ui.column().classes("gap-1").props("role=status") as status:
                status.props["data-testid"] = f"node-{testid}"
                self._doing = ui.label().classes("panel-doing")
                self._todo = ui.label().classes("panel-todo")
            self._said = ui.label().classes("panel-quiet panel-words")
            with ui.expansion("Values", on_value_change=self._fill).classes("w-full") as more:
                more.props["data-testid"] = f"node-{testid}-values"
                self._values = ui.label().classes("panel-values")
        self._more = more
        self._status = status
        self._last: Mapping[str, str] = {}

    def show(self, words: Words, values: Mapping[str, str]) -> None:
        """Set what differs."""
        off = not words.running and words.level is NodeLevel.OK
        icon, colour, word = _NOT_RUNNING if off else _LAMPS[words.level]
        self._icon.set_name(icon)
        self._icon.classes(add=colour, remove=_COLOURS.replace(colour, ""))
        if self._status.props.get("data-level") != words.level.name.lower():
            self._status.props["data-level"] = words.level.name.lower()
        self._doing.set_text(f"{word}. {words.doing}" if words.running else words.doing)
        self._todo.set_text(words.todo)
        self._todo.set_visibility(bool(words.todo))
        said = f"It says: {words.said}" if words.said else ""
        self._said.set_text(said)
        self._said.set_visibility(bool(said))
        self._last = values if words.running else {}
        self._more.set_visibility(bool(self._last))
        self._fill()

    def _fill(self) -> None:
        """Write the values only while they are seen: there are many, and they never rest."""
        if self._more.value:
            self._values.set_text("\n".join(f"{key}: {text}" for key, text in self._last.items()))
