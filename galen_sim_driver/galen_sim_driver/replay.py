# SPDX-License-Identifier: Apache-2.0
"""Simulate the readings of sensor and tracker along recorded joint states.

    reading = read(W(true pose; tool) + W(true pose; adapter) - W(true bias pose; adapter) + others)
    tip     = T(true joints) moved by the deflection that the applied wrench causes

with effects (`effects/`) in the places that `effects/effect.py` tells. Everything works on whole
bags at once. What a hand pushed is not known beforehand: it is what a reading tells beyond the
prediction, `applied_wrench`. No noise, no quanta.

Sensor errors act on the zeroed reading. Had the zero been taken through the same errors, that would
be the same but for where a saturated axis clips.

A diagnosis replays a scene hundreds of times with nearly the same effects. What a step computes is
kept in the scene by the effects that take part in it (those that override its hooks, and their
numbers), and the next replay with the same ones takes it from there.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.sensor_motion import SensorMotion, sensor_motion
from galen_model.arrays import Array
from galen_model.load.inertia import inertial_wrench, point_mass_inertia
from galen_model.load.model import Load, ToolGeometry
from galen_model.registration import move_wrench
from galen_model.rotation import rotvec_to_matrix
from numpy.lib.stride_tricks import sliding_window_view

from galen_sim_driver.effects.effect import (
    Effect,
    Instants,
    Loading,
    Posture,
    added,
    in_order,
)

_STILL_POSE_M = 2e-4
"""Joints nearer to each other than this (m, rad) share a compliance: it changes by 1e-3 of itself
over some millimetres."""
_KEPT = 64
"""Results that a scene keeps; with some ten steps those of the last five or six sets of effects."""

_Result = TypeVar("_Result")


class _Results:
    """Results of steps by what they depend on; the one not asked for the longest is dropped."""

    def __init__(self) -> None:
        self._known: dict[Hashable, Any] = {}

    def get(self, key: Hashable, make: Callable[[], _Result]) -> _Result:
        """Return the result of this key, made where it isn't known."""
        found: _Result = self._known.pop(key) if key in self._known else make()
        self._known[key] = found
        if len(self._known) > _KEPT:
            del self._known[next(iter(self._known))]
        return found


@dataclass(frozen=True)
class Scene:
    """Hold one bag as the simulator needs it; times in s since the bag's first stamp.

    joint_s (nj,), joints (nj, n) as reported, m and rad; wrench_s (nw,), reading (nw, 6), N and
    N.m in ft_sensor; touched (nw,): where a hand may be at the tool; tracker_s (nt,), empty without
    a tracker. start_s: the bag's first stamp since the recording's. tool, adapter, zero_pose_rad
    (k,): as the tool's file says, None for home. inertia_kg_m2 (6,): of tool and adapter about the
    sensor's origin, as `galen_model.load.inertia` has it, where the nominal model has inertial
    forces; None where it has none. nominal: effects of every replay, as a file's mounting.
    No array may be changed afterwards.
    """

    bag: str
    start_s: float
    joint_s: Array
    joints: Array
    wrench_s: Array
    reading: Array
    touched: np.ndarray
    tracker_s: Array
    tool: ToolGeometry
    adapter: Load
    zero_pose_rad: tuple[float, ...] | None = None
    arm: Arm = field(kw_only=True)
    inertia_kg_m2: Array | None = None
    nominal: tuple[Effect, ...] = ()
    compliances: dict[tuple[Any, ...], Array] = field(
        init=False, default_factory=dict, repr=False, compare=False
    )
    """Of the tip, by joints and stiffnesses, as they are worked out: many replays share them."""
    results: _Results = field(init=False, default_factory=_Results, repr=False, compare=False)

    def instants(self, at_s: Array) -> Instants:
        """Return times of this bag as effects take them.

        Args:
            at_s: (n,), s since the bag's first stamp.

        Returns:
            The same, and since the recording's first stamp.

        """
        return Instants(self.bag, at_s, at_s + self.start_s)


_WRENCH, _TRACKER = "wrench", "tracker"
"""Streams, each with stamps and a delay of its own."""
_POSE = ("true_joints", "misaligned")
_UNTOUCHED = (*_POSE, "gravity", "tool_load", "wrench")
"""Hooks of the true wrench without contact."""
_READ = (*_UNTOUCHED, "read", "unread")
"""Hooks of the reading."""


