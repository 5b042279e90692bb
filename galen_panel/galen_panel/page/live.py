"""What the sensor and the arm do now: plots, and the arm in three dimensions.

The streams are listened to only while a page shows them: the tab is open and the browser is there.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from nicegui import ui

from galen_panel.page.arm import ArmView
from galen_panel.page.page import Page
from galen_panel.page.plots import Plots

PLOT_PERIOD_S = 0.2
ARM_PERIOD_S = 0.1
_LOOK_PERIOD_S = 0.2
_STYLE = Path(__file__).with_suffix(".css")
_SCRIPT = Path(__file__).with_suffix(".js")


def build(page: Page, shown: Callable[[], bool]) -> None:
    """Draw it; `shown` says whether its tab is open."""
    ui.add_css(_STYLE)
    ui.add_head_html(f"<script>{_SCRIPT.read_text()}</script>")
    client = ui.context.client
    listening: list[ExitStack] = []
    with ui.element("div").classes("live-columns"):
        with ui.element("section").classes("live-left").props('aria-label="Plots"'):
            plots = Plots(page)
        with ui.element("section").classes("live-right").props('aria-label="Arm"'):
            arm = ArmView(page)
    timers = (
        ui.timer(PLOT_PERIOD_S, plots.update, active=False),
        ui.timer(ARM_PERIOD_S, arm.update, active=False),
    )

    def leave() -> None:
        while listening:
            listening.pop().close()

    def look() -> None:
        seen = shown() and client.has_socket_connection
        if seen == bool(listening):
            return
        if seen:
            listening.append(ExitStack())
            listening[-1].enter_context(page.suite.watch())
            plots.resume_listening()
        else:
            leave()
        for timer in timers:
            timer.active = seen

    ui.timer(_LOOK_PERIOD_S, look)
    # A browser that vanishes: its timers may wait for an answer that never comes.
    client.on_disconnect(leave)
    client.on_delete(leave)
