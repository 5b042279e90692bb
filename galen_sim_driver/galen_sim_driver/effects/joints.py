"""Effects of joints and of the base (contract, section 6).

Zero offset: true angle = reported + offset; gain: true = (1 + gain) reported; with both
(1 + gain) reported + offset.

Misaligned axis: with the turn A of an axis in its parent link, the joint's rotation R(q) becomes
A R(q) A^T: at q = 0 the link is where it should be. For the tilt axis turned about its parent's z,

    R_base_sensor = Rx(roll) Rz(a) Ry(tilt) Rz(a)^T Ry(pi/2).

Inclined base: gravity in base_link is (Rx(a) Ry(b))^T g.

Compliance: the tip deflects by C w with C = sum over springs of J^T J / k, which is linear in 1/k.
A fit therefore works on how much softer than nominal a spring is,

    c = k_nominal / k - 1,

in which the deflection is linear, carriages and rods included: with the square matrix A of the
six rods' rows K_p^-1 = A^-1 (I / k_rod + G G^T / k_q) A^-T (`galen_model.arm.delta`).

Play in a joint: after each reversal its true value lags by half the gap.

In motion: with x the reported joint and h = gap / 2 the true one is the play operator's

    w_k = min(max(w_(k-1), x_k - h), x_k + h),    w_0 = x_0 + `start` h

(e.g. Brokate and Sprekels, Hysteresis and Phase Transitions, 1996, section 2.2): x - h while it
goes up, x + h while it goes down, and between the two it stays. Its place in the gap before the
first motion of a bag is unknown: `start`, 0 for the middle, is -1 after going up and 1 after going
down.

In a push: a moment M about the axis takes the joint to the side of the gap that it points to, and
there it stays until a moment points the other way. It takes M_s (`seat` times 0.05 N.m, or 0.5 N of
a sliding joint) to move it at all, so that what a sensor's noise makes of no load does nothing, and
3 M_s to take it all the way. With u = M / M_s, and clip to -1 ... 1,

    s_k = min(max(s_(k-1), clip(u - 2)), clip(u + 2)),

and the tip moves by s h less where it rested. Rest is where the last motion left the joint: on the
side it came from, s = -1 after going up; `start` before any motion. So the first push moves it by h
from the middle, and by the whole gap or not at all after a motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.rotation import rot_x, rot_y, rot_z
from galen_ros.parameters import param

from galen_sim_driver.effects.effect import (
    ROTARY_JOINTS,
    Effect,
    Fitted,
    Instants,
    Loading,
    check_choice,
)


@dataclass(frozen=True)
class _RotaryEffect(Effect):
    of_a_joint = True

    joint: str = param("tilt", "the joint: roll tilt")

    def validate(self) -> None:
        check_choice(self.name, "joint", self.joint, ROTARY_JOINTS)


@dataclass(frozen=True)
class JointZeroOffset(_RotaryEffect):
    """true angle of `joint` = reported + `offset_rad`."""

    name = "joint_zero_offset"
    fitted = (Fitted("offset_rad", "rad", 0.01, -0.5, 0.5),)
    order = 1

    offset_rad: float = param(0.0, "true angle minus the reported one, rad", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        true = joints.copy()
        true[:, GALEN.joint_names.index(self.joint)] += self.offset_rad
        return true


@dataclass(frozen=True)
class JointGain(_RotaryEffect):
    """true angle of `joint` = (1 + `gain`) reported."""

    name = "joint_gain"
    fitted = (Fitted("gain", "", 0.02, -0.5, 0.5),)

    gain: float = param(0.0, "true angle over the reported one, minus 1", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        true = joints.copy()
        true[:, GALEN.joint_names.index(self.joint)] *= 1.0 + self.gain
        return true


_ABOUT = {"x": rot_x, "y": rot_y, "z": rot_z}


@dataclass(frozen=True)
class JointAxisMisalignment(_RotaryEffect):
    """The axis of `joint` is turned by `angle_rad` about an axis of its parent link."""

    name = "joint_axis_misalignment"
    fitted = (Fitted("angle_rad", "rad", 0.02, -0.5, 0.5),)

    about: str = param("z", "axis of the parent link that it is turned about: x y z")
    angle_rad: float = param(0.0, "by how much it is turned, rad", -0.5, 0.5)

    def validate(self) -> None:
        super().validate()
        check_choice(self.name, "about", self.about, _ABOUT)

    def misaligned(self, arm: Arm) -> Arm:
        joints = list(arm.joints)
        index = arm.joint_names.index(self.joint)
        axis = _ABOUT[self.about](self.angle_rad) @ joints[index].axis
        joints[index] = replace(joints[index], axis=axis)
        return replace(arm, joints=tuple(joints))


@dataclass(frozen=True)
class BaseInclination(Effect):
    """Gravity in base_link is (Rx(`about_x_rad`) Ry(`about_y_rad`))^T (0, 0, -g)."""

    name = "base_inclination"
    fitted = (
        Fitted("about_x_rad", "rad", 0.01, -0.5, 0.5),
        Fitted("about_y_rad", "rad", 0.01, -0.5, 0.5),
    )

    about_x_rad: float = param(0.0, "the base is inclined so far about its x, rad", -0.5, 0.5)
    about_y_rad: float = param(0.0, "the same about its y, after x, rad", -0.5, 0.5)

    def gravity(self, gravity_base: Array) -> Array:
        turn = rot_x(self.about_x_rad) @ rot_y(self.about_y_rad)
        return np.asarray(turn.T @ gravity_base)


_SPRINGS = tuple(GALEN.stiffness)


def _softer(of: str) -> Fitted:
    return Fitted(f"softness_{of}", "", 0.3, -0.9, 20.0)


@dataclass(frozen=True)
class JointCompliance(Effect):
    """Stiffnesses of the true arm, SI; 0 for one that is as nominal.

    `vector` holds k_nominal / k - 1 of roll, tilt, carriages and rods, in this order.
    """

    name = "joint_compliance"
    fitted = tuple(map(_softer, _SPRINGS))
    contract_names: ClassVar[Mapping[str, str]] = {name: f"stiffness.{name}" for name in _SPRINGS}

    roll: float = param(0.0, "stiffness of the roll joint, 0 for the nominal one, Nm/rad", 0.0)
    tilt: float = param(0.0, "stiffness of the tilt joint, 0 for the nominal one, Nm/rad", 0.0)
    carriage: float = param(0.0, "stiffness of a carriage, 0 for the nominal one, N/m", 0.0)
    rod: float = param(0.0, "stiffness of a rod, 0 for the nominal one, N/m", 0.0)

    def vector(self) -> Array:
        softer = []
        for spring in _SPRINGS:
            stiffness = getattr(self, spring)
            softer.append(GALEN.stiffness[spring] / stiffness - 1.0 if stiffness > 0.0 else 0.0)
        return np.array(softer)

    def with_vector(self, vector: Array) -> Self:
        return replace(
            self,
            **{
                spring: GALEN.stiffness[spring] / (1.0 + float(softer)) if softer != 0.0 else 0.0
                for spring, softer in zip(_SPRINGS, vector, strict=True)
            },
        )

    def arm(self, arm: Arm) -> Arm:
        given = {spring: getattr(self, spring) for spring in _SPRINGS}
        return arm.with_stiffness({spring: k for spring, k in given.items() if k > 0.0})


_TILT = GALEN.joint_names.index("tilt")
_ROLL = GALEN.joint_names.index("roll")
_SEAT = (0.5, 0.5, 0.5, 0.05, 0.05)
_STILL = (5e-5, 5e-5, 5e-5, 5e-4, 5e-4)
"""Joints that move by less, m or rad, stand: some ten quanta of the encoders."""


class _Memory:
    """What a joint in its gap knows of before."""

    def __init__(self, start: float) -> None:
        self.true: float | None = None
        self.at: float | None = None
        self.rest = self.side = start


@dataclass(frozen=True)
class Backlash(Effect):
    """`joint` has a gap of `gap_rad`; of a sliding joint, in m."""

    name = "backlash"
    fitted = (
        Fitted("gap_rad", "rad", 0.002, 0.0, 0.2),
        Fitted("start", "", 1.0, -1.0, 1.0),
        Fitted("seat", "", 2.0, 0.1, 30.0),
    )
    beyond_contract = ("start", "seat")

    joint: str = param("tilt", "the joint with the gap: delta_x delta_y delta_z roll tilt")
    gap_rad: float = param(0.0, "the gap, rad; of a sliding joint in m", 0.0, 0.2)
    start: float = param(
        0.0, "where in its gap it starts, -1 to 1, as after going up or down", -1.0, 1.0
    )
    seat: float = param(
        1.0, "moment that moves it through its gap, over 0.05 Nm, or force over 0.5 N", 0.1, 30.0
    )

    _memory: ClassVar[_Memory | None] = None

    @property
    def changes_nothing(self) -> bool:
        return self.gap_rad == 0.0

    def validate(self) -> None:
        check_choice(self.name, "joint", self.joint, GALEN.joint_names)

    def fresh(self) -> Self:
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Memory(self.start))
        return new

    @property
    def _index(self) -> int:
        return GALEN.joint_names.index(self.joint)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        if not len(joints) or self.gap_rad == 0.0:
            return joints
        memory = self._memory or _Memory(self.start)
        half, reported = 0.5 * self.gap_rad, joints[:, self._index].tolist()
        now = reported[0] + self.start * half if memory.true is None else memory.true
        path = []
        for value in reported:
            now = min(max(now, value - half), value + half)
            path.append(now)
        memory.true = now
        true = joints.copy()
        true[:, self._index] = path
        return true

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        if not len(when) or self.gap_rad == 0.0:
            return None
        memory = self._memory or _Memory(self.start)
        column = self._column(loading)
        index = self._index
        loads = np.einsum("ni,ni->n", column, loading.wrench) / (self.seat * _SEAT[index])
        at = memory.at
        moved = []
        for place, load in zip(loading.joints[:, index].tolist(), loads.tolist(), strict=True):
            if at is None:
                at = place
            elif abs(place - at) > _STILL[index]:
                memory.rest = memory.side = -1.0 if place > at else 1.0
                at = place
            low, high = (min(max(load + way, -1.0), 1.0) for way in (-2.0, 2.0))
            memory.side = min(max(memory.side, low), high)
            moved.append(memory.side - memory.rest)
        memory.at = at
        return 0.5 * self.gap_rad * np.array(moved)[:, None] * column

    def _column(self, loading: Loading) -> Array:
        """Twist of the tip (n, 6) in base_link over the joint's rate.

        The tip lies from the tilt axis by Ry(tilt) (tilt to sensor + Ry(pi/2) tip) in the axes of
        the roll link, and from the roll axis by that and roll to tilt.
        """
        column = np.zeros((len(loading.joints), 6))
        index = self._index
        if index < _ROLL:
            column[:, index] = 1.0
            return column
        tilt, arm = loading.joints[:, _TILT], loading.arm
        z, y, x = -loading.tip_m[0], loading.tip_m[1], loading.tip_m[2]
        x, y, z = np.array([x, y, z]) + arm.sensor_origin_m
        lever = np.stack(
            [
                np.cos(tilt) * x + np.sin(tilt) * z,
                0.0 * tilt + y,
                np.cos(tilt) * z - np.sin(tilt) * x,
            ],
            axis=1,
        )
        axis = np.array([0.0, 1.0, 0.0])
        if index == _ROLL:
            lever, axis = lever + arm.joints[_TILT].origin_m, np.array([1.0, 0.0, 0.0])
        roll = rot_x(loading.joints[:, _ROLL])
        column[:, :3] = np.einsum("nij,nj->ni", roll, np.cross(axis, lever))
        column[:, 3:] = roll @ axis
        return column
