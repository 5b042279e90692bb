# SPDX-License-Identifier: Apache-2.0
"""The plan of a collection, its commands, and the node's parameters, checked before it moves.

As in the 2019 report (section 2.3.4): several levels of force in both directions along all axes,
at various positions, each visited twice. The axes are those of base_link.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import combinations
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from galen_common.goal.parameters import MotionParameters
from galen_common.goal.procedure import End, MoveTo, Stop
from galen_common.parameters import param
from galen_model.arm.clearance import ArmClearance, ObstacleError
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.registration import move_wrench

from galen_deflection.measurement.arm_track import same_position

NOTHING = np.full(6, np.nan)
NOTHING.setflags(write=False)
"""A load that isn't looked at."""


class State(IntEnum):
    """States as in CollectPushes's feedback."""

    CALIBRATION = 0
    MOVE = 1
    UNTOUCHED = 2
    PUSH = 3
    HOLD = 4
    RELEASE = 5
    REST = 6


COLLECTION_PHASES = {
    State.CALIBRATION: "calibration set: keep off",
    State.MOVE: "moving: keep off",
    State.UNTOUCHED: "without contact: keep off",
    State.PUSH: "push",
    State.HOLD: "hold",
    State.RELEASE: "let go",
    State.REST: "keep off until the next push",
}
"""The states in words."""


class ErrorCode(IntEnum):
    """Error codes as in CollectPushes's result."""

    NONE = 0
    INVALID_NAME = 1
    CANCELED = 2
    DRIVER_SILENT = 3
    MOTION_TIMEOUT = 4
    SERVICE_FAILED = 5
    TOOL_FILE = 6
    OUT_OF_REACH = 7
    BAD_INPUT = 8
    NOT_UNTOUCHED = 9
    OVERLOAD = 10
    NO_PUSHES = 11
    WRITE_FAILED = 12
    INTERNAL = 99


@dataclass(frozen=True)
class Record:
    """Record into this bag from now on, and no more into the one before.

    Answer with `on_recording` as soon as every topic has been recorded at least once.
    """

    bag: str


@dataclass(frozen=True)
class Push:
    """Call `push_tool`: wrench (6,) about the tip along base_link's axes, N and N.m, times in s.

    Answer with `on_service`.
    """

    wrench: Array
    rise_s: float
    hold_s: float
    fall_s: float


@dataclass(frozen=True)
class Feedback:
    """One feedback message of the action; loads (6,) at the tip in base_link, N and N.m."""

    state: State
    message: str
    set_number: int = 0
    position: int = 0
    done: int = 0
    wanted: Array = field(default_factory=lambda: NOTHING)
    load: Array = field(default_factory=lambda: NOTHING)
    along: float = float("nan")
    aside: float = float("nan")


@dataclass(frozen=True)
class Finished(End):
    """The collection is over, and this has come of it.

    left_out: pushes that were not as asked, each with its reason. shift (6,): by the second
    calibration set, as `collection_shift` has it, NaN without one; holds: within the tolerance.
    """

    error_code: ErrorCode
    pushes: int = 0
    left_out: tuple[str, ...] = ()
    shift: Array = field(default_factory=lambda: NOTHING)
    holds: bool = False
    warnings: tuple[str, ...] = ()


Command = MoveTo | Stop | Record | Push | Feedback | Finished

MOST_POSITIONS, MOST_LEVELS, MOST_SETS = 100, 20, 20

_POSITIONS = (
    (0.00, 0.00, 0.408, 0.0, 0.0),
    (0.06, -0.05, 0.43, 0.7, -0.4),
    (-0.07, 0.04, 0.37, -0.9, 0.5),
    (0.03, 0.07, 0.40, 0.3, 0.8),
)
"""The Galen's, those of bags/pushes."""
_OFFSET = (0.03, 0.15)
"""From the present pose of another arm, around which nothing is known: the tip moves decimetres."""
_SIGNS = np.array([[1, -1, 1, -1], [1, 1, -1, -1], [-1, 1, 1, -1]])
"""By position and joint, those of four joints again and again."""


class PlanError(GalenError):
    """A collection that makes no sense; the message names the value."""


class OutOfReachError(PlanError):
    """A position that the arm can't take; the message names it and the joint."""


