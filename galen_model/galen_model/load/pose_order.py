# SPDX-License-Identifier: Apache-2.0
"""Order of a sweep's poses in which a drift of the sensor costs little, and what it costs.

A reading that drifts while the poses are visited is y_i = G(u_i) x + c + b(t_i) + noise, u gravity
in the sensor. With the curve b fitted (`galen_model.estimation.curves`) the load's covariance
depends on the poses and their times alone. **The price of a drift** is the ratio of the standard
deviations of the mass and of the first moments with the curves fitted to those with a constant
bias, the largest of the four:

    N_mass = sum_k K_k[k, k],   N_h = sum_k S_k' K S_k,   K = U' (1 - B (B'B + Q)^-1 B') U

U (n, 3) are the poses' gravity, B and Q the curves' basis and prior, S_k the rows of h x g.

**The order.** A straight line costs nothing where the poses' times are uncorrelated with gravity. A
random walk is told from the load only by poses that are near in time and far in orientation, which
takes travel. Both are drifts of a sensor whose walk has the variance 0.1 stay_s per second, in the
variance of one average: the longer an average, the smaller its noise, and the larger a drift beside
it. The Galen's sensor (1.3 mN in 0.5 s) gets 3 sigma far in 100 s, a drift of 0.1 N/h 2 sigma. The
order makes

    T sqrt(price^2 + n r^2 R^2 / 12)

small: T is the sweep's time, r^2 the walk's variance over the sweep, and R^2 the share of the
times' variance that a regression on u explains, so that the second term is the squared error by a
straight line of r sigma that nothing fits, in units of the load's variance. As T price^2 is the
time to a given precision with the drift and T the one without, T price weighs both alike;
no sweep is longer than 1.15 times the shortest found.

Orders are found by a greedy rule: a Kalman filter of the walk gives for each pose that is left the
information about the load, |u - u_expected|^2 / S, less a rate times the seconds that it takes; the
best comes next. Rates and first poses are tried in numbers, half of them with some chance in the
rule. The best order is then improved by random changes: a stretch turned round, a pose moved (Lin,
*Bell System Tech. J.* 44, 1965).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from galen_model.arrays import Array
from galen_model.estimation.curves import BiasBasis, BiasShape
from galen_model.load.model import gravity_regressor

PRICE_LIMIT = 1.2
"""Price of a drift below which no sweep's order is remarked on."""

MOST_ORDERED = 400
"""More poses stay as they are: the search takes too long."""

_BETTER = 1.3  # times: another order is worth a remark
_WALK_PER_S2 = 0.1
_LONGEST = 1.15
_RATES = 0.02, 3.0  # of information per second, in a pose's mean without drift
_CHANCE = 0.1
_LEAST = 1e-12  # of the information without a drift
_TRIED = 16, 1000
_WORK = 4e6  # tried orders times poses squared, some 0.2 s
_ROUNDS, _CHANGES = 50, 200


def best_order(gravity: Array, seconds: Array, stay_s: float) -> np.ndarray:
    """Find an order in which to visit poses, for which a drift costs little.

    Args:
        gravity: (n, 3) in the sensor, in any unit.
        seconds: (n + 1, n + 1) of travel from each pose to each, home the last.
        stay_s: time at each pose.

    Returns:
        Indices of the poses (n,) in visiting order.

    """
    count, gravity = len(gravity), _scaled(gravity)
    walk = _WALK_PER_S2 * stay_s

    def judged(orders: np.ndarray) -> tuple[Array, Array]:
        ends = np.full((len(orders), 1), count)
        way = np.hstack([ends, orders, ends])
        legs = seconds[way[:, :-1], way[:, 1:]]
        at = np.cumsum(legs[:, :-1] + stay_s, axis=1)
        whole = at[:, -1] + legs[:, -1]
        price = _walk_price(gravity[orders], np.diff(at, axis=1), walk)
        line = count * walk * whole / 12.0 * _explained(gravity[orders], at)
        return whole, whole * np.sqrt(price**2 + line)

    random = np.random.default_rng(0)
    tried = int(np.clip(_WORK / count**2, *_TRIED))
    orders = _greedy(gravity, seconds[:-1, :-1] + stay_s, walk, tried, random)
    whole, cost = judged(orders)
    longest = _LONGEST * whole.min()
    order, best = np.arange(count), np.inf
    for _ in range(_ROUNDS):
        cost[whole > longest] = np.inf
        if cost.min() < best:
            order, best = orders[np.argmin(cost)], cost.min()
        orders = _changed(order, min(tried, _CHANGES), random)
        whole, cost = judged(orders)
    return order


