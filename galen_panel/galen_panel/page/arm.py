"""The arm in three dimensions, and how far it bends, exaggerated; the same in numbers below."""

from __future__ import annotations

import math
import time

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from nicegui import events, ui
from nicegui.awaitable_response import AwaitableResponse
from nicegui.elements.scene import Object3D

from galen_panel.history import NS_PER_S, StreamSeries
from galen_panel.page.arm_drawing import Part, Placement, middle_and_size, parts, place
from galen_panel.page.page import Page

FACTOR_MAX = 500
FACTOR = 100
"""0.3 mm are then 30 mm, some 20 pixels."""
_ANSWER_S = 10.0
_NUMBERS_PERIOD_S = 0.5
_MEAN_S = 0.1
_STALE_S = 1.0
# By name, where the camera is from the middle of the arm, in sizes of the arm.
_VIEWS = {"Overview": (1.1, -1.3, 0.6), "Front": (1.9, 0.0, 0.0), "Side": (0.0, -1.8, 0.0)}


class ArmView:
    """One browser's picture; `update` is to be awaited again and again while it is shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._factor = float(FACTOR)
        self._placed: Placement | None = None
        self._numbers_at_s = -math.inf
        self._numbers: dict[str, ui.label] = {}
        with ui.row().classes("items-center w-full"):
            for name in _VIEWS:
                ui.button(name, on_click=lambda name=name: self._look_from(name)).props(
                    f"data-testid=view-{name.lower()} no-caps outline"
                )
        with ui.element("div").classes("live-scene"):
            camera = ui.scene.perspective_camera(fov=32, near=0.05, far=20.0)
            self._scene = ui.scene(grid=False, camera=camera, click_events=[])
            self._scene.props(
                'data-testid=arm role=img aria-label="The arm; its numbers are below"'
            )
            self._scene.on("init", self._on_init)
            self._told_factor = ui.label().classes("live-factor").props("data-testid=factor")
        with self._scene:
            self._object = ArmObject(parts(GALEN))
        self._look_from("Overview", duration_s=0.0)
        ui.label(
            "Grey: as the joints say. Orange: with the tip's predicted deflection, exaggerated and"
            " spread along the arm. Green ball: the tool's centre of mass. Arrow: the force."
        )
        with ui.row(wrap=False).classes("items-center w-full"):
            ui.label("Bend shown times").classes("whitespace-nowrap")
            ui.slider(
                min=1, max=FACTOR_MAX, step=1, value=FACTOR, on_change=self._choose_factor
            ).props('data-testid=exaggeration label aria-label="Bend shown times"')
        with ui.element("table").classes("live-numbers"), ui.element("tbody"):
            for row in (*GALEN.joint_names, "deflection", "force"):
                with ui.element("tr"):
                    with ui.element("th").props("scope=row"):
                        ui.label(row)
                    with ui.element("td"):
                        self._numbers[row] = ui.label("–").props(f"data-testid=arm-{row}")
        self._tell_factor()

    async def update(self) -> None:
        """Bring the arm's pose to the browser, and wait until it is there."""
        history = self._page.suite.history
        streams = (history.joints, history.deflection, history.compensated)
        now_ns = max((series.newest_ns or 0 for series in streams), default=0)
        joints, deflection, wrench = (
            _now(series, seconds, now_ns)
            for series, seconds in zip(streams, (0.0, 0.0, _MEAN_S), strict=True)
        )
        if time.monotonic() - self._numbers_at_s >= _NUMBERS_PERIOD_S:
            self._numbers_at_s = time.monotonic()
            self._show_numbers(joints, deflection, wrench)
        active = self._page.suite.state.active_tool
        has_tool = active is not None and bool(active.tool)
        placement = place(
            GALEN,
            GALEN.home if joints is None else joints,
            np.array(active.tip_m) if active is not None and has_tool else np.zeros(3),
            np.array(active.com_m) if active is not None and has_tool else None,
            None if deflection is None else self._factor * deflection,
            wrench,
        )
        if placement == self._placed:
            return
        try:
            arrived = await self._object.place(placement, _ANSWER_S)
        except TimeoutError:
            arrived = None
        self._placed = placement if arrived is True else None

    def _on_init(self) -> None:
        # Nothing of the page's look, dark or light, is to be painted over.
        self._scene.client.run_javascript(f"getElement({self._scene.id}).renderer.setClearAlpha(0)")
        self._placed = None

    def _look_from(self, name: str, duration_s: float = 0.5) -> None:
        middle, size_m = middle_and_size(GALEN)
        camera = middle + size_m * np.array(_VIEWS[name])
        self._scene.move_camera(*camera.tolist(), *middle.tolist(), duration=duration_s)

    def _choose_factor(self, event: events.ValueChangeEventArguments) -> None:
        if isinstance(event.value, int | float) and 1 <= event.value <= FACTOR_MAX:
            self._factor = float(event.value)
            self._tell_factor()

    def _tell_factor(self) -> None:
        self._told_factor.set_text(f"Bend × {self._factor:.0f}")

    def _show_numbers(
        self, joints: Array | None, deflection: Array | None, wrench: Array | None
    ) -> None:
        texts = dict.fromkeys(self._numbers, "–")
        if joints is not None:
            for joint, value in zip(GALEN.joints, joints.tolist(), strict=True):
                turns = joint.kind == "revolute"
                shown = f"{math.degrees(value):.2f}°" if turns else f"{1e3 * value:.1f} mm"
                texts[joint.name] = shown
        if deflection is not None:
            along = ", ".join(f"{1e3 * value:.3f}" for value in deflection[:3])
            size = float(np.linalg.norm(deflection[:3]))
            texts["deflection"] = f"{1e3 * size:.3f} mm ({along})"
        if wrench is not None:
            texts["force"] = f"{float(np.linalg.norm(wrench[:3])):.2f} N"
        for name, text in texts.items():
            self._numbers[name].set_text(text)


def _now(series: StreamSeries, seconds: float, now_ns: int) -> Array | None:
    """Average a series' last rows; None where it has none or ended a while ago."""
    samples = series.last(seconds)
    if samples.newest_ns is None or now_ns - samples.newest_ns > _STALE_S * NS_PER_S:
        return None
    return np.asarray(samples.values.mean(axis=0))


class ArmObject(Object3D, component="arm_object.js"):
    """Parts and placements as in `galen_panel.page.arm_drawing`."""

    def __init__(self, parts: list[Part]) -> None:
        super().__init__(parts)

    def place(self, placement: Placement, timeout_s: float) -> AwaitableResponse:
        """Move the parts; awaited, it is True once that is done, None without a picture."""
        return self.run_method("place", placement, timeout=timeout_s)