class WantedPush(NamedTuple):
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
    """positions (p, j), m and rad; the same pushes at each visit; `sets` visits of each.

    from_present: positions are counted from where the arm stands at the start. warnings: which
    collisions are not checked.
    """

    positions: Array
    pushes: tuple[WantedPush, ...]
    sets: int
    from_present: bool = False
    warnings: tuple[str, ...] = ()

    @property
    def total(self) -> int:
        """Pushes in all visits."""
        return self.sets * len(self.positions) * len(self.pushes)

    def begun_at(
        self, joints: Array, settings: CollectionParameters, tip_m: Array
    ) -> CollectionPlan:
        """Return the plan of an arm that stands at some joints.

        An arm with a description of its links is kept from hitting itself on its ways.

        Args:
            joints: (j,) where the arm stands at the start, m and rad.
            settings: the node's parameters.
            tip_m: (3,) in ft_sensor.

        Returns:
            The plan with the positions that the arm goes to.

        Raises:
            PlanError: as `make_plan`, or for a collision on the ways.

        """
        plan, arm = self, settings.arm
        if self.from_present:
            rows = np.clip(joints + self.positions, arm.lower, arm.upper)
            rows[0] = joints
            plan = replace(self, positions=rows, from_present=False)
            _check(plan, settings, tip_m)
        if arm.delta is None and arm.urdf:
            plan = replace(plan, warnings=_check_ways(plan.positions, joints, settings, tip_m))
        return plan


@dataclass(frozen=True)
class CollectionParameters(MotionParameters):
    """Parameters of collection_node."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    recordings_dir: str = param(
        "~/.ros/galen/recordings", "directory in which the recordings are made; `~` is expanded"
    )

    positions: tuple[float, ...] = param(
        [],
        "the arm's joints of one position after the other, m and rad; the first position is also"
        " that of the calibration sets; empty: four, of the Galen those of bags/pushes, of another"
        f" arm where it stands and {_OFFSET[1]:g} rad, {_OFFSET[0]:g} m about it",
    )
    sets: int = param(2, "how often each position is visited", minimum=1, maximum=MOST_SETS)
    forces_n: tuple[float, ...] = param(
        [3.0, 6.0, 10.0], "levels of force to both sides along each axis of base_link, N"
    )
    torques_nm: tuple[float, ...] = param(
        [], "levels of torque about the tip to both sides about each axis of base_link, N·m"
    )

    untouched_s: float = param(
        3.0, "the tool is left alone for so long at the start of each set", 0.6, 60.0
    )
    untouched_timeout_s: float = param(
        60.0, "a tool that is not left alone, or a marker not seen, for so long ends it", 1.0, 3600
    )
    level_tolerance: float = param(
        0.15, "a push is as asked within this share of its level", 0.01, 1.0
    )
    aside_share: float = param(
        0.3, "most of it that may go aside of its axis, as a share of its level", 0.01, 10.0
    )
    hold_s: float = param(0.5, "a push is held for so long", 0.05, 60.0)
    rest_s: float = param(0.5, "the tool is left alone for so long after a push", 0.1, 60.0)
    push_timeout_s: float = param(20.0, "a person has so long for a push", 0.5, 3600.0)
    push_retries: int = param(1, "how often a push that was not as asked is asked for again", 0, 10)

    max_force_n: float = param(20.0, "more force, at any time, stops the arm, N", 0.1, 500.0)
    max_torque_nm: float = param(
        2.9, "more torque about the sensor's origin stops the arm, N·m", 0.01, 100.0
    )
    shift_tolerance_m: float = param(
        0.0001, "largest way of the tip between the calibration sets, m", 1e-6, 0.1
    )
    shift_tolerance_rad: float = param(0.0003, "and its largest turn, rad", 1e-6, 0.5)

    # Without contact the mean wrench of 0.1 s stays this near to itself, N and N.m.
    untouched_tolerance: ClassVar[Array] = np.array([0.2] * 3 + [0.02] * 3)
    # A marker that isn't seen for longer spoils a push or a start, s.
    max_marker_gap_s: ClassVar[float] = 0.2
    # A push that comes to this share of its level is asked for again.
    overload_share: ClassVar[float] = 1.6
    # Released: below this force and torque about the tip, N and N.m.
    released: ClassVar[tuple[float, float]] = (0.15, 0.02)
    release_timeout_s: ClassVar[float] = 10.0
    # So many pushes left out in a row end it.
    max_left_out_in_a_row: ClassVar[int] = 4
    # In which `push_tool` shall rise and fall.
    push_edge_s: ClassVar[float] = 0.3

    def validate(self) -> None:
        """Reject positions or levels that can't be; raises PlanError."""
        make_plan(self, np.zeros(3))

    def folder(self, name: str) -> Path:
        """Return one of the two directories.

        Args:
            name: the parameter's name, `tools_dir` or `recordings_dir`.

        Returns:
            The directory, with `~` expanded.

        """
        return Path(getattr(self, name)).expanduser()


