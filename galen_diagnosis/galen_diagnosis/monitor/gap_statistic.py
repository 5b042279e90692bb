"""Is there a gap between stops of an untouched arm? The noise of windows, and a robust test.

What is left of the reading at rest (measured less the file's load) is averaged in windows of half a
second. Within a stop nothing but noise changes it; from stop to stop a gap does. Within a stop the
windows' means are taken as

    x_t = mu + n_t,   Cov(n_t, n_{t+k}) = v rho^|k|      (first-order autoregressive)

and v, rho are found for each channel from the sums S_0 = sum (x_t - mean)^2 and
S_1 = sum (x_t - mean)(x_{t+1} - mean) over all stops, by their expectations

    E S_0 = v tr(P R(rho)),   E S_1 = v tr(P D P R(rho)),   P = 1 - 11^T/m,

R the correlation matrix and D the shift by one, so that what taking the mean away does to short
stops is allowed for exactly. A stop of m windows then has a mean of variance
v (1 + 2 sum_k (1 - k/m) rho^k) / m.

The test: with b the sensor's zero, which isn't known, e_k = sum over channels of
(mean_k - b)^2 / var_k, and T the sum of the smallest four fifths of the e_k, with b the mean of
just these stops (least trimmed squares, Rousseeuw, *J. Am. Stat. Assoc.* 79, 1984, by concentration
steps). A hand that holds still at a fifth of the stops so changes nothing. Without a gap T is close
to a gamma variable, whose two moments come from simulation, widened by what isn't known of v; each
channel's part of it is at most chi-square. The probability of the test is twice the smaller of that
of T and six times that of the oddest channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from galen_model.arrays import Array
from scipy.special import gammaincc

LONGEST = 10
"""Windows of one stop; a longer stay counts as several."""
_TRIMMED = 0.2
_STEPS = 4
_CORRELATIONS = np.linspace(-0.3, 0.95, 51)
_NULL_DRAWS = 3000
_SEED = 12


@dataclass(frozen=True)
class WindowNoise:
    """Of one window's mean: variance (6,), correlation with the next (6,); degrees of freedom."""

    variance: Array
    correlation: Array
    freedom: int

    def of_mean(self, windows: int) -> Array:
        """Variance (6,) of the mean of so many windows after one another."""
        lag = np.arange(1, windows)[:, None]
        more = 2.0 * np.sum((1.0 - lag / windows) * self.correlation**lag, axis=0)
        return np.asarray(self.variance * np.maximum(1.0 + more, 0.1) / windows)


@dataclass(frozen=True)
class Scatter:
    """Of one stop's windows: how many, S_0 and S_1 (6,)."""

    windows: int
    first: Array
    second: Array

    @classmethod
    def of(cls, means: Array) -> Scatter:
        """From the windows' means (m, 6), 2 <= m <= LONGEST."""
        left = means - means.mean(axis=0)
        return cls(len(means), np.sum(left**2, axis=0), np.sum(left[1:] * left[:-1], axis=0))


def window_noise(stops: Sequence[Scatter], floor: Array) -> WindowNoise:
    """The noise of the windows of all stops; floor (6,): least variance.

    With the correlation estimated as well, a degree of freedom is worth about half.
    """
    if not stops:
        return WindowNoise(floor.copy(), np.zeros(6), 0)
    counts = np.bincount([stop.windows for stop in stops])
    expected = sum(number * _traces(windows) for windows, number in enumerate(counts) if number)
    first = np.sum([stop.first for stop in stops], axis=0)
    second = np.sum([stop.second for stop in stops], axis=0)
    ratio = second / np.maximum(first, 1e-300)
    correlation = np.interp(ratio, expected[1] / expected[0], _CORRELATIONS)
    each = [np.interp(at, _CORRELATIONS, expected[0]) for at in correlation]
    variance = first / np.array(each)
    freedom = sum(stop.windows - 1 for stop in stops) // 2
    return WindowNoise(np.maximum(variance, floor), correlation, freedom)