class Replay:
    """Drive the simulator with some effects along a scene."""

    def __init__(self, scene: Scene, effects: Sequence[Effect] = ()) -> None:
        self.scene = scene
        effects = (*scene.nominal, *effects)
        self.effects = in_order(effects)
        self._delay_s = {
            _WRENCH: sum(effect.wrench_delay_s for effect in effects),
            _TRACKER: sum(effect.tracker_delay_s for effect in effects),
        }
        self._gravity = scene.arm.gravity_m_s2
        self.arm = scene.arm
        for effect in self.effects:
            self._gravity = effect.gravity(self._gravity)
            self.arm = effect.arm(self.arm)
        self._misaligned = self.arm
        for effect in self.effects:
            self._misaligned = effect.misaligned(self._misaligned)

    def _overriding(self, hooks: Sequence[str]) -> tuple[Effect, ...]:
        """Return the effects whose class overrides one of these hooks of the base."""
        return tuple(
            effect
            for effect in self.effects
            if any(getattr(type(effect), hook) is not getattr(Effect, hook) for hook in hooks)
        )

    def _shared(
        self,
        step: str,
        stream: str,
        hooks: Sequence[str],
        make: Callable[[], _Result],
        *more: Hashable,
    ) -> _Result:
        """Return a step's result, which depends on the effects with these hooks, and on `more`."""
        key = (step, stream, self._delay_s[stream], self._overriding(hooks), *more)
        return self.scene.results.get(key, make)

    # --- the wrench ---------------------------------------------------------------------------

    def reading(self) -> Array:
        """Return the reading (nw, 6) of a tool without contact at the wrenches' stamps.

        A sensor that remembers has that of the pushes before.
        """
        return self._shared("reading", _WRENCH, _READ, self._reading)

    def _reading(self) -> Array:
        when, true = self._untouched()
        remembering = set(self._overriding(("read",))) & set(self._overriding(("fresh",)))
        if not remembering or not self.scene.touched.any():
            return self._read(when, true)
        applied = self.applied_wrench()
        return self._read(when, true + applied) - applied

    def applied_wrench(self) -> Array:
        """Return the applied wrench (nw, 6) in ft_sensor; zero without contact."""
        return self._shared("applied", _WRENCH, _READ, self._applied_wrench)

    def _applied_wrench(self) -> Array:
        when, true = self._untouched()
        pushed = self.scene.reading
        for effect in reversed(self.effects):
            pushed = effect.unread(when, pushed)
        return np.where(self.scene.touched[:, None], pushed - true, 0.0)

    def _read(self, when: Instants, true: Array) -> Array:
        for effect in self.effects:
            true = effect.read(when, true)
        return true

    def _untouched(self) -> tuple[Instants, Array]:
        return self._shared("untouched", _WRENCH, _UNTOUCHED, self._true_untouched)

    def _true_untouched(self) -> tuple[Instants, Array]:
        scene, when = self.scene, self._when(_WRENCH)
        joints = self._joints(_WRENCH)
        gravity = self._shared(
            "gravity", _WRENCH, (*_POSE, "gravity"), lambda: self._gravity_at(joints)
        )
        total = _weight(gravity, *self._tool(gravity)) + _weight(
            gravity, *_mass_and_com(scene.adapter)
        )
        if scene.inertia_kg_m2 is not None:
            total = total + self._inertial_forces(scene.inertia_kg_m2)
        pulling = self._overriding(("wrench",))
        if pulling:
            posture = self._posture(joints, gravity, any(one.needs_motion for one in pulling))
            more = added(effect.fresh().wrench(when, posture) for effect in pulling)
            total = total if more is None else total + more
        return when, total - self.tare()

    def tare(self) -> Array:
        """Return the load (1, 6) that the sensor was zeroed at: the adapter's, N and N.m."""
        scene = self.scene
        pose = scene.arm.home_angles if scene.zero_pose_rad is None else scene.zero_pose_rad
        zero = scene.arm.with_angles(np.array([pose]), scene.joints[:1])
        at_zero = self._gravity_at(self._true_joints(scene.instants(np.zeros(1)), zero))
        return _weight(at_zero, *_mass_and_com(scene.adapter))

    def _tool(self, gravity: Array) -> tuple[float, Array]:
        """Return the true tool's mass and centre (n, 3) or (3,), with gravity (n, 3) on it."""
        mass, com = _mass_and_com(self.scene.tool.load)
        changing = self._overriding(("tool_load",))
        if changing:
            direction = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
            com = np.broadcast_to(com, direction.shape)
        for effect in changing:
            mass, com = effect.tool_load(mass, com, direction)
        return mass, com

    def _inertial_forces(self, inertia_kg_m2: Array) -> Array:
        """Return those of tool and adapter (nw, 6); the true tool's points for the file's."""
        file, tool = self.scene.tool.load, self._true_tool()
        inertia = inertia_kg_m2 + point_mass_inertia(tool) - point_mass_inertia(file)
        motion = self._motion()
        return inertial_wrench(
            *(-motion.acceleration_m_s2, motion.velocity_rad_s, motion.acceleration_rad_s2),
            *(tool.moments + self.scene.adapter.moments, inertia),
        )

    # --- the tip ------------------------------------------------------------------------------

    def tip(self, applied: Array | None = None) -> tuple[Array, Array]:
        """Return tool_tip's pose at the tracker's stamps, deflection included.

        Args:
            applied: what is pushed (nw, 6) at the wrenches' stamps, N and N.m in ft_sensor about
                its origin; None to take `applied_wrench`.

        Returns:
            Rotation (nt, 3, 3) and position (nt, 3) in base_link, m.

        """
        scene = self.scene
        if applied is None:
            applied = self.applied_wrench()
        when, joints, tip_m = self._when(_TRACKER), self._joints(_TRACKER), self._tip_m()
        rotation, origin = self._pose(_TRACKER)
        position = origin + rotation @ tip_m
        wrench_s = scene.wrench_s - self._delay_s[_WRENCH]
        between = self._shared(
            *("between", _TRACKER, (), lambda: Between(when.bag_s, wrench_s)),
            self._delay_s[_WRENCH],
        )
        at_tip = move_wrench(between.of(applied), rotation, origin - position)
        elastic = self._elastic(joints, at_tip)
        loading = Loading(joints, at_tip, elastic, tip_m, self.arm)
        more = added(effect.fresh().deflect(when, loading) for effect in self.effects)
        bent = elastic if more is None else elastic + more
        return rotvec_to_matrix(bent[:, 3:]) @ rotation, position + bent[:, :3]

    def _elastic(self, joints: Array, wrench: Array) -> Array:
        """Return the springs' displacement (nt, 6) at joints (nt, n) under wrenches (nt, 6)."""
        loaded = np.any(wrench != 0.0, axis=1)
        bent = np.zeros((len(joints), 6))
        if loaded.any():
            springs = self._shared(
                *("springs", _TRACKER, (*_POSE[:1], "arm"), lambda: self._springs(joints[loaded])),
                loaded.tobytes(),
            )
            bent[loaded] = (springs @ wrench[loaded, :, None])[..., 0]
        return bent

    def _springs(self, joints: Array) -> Array:
        """Return the tip's compliance (n, 6, 6) at joints (n, k): that of a place near by."""
        keys = np.round(joints / _STILL_POSE_M).astype(np.int64)
        # The arm stands most of the time: sorting all its rows would take longer than all the rest.
        new = np.concatenate([[True], np.any(np.diff(keys, axis=0) != 0, axis=1)])
        each = [self._compliance(place * _STILL_POSE_M) for place in keys[new]]
        return np.array(each)[np.cumsum(new) - 1]

    def _compliance(self, joints: Array) -> Array:
        key = (joints.tobytes(), *self.arm.stiffness.items())
        known = self.scene.compliances
        if key not in known:
            known[key] = self.arm.tip_compliance(joints, self.scene.tool.tip_m)
        return known[key]

    def seen_by_tracker(
        self, rotation: Array, position: Array, base_rotation: Array, base_position: Array
    ) -> tuple[Array, Array]:
        """Return the tip's pose in the tracker's frame, as the tracker reads it.

        Args:
            rotation: of the tip (nt, 3, 3) in base_link.
            position: of the tip (nt, 3) in base_link, m.
            base_rotation: of base_link (3, 3) in the tracker's frame.
            base_position: of base_link (3,) in the tracker's frame, m.

        Returns:
            Rotation (nt, 3, 3) and position (nt, 3), m.

        """
        when = self._when(_TRACKER)
        there = base_position + position @ base_rotation.T
        for effect in self.effects:
            there = effect.seen(when, there)
        return base_rotation @ rotation, there

    def base_marker(self) -> Array:
        """Return the base marker's displacement (nt, 6) in base_link at the tracker's stamps."""
        when = self._when(_TRACKER)
        moved = added(effect.base_marker(when) for effect in self.effects)
        return np.zeros((len(when), 6)) if moved is None else moved

    # --- inside -------------------------------------------------------------------------------

    def _when(self, stream: str) -> Instants:
        stamps = self.scene.wrench_s if stream == _WRENCH else self.scene.tracker_s
        return self.scene.instants(stamps - self._delay_s[stream])

    def _joints(self, stream: str) -> Array:
        """Return the true joints (n, k) at a stream's stamps."""

        def make() -> Array:
            when = self._when(stream)
            reported = _interpolated(when.bag_s, self.scene.joint_s, self.scene.joints)
            return self._true_joints(when, reported)

        return self._shared("joints", stream, _POSE[:1], make)

    def _true_joints(self, when: Instants, joints: Array) -> Array:
        for effect in self._overriding(_POSE[:1]):
            joints = effect.fresh().true_joints(when, joints)
        return joints

    def _pose(self, stream: str) -> tuple[Array, Array]:
        """Return the sensor's rotation (n, 3, 3) and origin (n, 3) at a stream's stamps."""
        joints = self._joints(stream)
        return self._shared("pose", stream, _POSE, lambda: self._misaligned.sensor_pose(joints))

    def _gravity_at(self, joints: Array) -> Array:
        """Return gravity (n, 3) in ft_sensor, m/s^2."""
        arm = self._misaligned
        return arm.direction_in_sensor(arm.angles(joints), self._gravity)

    def _posture(self, joints: Array, gravity: Array, needs_motion: bool) -> Posture:
        rotation, origin = self._pose(_WRENCH)
        return Posture(
            joints=joints,
            rotation=rotation,
            origin=origin,
            gravity=gravity,
            motion=self._motion() if needs_motion else None,
            tool=self._true_tool(),
            adapter=self.scene.adapter,
            tip_m=self._tip_m(),
            arm=self.scene.arm,
        )

    def _tip_m(self) -> Array:
        return np.asarray(self.scene.tool.tip_m, dtype=float)

    def _true_tool(self) -> Load:
        mass, com = self.scene.tool.load.mass_kg, np.reshape(self.scene.tool.load.com_m, (1, 3))
        for effect in self.effects:
            mass, com = effect.tool_load(mass, com, np.zeros((1, 3)))
        return Load(mass, com[0])

    def _motion(self) -> SensorMotion:
        """Return the sensor's motion at the wrenches' stamps.

        Rates come from the joints' own stamps: between them joints go in straight lines here.
        """

        def make() -> SensorMotion:
            scene, at_s = self.scene, self._when(_WRENCH).bag_s
            moving = self._true_joints(scene.instants(scene.joint_s), scene.joints)
            velocities, accelerations = (
                _interpolated(at_s, scene.joint_s, rate) for rate in rates(scene.joint_s, moving)
            )
            return sensor_motion(self._joints(_WRENCH), velocities, accelerations, self.arm)

        return self._shared("motion", _WRENCH, _POSE[:1], make)


