"""The streams over time: raw and compensated wrench, the tip's deflection; pause, zoom, save.

What is new goes to the browser some times a second, the next only when it has said that it has the
last: a slow browser gets fewer pictures, not a queue.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from nicegui import events, run, ui

from galen_panel.history import (
    NS_PER_S,
    SECONDS,
    StreamSamples,
    StreamSeries,
    between,
    csv,
    file_name,
)
from galen_panel.messages.silence import COMPENSATED, DEFLECTION, JOINTS, RAW, Heard, tell
from galen_panel.page.live.decimation import Follower, Patch, PlotRows, bucket_ns, zoomed
from galen_panel.page.live.plot_options import (
    DEFLECTION_NAMES,
    HEIGHT_PX,
    Option,
    deflection_curves,
    headings,
    look,
    options,
    time_span,
    wrench_curves,
)
from galen_panel.page.page import Page

WINDOWS_S = (10, 30, 60, 120)
_FIRST_WINDOW_S = 30
MEAN_S = 2.0
_MEAN_PERIOD_S = 0.5
_ANSWER_S = 10.0
_MIN_ZOOM_PERCENT = 0.02
_SCRIPT = Path(__file__).with_suffix(".js")
_ZOOM_ARGUMENTS = (
    "(event) => { const zoom = event.batch ? event.batch[0] : event;"
    " emit({start: zoom.start, end: zoom.end}); }"
)
_CURVES: tuple[Callable[[Array], Array], ...] = (wrench_curves, wrench_curves, deflection_curves)


class Plots:
    """One browser's plots; `update` is to be awaited again and again while they are shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        history = page.suite.history
        self._series: tuple[StreamSeries, ...] = (
            history.raw,
            history.compensated,
            history.deflection,
        )
        self._followers = [
            Follower(series, curves) for series, curves in zip(self._series, _CURVES, strict=True)
        ]
        self._heard = Heard()
        self._window_s = float(_FIRST_WINDOW_S)
        self._base_ns: int | None = None
        self._option: Option | None = None
        self._frozen: tuple[StreamSamples, ...] | None = None
        self._zoom = (0.0, 100.0)
        self._stale = False
        self._means_at_s = -math.inf
        self._means: dict[str, tuple[ui.label, ui.label]] = {}
        self._build()
        self._look_at(self._window_s)

    async def update(self) -> None:
        """Bring what is new to the browser, and wait until it is there."""
        self._tell_silence()
        if self._frozen is not None:
            if self._stale:
                self._stale = False
                if not await self._send_frozen(self._frozen):
                    self._stale = True
                    self._begin(time_span(SECONDS))
            return
        patches = [follower.patch() for follower in self._followers]
        if not await self._send_patches(patches):
            self._forget()
        now_s = time.monotonic()
        if now_s - self._means_at_s >= _MEAN_PERIOD_S:
            self._means_at_s = now_s
            self._show_means()

    def resume_listening(self) -> None:
        """Count silence anew after a while without listening."""
        self._heard.forget(time.monotonic())

    def _build(self) -> None:
        ui.add_head_html(f"<script>{_SCRIPT.read_text()}</script>")
        with ui.row().classes("items-center w-full"):
            self._window = ui.toggle(
                {seconds: f"{seconds} s" for seconds in WINDOWS_S},
                value=_FIRST_WINDOW_S,
                on_change=lambda event: self._choose_window(event.value),
            ).props('data-testid=window no-caps aria-label="How far back"')
            self._pause = ui.button("Pause", icon="pause", on_click=self._toggle_pause).props(
                "data-testid=pause no-caps aria-pressed=false"
            )
            for name, icon, label, act in (
                ("zoom-in", "zoom_in", "Zoom in", lambda: self._zoom_by(0.5)),
                ("zoom-out", "zoom_out", "Zoom out", lambda: self._zoom_by(2.0)),
                ("earlier", "chevron_left", "Earlier", lambda: self._move_by(-0.5)),
                ("later", "chevron_right", "Later", lambda: self._move_by(0.5)),
            ):
                button = ui.button(icon=icon, on_click=act)
                button.props(f'data-testid={name} flat round aria-label="{label}"').tooltip(label)
            ui.space()
            self._csv = ui.button("CSV", icon="download", on_click=self._save_csv)
            self._csv.props('data-testid=csv no-caps outline aria-label="Save as CSV"')
            self._csv.tooltip("All samples of the window, at full rate")
            png = ui.button("PNG", icon="image", on_click=self._save_png)
            png.props('data-testid=png no-caps outline aria-label="Save as PNG"')
            png.tooltip("The picture as it is shown")
        with ui.row(wrap=False).classes("items-center live-silence") as self._silence:
            ui.icon("signal_disconnected", color="warning", size="1.6rem").props("aria-hidden=true")
            self._silence_text = ui.label().props(
                "role=status aria-live=polite data-testid=silence"
            )
        self._silence.set_visibility(False)
        with ui.element("div").classes("live-plots").style(f"height:{HEIGHT_PX}px"):
            self._chart = ui.echart(options(self._window_s)).classes("live-chart")
            self._chart.props(
                'data-testid=plot role=img aria-label="Forces, torques and deflection over time;'
                ' their size is told beside each axis"'
            )
            self._chart.on("chart:datazoom", self._zoomed, js_handler=_ZOOM_ARGUMENTS)
            for heading in headings():
                place = f"left:{heading.left};top:{heading.top_px}px"
                with ui.row(wrap=False).classes("live-heading").style(place):
                    ui.label(heading.axis).classes("live-axis")
                    number = ui.label("–").classes("live-mean")
                    number.props(f"data-testid=mean-{heading.axis}")
                    ui.label(heading.unit)
                    raw = ui.label().classes("live-raw")
                    raw.props(f"data-testid=mean-raw-{heading.axis}")
                self._means[heading.axis] = (number, raw)
        ui.label(
            f"Numbers: mean of the last {MEAN_S:.0f} s. Zoom: the bar below the plots, the buttons"
            " above, or Shift and the wheel; pause to see single samples."
        )
        ui.timer(0.0, self._follow_look, once=True)

    async def _follow_look(self) -> None:
        self._run(f"galenPlots.follow({self._chart.id})")

    def _run(self, script: str) -> None:
        self._chart.client.run_javascript(script)

    async def _ask(self, script: str) -> bool:
        """Whether the browser answers that it is done."""
        try:
            answer = await self._chart.client.run_javascript(script, timeout=_ANSWER_S)
        except TimeoutError:
            return False
        return answer is True

    def _look_at(self, window_s: float) -> None:
        self._window_s = window_s
        for follower in self._followers:
            follower.look_at(window_s, bucket_ns(window_s))
        self._begin(time_span(window_s))

    def _begin(self, option: Option) -> None:
        """What is sent next has to be whole, and brings this option with it."""
        self._option = option
        self._base_ns = None

    def _forget(self) -> None:
        for follower in self._followers:
            follower.forget()
        self._begin(time_span(self._window_s if self._frozen is None else SECONDS))

    async def _send_patches(self, patches: list[Patch]) -> bool:
        newest = [patch.newest_ns for patch in patches if patch.newest_ns is not None]
        if not newest:
            return True
        if self._option is None and not any(len(patch.rows) or patch.whole for patch in patches):
            return True
        now_ns = max(newest)
        if self._base_ns is None:
            self._base_ns = now_ns
        streams = [
            self._stream(patch.rows, patch.whole, patch.from_ns, self._base_ns) for patch in patches
        ]
        return await self._send(streams, now_ns, self._window_s)

    async def _send_frozen(self, frozen: tuple[StreamSamples, ...]) -> bool:
        now_ns = _newest(frozen)
        self._base_ns = now_ns
        start_ns, end_ns = self._shown_ns(now_ns, SECONDS)
        streams = [
            self._stream(
                zoomed(samples.stamps_ns, curves(samples.values), start_ns, end_ns, SECONDS),
                True, 0, now_ns,
            )
            for samples, curves in zip(frozen, _CURVES, strict=True)
        ]  # fmt: skip
        return await self._send(streams, now_ns, SECONDS)

    async def _send(self, streams: list[Option], now_ns: int, span_s: float) -> bool:
        assert self._base_ns is not None
        message: Option = {"now": _ms(now_ns - self._base_ns), "span": span_s, "streams": streams}
        option = self._option
        if option is not None:
            message |= {"option": option, "looks": [look(dark=False), look(dark=True)]}
        script = f"galenPlots.patch({self._chart.id}, {json.dumps(message)})"
        arrived = await self._ask(script)
        if arrived and self._option is option:
            self._option = None
        return arrived

    @staticmethod
    def _stream(rows: PlotRows, whole: bool, from_ns: int, base_ns: int) -> Option:
        times = np.round((rows.stamps_ns - base_ns) / 1e6, 1)
        return {
            "whole": whole,
            "from": _ms(from_ns - base_ns),
            "rows": np.column_stack([times, rows.values]).tolist(),
        }

    def _shown_ns(self, now_ns: int, span_s: float) -> tuple[int, int]:
        start, end = (now_ns - int((1 - part / 100) * span_s * NS_PER_S) for part in self._zoom)
        return start, end

    def _choose_window(self, seconds: object) -> None:
        if seconds not in WINDOWS_S:
            return
        self._window_s = float(str(seconds))
        if self._frozen is None:
            self._look_at(self._window_s)
        self._zoom_to(*self._whole_window())

    def _whole_window(self) -> tuple[float, float]:
        """The zoom that shows the window, in %."""
        if self._frozen is None:
            return 0.0, 100.0
        return 100.0 * (1.0 - self._window_s / SECONDS), 100.0

    def _toggle_pause(self) -> None:
        if self._frozen is None:
            frozen = tuple(series.last() for series in self._series)
            if not any(len(samples.stamps_ns) for samples in frozen):
                ui.notify("Nothing has come yet.")
                return
            shown = self._zoom
            self._frozen = frozen
            self._begin(time_span(SECONDS))
            share = self._window_s / SECONDS
            self._zoom_to(*(100.0 - share * (100.0 - part) for part in shown))
            self._stale = True
            self._pause.set_text("Resume")
            self._pause.set_icon("play_arrow")
        else:
            self._frozen = None
            self._look_at(self._window_s)
            self._zoom_to(0.0, 100.0)
            self._pause.set_text("Pause")
            self._pause.set_icon("pause")
        self._pause.props(f"aria-pressed={'false' if self._frozen is None else 'true'}")

    def _zoomed(self, event: events.GenericEventArguments) -> None:
        """The person has zoomed or moved the plots; what comes is checked."""
        try:
            start, end = (float(event.args[name]) for name in ("start", "end"))
        except (TypeError, KeyError, ValueError):
            return
        if 0.0 <= start < end <= 100.0:
            self._zoom, self._stale = (start, end), True

    def _zoom_by(self, factor: float) -> None:
        start, end = self._zoom
        half = max(factor * (end - start) / 2.0, _MIN_ZOOM_PERCENT)
        middle = (start + end) / 2.0
        self._zoom_to(middle - half, middle + half)

    def _move_by(self, share: float) -> None:
        start, end = self._zoom
        step = share * (end - start)
        step = min(max(step, -start), 100.0 - end)
        self._zoom_to(start + step, end + step)

    def _zoom_to(self, start: float, end: float) -> None:
        self._zoom, self._stale = (max(start, 0.0), min(end, 100.0)), True
        self._run(f"galenPlots.zoom({self._chart.id}, {self._zoom[0]!r}, {self._zoom[1]!r})")

    async def _save_csv(self) -> None:
        if self._frozen is None:
            streams: tuple[StreamSamples, ...] = tuple(series.last() for series in self._series)
            span_s, zoom = self._window_s, (0.0, 100.0)
        else:
            streams, span_s, zoom = self._frozen, SECONDS, self._zoom
        if not any(len(samples.stamps_ns) for samples in streams):
            ui.notify("Nothing has come yet.")
            return
        now_ns = _newest(streams)
        start_ns, end_ns = (now_ns - int((1 - part / 100) * span_s * NS_PER_S) for part in zoom)
        self._csv.props("loading disable")
        try:
            content = await run.io_bound(
                csv, *(between(samples, start_ns, end_ns) for samples in streams)
            )
        finally:
            self._csv.props(remove="loading disable")
        if content is not None:
            ui.download.content(content, file_name("wrench", "csv", datetime.now()), "text/csv")

    async def _save_png(self) -> None:
        name = file_name("plots", "png", datetime.now())
        await self._ask(f"galenPlots.png({self._chart.id}, {json.dumps(name)})")

    def _tell_silence(self) -> None:
        history, now_s = self._page.suite.history, time.monotonic()
        streams = {
            RAW: history.raw,
            COMPENSATED: history.compensated,
            DEFLECTION: history.deflection,
            JOINTS: history.joints,
        }
        self._heard.look({name: series.newest_ns for name, series in streams.items()}, now_s)
        text = tell(self._heard.silent(now_s), self._page.suite.state)
        self._silence_text.set_text(text)
        self._silence.set_visibility(bool(text))

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


def _newest(streams: tuple[StreamSamples, ...]) -> int:
    return max(samples.newest_ns or 0 for samples in streams)


def _ms(duration_ns: int) -> float:
    return round(duration_ns / 1e6, 1)


def _mean(values: Array) -> Array:
    """Of each column, with its sign; NaN without rows."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    return np.asarray(values.mean(axis=0))


def _text(value: float, digits: int) -> str:
    # A rounded zero has no sign.
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else "–"
