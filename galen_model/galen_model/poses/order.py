"""In which order poses are visited: a short way on which a drift does not look like a load.

A reading that drifts by b t over the sweep moves the fit by C A^T W (b t). The load's columns are
linear in gravity's direction u, the offsets take the mean; so nothing of the drift reaches the load
where the poses' times are uncorrelated with u, sum_i (t_i - mean t) u_i = 0. R^2, the share of the
times' variance that a regression on u explains, says how far that holds: a grid's serpentine,
which goes from one end of one angle to the other, has nearly 1, a way there and back nearly 0.
The order makes travel + weight R^2 small: first a short open way through all poses, every second
one of them on the way there and the others on the way back, then 2-opt and moves of single poses
(Lin, *Bell System Tech. J.* 44, 1965) until none is better.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import GALEN
from galen_model.arrays import Array

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