@lru_cache(maxsize=LONGEST)
def _traces(count: int) -> Array:
    """tr(P R) and tr(P D P R) (2, r) of stops with `count` windows."""
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    centre = np.eye(count) - 1.0 / count
    shift = 0.5 * (lags == 1)
    powers = _CORRELATIONS[:, None, None] ** lags
    return np.stack(
        [np.einsum("ij,rji->r", matrix, powers) for matrix in (centre, centre @ shift @ centre)]
    )


@dataclass(frozen=True)
class GapTest:
    """The test of k stops.

    probability: of so much or more without a gap. kept (k,): stops that count. zero (6,): the
    sensor's. size (6,): root mean square from stop to stop beyond the noise, N and N.m.
    channel_probability (6,): of each channel alone.
    """

    statistic: float
    probability: float
    kept: np.ndarray
    zero: Array
    size: Array
    channel_probability: Array


def gap_test(means: Array, variances: Array, freedom: int) -> GapTest:
    """Test stops' means (k, 6) with variances (k, 6), known with `freedom` degrees a channel."""
    count = len(means)
    keep = kept_count(count)
    zero = np.median(means, axis=0)
    kept = np.arange(count)
    for _ in range(_STEPS):
        distance = np.sum((means - zero) ** 2 / variances, axis=1)
        kept = np.sort(np.argsort(distance)[:keep])
        weight = 1.0 / variances[kept]
        zero = np.sum(means[kept] * weight, axis=0) / weight.sum(axis=0)
    squares = (means[kept] - zero) ** 2
    by_channel = np.sum(squares / variances[kept], axis=0)
    statistic = float(by_channel.sum())
    mean, variance = _null_moments(count)
    of_all = _tail(statistic, mean, variance, freedom, 6)
    by_channel_tail = _tail(by_channel, keep - 1.0, 2.0 * (keep - 1.0), freedom, 1)
    # All channels together see a gap that is in many, each alone one that is in few.
    probability = float(min(1.0, 2.0 * min(of_all, 6.0 * by_channel_tail.min())))
    beyond = squares.mean(axis=0) - variances[kept].mean(axis=0)
    return GapTest(
        statistic,
        probability,
        kept,
        zero,
        np.sqrt(np.maximum(beyond, 0.0)),
        by_channel_tail,
    )


def _tail(statistic: Any, mean: float, variance: float, freedom: int, channels: int) -> Any:
    """P of so much or more: a gamma variable with these moments, over an estimate of v.

    Each channel's part is divided by its own estimate, chi-square over its freedom.
    """
    wider = mean * freedom / max(freedom - 2.0, 1.0)
    spread = variance * (wider / mean) ** 2 + wider**2 * 2.0 / (channels * max(freedom, 1))
    shape = wider**2 / spread
    return gammaincc(shape, statistic * shape / wider)


def kept_count(stops: int) -> int:
    """How many of the stops count."""
    return stops - int(_TRIMMED * stops)


@lru_cache(maxsize=128)
def _null_moments(count: int) -> tuple[float, float]:
    """Mean and variance of T for stops of pure noise, by simulation with a seed of its own."""
    rng = np.random.default_rng([_SEED, count])
    drawn = rng.standard_normal((_NULL_DRAWS, count, 6))
    keep = kept_count(count)
    zero = np.median(drawn, axis=1, keepdims=True)
    total = np.zeros(_NULL_DRAWS)
    for _ in range(_STEPS):
        distance = np.sum((drawn - zero) ** 2, axis=2)
        order = np.argsort(distance, axis=1)[:, :keep]
        part = np.take_along_axis(drawn, order[..., None], axis=1)
        zero = part.mean(axis=1, keepdims=True)
        total = np.sum((part - zero) ** 2, axis=(1, 2))
    return float(total.mean()), float(total.var())
