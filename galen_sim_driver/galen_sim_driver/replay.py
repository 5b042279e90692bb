"""Simulate the readings of sensor and tracker along recorded joint states.

    reading = read(W(true pose; tool) + W(true pose; adapter) - W(true bias pose; adapter) + others)
    tip     = T(true joints) moved by the deflection that the applied wrench causes

with effects (`effects/`) in the places that `effects/effect.py` tells. Everything works on whole
bags at once. What a hand pushed is not known beforehand: it is what a reading tells beyond the
prediction, `applied_wrench`. No noise, no quanta.

Sensor errors act on the zeroed reading. Had the zero been taken through the same errors, that would
be the same but for where a saturated axis clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arm.sensor_motion import SensorMotion, sensor_motion
from galen_model.arrays import Array
from galen_model.load.model import Load, ToolGeometry
from galen_model.registration import move_wrench
from galen_model.rotation import rotvec_to_matrix
from scipy.signal import savgol_filter

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


@dataclass(frozen=True)
class Scene:
    """Hold one bag as the simulator needs it; times in s since the bag's first stamp.

    joint_s (nj,), joints (nj, 5) as reported, m and rad; wrench_s (nw,), reading (nw, 6), N and
    N.m in ft_sensor; touched (nw,): where a hand may be at the tool; tracker_s (nt,), empty without
    a tracker. start_s: the bag's first stamp since the recording's. tool, adapter, zero_pose_rad
    (k,): as the tool's file says.
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
    zero_pose_rad: tuple[float, ...] = (0.0, 0.0)
    arm: Arm = GALEN
    compliances: dict[tuple[Any, ...], Array] = field(
        init=False, default_factory=dict, repr=False, compare=False
    )
    """Of the tip, by joints and stiffnesses, as they are worked out: many replays share them."""

    def instants(self, at_s: Array) -> Instants:
        """Return times of this bag as effects take them."""
        return Instants(self.bag, at_s, at_s + self.start_s)


