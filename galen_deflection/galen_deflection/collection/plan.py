"""What a collection is to record: positions x directions x levels, checked before the arm moves.

As in the 2019 report (section 2.3.4): several levels of force in both directions along all axes,
at various positions, each visited twice. The axes are those of base_link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, JOINT_UNITS, LIMITS
from galen_model.arm.kinematics import sensor_pose, tip_pose
from galen_model.arrays import Array
from galen_model.errors import GalenError, KinematicsError
from galen_model.wrench import move_wrench

from galen_deflection.measurement.arm_positions import PositionSettings

MOST_POSITIONS, MOST_LEVELS, MOST_SETS = 100, 20, 20


class PlanError(GalenError):
    """A collection that makes no sense; the message names the value."""


class OutOfReachError(PlanError):
    """A position that the arm can't take; the message names it and the joint."""


@dataclass(frozen=True)
class LoadLimits:
    """The largest force (N), and torque about the sensor's origin (N.m), that it may read."""

    force_n: float
    torque_nm: float


@dataclass(frozen=True)
class WantedPush:
    """A push along one axis: `axis` 0 to 5 of a wrench, `sign` +1 or -1, `level` in N or N.m."""

    axis: int
    sign: int
    level: float

    @property
    def is_force(self) -> bool:
        """Whether it is a force, not a torque."""
        return self.axis < 3

    @property
    def unit(self) -> str:
        """Of the level."""
        return "N" if self.is_force else "N·m"

    @property
    def wrench(self) -> Array:
        """(6,) about the tip along base_link's axes, N and N.m."""
        wrench = np.zeros(6)
        wrench[self.axis] = self.sign * self.level
        return wrench

    def __str__(self) -> str:
        """Name it, as in "6 N along -x" or "0.3 N·m about +z"."""
        axis = f"{'+' if self.sign > 0 else '-'}{'xyz'[self.axis % 3]}"
        return f"{self.level:g} {self.unit} {'along' if self.is_force else 'about'} {axis}"


@dataclass(frozen=True)
class CollectionPlan:
    """positions (p, 5), m and rad; the same pushes at each visit; `sets` visits of each."""

    positions: Array
    pushes: tuple[WantedPush, ...]
    sets: int

    @property
    def total(self) -> int:
        """Pushes in all visits."""
        return self.sets * len(self.positions) * len(self.pushes)


def make_plan(
    positions: Sequence[float] | Array,
    forces_n: Sequence[float],
    torques_nm: Sequence[float],
    sets: int,
    tip_m: Array,
    limits: LoadLimits,
) -> CollectionPlan:
    """Check what is asked for; positions are rows of five joints, flat or not.

    Raises OutOfReachError, and PlanError for anything else that can't be done.
    """
    flat = np.asarray(positions, dtype=float).reshape(-1)
    if not len(flat) or len(flat) % 5 or len(flat) > 5 * MOST_POSITIONS:
        raise PlanError(
            f"positions holds {len(flat)} numbers: five joints a position are wanted, of 1 to"
            f" {MOST_POSITIONS} positions"
        )
    rows = flat.reshape(-1, 5)
    for number, joints in enumerate(rows, start=1):
        _check_reach(number, joints)
    same = PositionSettings().tolerance
    for a, b in combinations(range(len(rows)), 2):
        if np.all(np.abs(rows[a] - rows[b]) <= same):
            raise PlanError(f"positions {a + 1} and {b + 1} are the same place")
    if not 1 <= sets <= MOST_SETS:
        raise PlanError(f"sets is {sets}: it must be 1 to {MOST_SETS}")
    if sets > 1 and len(rows) == 1:
        raise PlanError(
            "two sets at a single position can't be distinguished: the arm must go elsewhere"
            " between"
        )
    for name, levels in (("forces_n", forces_n), ("torques_nm", torques_nm)):
        if len(levels) > MOST_LEVELS or not all(np.isfinite(v) and v > 0.0 for v in levels):
            shown = ", ".join(f"{value:g}" for value in levels)
            raise PlanError(f"{name} is [{shown}]: at most {MOST_LEVELS} positive numbers")
    pushes = tuple(
        WantedPush(first + axis, sign, float(level))
        for first, levels in ((0, forces_n), (3, torques_nm))
        for axis in range(3)
        for sign in (1, -1)
        for level in levels
    )
    if not pushes:
        raise PlanError("forces_n and torques_nm are both empty: there is nothing to push")
    for number, joints in enumerate(rows, start=1):
        for push in pushes:
            _check_load(number, joints, push, tip_m, limits)
    return CollectionPlan(rows, pushes, sets)


def _check_reach(number: int, joints: Array) -> None:
    for name, unit, value, low, high in zip(
        JOINT_NAMES, JOINT_UNITS, joints, LIMITS.lower, LIMITS.upper, strict=True
    ):
        if not low <= value <= high:  # NaN too
            raise OutOfReachError(
                f"position {number}: {name} = {value:g} {unit} is outside its limits,"
                f" {low:g} ... {high:g} {unit}"
            )
    try:
        # Between two such positions it is well too: a carriage's coordinate is convex in the
        # platform's position, and in the joints' box it has room to spare downwards.
        GALEN.delta.carriages(joints[:3])
    except KinematicsError as error:
        raise OutOfReachError(f"position {number}: {error}") from None


def _check_load(
    number: int, joints: Array, push: WantedPush, tip_m: Array, limits: LoadLimits
) -> None:
    """The sensor must bear it."""
    read = to_tip(joints, tip_m).inverse_of(push.wrench)
    force, torque = float(np.linalg.norm(read[:3])), float(np.linalg.norm(read[3:]))
    if force > limits.force_n or torque > limits.torque_nm:
        raise PlanError(
            f"position {number}: {push} would be {force:.2f} N and {torque:.2f} N·m at the sensor,"
            f" more than max_force_n = {limits.force_n:g} and max_torque_nm ="
            f" {limits.torque_nm:g} allow"
        )


@dataclass(frozen=True)
class ToTip:
    """Takes wrenches from ft_sensor to the tip in base_link, and back, where the arm stands."""

    rotation: Array
    lever_m: Array

    def __call__(self, wrench: Array) -> Array:
        """(..., 6) in ft_sensor to (..., 6) about the tip along base_link's axes."""
        return move_wrench(wrench, self.rotation, -self.lever_m)

    def inverse_of(self, at_tip: Array) -> Array:
        """The wrench (..., 6) in ft_sensor that is `at_tip` there."""
        return move_wrench(at_tip, self.rotation.T, self.rotation.T @ self.lever_m)


def to_tip(joints: Array, tip_m: Array) -> ToTip:
    """For joints (5,), m and rad, and tip_m (3,) in ft_sensor."""
    rotation, origin = sensor_pose(joints)
    _, tip = tip_pose(joints, tip_m)
    return ToTip(rotation, tip - origin)