def _changed(order: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return orders (count, n) with a stretch turned round, or a pose moved, by chance."""
    places = np.tile(np.arange(len(order), dtype=float), (count, 1))
    ends = np.sort(random.integers(0, len(order), (count, 2)))
    first, last = ends[:, :1], ends[:, 1:]
    turned = np.where((places >= first) & (places <= last), first + last - places, places)
    one, other = random.permuted(ends, axis=1).T
    places[np.arange(count), one] = other + 0.5 * np.sign(other - one)
    turn = random.random((count, 1)) < 0.5
    return np.asarray(order[np.argsort(np.where(turn, turned, places), axis=1)])


def drift_price(gravity: Array, time_s: Array, shapes: Sequence[BiasShape]) -> float:
    """Compute how many times larger a drift makes the load's standard deviation.

    Args:
        gravity: (n, 3) in the sensor, in any unit.
        time_s: (n,) of one sweep.
        shapes: of the six axes' curves.

    Returns:
        1 for a constant bias, 1e6 where the curves take all of the load.

    """
    kernels = {shape: _kernel(gravity, time_s, shape) for shape in {*shapes, BiasShape()}}
    drifting = _information([kernels[shape] for shape in shapes])
    constant = _information([kernels[BiasShape()]] * 6)
    least = np.maximum(_LEAST * constant, 1e-300)
    return float(np.sqrt(np.max(constant / np.maximum(drifting, least))))


def drift_warning(gravity: Array, time_s: Array, shapes: Sequence[BiasShape]) -> str:
    """Write by how much a better order of the poses would lower a drift's price, and how.

    The factor does not depend on how the fit has shared out the residual between noise and drift,
    as the price itself does.

    Args:
        gravity: (n, 3) in the sensor, in any unit.
        time_s: (n,) of one sweep.
        shapes: of the six axes' curves.

    Returns:
        A clause; "" where the price is below PRICE_LIMIT, no order found is clearly better, or
        there are fewer than 3 or more than MOST_ORDERED poses.

    """
    if not 3 <= len(time_s) <= MOST_ORDERED:
        return ""
    now = drift_price(gravity, time_s, shapes)
    if now < PRICE_LIMIT:
        return ""
    order, times = _another(gravity, time_s)
    factor = now / drift_price(gravity[order], times, shapes)
    if factor < _BETTER:
        return ""
    return (
        f"in the order of these poses a drift of the bias makes the load's standard deviation"
        f" {factor:.1f} times what it is in a better one: swing to and fro between far"
        " orientations, not once from one end to the other"
    )


def _another(gravity: Array, time_s: Array) -> tuple[np.ndarray, Array]:
    """Return a good order (n,) and its times (n,), s, at the pace of the poses' times (n,).

    Half of the time counts as stays, half is proportional to the angle by which gravity turns.
    """
    inside = gravity / np.linalg.norm(gravity, axis=1)[:, None]
    angle = np.arccos(np.clip(inside @ inside.T, -1.0, 1.0))
    visited = np.argsort(time_s)
    turned = float(angle[visited[:-1], visited[1:]].sum())
    half = 0.5 * float(np.ptp(time_s))
    stay = half / (len(time_s) - 1)
    seconds = np.pad(angle * half / max(turned, 1e-9), (0, 1))
    order = best_order(gravity, seconds, stay)
    return order, np.cumsum(np.append(0.0, seconds[order[:-1], order[1:]] + stay))


def _scaled(gravity: Array) -> Array:
    """Return gravity (n, 3) less its mean, with a mean square of one."""
    centred = gravity - gravity.mean(axis=0)
    return np.asarray(centred / max(np.sqrt(np.mean(np.sum(centred**2, axis=1))), 1e-9))


def _greedy(
    gravity: Array, seconds: Array, walk: float, tried: int, random: np.random.Generator
) -> np.ndarray:
    """Return orders (tried, n); seconds (n, n) from the end of one stay to that of the next."""
    count, rows = len(gravity), np.arange(tried)
    rates = np.geomspace(*_RATES, tried)[:, None]
    chance = np.where(rows % 2, _CHANCE, 0.0)[:, None]
    last = (rows * (np.sqrt(5.0) - 1.0) / 2.0 % 1.0 * count).astype(int)
    orders = np.empty((tried, count), dtype=int)
    orders[:, 0] = last
    left = np.ones((tried, count), dtype=bool)
    left[rows, last] = False
    expected, variance = gravity[last], np.ones(tried)
    square = np.sum(gravity**2, axis=1)
    for place in range(1, count):
        took = seconds[last]
        expects = 1.0 + variance[:, None] + walk * took
        gap = square - 2.0 * expected @ gravity.T + np.sum(expected**2, axis=1)[:, None]
        gain = gap / expects - rates * took + chance * random.standard_normal(took.shape)
        last = np.argmax(np.where(left, gain, -np.inf), axis=1)
        variance = 1.0 - 1.0 / expects[rows, last]
        expected = expected + variance[:, None] * (gravity[last] - expected)
        left[rows, last] = False
        orders[:, place] = last
    return orders


def _walk_price(gravity: Array, steps_s: Array, walk: float) -> Array:
    """Return prices (k,) of a walk for gravity (k, n, 3) in order, by the filter's innovations.

    steps_s: (k, n - 1).
    """
    gaps = np.zeros_like(gravity)
    expected, variance = gravity[:, 0], np.ones((len(gravity), 1))
    for place in range(1, gravity.shape[1]):
        expects = 1.0 + variance + walk * steps_s[:, place - 1, None]
        gap = gravity[:, place] - expected
        gaps[:, place] = gap / np.sqrt(expects)
        variance = 1.0 - 1.0 / expects
        expected = expected + variance * gap
    kernel = np.swapaxes(gaps, 1, 2) @ gaps
    still = np.swapaxes(gravity, 1, 2) @ gravity
    constant = _information([still] * 6)
    drifting = np.maximum(_information([kernel] * 6), _LEAST * constant)
    return np.asarray(np.sqrt(np.max(constant / drifting, axis=-1)))


def _explained(gravity: Array, times: Array) -> Array:
    """R^2 (k,) of times (k, n) on gravity (k, n, 3), whose mean is zero."""
    centred = times - times.mean(axis=1, keepdims=True)
    # Poses in one plane leave the matrix singular; then any of its solutions will do.
    matrix = np.swapaxes(gravity, 1, 2) @ gravity + 1e-9 * np.eye(3)
    right = np.einsum("kni,kn->ki", gravity, centred)
    found = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.asarray(np.sum(right * found, axis=1) / np.maximum(np.sum(centred**2, axis=1), 1e-12))


def _kernel(gravity: Array, time_s: Array, shape: BiasShape) -> Array:
    """K (3, 3) of one channel."""
    segment = np.zeros(len(time_s), dtype=int)
    basis = BiasBasis(shape, np.asarray(time_s, dtype=float), segment)
    rows = basis.rows(time_s, segment)
    curves = np.linalg.solve(rows.T @ rows + basis.penalty(), rows.T @ gravity)
    return np.asarray(gravity.T @ (gravity - rows @ curves))


def _information(kernels: Sequence[Array]) -> Array:
    """Information (..., 4) about the mass and each first moment, of six kernels (..., 3, 3)."""
    mass = sum(kernels[k][..., k, k] for k in range(3))
    turning = gravity_regressor(np.eye(3))[:, 3:, 1:]  # (direction, torque, moment)
    moments = sum(turning[:, k].T @ kernels[3 + k] @ turning[:, k] for k in range(3))
    # Poses along one line tell nothing of one moment, with a drift or without.
    ridge = _LEAST * np.trace(moments, axis1=-2, axis2=-1) + 1e-300
    inverse = np.linalg.inv(moments + ridge[..., None, None] * np.eye(3))
    own = np.diagonal(inverse, axis1=-2, axis2=-1)
    return np.concatenate([np.asarray(mass)[..., None], 1.0 / own], axis=-1)
