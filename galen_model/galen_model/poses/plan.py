# SPDX-License-Identifier: Apache-2.0
"""Which poses a sweep visits: the grid's, chosen or listed ones, and the ways around boxes.

The grid is over tilt and roll. The 2019 report sweeps 7 tilts x 8 rolls = 56 poses (class
roBehaviorGravComp: tstart, tend, itersT, rstart, rend, itersR). The order of grid and chosen poses
is that of `galen_model.load.pose_order`.

An arm of more than two revolute joints has no grid. Its candidates are spread evenly over a box
around the present pose in which only the last joints before the sensor move, the fewest that do:
two at first, one more where the poses' information, phi of directions all over the workspace over
phi of theirs, is below `good_share`. A UR5 with its elbow up turns wrist 2 and 3, as does a Panda,
by up to 1.2 rad: 0.8 of the information, and a tip 0.15 m from the sensor stays within 0.31 m.
With 0.5 rad, as in a check, three joints have 0.37, within 0.18 m; all of them 0.76, within 0.74 m.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ArmClearance, Box, ObstacleError
from galen_model.arm.routes import Router
from galen_model.arrays import Array, evenly_spread
from galen_model.errors import GalenError, NotExcitedError
from galen_model.load.identification import check_planned_poses
from galen_model.load.pose_order import MOST_ORDERED, best_order
from galen_model.poses.design import (
    MOST_GRID_JOINTS,
    PoseDesign,
    PoseDesignError,
    angle_grid,
    workspace,
)

# Rest-to-rest quintic s(x) = 10 x^3 - 15 x^4 + 6 x^5 over x = t/T in 0..1:
# s' peaks at x = 1/2 with 15/8; s'' peaks at x = (3 -+ sqrt 3)/6 with 10/sqrt 3.
PEAK_VELOCITY = 15.0 / 8.0
PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)


def quintic_duration_s(
    displacement: ArrayLike,
    max_velocity: ArrayLike,
    max_acceleration: ArrayLike,
    shortest_s: float = 0.05,
) -> float:
    """Compute the shortest duration of a quintic from rest to rest within every joint's limits.

    Peaks are 15/8 * d/T and 10/sqrt(3) * d/T^2.

    Args:
        displacement: (n,), m or rad.
        max_velocity: (n,), m/s or rad/s, positive.
        max_acceleration: (n,), m/s^2 or rad/s^2, positive.
        shortest_s: least result, which keeps a move of no distance from being a step.

    Returns:
        Duration, s.

    """
    moved = np.asarray(displacement, float)
    return float(_durations_s(moved, max_velocity, max_acceleration, shortest_s))


def _durations_s(
    displacements: Array, velocity: ArrayLike, acceleration: ArrayLike, shortest_s: float = 0.05
) -> Array:
    """Return durations (...), s, of displacements (..., n)."""
    distance = np.abs(displacements)
    by_velocity = PEAK_VELOCITY * distance / np.asarray(velocity, float)
    by_acceleration = np.sqrt(PEAK_ACCELERATION * distance / np.asarray(acceleration, float))
    longest = np.maximum(by_velocity, by_acceleration).max(axis=-1, initial=0.0)
    return np.asarray(np.maximum(longest, shortest_s))


class SweepTimes:
    """How long moves between angles (n, k), rad, and the stay at each take, s."""

    def __init__(
        self, home: Array, max_velocity: Array, max_acceleration: Array, stay_s: float
    ) -> None:
        """Take what a sweep's time depends on.

        Args:
            home: angles (k,), rad, where it begins and ends.
            max_velocity: (k,), rad/s.
            max_acceleration: (k,), rad/s^2.
            stay_s: time at each pose.

        """
        self._home = np.asarray(home, dtype=float)
        self._limits = max_velocity, max_acceleration
        self.stay_s = stay_s

    def table(self, poses: Array) -> Array:
        """Compute the times of moves from each pose to each.

        Args:
            poses: angles (n, k), rad.

        Returns:
            Seconds (n + 1, n + 1), home the last, without stays.

        """
        places = np.vstack([poses, self._home])
        return _durations_s(places[:, None] - places, *self._limits)

    def at_s(self, poses: Array) -> Array:
        """Compute when the stay at each pose is over.

        Args:
            poses: angles (n, k), rad, in visiting order.

        Returns:
            Seconds (n,) from the start at home.

        """
        places = np.vstack([self._home, poses])
        legs = _durations_s(np.diff(places, axis=0), *self._limits)
        return np.asarray(np.cumsum(legs + self.stay_s))

    def sweep_s(self, poses: Array) -> float:
        """Compute the time of a sweep, from home to home.

        Args:
            poses: angles (n, k), rad, in visiting order.

        Returns:
            Seconds, with the stays.

        """
        places = np.vstack([self._home, poses, self._home])
        legs = _durations_s(np.diff(places, axis=0), *self._limits)
        return float(np.sum(legs)) + len(poses) * self.stay_s


def order_poses(poses: Array, times: SweepTimes, arm: Arm) -> Array:
    """Put poses in a good visiting order; fewer than 3 or more than MOST_ORDERED stay as they are.

    Args:
        poses: angles (n, k), rad.
        times: of moves and stays.
        arm: that takes the poses.

    Returns:
        The angles (n, k), rad, in the order to visit them.

    """
    if not 3 <= len(poses) <= MOST_ORDERED:
        return poses
    order = best_order(arm.gravity_in_sensor(poses), times.table(poses), times.stay_s)
    return np.asarray(np.asarray(poses)[order])


def sweep_grid(
    tilts: tuple[float, float, int],
    rolls: tuple[float, float, int],
    lower: Sequence[float] | Array,
    upper: Sequence[float] | Array,
) -> Array:
    """Make a grid's poses, one roll after the other.

    Every second roll has its tilts backwards, so that more than MOST_ORDERED poses, which stay in
    this order, need little travel.

    Args:
        tilts: start, end (both included, rad) and count.
        rolls: start, end (both included, rad) and count.
        lower: lower limits of (roll, tilt), rad.
        upper: upper limits of (roll, tilt), rad.

    Returns:
        Poses (n, 2) as (roll, tilt), rad.

    Raises:
        GalenError: a count is below 1, an angle is not finite or outside the limits, or start and
            end of several poses are the same.

    """
    outer = _axis("roll", "r", *rolls, lower[0], upper[0])
    inner = _axis("tilt", "t", *tilts, lower[1], upper[1])
    grid = np.stack(np.meshgrid(outer, inner, indexing="ij"), axis=-1)
    grid[1::2] = grid[1::2, ::-1].copy()
    return np.asarray(grid.reshape(-1, 2))


def _axis(
    joint: str, letter: str, start: float, end: float, count: int, lower: float, upper: float
) -> Array:
    if count < 1:
        raise GalenError(f"iters{letter.upper()} is {count}: a sweep needs at least 1 {joint}")
    for name, value in ((f"{letter}start", start), (f"{letter}end", end)):
        if not np.isfinite(value):
            raise GalenError(f"{name} of joint {joint} is {value}: not a finite angle")
        if not lower <= value <= upper:
            raise GalenError(
                f"{name} = {value:g} rad is outside the limits of joint {joint},"
                f" {lower:g} ... {upper:g} rad"
            )
    if count > 1 and start == end:
        raise GalenError(
            f"{letter}start and {letter}end of joint {joint} are both {start:g} rad:"
            f" iters{letter.upper()} = {count} poses would be one and the same"
        )
    if count == 1:
        return np.array([0.5 * (start + end)])
    return np.linspace(start, end, count)


# Candidates over the sweep's range of angles. 187 are within 0.6 % of the best poses of a
# continuum, up to some fifty (test_model_pose_design.py).
CANDIDATES = (17, 11)
SPREAD_CANDIDATES = 256
"""Of an arm without a grid."""


@dataclass(frozen=True)
class Surroundings:
    """Boxes around the arm, and how far from them to stay (m).

    require_shapes: reject an arm whose links have no collision shapes that can be reached.
    """

    boxes: tuple[Box, ...] = ()
    clearance_m: float = 0.0
    require_shapes: bool = False


@dataclass(frozen=True)
class SweepRange:
    """Where a sweep may go: home (n,), and lowest and highest angles (k,), rad.

    steps: candidates along each angle of a grid; `name`: what home is called where it can't be
    taken; `remedy`: what to do where the poses of this range excite too little; good_share: of the
    best information, which is enough to let more joints stay.
    """

    home: Array
    lower: Sequence[float]
    upper: Sequence[float]
    steps: tuple[int, ...] = CANDIDATES
    name: str = "home"
    arm: Arm = field(kw_only=True)
    remedy: str = ""
    good_share: float = 0.6

    @classmethod
    def around(cls, here: Array, reach_rad: float, arm: Arm, **more: Any) -> SweepRange:
        """Make the box within a reach of the present pose and the limits.

        Where the arm stands near a limit the box is moved away from it, not made smaller.

        Args:
            here: joints (n,), m and rad, which become home.
            reach_rad: largest change of each angle, but near a limit.
            arm: that stands there.
            **more: further fields of the range.

        Returns:
            The range.

        """
        low, high = arm.angles(arm.lower), arm.angles(arm.upper)
        reach = np.minimum(reach_rad, (high - low) / 2.0)
        centre = np.clip(arm.angles(here), low + reach, high - reach)
        lower, upper = (tuple(edge.tolist()) for edge in (centre - reach, centre + reach))
        return cls(here, lower, upper, name="the present pose", arm=arm, **more)

    @property
    def home_angles(self) -> Array:
        """Angles (k,) at home, rad."""
        return self.arm.angles(self.home)

    @property
    def is_grid(self) -> bool:
        """Whether candidates are a grid."""
        return len(self.lower) <= MOST_GRID_JOINTS

    @property
    def moving(self) -> range:
        """How many of the last revolute joints may move: fewest first."""
        joints = len(self.lower)
        return range(joints if self.is_grid else MOST_GRID_JOINTS, joints + 1)

    def candidates(self, moving: int | None = None) -> Array:
        """Spread candidates evenly over the range.

        Args:
            moving: all but so many of the last angles stay at home; None: all move. Of a grid all
                move.

        Returns:
            Angles (m, k), rad.

        """
        if self.is_grid:
            wide = np.array(self.upper) > np.array(self.lower)
            counts = np.where(wide, self.steps[: len(wide)], 1)
            if wide.sum() == 1:  # as many along one angle as over two
                counts = np.where(wide, np.prod(self.steps), 1)
            return np.unique(angle_grid(self.lower, self.upper, *counts), axis=0)
        first = len(self.lower) - (len(self.lower) if moving is None else moving)
        lower, upper = np.array(self.lower)[first:], np.array(self.upper)[first:]
        found = np.tile(self.home_angles, (SPREAD_CANDIDATES, 1))
        found[:, first:] = lower + (upper - lower) * evenly_spread(len(found), len(lower))
        return found


@dataclass(frozen=True)
class SweepPlan:
    """Angles (n, k), rad, in visiting order, the free ways there, and what is to be known."""

    poses: Array
    router: Router | None = None
    warnings: tuple[str, ...] = ()


def plan_as_is(
    poses: Array,
    where: SweepRange,
    surroundings: Surroundings,
    tip_m: Array,
    *,
    source: str = "the grid",
    remedy: str = "clear the space, narrow the grid, or set poses to chosen",
) -> SweepPlan:
    """Plan given poses in their order.

    Args:
        poses: angles (n, k), rad, in visiting order.
        where: home and arm.
        surroundings: boxes to keep away from.
        tip_m: the tool's tip (3,) in the sensor's frame.
        source: what the poses are of, for the error's text.
        remedy: what to do where a pose can't be visited, for the error's text.

    Returns:
        The plan.

    Raises:
        ObstacleError: a pose can't be visited, named by its place; or home can't be taken.

    """
    router = make_router(where, surroundings, tip_m)
    if router is not None:
        for index, angles in enumerate(poses):
            if fault := router.fault(where.arm.with_angles(angles, where.home)):
                raise ObstacleError(
                    f"pose {index} of {source} ({where.arm.described(angles)}) can't be visited:"
                    f" {fault}; {remedy}"
                )
    return SweepPlan(poses, router, _warnings(router))


def plan_chosen(
    count: int,
    where: SweepRange,
    surroundings: Surroundings,
    tip_m: Array,
    times: SweepTimes,
    *,
    one_sweep: bool = False,
) -> SweepPlan:
    """Choose the most informative poses that can be visited, in a good order.

    Args:
        count: number of poses.
        where: home, arm and the range of its angles.
        surroundings: boxes to keep away from.
        tip_m: the tool's tip (3,) in the sensor's frame.
        times: of moves and stays.
        one_sweep: there is none without the tool; the sensor is zeroed at home.

    Returns:
        The plan.

    Raises:
        ObstacleError: naming what is to blame where too few poses are left; or home can't be taken.
        PoseDesignError: the poses excite too little, or the arm has no revolute joint.
        NotExcitedError: the poses excite too little.

    """
    router = make_router(where, surroundings, tip_m)
    zero, arm = where.home_angles, where.arm
    if not len(zero):
        raise PoseDesignError("gravity is the same at all poses: the arm has no revolute joint")
    candidates, faults = _best_candidates(count, where, router, zero if one_sweep else None)
    try:
        poses = _choose(count, where, router, candidates, faults, one_sweep)
        check_planned_poses(poses, one_sweep=one_sweep, zero_angles=zero, arm=arm)
    except (PoseDesignError, NotExcitedError) as error:
        _check_arm(arm, zero, one_sweep)
        remedy = f"; {where.remedy}" if where.remedy else ""
        if not any(faults):
            raise type(error)(f"{error}{remedy}") from error
        raise ObstacleError(f"{error}; {_blame(faults)}{remedy}") from error
    return SweepPlan(order_poses(poses, times, arm), router, _warnings(router))


def _check_arm(arm: Arm, zero: Array, one_sweep: bool) -> None:
    """Raise NotExcitedError where no poses within the arm's limits excite enough."""
    try:
        check_planned_poses(workspace(12, arm), one_sweep=one_sweep, zero_angles=zero, arm=arm)
    except NotExcitedError as error:
        raise NotExcitedError(
            f"the revolute joints of the arm ({', '.join(arm.turning_names)}) turn gravity in the"
            " sensor too little anywhere within their limits: mount the base so that an axis is"
            f" across gravity; {error}"
        ) from error