def _mass_and_com(load: Load) -> tuple[float, Array]:
    return load.mass_kg, np.asarray(load.com_m, dtype=float)


def _weight(gravity: Array, mass_kg: float, com_m: Array) -> Array:
    """Wrench (n, 6) of a mass with its centre at com_m (3,) or (n, 3) under gravity (n, 3)."""
    x, y, z = (mass_kg * gravity).T
    a, b, c = np.moveaxis(com_m, -1, 0)
    return np.stack([x, y, z, b * z - c * y, c * x - a * z, a * y - b * x], axis=1)


class Between:
    """Linear interpolation at times at_s (n,) or (n, k) of values at known_s (m,); ends hold.

    As `np.interp` has it, but where a time lies is found once.
    """

    def __init__(self, at_s: Array, known_s: Array) -> None:
        last = max(len(known_s) - 1, 1)
        after = np.clip(np.searchsorted(known_s, at_s, side="right"), 1, last)
        self._before, self._after = after - 1, np.minimum(after, len(known_s) - 1)
        span = known_s[self._after] - known_s[self._before]
        part = np.clip((at_s - known_s[self._before]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
        self._part = part if part.ndim == 2 else part[:, None]

    def of(self, values: Array) -> Array:
        """Interpolate values.

        Args:
            values: (m, k) at the known times.

        Returns:
            (n, k); each column at its own times where those are (n, k).

        """
        if self._before.ndim == 2:
            before = np.take_along_axis(values, self._before, axis=0)
            after = np.take_along_axis(values, self._after, axis=0)
        else:
            before, after = values[self._before], values[self._after]
        return np.asarray(before + self._part * (after - before))


GAP_S = 0.3
"""A longer time between two stamps of a bag is a gap, of which nothing is known."""


def _interpolated(at_s: Array, known_s: Array, values: Array) -> Array:
    """Values (n, k) at known_s, linearly at at_s; ends hold, those of a gap to its middle."""
    gaps = np.flatnonzero(np.diff(known_s) > GAP_S)
    if len(gaps):
        middle = 0.5 * (known_s[gaps] + known_s[gaps + 1])
        known_s = np.insert(known_s, np.repeat(gaps + 1, 2), np.repeat(middle, 2))
        held = np.stack([values[gaps], values[gaps + 1]], axis=1).reshape(-1, values.shape[1])
        values = np.insert(values, np.repeat(gaps + 1, 2), held, axis=0)
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)


_RATE_WINDOW_S = 0.08


def rates(at_s: Array, joints: Array) -> tuple[Array, Array]:
    """Return velocity and acceleration of joints.

    Cubic polynomials over 80 ms (Savitzky and Golay, Anal. Chem. 36, 1964) on an even grid of the
    stamps' median period; across a gap of more than that nothing is known, and in a part too short
    for the window both are 0.

    Args:
        at_s: (n,), s, increasing.
        joints: (n, k), m and rad.

    Returns:
        Velocity (n, k), m/s and rad/s; acceleration (n, k), m/s^2 and rad/s^2.

    """
    velocity, acceleration = np.zeros_like(joints), np.zeros_like(joints)
    step = float(np.median(np.diff(at_s))) if len(at_s) > 1 else 0.0
    if step <= 0.0:
        return velocity, acceleration
    window = 2 * round(0.5 * _RATE_WINDOW_S / step) + 1
    window = max(window, 5)
    cuts = np.flatnonzero(np.diff(at_s) > _RATE_WINDOW_S) + 1
    for rows in np.split(np.arange(len(at_s)), cuts):
        if len(rows) < window + 2:
            continue
        here = at_s[rows]
        even = np.arange(here[0], here[-1] + 0.5 * step, step)
        if len(even) <= window:
            continue
        first, second = _cubic_slopes(_interpolated(even, here, joints[rows]), window)
        velocity[rows] = _interpolated(here, even, first / step)
        acceleration[rows] = _interpolated(here, even, second / step**2)
    return velocity, acceleration


def _cubic_slopes(values: Array, window: int) -> tuple[Array, Array]:
    """Return first and second derivatives by the sample, of cubics through values (n, k).

    Each of the window about a sample, at the ends of the first and the last. `scipy.signal` has
    this, but takes two seconds to be imported, in every command.
    """
    half = window // 2
    powers = np.vander(np.arange(-half, half + 1.0), 4, increasing=True)
    cubics = sliding_window_view(values, window, axis=0) @ np.linalg.pinv(powers).T
    middle = np.clip(np.arange(len(values)), half, len(values) - 1 - half)
    at = (np.arange(len(values)) - middle)[:, None]
    _, b, c, d = np.moveaxis(cubics[middle - half], -1, 0)
    return b + 2.0 * c * at + 3.0 * d * at**2, 2.0 * c + 6.0 * d * at