def make_plan(settings: CollectionParameters, tip_m: Array) -> CollectionPlan:
    """Check what is asked for, and make the plan.

    Args:
        settings: the node's parameters, with what a goal asks for in their place.
        tip_m: (3,) in ft_sensor.

    Returns:
        The plan; `from_present` where no positions are given for an arm other than the Galen.

    Raises:
        OutOfReachError: a position that the arm can't take.
        PlanError: anything else that can't be done, as a push that the sensor must not read.

    """
    arm, sets = settings.arm, settings.sets
    if not 1 <= sets <= MOST_SETS:
        raise PlanError(f"sets is {sets}: it must be 1 to {MOST_SETS}")
    pushes: list[WantedPush] = []
    for first, name, levels in (
        (0, "forces_n", settings.forces_n),
        (3, "torques_nm", settings.torques_nm),
    ):
        if len(levels) > MOST_LEVELS or not all(np.isfinite(v) and v > 0.0 for v in levels):
            shown = ", ".join(f"{value:g}" for value in levels)
            raise PlanError(f"{name} is [{shown}]: at most {MOST_LEVELS} positive numbers")
        pushes += [
            WantedPush(first + axis, sign, float(level))
            for axis in range(3)
            for sign in (1, -1)
            for level in levels
        ]
    if not pushes:
        raise PlanError("forces_n and torques_nm are both empty: there is nothing to push")
    flat, count = np.asarray(settings.positions, dtype=float).reshape(-1), len(arm.joints)
    if len(flat) % count or len(flat) > count * MOST_POSITIONS:
        raise PlanError(
            f"positions holds {len(flat)} numbers: {count} joints a position are wanted, of 1 to"
            f" {MOST_POSITIONS} positions"
        )
    if not len(flat) and arm.joint_names != GALEN.joint_names:
        signs = np.vstack([np.zeros(count), np.resize(_SIGNS.T, (count, len(_SIGNS))).T])
        return CollectionPlan(signs * arm.by_unit(*_OFFSET), tuple(pushes), sets, True)
    rows = flat.reshape(-1, count) if len(flat) else np.array(_POSITIONS)
    plan = CollectionPlan(rows, tuple(pushes), sets)
    _check(plan, settings, tip_m)
    return plan


def _check(plan: CollectionPlan, settings: CollectionParameters, tip_m: Array) -> None:
    """Raise PlanError for positions that can't be, or a push that the sensor must not read."""
    rows, arm = plan.positions, settings.arm
    for number, joints in enumerate(rows, start=1):
        # Between two such positions the carriages are well too: a carriage's coordinate is convex
        # in the platform's position, and in the joints' box it has room to spare downwards.
        if fault := arm.limit_fault(joints):
            raise OutOfReachError(f"position {number}: {fault}")
    for a, b in combinations(range(len(rows)), 2):
        if np.all(np.abs(rows[a] - rows[b]) <= same_position(arm)):
            raise PlanError(f"positions {a + 1} and {b + 1} are the same place")
    if plan.sets > 1 and len(rows) == 1:
        raise PlanError(
            "two sets at a single position can't be distinguished: the arm must go elsewhere"
            " between"
        )
    for number, joints in enumerate(rows, start=1):
        for push in plan.pushes:
            _check_load(number, joints, push, tip_m, settings)


def _check_ways(
    rows: Array, joints: Array, settings: CollectionParameters, tip_m: Array
) -> tuple[str, ...]:
    """Return which collisions are not checked; raises PlanError for one on the ways."""
    if not np.all(np.isfinite(joints)):
        raise PlanError(f"joint_states holds {joints.tolist()}: all joints must be finite")
    arm = settings.arm
    try:
        clearance = ArmClearance((), 0.0, tip_m, arm, joints)
        if settings.require_collision_shapes:
            clearance.require_shapes()
    except ObstacleError as error:
        raise PlanError(str(error)) from error
    start, name = joints, "where the arm stands"
    # The last set ends at the last position, and the calibration set after it is at the first.
    for place, goal in [*enumerate(rows, start=1), (1, rows[0])]:
        if fault := clearance.path_fault(arm.nearest(start, goal), goal):
            raise OutOfReachError(
                f"position {place}: on the way from {name}, {fault}; choose other positions, or"
                " start from another pose"
            )
        start, name = goal, f"position {place}"
    return clearance.warnings


def _check_load(
    number: int, joints: Array, push: WantedPush, tip_m: Array, settings: CollectionParameters
) -> None:
    """Raise PlanError for a push that the sensor must not read."""
    rotation, tip = settings.arm.tip_pose(joints, tip_m)
    _, origin = settings.arm.sensor_pose(joints)
    read = move_wrench(push.wrench, rotation.T, rotation.T @ (tip - origin))
    force, torque = float(np.linalg.norm(read[:3])), float(np.linalg.norm(read[3:]))
    if force > settings.max_force_n or torque > settings.max_torque_nm:
        raise PlanError(
            f"position {number}: {push} would be {force:.2f} N and {torque:.2f} N·m at the sensor,"
            f" more than max_force_n = {settings.max_force_n:g} and max_torque_nm ="
            f" {settings.max_torque_nm:g} allow"
        )
