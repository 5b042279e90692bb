# SPDX-License-Identifier: Apache-2.0
"""The arm in three dimensions, and how far it bends, exaggerated; the same in numbers below.

A part is shapes fixed to a frame, sent once; a placement holds the frames' poses, sent again and
again: x, y, z (m), a quaternion x, y, z, w, and the length (m) of a part that is stretched along z.
The straight arm is drawn as the joints say: a link as its description has it, or as a line to the
next joint where that has no shape. The bent one is displaced by the deflection, exaggerated: a
point moves as the tip's rigid displacement has it, times its share of the way from base to tip.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.rotation import matrix_to_quaternion, rotvec_to_matrix
from nicegui import events, ui
from nicegui.awaitable_response import AwaitableResponse
from nicegui.elements.scene import Object3D

from galen_panel.page.page import Page
from galen_panel.state.history import NS_PER_S, StreamSeries
from galen_panel.state.shapes import GREY, Drawing
from galen_panel.state.snapshot import SuiteState

Part = dict[str, Any]
Placement = dict[str, list[float] | None]

FORCE_M_PER_N = 0.03
_FORCE_MIN_N = 0.15
_FORCE_MAX_M = 0.4
_LINK_RADIUS_M, _TOOL_RADIUS_M, _JOINT_RADIUS_M, _COM_RADIUS_M = 0.015, 0.004, 0.022, 0.012
_STRAIGHT, _BENT, _JOINT, _COM, _FORCE = GREY, "#ff8c1a", "#6c7a89", "#2f9e6e", "#e0316f"
_BENT_OPACITY, _GHOST_OPACITY = 0.6, 0.35
_SHORTEST_M = 1e-4
_DECIMALS = 5
"""Of places, m, and of quaternions."""
FACTOR_MAX = 500
FACTOR = 100
"""0.3 mm are then 30 mm, some 20 pixels."""
_ANSWER_S = 10.0
_NUMBERS_PERIOD_S = 0.5
_MEAN_S = 0.1
_STALE_S = 1.0
_POSES = 300
"""Of a serial arm, by chance, to see how far it goes."""
_CAMERA = (1.1, -1.3, 0.6)
"""From the middle of the arm, in sizes of the arm."""


class ArmView:
    """One browser's picture; `update` is to be awaited again and again while it is shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._drawing: Drawing | None = None
        self._factor = float(FACTOR)
        self._placed: Placement | None = None
        self._numbers_at_s = -math.inf
        self._numbers: dict[str, ui.label] = {}
        self._problem = (
            ui.label().classes("panel-note").props("role=status data-testid=arm-problem")
        )
        self._place = ui.element("div")
        page.on_change(self._follow)

    def _follow(self, state: SuiteState) -> None:
        """Show another arm, and what is wrong with its description."""
        self._problem.set_text(state.arm_problem)
        self._problem.set_visibility(bool(state.arm_problem))
        if state.drawing is self._drawing or state.drawing is None:
            return
        self._drawing, self._placed = state.drawing, None
        self._place.clear()
        with self._place:
            self._build(state.drawing)

    def _build(self, drawing: Drawing) -> None:
        arm = drawing.arm
        with ui.element("div").classes("live-scene"):
            camera = ui.scene.perspective_camera(fov=32, near=0.05, far=20.0)
            self._scene = ui.scene(grid=False, camera=camera, click_events=[])
            self._scene.props(
                'data-testid=arm role=img aria-label="The arm; its numbers are below"'
            )
            self._scene.on("init", self._on_init)
            self._told_factor = ui.label().classes("live-factor").props("data-testid=factor")
        with self._scene:
            self._object = ArmObject(parts(drawing))
        middle, size_m = middle_and_size(arm)
        x, y, z = (middle + size_m * np.array(_CAMERA)).tolist()
        to_x, to_y, to_z = middle.tolist()
        self._scene.move_camera(x, y, z, to_x, to_y, to_z, duration=0.0)
        ui.label(
            "Grey: as the joints say. Orange: with the tip's predicted deflection, exaggerated and"
            " spread along the arm. Green ball: the tool's centre of mass. Arrow: the force."
            if not any(drawing.links)
            else "Orange: the arm with the tip's predicted deflection, exaggerated and spread along"
            " it. Green ball: the tool's centre of mass. Arrow: the force."
        )
        if drawing.note:
            ui.label(drawing.note).props("data-testid=arm-note").classes("panel-lines")
        with ui.row(wrap=False).classes("items-center w-full"):
            ui.label("Bend shown times").classes("whitespace-nowrap")
            ui.slider(
                min=1, max=FACTOR_MAX, step=1, value=FACTOR, on_change=self._choose_factor
            ).props('data-testid=exaggeration label aria-label="Bend shown times"')
        with ui.element("table").classes("live-numbers"), ui.element("tbody"):
            for row in (*arm.joint_names, "deflection", "force"):
                with ui.element("tr"):
                    with ui.element("th").props("scope=row"):
                        ui.label(row)
                    with ui.element("td"):
                        self._numbers[row] = number = ui.label("–")
                        # The names are a description's: no text of properties is made of them.
                        number.props["data-testid"] = f"arm-{row}"
        self._tell_factor()

    async def update(self) -> None:
        """Bring the arm's pose to the browser, and wait until it is there."""
        drawing, history = self._drawing, self._page.suite.history
        if drawing is None:
            return
        arm = drawing.arm
        streams = (history.joints, history.deflection, history.compensated)
        now_ns = max((series.newest_ns or 0 for series in streams), default=0)
        joints, deflection, wrench = (
            _now(series, seconds, now_ns)
            for series, seconds in zip(streams, (0.0, 0.0, _MEAN_S), strict=True)
        )
        if time.monotonic() - self._numbers_at_s >= _NUMBERS_PERIOD_S:
            self._numbers_at_s = time.monotonic()
            self._show_numbers(arm, joints, deflection, wrench)
        active = self._page.suite.state.active_tool
        has_tool = active is not None and bool(active.tool)
        placement = place(
            drawing,
            arm.home if joints is None else joints,
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

    def _choose_factor(self, event: events.ValueChangeEventArguments) -> None:
        if isinstance(event.value, int | float) and 1 <= event.value <= FACTOR_MAX:
            self._factor = float(event.value)
            self._tell_factor()

    def _tell_factor(self) -> None:
        self._told_factor.set_text(f"Bend × {self._factor:.0f}")

    def _show_numbers(
        self, arm: Arm, joints: Array | None, deflection: Array | None, wrench: Array | None
    ) -> None:
        texts = dict.fromkeys(self._numbers, "–")
        if joints is not None:
            for joint, value in zip(arm.joints, joints.tolist(), strict=True):
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
    """The drawing in the browser."""

    def __init__(self, parts: list[Part]) -> None:
        super().__init__(parts)

    def place(self, placement: Placement, timeout_s: float) -> AwaitableResponse:
        """Move the parts.

        Args:
            placement: as `place` returns it.
            timeout_s: how long to wait for the browser's answer, s.

        Returns:
            To be awaited; it is True once that is done, None without a picture.

        """
        return self.run_method("place", placement, timeout=timeout_s)


def parts(drawing: Drawing) -> list[Part]:
    """List all parts of the drawing.

    Args:
        drawing: an arm and the shapes of its links.

    Returns:
        Name and shapes of each part; each shape with kind, sizes (m), place, colour, opacity.

    """
    found = []
    # The last piece is the tool, from sensor to tip.
    for piece, shapes in enumerate([*drawing.links, ()]):
        if shapes:
            ghosts = [shape | {"colour": _BENT, "opacity": _GHOST_OPACITY} for shape in shapes]
            found.append({"name": f"straight/{piece}", "shapes": list(shapes)})
            found.append({"name": f"bent/{piece}", "shapes": ghosts})
        else:
            radius = _TOOL_RADIUS_M if piece == len(drawing.links) else _LINK_RADIUS_M
            found.append(_part(f"straight/{piece}", "cylinder", [radius, 1.0], _STRAIGHT))
            found.append(_part(f"bent/{piece}", "cylinder", [radius, 1.0], _BENT, _BENT_OPACITY))
    found += [
        _part(f"joint/{k}", "sphere", [_JOINT_RADIUS_M], _JOINT) for k in _bare_joints(drawing)
    ]
    found.append(_part("com", "sphere", [_COM_RADIUS_M], _COM))
    return [*found, _part("force", "arrow", [0.006, 0.018], _FORCE)]


def place(
    drawing: Drawing,
    joints: Array,
    tip_m: Array,
    com_m: Array | None,
    deflection: Array | None,
    wrench: Array | None,
) -> Placement:
    """Return where the parts are.

    Args:
        drawing: as for `parts`.
        joints: (n,), m and rad.
        tip_m: the tool's tip (3,) in the sensor's frame, m; zeros without a tool.
        com_m: the tool's centre of mass (3,) in the sensor's frame, m; None without a tool.
        deflection: (6,) of the tip in the base's frame, m and rad, exaggerated as it is to be
            shown; None: there is none.
        wrench: (6,) in the sensor's frame, N and N.m; None: there is none.

    Returns:
        Place by the part's name, in the base's frame: x, y, z (m), quaternion x, y, z, w and, of a
        stretched part, its length (m); None for one that isn't to be seen.

    """
    arm = drawing.arm
    rotation, sensor = arm.sensor_pose(joints)
    origins, _ = arm.joint_axes(joints)
    tip = sensor + rotation @ tip_m
    # Base, joints, sensor, tip: the last piece between two of them is the tool.
    points = np.vstack([np.zeros(3), origins, sensor, tip])
    links = drawing.link_places(joints) if any(drawing.links) else []
    still = np.zeros_like(points)
    placed: Placement = dict(_pieces("straight", drawing, links, points, still))
    if deflection is None:
        bent = points
        placed |= dict.fromkeys(name.replace("straight", "bent") for name in placed)
    else:
        shares = _shares(points)[:, None]
        bent = points + shares * (deflection[:3] + np.cross(deflection[3:], points - tip))
        placed |= _pieces("bent", drawing, links, bent, shares * deflection[3:])
        if drawing.links[0]:
            # The base stays where it is: a bent one would only cover it.
            placed["bent/0"] = None
    for k in _bare_joints(drawing):
        placed[f"joint/{k}"] = _at(origins[k])
    placed["com"] = None if com_m is None else _at(sensor + rotation @ com_m)
    force = np.zeros(3) if wrench is None else rotation @ wrench[:3]
    size_n = float(np.linalg.norm(force))
    placed["force"] = None
    if size_n >= _FORCE_MIN_N:
        length_m = min(FORCE_M_PER_N * size_n, _FORCE_MAX_M)
        placed["force"] = _rounded(
            [*bent[-1].tolist(), *_turn_of_z((force / size_n).tolist()), length_m]
        )
    return placed


def middle_and_size(arm: Arm) -> tuple[Array, float]:
    """Return the middle and the size of what is to be seen.

    Of an arm on rods what it takes up at home; a serial arm goes wherever its limits let it.

    Args:
        arm: to be drawn.

    Returns:
        Middle (3,) in the base's frame, m; size, m.

    """
    joints = arm.home[None]
    if arm.delta is None:
        rng = np.random.default_rng(0)
        low, high = np.clip([arm.lower, arm.upper], -np.pi, np.pi)
        joints = rng.uniform(low, high, (_POSES, len(arm.joints)))
    origins, _ = arm.joint_axes(joints)
    points = np.concatenate([origins.reshape(-1, 3), arm.sensor_pose(joints)[1], np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    # What is nearer to the camera than the middle takes more of the picture.
    size_m = np.linalg.norm(high - low) if arm.delta is not None else 1.2 * np.max(high - low)
    return (low + high) / 2.0, max(float(size_m), _SHORTEST_M)


def _pieces(
    name: str,
    drawing: Drawing,
    links: list[tuple[Array, Array]],
    points: Array,
    turned: Array,
) -> Iterator[tuple[str, list[float] | None]]:
    """Yield each piece and its place: a link turned by (3,) at its point, or a line to the next."""
    for piece, shapes in enumerate([*drawing.links, ()]):
        if shapes:
            turn = rotvec_to_matrix(turned[piece])
            yield f"{name}/{piece}", _pose(turn @ links[piece][0], points[piece])
        else:
            yield f"{name}/{piece}", _between(*points[piece : piece + 2].tolist())


def _bare_joints(drawing: Drawing) -> list[int]:
    """Places of the revolute joints whose link is drawn as a line."""
    return [k for k in drawing.arm.turning if not drawing.links[k + 1]]


def _shares(points: Array) -> Array:
    """Share (n,) of the way from base to tip at points (n, 3)."""
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    return np.asarray(way / max(way[-1], _SHORTEST_M))


def _part(name: str, kind: str, sizes: list[float], colour: str, opacity: float = 1.0) -> Part:
    here = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    shape = {"kind": kind, "sizes": sizes, "place": here, "colour": colour, "opacity": opacity}
    return {"name": name, "shapes": [shape]}


def _between(start_m: list[float], end_m: list[float]) -> list[float] | None:
    """Place a part of length 1 along z from start to end; None where they are one point."""
    length_m = math.dist(start_m, end_m)
    if length_m < _SHORTEST_M:
        return None
    direction = [(end - start) / length_m for start, end in zip(start_m, end_m, strict=True)]
    middle = [(start + end) / 2.0 for start, end in zip(start_m, end_m, strict=True)]
    return _rounded([*middle, *_turn_of_z(direction), length_m])


def _pose(rotation: Array, origin_m: Array) -> list[float]:
    return _rounded([*origin_m.tolist(), *matrix_to_quaternion(rotation).tolist()])


def _at(point_m: Array) -> list[float]:
    return _rounded([*point_m.tolist(), 0.0, 0.0, 0.0, 1.0])


def _turn_of_z(direction: list[float]) -> list[float]:
    """Return the quaternion x, y, z, w that turns z to this unit vector the shortest way."""
    x, y, z = direction
    if z < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    size = math.sqrt(2.0 * (1.0 + z))
    return [-y / size, x / size, 0.0, size / 2.0]


def _rounded(numbers: list[float]) -> list[float]:
    return [round(number, _DECIMALS) for number in numbers]
