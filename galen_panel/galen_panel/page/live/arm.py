"""The arm in three dimensions, and how far it bends, exaggerated; the same in numbers below."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from galen_model.arm.galen import HOME
from galen_model.arrays import Array
from nicegui import events, ui
from nicegui.awaitable_response import AwaitableResponse
from nicegui.elements.scene import Object3D

from galen_panel.history import NS_PER_S, StreamSeries
from galen_panel.page.live.arm_drawing import Drawing, Part, Placement
from galen_panel.page.page import Page
from galen_panel.snapshot import LoadedTool

FACTOR_MAX = 500
FACTOR = 100
"""0.3 mm are then 30 mm, some 20 pixels."""
_SCRIPT = Path(__file__).with_suffix(".js")
_ANSWER_S = 10.0
_NUMBERS_PERIOD_S = 0.5
_MEAN_S = 0.1
_STALE_S = 1.0
# Where the camera stands, and what it looks at; base_link, m.
_CENTRE = (0.28, 0.0, 0.27)
_VIEWS = {
    "overview": ("Overview", (1.35, -1.3, 0.85)),
    "front": ("Front", (2.1, 0.0, 0.3)),
    "side": ("Side", (0.28, -1.7, 0.3)),
    # Not straight above: there the camera would not know what is up on the screen.
    "top": ("Top", (0.28, -0.01, 2.1)),
}


class Arm:
    """One browser's picture; `update` is to be awaited again and again while it is shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._factor = float(FACTOR)
        self._tool: tuple[object, object] | None = None
        self._drawing = Drawing(np.zeros(3), None)
        self._object: ArmObject | None = None
        self._placed: Placement | None = None
        self._numbers_at_s = -math.inf
        self._numbers: dict[str, ui.label] = {}
        self._build()

    async def update(self) -> None:
        """Bring the arm's pose to the browser, and wait until it is there."""
        self._choose_drawing(self._page.suite.state.active_tool)
        joints, deflection, wrench = self._newest()
        if time.monotonic() - self._numbers_at_s >= _NUMBERS_PERIOD_S:
            self._numbers_at_s = time.monotonic()
            self._show_numbers(joints, deflection, wrench)
        placement = self._drawing.place(
            HOME if joints is None else joints, deflection, wrench, self._factor
        )
        if placement == self._placed or self._object is None:
            return
        try:
            arrived = await self._object.place(placement, _ANSWER_S)
        except TimeoutError:
            arrived = None
        self._placed = placement if arrived is True else None

    def _build(self) -> None:
        ui.add_head_html(f"<script>{_SCRIPT.read_text()}</script>")
        with ui.row().classes("items-center w-full"):
            for name, (label, _) in _VIEWS.items():
                ui.button(label, on_click=lambda name=name: self._look_from(name)).props(
                    f"data-testid=view-{name} no-caps outline"
                )
        with ui.element("div").classes("live-scene"):
            camera = ui.scene.perspective_camera(fov=32, near=0.05, far=20.0)
            self._scene = ui.scene(grid=False, camera=camera, click_events=[])
            self._scene.props(
                'data-testid=arm role=img aria-label="The arm; its numbers are below"'
            )
            self._scene.on("init", self._on_init)
            self._told_factor = ui.label().classes("live-factor").props("data-testid=factor")
        ui.label(
            "Grey: as the joints say. Orange: bent. Green ball: the tool's centre of mass."
            " Arrow: the force."
        )
        self._look_from("overview", duration_s=0.0)
        with ui.row(wrap=False).classes("items-center w-full"):
            ui.label("Bend shown times").props("id=exaggeration-label").classes("whitespace-nowrap")
            ui.slider(
                min=1, max=FACTOR_MAX, step=1, value=FACTOR, on_change=self._choose_factor
            ).props('data-testid=exaggeration label aria-label="Bend shown times"')
        with ui.element("table").classes("live-numbers"), ui.element("tbody"):
            for row, cells in (
                ("Platform", ("platform-x", "platform-y", "platform-z")),
                ("Roll, tilt", ("roll", "tilt")),
                ("Deflection", ("deflection-x", "deflection-y", "deflection-z")),
                ("  its size", ("deflection-size",)),
                ("Force", ("force",)),
            ):
                with ui.element("tr"):
                    with ui.element("th").props("scope=row"):
                        ui.label(row)
                    for cell in cells:
                        with ui.element("td"):
                            self._numbers[cell] = ui.label("–").props(f"data-testid=arm-{cell}")
        self._tell_factor()

    def _on_init(self) -> None:
        # Nothing of the page's look, dark or light, is to be painted over.
        self._scene.client.run_javascript(f"getElement({self._scene.id}).renderer.setClearAlpha(0)")
        self._placed = None

    def _look_from(self, name: str, duration_s: float = 0.5) -> None:
        _, (x, y, z) = _VIEWS[name]
        self._scene.move_camera(x, y, z, *_CENTRE, duration=duration_s)

    def _choose_factor(self, event: events.ValueChangeEventArguments) -> None:
        if isinstance(event.value, int | float) and 1 <= event.value <= FACTOR_MAX:
            self._factor = float(event.value)
            self._tell_factor()

    def _tell_factor(self) -> None:
        self._told_factor.set_text(f"Bend × {self._factor:.0f}")

    def _choose_drawing(self, active_tool: LoadedTool | None) -> None:
        """Another tool is another drawing."""
        has_tool = active_tool is not None and bool(active_tool.tool)
        tool = (
            (active_tool.tip_m, active_tool.com_m) if active_tool is not None and has_tool else None
        )
        if self._object is not None and tool == self._tool:
            return
        self._tool = tool
        tip_m, com_m = (np.zeros(3), None) if tool is None else map(np.array, tool)
        self._drawing = Drawing(tip_m, com_m)
        if self._object is not None:
            self._object.delete()
        with self._scene:
            self._object = ArmObject(self._drawing.parts())
        self._placed = None

    def _newest(self) -> tuple[Array | None, Array | None, Array | None]:
        """Joints, deflection and force now; None for what isn't known or no longer."""
        history = self._page.suite.history
        streams = (history.joints, history.deflection, history.compensated)
        now_ns = max((series.newest_ns or 0 for series in streams), default=0)
        joints, deflection, wrench = (
            _now(series, seconds, now_ns)
            for series, seconds in zip(streams, (0.0, 0.0, _MEAN_S), strict=True)
        )
        return joints, deflection, wrench

    def _show_numbers(
        self, joints: Array | None, deflection: Array | None, wrench: Array | None
    ) -> None:
        texts = dict.fromkeys(self._numbers, "–")
        if joints is not None:
            for axis, value in zip("xyz", joints[:3], strict=True):
                texts[f"platform-{axis}"] = f"{axis} {1e3 * value:.1f} mm"
            for name, value in (("roll", joints[3]), ("tilt", joints[4])):
                texts[name] = f"{math.degrees(value):.2f}°"
        if deflection is not None:
            for axis, value in zip("xyz", deflection[:3], strict=True):
                texts[f"deflection-{axis}"] = f"{axis} {1e3 * value:.3f} mm"
            texts["deflection-size"] = f"{1e3 * float(np.linalg.norm(deflection[:3])):.3f} mm"
        if wrench is not None:
            texts["force"] = f"{float(np.linalg.norm(wrench[:3])):.2f} N"
        for name, text in texts.items():
            self._numbers[name].set_text(text)


def _now(series: StreamSeries, seconds: float, now_ns: int) -> Array | None:
    """The mean of a series' last rows; None where it has none or ended a while ago."""
    samples = series.last(seconds)
    if samples.newest_ns is None or now_ns - samples.newest_ns > _STALE_S * NS_PER_S:
        return None
    return np.asarray(samples.values.mean(axis=0))


class ArmObject(Object3D, component="arm_object.js"):
    """Parts and placements as in `galen_panel.page.live.arm_drawing`."""

    def __init__(self, parts: list[Part]) -> None:
        super().__init__(parts)

    def place(self, placement: Placement, timeout_s: float) -> AwaitableResponse:
        """Move the parts; awaited, it is True once that is done, None without a picture."""
        return self.run_method("place", placement, timeout=timeout_s)