def _best_candidates(
    count: int, where: SweepRange, router: Router | None, zero: Array | None
) -> tuple[Array, list[str]]:
    """Return candidates with as few joints in motion as is good, and why some can't be taken."""
    found: list[tuple[float, Array, list[str]]] = []
    for moving in where.moving:
        candidates = where.candidates(moving)
        faults = [""] * len(candidates)
        if router is not None and where.is_grid:
            faults = router.lattice_faults
        elif router is not None:
            joints = where.arm.with_angles(candidates, where.home)
            faults = [router.clearance.pose_fault(pose) for pose in joints]
        if where.is_grid:
            return candidates, faults
        free = candidates[[not fault for fault in faults]]
        design = PoseDesign(free, one_sweep_zero=zero, arm=where.arm)
        value = np.inf if len(free) < count else design.value(free[design.first(count)])
        found.append((value, candidates, faults))
        if value * where.good_share <= design.best_value(count):
            break
    return min(found, key=lambda one: one[0])[1:]


def _choose(
    count: int,
    where: SweepRange,
    router: Router | None,
    candidates: Array,
    faults: list[str],
    one_sweep: bool,
) -> Array:
    """Choose among the candidates without fault; notes in `faults` where no way leads."""
    zero = where.home_angles if one_sweep else None
    while True:
        free = candidates[[not fault for fault in faults]]
        design = PoseDesign(free, one_sweep_zero=zero, arm=where.arm)
        poses = free[design.choose(count)]
        if router is None or where.is_grid:  # whose faults are those of the ways as well
            return poses
        if not any(router.fault(joints) for joints in where.arm.with_angles(poses, where.home)):
            return poses
        # Some ways are blocked: look at all before choosing again.
        for place, joints in enumerate(where.arm.with_angles(candidates, where.home)):
            faults[place] = faults[place] or router.fault(joints)


