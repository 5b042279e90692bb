"""Which poses a sweep visits: the grid's, chosen or listed ones, and the ways around boxes.

The grid is over tilt and roll, in an order that saves travel. The 2019 report sweeps 7 tilts x 8
rolls = 56 poses (class roBehaviorGravComp: tstart, tend, itersT, rstart, rend, itersR).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ArmClearance, Box, ObstacleError
from galen_model.arm.galen import GALEN
from galen_model.arm.routes import Router
from galen_model.arrays import Array
from galen_model.errors import GalenError, NotExcitedError
from galen_model.load.identification import check_planned_poses
from galen_model.poses.design import PoseDesign, PoseDesignError, angle_grid
from galen_model.poses.order import SweepTimes, order_poses


@dataclass(frozen=True)
class SweepGrid:
    """Start, end (both included, rad) and count of tilts and rolls; names as in the report."""

    tstart: float
    tend: float
    itersT: int
    rstart: float
    rend: float
    itersR: int

    def poses(self, lower: tuple[float, float], upper: tuple[float, float]) -> Array:
        """All poses as rows (roll, tilt) in rad, shape (itersT * itersR, 2), in visiting order.

        `lower` and `upper` are the limits of (roll, tilt) in rad.
        The order is a serpentine: the inner joint goes there and back while the outer one steps
        on, so that no move is longer than one step of the grid. Travel is
        outer range + outer count * inner range; the cheaper of both orders is taken.
        Raises GalenError for a count below 1, a value that is not finite or outside the limits.
        """
        rolls = _axis("roll", "r", self.rstart, self.rend, self.itersR, lower[0], upper[0])
        tilts = _axis("tilt", "t", self.tstart, self.tend, self.itersT, lower[1], upper[1])
        roll_inside = np.ptp(tilts) + len(tilts) * np.ptp(rolls)
        tilt_inside = np.ptp(rolls) + len(rolls) * np.ptp(tilts)
        if tilt_inside <= roll_inside:
            return _serpentine(rolls, tilts)
        return _serpentine(tilts, rolls)[:, ::-1].copy()


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


def _serpentine(outer: Array, inner: Array) -> Array:
    rows = []
    for k, value in enumerate(outer):
        turned = inner if k % 2 == 0 else inner[::-1]
        rows.append(np.column_stack([np.full(len(inner), value), turned]))
    return np.vstack(rows)


# Candidates over the sweep's range of angles. 187 are within 0.6 % of the best poses of a
# continuum, up to some fifty (test_model_pose_design.py).
CANDIDATES = (17, 11)


@dataclass(frozen=True)
class Surroundings:
    """Boxes around the arm, and how far from them to stay (m)."""

    boxes: tuple[Box, ...] = ()
    clearance_m: float = 0.0


@dataclass(frozen=True)
class SweepRange:
    """Where a sweep may go: home (n,), and lowest and highest angles (k,), rad.

    steps: candidates along each angle; `name`: what home is called where it can't be taken.
    """

    home: Array
    lower: Sequence[float]
    upper: Sequence[float]
    steps: tuple[int, ...] = CANDIDATES
    name: str = "home"
    arm: Arm = GALEN

    @property
    def home_angles(self) -> Array:
        """Angles (k,) at home, rad."""
        return self.arm.angles(self.home)

    def candidates(self) -> Array:
        """Angles (m, k), rad, evenly over the range."""
        grid = angle_grid(self.lower, self.upper, *self.steps)
        return np.unique(grid, axis=0)  # a range of no width gives the same ones again


@dataclass(frozen=True)
class SweepPlan:
    """Angles (n, k), rad, in visiting order, and the way around boxes where there are any."""

    poses: Array
    router: Router | None = None


def plan_as_is(
    poses: Array,
    where: SweepRange,
    surroundings: Surroundings,
    tip_m: Array,
    *,
    source: str = "the grid",
    remedy: str = "clear the space, narrow the grid, or set poses to chosen",
) -> SweepPlan:
    """Plan the poses of `source`; raises ObstacleError naming the first one in a box's way."""
    router = make_router(where, surroundings, tip_m)
    if router is not None:
        for index, angles in enumerate(poses):
            if fault := router.fault(where.arm.with_angles(angles, where.home)):
                raise ObstacleError(
                    f"pose {index} of {source} ({where.arm.described(angles)}) can't be visited:"
                    f" {fault}; {remedy}"
                )
    return SweepPlan(poses, router)


def plan_chosen(
    count: int,
    where: SweepRange,
    surroundings: Surroundings,
    tip_m: Array,
    times: SweepTimes,
    *,
    one_sweep: bool = False,
) -> SweepPlan:
    """Choose the `count` most informative poses that can be visited, in a good order.

    Raises ObstacleError naming what is to blame where too few are left or they excite too little.
    """
    router = make_router(where, surroundings, tip_m)
    candidates = where.candidates()
    faults = [""] * len(candidates) if router is None else router.lattice_faults
    free = candidates[[not fault for fault in faults]]
    zero = where.home_angles
    design = PoseDesign(free, one_sweep_zero=zero if one_sweep else None)
    try:
        poses = free[design.choose(count)]
        check_planned_poses(poses, one_sweep=one_sweep, zero_angles=zero)
    except (PoseDesignError, NotExcitedError) as error:
        if len(free) == len(candidates):
            raise
        raise ObstacleError(f"{error}; {_blame(faults)}") from error
    return SweepPlan(order_poses(poses, times), router)


def make_router(where: SweepRange, surroundings: Surroundings, tip_m: Array) -> Router | None:
    """Ways around the boxes for a tool with its tip at tip_m (3,), ft_sensor; None without boxes.

    Raises ObstacleError where the arm can't stand at home.
    """
    if not surroundings.boxes:
        return None
    clearance = ArmClearance(surroundings.boxes, surroundings.clearance_m, tip_m, where.arm)
    return Router(clearance, where.home, where.candidates(), where.name)


def left_out(faults: Sequence[str]) -> dict[str, int]:
    """How many candidates each box, or the limits, takes away, by its name."""
    names = (re.search(r"box \d+", fault) for fault in faults if fault)
    return dict(Counter(name.group() if name else "the limits" for name in names).most_common())


def _blame(faults: Sequence[str]) -> str:
    taken = ", ".join(f"{count} by {name}" for name, count in left_out(faults).items())
    return f"of {len(faults)} candidates {sum(map(bool, faults))} can't be visited: {taken}"
