"""Which poses a sweep visits: the grid's, chosen or listed ones, and the ways around boxes.

The grid is over tilt and roll, in an order that saves travel. The 2019 report sweeps 7 tilts x 8
rolls = 56 poses (class roBehaviorGravComp: tstart, tend, itersT, rstart, rend, itersR).

The order of chosen poses is a short way on which a drift does not look like a load. A reading that
drifts by b t over the sweep moves the fit by C A^T W (b t). The load's columns are linear in
gravity's direction u, the offsets take the mean; so nothing of the drift reaches the load where the
poses' times are uncorrelated with u, sum_i (t_i - mean t) u_i = 0. R^2, the share of the times'
variance that a regression on u explains, says how far that holds: a grid's serpentine, which goes
from one end of one angle to the other, has nearly 1, a way there and back nearly 0. The order makes
travel + weight R^2 small: first a short open way through all poses, every second one of them on the
way there and the others on the way back, then 2-opt and moves of single poses (Lin, *Bell System
Tech. J.* 44, 1965) until none is better.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ArmClearance, Box, ObstacleError
from galen_model.arm.galen import GALEN
from galen_model.arm.routes import Router
from galen_model.arrays import Array
from galen_model.errors import GalenError, NotExcitedError
from galen_model.load.identification import check_planned_poses
from galen_model.poses.design import PoseDesign, PoseDesignError, angle_grid

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
    """Shortest duration (s) of a quintic from rest to rest that keeps every joint in its limits.

    displacement (n,) in m or rad; max_velocity and max_acceleration (n,) in the same unit per s
    and s^2, positive. Peaks are 15/8 * d/T and 10/sqrt(3) * d/T^2.
    `shortest_s` keeps a move of no distance from being a step.
    """
    distance = np.abs(np.asarray(displacement, float))
    by_velocity = PEAK_VELOCITY * distance / np.asarray(max_velocity, float)
    by_acceleration = np.sqrt(PEAK_ACCELERATION * distance / np.asarray(max_acceleration, float))
    return float(max(np.max(by_velocity), np.max(by_acceleration), shortest_s))


# So long a detour is taken for having no drift in the load instead of all of it, as a part of the
# time that the poses themselves take.
_DRIFT_WEIGHT = 2.0
_BETTER = 1e-9


class SweepTimes:
    """How long moves between angles (n, k), rad, and the stay at each take, s."""

    def __init__(
        self, home: Array, max_velocity: Array, max_acceleration: Array, stay_s: float
    ) -> None:
        """`home` (k,), rad, is where it begins and ends; limits (k,) in rad/s and rad/s^2."""
        self._home = np.asarray(home, dtype=float)
        self._limits = max_velocity, max_acceleration
        self.stay_s = stay_s

    def table(self, poses: Array) -> Array:
        """Seconds (n + 1, n + 1) from each to each, home the last."""
        places = np.vstack([poses, self._home])
        return np.array(
            [[quintic_duration_s(b - a, *self._limits) for b in places] for a in places]
        )

    def at_s(self, poses: Array) -> Array:
        """Seconds (n,) from home until the stay at each pose is over, in this order."""
        places = np.vstack([self._home, poses])
        legs = [quintic_duration_s(leg, *self._limits) for leg in np.diff(places, axis=0)]
        return np.asarray(np.cumsum(np.array(legs) + self.stay_s))

    def sweep_s(self, poses: Array) -> float:
        """Seconds of a sweep in this order, from home to home."""
        places = np.vstack([self._home, poses, self._home])
        legs = [quintic_duration_s(leg, *self._limits) for leg in np.diff(places, axis=0)]
        return float(np.sum(legs)) + len(poses) * self.stay_s


def drift_share(poses: Array, times_s: Array) -> float:
    """R^2 (0 ... 1) of the poses' times (n,) on gravity's direction at angles (n, k), rad."""
    return float(_explained(_directions(poses)[None], np.asarray(times_s, dtype=float)[None])[0])


def order_poses(poses: Array, times: SweepTimes) -> Array:
    """Return the angles (n, k), rad, in the order to visit them."""
    count = len(poses)
    if count < 3:
        return poses
    seconds = times.table(poses)
    directions = _directions(poses)
    weight = _DRIFT_WEIGHT * count * times.stay_s

    def cost(orders: Array) -> Array:
        legs = _legs(seconds, orders)
        at = np.cumsum(legs[:, :-1] + times.stay_s, axis=1)
        return np.asarray(legs.sum(axis=1) + weight * _explained(directions[orders], at))

    short, _ = _improved(_nearest_first(seconds), lambda orders: _legs(seconds, orders).sum(axis=1))
    there_and_back = np.concatenate([short[::2], short[1::2][::-1]])
    ways = [_improved(start, cost) for start in (there_and_back, short)]
    return np.asarray(poses)[min(ways, key=lambda way: way[1])[0]]


def _directions(poses: Array) -> Array:
    gravity = GALEN.gravity_in_sensor(poses)
    return gravity / np.linalg.norm(gravity, axis=1)[:, None]


def _explained(directions: Array, times: Array) -> Array:
    """R^2 (k,) of times (k, n) on directions (k, n, 3)."""
    centred = times - times.mean(axis=1, keepdims=True)
    rows = directions - directions.mean(axis=1, keepdims=True)
    # Poses in one plane leave the matrix singular; then any of its solutions will do.
    matrix = np.swapaxes(rows, 1, 2) @ rows + 1e-9 * np.eye(3)
    right = np.einsum("kni,kn->ki", rows, centred)
    found = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.asarray(np.sum(right * found, axis=1) / np.maximum(np.sum(centred**2, axis=1), 1e-12))


def _legs(seconds: Array, orders: Array) -> Array:
    """Seconds (k, n + 1) of each leg, from home and back to it, of orders (k, n)."""
    home = np.full((len(orders), 1), len(seconds) - 1)
    way = np.hstack([home, orders, home])
    return np.asarray(seconds[way[:, :-1], way[:, 1:]])


def _nearest_first(seconds: Array) -> Array:
    left = list(range(len(seconds) - 1))
    order: list[int] = []
    at = len(left)
    while left:
        at = min(left, key=lambda k: seconds[at, k])
        left.remove(at)
        order.append(at)
    return np.array(order)


def _improved(order: Array, cost: Callable[[Array], Array]) -> tuple[Array, float]:
    """Take the best of all 2-opt and single moves until none is better."""
    moves = _moves(len(order))
    value = float(cost(order[None])[0])
    while True:
        tried = order[moves]
        costs = cost(tried)
        best = int(np.argmin(costs))
        if costs[best] >= value * (1.0 - _BETTER):
            return order, value
        order, value = tried[best], float(costs[best])


def _moves(count: int) -> Array:
    """Rearrangements (k, n) of places: each stretch turned round, each place moved elsewhere."""
    places = list(range(count))
    rows = []
    for i in range(count):
        rest = places[:i] + places[i + 1 :]
        for j in range(count):
            if i < j:
                rows.append(places[:i] + places[i : j + 1][::-1] + places[j + 1 :])
            if i != j:
                rows.append([*rest[:j], i, *rest[j:]])
    return np.array(rows)


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