def make_router(where: SweepRange, surroundings: Surroundings, tip_m: Array) -> Router | None:
    """Make the search for free ways of a tool.

    Args:
        where: home, arm and, of a grid, the poses between.
        surroundings: boxes to keep away from.
        tip_m: the tool's tip (3,) in the sensor's frame.

    Returns:
        The search; None where all ways are free.

    Raises:
        ObstacleError: the arm can't stand at home, or required shapes can't be reached.

    """
    arm = where.arm
    if not surroundings.boxes and (arm.delta is not None or not arm.urdf):
        return None
    clearance = ArmClearance(surroundings.boxes, surroundings.clearance_m, tip_m, arm, where.home)
    if surroundings.require_shapes:
        clearance.require_shapes()
    # Ways of more joints, where they aren't straight, lead over home alone.
    lattice = where.candidates() if where.is_grid else np.empty((0, len(where.lower)))
    return Router(clearance, where.home, lattice, where.name)


def _warnings(router: Router | None) -> tuple[str, ...]:
    """Return which collisions are not checked."""
    return () if router is None else router.clearance.warnings


def left_out(faults: Sequence[str]) -> dict[str, int]:
    """Count the candidates that each box, the arm itself, or the limits take away.

    Args:
        faults: why each candidate can't be taken; empty ones don't count.

    Returns:
        Counts by name, most first.

    """
    found = []
    for fault in filter(None, faults):
        box = re.search(r"box \d+", fault)
        itself = "the arm itself" if " would be " in fault else "the limits"
        found.append(box.group() if box else itself)
    return dict(Counter(found).most_common())


def _blame(faults: Sequence[str]) -> str:
    taken = ", ".join(f"{count} by {name}" for name, count in left_out(faults).items())
    return f"of {len(faults)} candidates {sum(map(bool, faults))} can't be visited: {taken}"
