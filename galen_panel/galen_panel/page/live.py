# SPDX-License-Identifier: Apache-2.0
"""What the sensor and the arm do now: plots, and the arm in three dimensions.

The streams are listened to only while a page shows them: the tab is open and the browser is there.

What is new goes to the browser some times a second, the next only when it has said that it has the
last: a slow browser gets fewer pictures, not a queue.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from nicegui import run, ui

from galen_panel.messages.programs import setup_sentence
from galen_panel.page.arm import ArmView
from galen_panel.page.page import Page
from galen_panel.page.plot_options import (
    DEFLECTION_NAMES,
    deflection_curves,
    headings,
    heights,
    look,
    options,
    time_span,
    wrench_curves,
)
from galen_panel.state.history import (
    NS_PER_S,
    StreamSamples,
    StreamSeries,
    bucket_ns,
    csv,
    plot_rows,
)

WINDOWS_S = (10, 30, 60, 120)
_FIRST_WINDOW_S = 30
MEAN_S = 2.0
_MEAN_PERIOD_S = 0.5
_ANSWER_S = 10.0
PLOT_PERIOD_S = 0.2
ARM_PERIOD_S = 0.1
_LOOK_PERIOD_S = 0.2
_HERE = Path(__file__).parent
_CURVES: tuple[Callable[[Array], Array], ...] = (wrench_curves, wrench_curves, deflection_curves)


def build(page: Page, shown: Callable[[], bool]) -> None:
    """Draw plots and arm.

    Args:
        page: the browser's, that it is drawn on.
        shown: returns whether its tab is open.

    """
    ui.add_css(_HERE / "live.css")
    for script in ("live.js", "plots.js"):
        ui.add_head_html(f"<script>{(_HERE / script).read_text()}</script>")
    client = ui.context.client
    listening: list[ExitStack] = []
    setup = ui.label().classes("panel-path q-mb-sm").props("role=status data-testid=setup")
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
        setup.set_text(setup_sentence(page.suite.state, time.monotonic()))
        seen = shown() and client.has_socket_connection
        if seen == bool(listening):
            return
        if seen:
            listening.append(ExitStack())
            listening[-1].enter_context(page.suite.watch())
        else:
            leave()
        for timer in timers:
            timer.active = seen

    ui.timer(_LOOK_PERIOD_S, look)
    # A browser that vanishes: its timers may wait for an answer that never comes.
    client.on_disconnect(leave)
    client.on_delete(leave)


class Plots:
    """One browser's plots; `update` is to be awaited again and again while they are shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._series = self._live()
        self._window_s = float(_FIRST_WINDOW_S)
        self._paused = False
        self._sent: tuple[object, ...] | None = None
        self._means_at_s = -math.inf
        self._means: dict[str, tuple[ui.label, ui.label]] = {}
        self._build()

    async def update(self) -> None:
        """Bring what is new to the browser, and wait until it is there."""
        newest_ns = max(series.newest_ns or 0 for series in self._series)
        # In a long window there is nothing to be seen of what is shorter than a bucket.
        new = (newest_ns // bucket_ns(self._window_s), self._window_s, self._series)
        if newest_ns and new != self._sent:
            self._sent = new if await self._send(newest_ns) else None
        now_s = time.monotonic()
        if now_s - self._means_at_s >= _MEAN_PERIOD_S:
            self._means_at_s = now_s
            self._show_means()

    def _build(self) -> None:
        with ui.row().classes("items-center w-full"):
            self._window = ui.toggle(
                {seconds: f"{seconds} s" for seconds in WINDOWS_S},
                value=_FIRST_WINDOW_S,
                on_change=lambda event: self._choose_window(event.value),
            ).props('data-testid=window no-caps aria-label="How far back"')
            self._pause = ui.button("Pause", icon="pause", on_click=self._toggle_pause).props(
                "data-testid=pause no-caps aria-pressed=false"
            )
            ui.space()
            self._csv = ui.button("CSV", icon="download", on_click=self._save_csv)
            self._csv.props('data-testid=csv no-caps outline aria-label="Save as CSV"')
            self._csv.tooltip("All samples of the window, at full rate")
        with ui.element("div").classes("live-plots").style(heights()):
            self._chart = ui.echart(options(self._window_s)).classes("live-chart")
            self._chart.props(
                'data-testid=plot role=img aria-label="Forces, torques and deflection over time;'
                ' their size is written beside each axis"'
            )
            for axis, unit, place in headings():
                with ui.row(wrap=False).classes("live-heading").style(place):
                    ui.label(axis).classes("live-axis")
                    number = ui.label("–").classes("live-mean").props(f"data-testid=mean-{axis}")
                    ui.label(unit)
                    raw = ui.label().classes("live-raw").props(f"data-testid=mean-raw-{axis}")
                self._means[axis] = (number, raw)
        ui.label(
            f"Numbers: mean of the last {MEAN_S:.0f} s. Zoom: the bar below the plots, or Shift and"
            " the wheel. The CSV has every sample."
        )
        looks = json.dumps([look(dark=False), look(dark=True)])
        script = f"galenPlots.follow({self._chart.id}, {looks})"
        ui.timer(0.0, lambda: self._chart.client.run_javascript(script), once=True)

    def _live(self) -> tuple[StreamSeries, ...]:
        history = self._page.suite.history
        return history.raw, history.compensated, history.deflection

    async def _send(self, newest_ns: int) -> bool:
        """Send all of the window, few rows of it; returns whether the browser has drawn it."""
        start_ns, width_ns = newest_ns - int(self._window_s * NS_PER_S), bucket_ns(self._window_s)
        streams = []
        for series, curves in zip(self._series, _CURVES, strict=True):
            samples = series.since(start_ns)
            stamps, rows = plot_rows(samples.stamps_ns, curves(samples.values), width_ns)
            times = np.round((stamps - newest_ns) / NS_PER_S, 4)
            streams.append({"source": np.column_stack([times, np.round(rows, 4)]).tolist()})
        option = time_span(self._window_s) | {"dataset": streams}
        script = f"galenPlots.show({self._chart.id}, {json.dumps(option)})"
        try:
            answer = await self._chart.client.run_javascript(script, timeout=_ANSWER_S)
        except TimeoutError:
            return False
        return answer is True

    def _choose_window(self, seconds: object) -> None:
        if seconds in WINDOWS_S:
            self._window_s = float(str(seconds))

    def _toggle_pause(self) -> None:
        """Hold what is there now, 120 s of it; resume with what has come since."""
        self._paused = not self._paused
        live = self._live()
        self._series = tuple(series.frozen() for series in live) if self._paused else live
        self._pause.set_text("Resume" if self._paused else "Pause")
        self._pause.set_icon("play_arrow" if self._paused else "pause")
        self._pause.props(f"aria-pressed={'true' if self._paused else 'false'}")

    async def _save_csv(self) -> None:
        newest_ns = max(series.newest_ns or 0 for series in self._series)
        start_ns = newest_ns - int(self._window_s * NS_PER_S)
        streams: list[StreamSamples] = [series.since(start_ns) for series in self._series]
        if not newest_ns:
            ui.notify("Nothing has come yet.")
            return
        self._csv.props("loading disable")
        try:
            content = await run.io_bound(csv, *streams)
        finally:
            self._csv.props(remove="loading disable")
        if content is not None:
            name = f"galen_wrench_{datetime.now():%Y-%m-%d_%H-%M-%S}.csv"
            ui.download.content(content, name, "text/csv")

    def _show_means(self) -> None:
        newest = max((series.newest_ns or 0 for series in self._series), default=0)
        raw, compensated, deflection = (
            _mean(curves(series.since(newest - int(MEAN_S * NS_PER_S)).values))
            for series, curves in zip(self._series, _CURVES, strict=True)
        )
        axes = list(self._means)[:6]
        for index, (axis, net, gross) in enumerate(zip(axes, compensated, raw, strict=True)):
            digits = 3 if index < 3 else 1
            number, beside = self._means[axis]
            number.set_text(_text(net, digits))
            beside.set_text(f"raw {_text(gross, digits)}")
        size = deflection[DEFLECTION_NAMES.index("size")]
        self._means["tip"][0].set_text(_text(size, 3))


def _mean(values: Array) -> Array:
    """Of each column, with its sign; NaN without rows."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    return np.asarray(values.mean(axis=0))


def _text(value: float, digits: int) -> str:
    # A rounded zero has no sign.
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else "–"
