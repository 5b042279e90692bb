"""Overlapping Allan deviation of a reading, and forecasts of its bias drift.

With y cells of tau_0 and their means over m neighbours, tau = m tau_0,

    AVAR(tau) = mean over i of (ybar_{i+m} - ybar_i)^2 / 2,   all starts i (overlapping)

(Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065, 2008, section 5.2.4). Cells that
are missing leave out the pairs that need them. The band is chi-squared's, with the degrees of
freedom of table 5 there, by the noise that the slope indicates. IEEE Std 952-1997, annex C, has the
terms of a sensor:

    AVAR = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2

white noise N (N/sqrt(Hz)), bias instability B (N), random walk K (N/sqrt(s)), ramp R (N/s); fitted
with non-negative least squares, each tau weighted by its degrees of freedom.

Forecasts are made from the past alone. The series of cells is cut in two. On the first part
forecasts are fitted (to its first two thirds) and chosen (on its last third); on the second part
those chosen are scored, once. Two kinds compete:

keep a value: `zero`, that of the zeroing (no correction); `last`, the newest cell; `level`, an
    exponential mean of the past, which is the local level of a random walk in white noise
    (Muth, *J. Am. Stat. Assoc.* 55, 1960).
predict a change: `line`, a straight line fitted to all of the past, from the newest level on;
    `day`, the same with waves of a day and half a day.

The bias drift counts as predictable at a horizon if the chosen predictor beats the chosen keeper by
a skill, 1 - MSE / MSE, of 0.1 or more whose 99 % interval is above zero; the interval is a moving
block bootstrap's (Künsch, *Ann. Stat.* 17, 1989) with blocks of the horizon's length or more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from scipy.optimize import nnls
from scipy.signal import lfilter

_PER_DECADE = 8
_FEWEST_PAIRS = 3  # whole, that don't overlap
HORIZONS_S = (60.0, 300.0, 900.0, 3600.0, 3.0 * 3600.0, 6.0 * 3600.0)
KEEPERS, PREDICTORS = ("zero", "last", "level"), ("line", "day")
_DAY_S = 86400.0
_ZEROING_S = 60.0
_FEWEST_HORIZONS = 5  # so many must fit into the part that is scored
_LEVELS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
_RESAMPLES = 400
_LEAST_SKILL = 0.1
_MOST_CELLS = 6000  # beyond, cells grow


@dataclass(frozen=True)
class Allan:
    """Of one channel: tau_s (k,), deviation (k,) and its 95 % band low, high (k,).

    white (unit/sqrt(Hz)), instability (unit), walk (unit/sqrt(s)), ramp (unit/s): coefficients.
    """

    tau_s: Array
    deviation: Array
    low: Array
    high: Array
    white: float
    instability: float
    walk: float
    ramp: float


def allan_deviation(cells: Array, cell_s: float) -> Allan:
    """Compute it of cells (n,), NaN where there is none."""
    there = np.isfinite(cells)
    total = np.concatenate([[0.0], np.cumsum(np.where(there, cells - np.nanmean(cells), 0.0))])
    number = np.concatenate([[0], np.cumsum(there)])
    longest = max(1, len(cells) // (_FEWEST_PAIRS + 1))
    steps = int(_PER_DECADE * np.log10(longest)) + 1
    rows: list[tuple[int, float, int, float]] = []
    for m in np.unique(np.round(np.logspace(0, np.log10(longest), steps)).astype(int)):
        used = number[m:] - number[:-m]
        mean = (total[m:] - total[:-m]) / np.maximum(used, 1)
        enough = 2 * used > m
        pairs = enough[m:] & enough[:-m]
        if not pairs.any() or (pairs.sum() < _FEWEST_PAIRS * m and m > 1):
            continue
        half = float(np.mean((mean[m:] - mean[:-m])[pairs] ** 2) / 2.0)
        white = float(np.mean(1.0 / used[m:][pairs] + 1.0 / used[:-m][pairs]) / 2.0)
        rows.append((int(m), half, int(pairs.sum()) + 2 * int(m) - 1, white / cell_s))
    factor, variance, cells_used, white_part = np.array(rows).T
    tau = factor * cell_s
    deviation = np.sqrt(variance)
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(deviation, 1e-300))
    slope = np.gradient(logs, np.log(tau)) if len(tau) > 1 else np.array([-0.5])
    freedom = np.array(
        [_freedom(s, n + 1, m) for s, n, m in zip(slope, cells_used, factor, strict=True)]
    )
    low = deviation * np.sqrt(freedom / chi2_ppf(0.975, freedom))
    high = deviation * np.sqrt(freedom / chi2_ppf(0.025, freedom))
    coefficients = _fit(tau, variance, freedom, white_part)
    return Allan(tau, deviation, low, high, *np.sqrt(coefficients).tolist())


def _fit(tau: Array, variance: Array, freedom: Array, white: Array) -> Array:
    """Squares (4,) of the coefficients."""
    if not variance.max() > 0.0:  # a sensor that stays at one value
        return np.zeros(4)
    basis = np.column_stack(
        [white, np.full(len(tau), 2.0 * np.log(2.0) / np.pi), tau / 3.0, tau**2 / 2.0]
    )
    floor = float(variance.max()) * 1e-12
    expected = np.maximum(variance, floor)
    for _ in range(10):  # the error of a variance is a part of the true one, not of the measured
        weight = np.sqrt(freedom / 2.0) / expected
        weighted = basis * weight[:, None]
        size = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
        squares = nnls(weighted / size, variance * weight)[0] / size
        expected = np.maximum(basis @ squares, floor)
    return np.asarray(squares)


def _freedom(slope: float, n: int, m: int) -> float:
    """Degrees of freedom of n phase points averaged over m (NIST SP 1065, table 5)."""
    if slope < -0.25:  # white
        value = (3.0 * (n - 1) / (2.0 * m) - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    elif slope < 0.25:  # flicker
        first = 2.0 * (n - 2) ** 2 / (2.3 * n - 4.9)
        value = first if m == 1 else 5.0 * n**2 / (4.0 * m * (n + 3.0 * m))
    else:  # walk
        shrink = ((n - 1) ** 2 - 3.0 * m * (n - 1) + 4.0 * m**2) / (n - 3.0) ** 2
        value = (n - 2) / m * shrink
    return max(float(value), 1.0)


# Forecasts


@dataclass(frozen=True)
class HorizonScore:
    """At one horizon: root mean square errors (by name) on the part not seen, all axes together.

    keeper, predictor: chosen beforehand; skill of predictor over keeper with its 99 % interval.
    """

    horizon_s: float
    rmse: dict[str, float]
    keeper: str
    predictor: str
    skill: float
    interval: tuple[float, float]

    @property
    def predictable(self) -> bool:
        """Whether the predictor clearly beats keeping a value."""
        return self.skill >= _LEAST_SKILL and self.interval[0] > 0.0


def score_forecasts(series: Array, cell_s: float, seed: int = 0) -> list[HorizonScore]:
    """Score a group of axes (n, k), NaN where there is none; empty where it is too short."""
    count = len(series)
    half, third = count // 2, count // 3
    filled = np.column_stack([_filled(column) for column in series.T])
    rng = np.random.default_rng(seed)
    result = []
    for horizon_s in HORIZONS_S:
        horizon = round(horizon_s / cell_s)
        if horizon < 1 or _FEWEST_HORIZONS * horizon > count - half:
            continue
        errors: dict[str, list[Array]] = {}
        chosen_on: dict[str, float] = {}
        for axis in range(series.shape[1]):
            truth = series[horizon:, axis]
            early = _forecasts(filled[:, axis], third, cell_s, horizon)
            # fitted anew to all that is not scored
            late = _forecasts(filled[:, axis], half, cell_s, horizon)
            for name in early:
                off = truth - early[name][: count - horizon]
                mean = float(np.nanmean(off[third : half - horizon] ** 2))
                chosen_on[name] = chosen_on.get(name, 0.0) + mean
                off = truth - late[name][: count - horizon]
                errors.setdefault(name, []).append(off[half:])
        squares = {n: np.nansum(np.square(e), axis=0) for n, e in errors.items()}
        keeper = min(KEEPERS, key=lambda n: chosen_on[n])
        predictors = [name for name in PREDICTORS if name in chosen_on]
        # A line is a wave's simplest case, and takes its place unless the wave is clearly better.
        predictor = min(predictors, key=lambda n: chosen_on[n] * (1.1 if n == "day" else 1.0))
        skill, interval = _skill(squares[predictor], squares[keeper], horizon, rng)
        rmse = {n: float(np.sqrt(np.mean(s) / series.shape[1])) for n, s in squares.items()}
        result.append(HorizonScore(horizon_s, rmse, keeper, predictor, skill, interval))
    return result


def cell_for(duration_s: float, series_cell_s: float) -> float:
    """Choose cells to forecast with: a minute, or less for a short recording."""
    wanted = 60.0 if duration_s >= 3000.0 else max(series_cell_s, duration_s / 200.0)
    wanted = max(wanted, duration_s / _MOST_CELLS)
    return max(1, round(wanted / series_cell_s)) * series_cell_s


def _forecasts(series: Array, known: int, cell_s: float, horizon: int) -> dict[str, Array]:
    """By name, forecasts (n,) made with parameters fitted to the first `known` cells."""
    zero = float(np.mean(series[: max(1, round(_ZEROING_S / cell_s))]))
    levels = [lfilter([a], [1.0, a - 1.0], series, zi=[(1.0 - a) * series[0]])[0] for a in _LEVELS]
    last = max(known - horizon, 1)
    errors = [np.mean((series[horizon:known] - c[:last][: known - horizon]) ** 2) for c in levels]
    level = levels[int(np.argmin(errors))]
    found = {"zero": np.full(len(series), zero), "last": series, "level": level}
    found["line"] = _waves(series, level, known, horizon, cell_s, 0)
    if known * cell_s >= _DAY_S:
        found["day"] = _waves(series, level, known, horizon, cell_s, 2)
    return found


def _waves(
    series: Array, level: Array, known: int, horizon: int, cell_s: float, harmonics: int
) -> Array:
    """Forecast by a line and so many harmonics of a day, from the newest level on.

    Fitted anew each hour, to all cells up to then.
    """
    time = np.arange(len(series)) * cell_s / _DAY_S
    waves = [np.ones(len(time)), time]
    for k in range(1, harmonics + 1):
        waves += [np.cos(2.0 * np.pi * k * time), np.sin(2.0 * np.pi * k * time)]
    design = np.column_stack(waves)
    ahead = design.copy()
    ahead[:-horizon] = design[horizon:]
    change = ahead - design
    change[-horizon:] = 0.0
    result = level.copy()
    every = max(1, round(3600.0 / cell_s))
    start = max(1, min(known, round(_DAY_S / cell_s)))
    information = design[:start].T @ design[:start]
    right = design[:start].T @ series[:start]
    for first in range(start, len(series), every):
        rows = slice(first, min(first + every, len(series)))
        weights = np.linalg.solve(information + 1e-6 * np.eye(len(right)), right)
        result[rows] = level[rows] + change[rows] @ weights
        information += design[rows].T @ design[rows]
        right += design[rows].T @ series[rows]
    return result


def _skill(
    predictor: Array, keeper: Array, horizon: int, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """1 - MSE / MSE of squares (n,), and its 99 % interval."""
    count = len(predictor)
    block = min(max(horizon, count // 50, 1), max(count // 4, 1))
    pieces = -(-count // block)
    starts = rng.integers(0, count - block + 1, size=(_RESAMPLES, pieces))
    sums = [np.concatenate([[0.0], np.cumsum(s)]) for s in (predictor, keeper)]
    drawn = [(total[starts + block] - total[starts]).sum(axis=1) for total in sums]
    skills = 1.0 - drawn[0] / np.maximum(drawn[1], 1e-300)
    low, high = np.quantile(skills, [0.005, 0.995])
    skill = 1.0 - float(np.mean(predictor)) / max(float(np.mean(keeper)), 1e-300)
    return skill, (float(low), float(high))


def _filled(column: Array) -> Array:
    there = np.isfinite(column)
    last = np.maximum.accumulate(np.where(there, np.arange(len(column)), -1))
    first = int(np.argmax(there))
    return np.asarray(column[np.maximum(last, first)])