class Replay:
    """Drive the simulator with some effects along a scene."""

    def __init__(self, scene: Scene, effects: Sequence[Effect] = ()) -> None:
        self.scene = scene
        self.effects = in_order(effects)
        self._wrench_delay_s = sum(effect.wrench_delay_s for effect in effects)
        self._tracker_delay_s = sum(effect.tracker_delay_s for effect in effects)
        self._gravity = scene.arm.gravity_m_s2
        self._known: tuple[Instants, Array] | None = None
        self.arm = scene.arm
        for effect in effects:
            self._gravity = effect.gravity(self._gravity)
            self.arm = effect.arm(self.arm)
        self._misaligned = self.arm
        for effect in effects:
            self._misaligned = effect.misaligned(self._misaligned)

    # --- the wrench ---------------------------------------------------------------------------

    def reading(self) -> Array:
        """Return the reading (nw, 6) of a tool without contact at the wrenches' stamps."""
        when, true = self._untouched()
        return self._read(when, true)

    def applied_wrench(self) -> Array:
        """Return the applied wrench (nw, 6) in ft_sensor; zero without contact."""
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
        if self._known is None:
            self._known = self._true_untouched()
        return self._known

    def _true_untouched(self) -> tuple[Instants, Array]:
        scene = self.scene
        at_s = scene.wrench_s - self._wrench_delay_s
        when = scene.instants(at_s)
        needs_motion = any(effect.needs_motion for effect in self.effects)
        posture = self._posture(when, self._joints_at(at_s), needs_motion)
        total = self._weight(posture, with_tool=True)
        more = added(effect.fresh().wrench(when, posture) for effect in self.effects)
        total = total if more is None else total + more
        zero = scene.arm.with_angles(np.array([scene.zero_pose_rad]), scene.joints[:1])
        at_zero = self._posture(scene.instants(np.zeros(1)), zero, False)
        return when, total - self._weight(at_zero, with_tool=False)

    def _weight(self, posture: Posture, *, with_tool: bool) -> Array:
        loads = [(self.scene.adapter.mass_kg, np.asarray(self.scene.adapter.com_m, dtype=float))]
        if with_tool:
            direction = posture.gravity / np.linalg.norm(posture.gravity, axis=1, keepdims=True)
            mass = self.scene.tool.load.mass_kg
            com = np.broadcast_to(self.scene.tool.load.com_m, direction.shape)
            for effect in self.effects:
                mass, com = effect.tool_load(mass, com, direction)
            loads.append((mass, com))
        force = sum(mass * posture.gravity for mass, _ in loads)
        torque = sum(np.cross(com, mass * posture.gravity) for mass, com in loads)
        return np.concatenate([force, torque], axis=1)

    # --- the tip ------------------------------------------------------------------------------

    def tip(self, applied: Array | None = None) -> tuple[Array, Array]:
        """Return tool_tip's rotation (nt, 3, 3) and position (nt, 3) in base_link.

        At the tracker's stamps.

        applied (nw, 6): what is pushed at the wrenches' stamps; None to take `applied_wrench`.
        """
        scene = self.scene
        if applied is None:
            applied = self.applied_wrench()
        at_s = scene.tracker_s - self._tracker_delay_s
        when = scene.instants(at_s)
        joints = self._joints_at(at_s)
        posture = self._posture(when, joints, False)
        tip_m = np.asarray(scene.tool.tip_m, dtype=float)
        rotation = posture.rotation
        position = posture.origin + rotation @ tip_m
        wrench_s = scene.wrench_s - self._wrench_delay_s
        pushed = _interpolated(at_s, wrench_s, applied)
        at_tip = move_wrench(pushed, rotation, posture.origin - position)
        elastic = self._elastic(posture.joints, at_tip)
        loading = Loading(posture.joints, at_tip, elastic, tip_m, self.arm)
        more = added(effect.fresh().deflect(when, loading) for effect in self.effects)
        bent = elastic if more is None else elastic + more
        return rotvec_to_matrix(bent[:, 3:]) @ rotation, position + bent[:, :3]

    def _elastic(self, joints: Array, wrench: Array) -> Array:
        bent = np.zeros((len(joints), 6))
        loaded = np.flatnonzero(np.any(wrench != 0.0, axis=1))
        if not len(loaded):
            return bent
        keys = np.round(joints[loaded] / _STILL_POSE_M).astype(np.int64)
        places, which = np.unique(keys, axis=0, return_inverse=True)
        for number, place in enumerate(places):
            rows = loaded[which.ravel() == number]
            bent[rows] = wrench[rows] @ self._compliance(place * _STILL_POSE_M).T
        return bent

    def _compliance(self, joints: Array) -> Array:
        key = (joints.tobytes(), *self.arm.stiffness.values())
        known = self.scene.compliances
        if key not in known:
            known[key] = self.arm.tip_compliance(joints, self.scene.tool.tip_m)
        return known[key]

    def seen_by_tracker(
        self, rotation: Array, position: Array, base_rotation: Array, base_position: Array
    ) -> tuple[Array, Array]:
        """Return the tip in the tracker's frame, with base_link at the given pose there.

        rotation (nt, 3, 3), position (nt, 3) in base_link; their readings by the tracker.
        """
        when = self.scene.instants(self.scene.tracker_s - self._tracker_delay_s)
        there = base_position + position @ base_rotation.T
        for effect in self.effects:
            there = effect.seen(when, there)
        return base_rotation @ rotation, there

    def base_marker(self) -> Array:
        """Return the base marker's displacement (nt, 6) in base_link at the tracker's stamps."""
        when = self.scene.instants(self.scene.tracker_s - self._tracker_delay_s)
        moved = added(effect.base_marker(when) for effect in self.effects)
        return np.zeros((len(when), 6)) if moved is None else moved

    # --- inside -------------------------------------------------------------------------------

    def _joints_at(self, at_s: Array) -> Array:
        return _interpolated(at_s, self.scene.joint_s, self.scene.joints)

    def _posture(self, when: Instants, reported: Array, needs_motion: bool) -> Posture:
        joints = reported
        for effect in self.effects:
            joints = effect.fresh().true_joints(when, joints)
        rotation, origin = self._misaligned.sensor_pose(joints)
        return Posture(
            joints=joints,
            rotation=rotation,
            origin=origin,
            gravity=np.einsum("nji,j->ni", rotation, self._gravity),
            motion=self._motion(when.bag_s, joints) if needs_motion else None,
            tool=self._true_tool(),
            adapter=self.scene.adapter,
            tip_m=np.asarray(self.scene.tool.tip_m, dtype=float),
        )

    def _true_tool(self) -> Load:
        mass, com = self.scene.tool.load.mass_kg, np.reshape(self.scene.tool.load.com_m, (1, 3))
        for effect in self.effects:
            mass, com = effect.tool_load(mass, com, np.zeros((1, 3)))
        return Load(mass, com[0])

    def _motion(self, at_s: Array, joints: Array) -> SensorMotion:
        """Motion at times at_s (n,), where the true joints are joints (n, 5).

        Rates come from the joints' own stamps: between them joints go in straight lines here.
        """
        scene = self.scene
        moving = scene.joints
        for effect in self.effects:
            moving = effect.fresh().true_joints(scene.instants(scene.joint_s), moving)
        velocities, accelerations = (
            _interpolated(at_s, scene.joint_s, rate) for rate in rates(scene.joint_s, moving)
        )
        return sensor_motion(joints, velocities, accelerations, self.arm)


def _interpolated(at_s: Array, known_s: Array, values: Array) -> Array:
    """Values (n, k) at known_s, linearly at at_s; the ends hold."""
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)


_RATE_WINDOW_S = 0.08


def rates(at_s: Array, joints: Array) -> tuple[Array, Array]:
    """Return velocity and acceleration (n, 5) of joints (n, 5) at times at_s (n,), s.

    Cubic polynomials over 80 ms (Savitzky and Golay, Anal. Chem. 36, 1964) on an even grid of the
    stamps' median period; across a gap of more than that nothing is known, and both are 0 there.
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
        on_even = _interpolated(even, here, joints[rows])
        for order, out in ((1, velocity), (2, acceleration)):
            fitted = savgol_filter(on_even, window, 3, deriv=order, delta=step, axis=0)
            out[rows] = _interpolated(here, even, fitted)
    return velocity, acceleration
