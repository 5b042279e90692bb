"""The lamp: the worst thing that an operator must know of the suite, in words, on every tab."""

from __future__ import annotations

import time

from nicegui import ui

from galen_panel.messages.states import overall
from galen_panel.page.elements import LOOKS, pick_class, set_prop
from galen_panel.page.page import Page

# Nodes that fall silent change nothing in the state; only time tells.
_PERIOD_S = 1.0


def build(page: Page) -> None:
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
