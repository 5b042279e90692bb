"""Forecast the bias drift from the past alone, scored on blocks that were not seen.

The series of cells is cut in two. On the first part forecasts are fitted (to its first two thirds)
and chosen (on its last third); on the second part those chosen are scored, once. Two kinds compete:

keep a value: `zero`, that of the zeroing (no correction); `last`, the newest cell; `level`, an
    exponential mean of the past, which is the local level of a random walk in white noise
    (Muth, *J. Am. Stat. Assoc.* 55, 1960).
tell a change: `trend`, the newest level and a line through a window of the past; `ar`, least
    squares of the change over the horizon on the past changes over several lags; `line`, one
    fitted to all of the past, from the newest level on; `day`, the same with waves of a day and
    half a day.

The bias drift counts as predictable at a horizon if the chosen teller beats the chosen keeper by a
skill, 1 - MSE / MSE, of 0.1 or more whose 99 % interval is above zero; the interval is a moving
block bootstrap's (Künsch, *Ann. Stat.* 17, 1989) with blocks of the horizon's length or more.
White noise is no bias_drift: a longer mean beats the newest cell there, and nothing tells a change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from scipy.signal import lfilter

HORIZONS_S = (60.0, 300.0, 900.0, 3600.0, 3.0 * 3600.0, 6.0 * 3600.0)
_DAY_S = 86400.0
_ZEROING_S = 60.0
_FEWEST_HORIZONS = 5  # so many must fit into the part that is scored
_LEVELS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
_TREND_WINDOWS_S = (900.0, 3600.0, 4 * 3600.0, 12 * 3600.0)
_LAGS_S = (60.0, 300.0, 1800.0, 7200.0)
_RESAMPLES = 400
_LEAST_SKILL = 0.1
_MOST_CELLS = 6000  # beyond, cells grow

Forecast = Callable[[Array, int], Array]
"""From the series (n,) and a horizon in cells to forecasts (n,): at i, of i + horizon."""


@dataclass(frozen=True)
class HorizonScore:
    """At one horizon: root mean square errors (by name) on the part not seen, all axes together.

    keeper, teller: chosen beforehand; skill of teller over keeper with its 99 % interval;
    predictable: see above.
    """

    horizon_s: float
    rmse: dict[str, float]
    keeper: str
    teller: str
    skill: float
    interval: tuple[float, float]

    @property
    def predictable(self) -> bool:
        """Whether the teller clearly beats keeping a value."""
        return self.skill >= _LEAST_SKILL and self.interval[0] > 0.0


def score_forecasts(series: Array, cell_s: float, seed: int = 0) -> list[HorizonScore]:
    """Of a group of axes (n, k), NaN where there is none; empty where it is too short."""
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
        keeper = min(("zero", "last", "level"), key=lambda n: chosen_on[n])
        tellers = [name for name in ("trend", "line", "ar", "day") if name in chosen_on]
        # A line is a wave's simplest case, and takes its place unless the wave is clearly better.
        teller = min(tellers, key=lambda n: chosen_on[n] * (1.1 if n == "day" else 1.0))
        skill, interval = _skill(squares[teller], squares[keeper], horizon, rng)
        rmse = {n: float(np.sqrt(np.mean(s) / series.shape[1])) for n, s in squares.items()}
        result.append(HorizonScore(horizon_s, rmse, keeper, teller, skill, interval))
    return result


def cell_for(duration_s: float, series_cell_s: float) -> float:
    """Cells to forecast with: a minute, or less where that is more than a fiftieth of it all."""
    wanted = 60.0 if duration_s >= 3000.0 else max(series_cell_s, duration_s / 200.0)
    wanted = max(wanted, duration_s / _MOST_CELLS)
    return max(1, round(wanted / series_cell_s)) * series_cell_s


def _forecasts(series: Array, known: int, cell_s: float, horizon: int) -> dict[str, Array]:
    """By name, forecasts (n,) made with parameters fitted to the first `known` cells."""
    zero = float(np.mean(series[: max(1, round(_ZEROING_S / cell_s))]))
    level = _best(
        [lfilter([a], [1.0, a - 1.0], series, zi=[(1.0 - a) * series[0]])[0] for a in _LEVELS],
        series,
        known,
        horizon,
    )
    windows = [round(w / cell_s) for w in _TREND_WINDOWS_S]
    windows = [w for w in windows if 4 <= w <= known // 2] or [max(4, known // 4)]
    trend = _best([level + horizon * _slope(series, w) for w in windows], series, known, horizon)
    found = {
        "zero": np.full(len(series), zero),
        "last": series,
        "level": level,
        "trend": trend,
        "ar": _autoregression(series, level, known, horizon, cell_s),
    }
    found["line"] = _waves(series, level, known, horizon, cell_s, 0)
    if known * cell_s >= _DAY_S:
        found["day"] = _waves(series, level, known, horizon, cell_s, 2)
    return found


def _best(candidates: list[Array], series: Array, known: int, horizon: int) -> Array:
    """The candidate with the least error within the first `known` cells."""
    last = max(known - horizon, 1)
    errors = [float(np.mean((series[horizon:known] - c[:last][: known - horizon]) ** 2))
              for c in candidates]  # fmt: skip
    return candidates[int(np.argmin(errors))]


def _slope(series: Array, window: int) -> Array:
    """Slope (n,), a cell, of the least-squares line through the last `window` cells."""
    weight = np.arange(window) - (window - 1) / 2.0
    weight /= np.sum(weight**2)
    padded = np.concatenate([np.full(window - 1, series[0]), series])
    return np.convolve(padded, weight[::-1], mode="valid")


def _autoregression(series: Array, level: Array, known: int, horizon: int, cell_s: float) -> Array:
    """The level's change over the horizon by its changes over lags: least squares with a ridge."""
    lags = sorted({max(1, round(lag / cell_s)) for lag in _LAGS_S} | {horizon})
    lags = [lag for lag in lags if lag < known // 4]
    columns = [np.ones(len(series))]
    for lag in lags:
        before = np.concatenate([np.full(lag, level[0]), level[:-lag]])
        columns.append(level - before)
    design = np.column_stack(columns)
    first = max(lags, default=0)
    rows = slice(first, known - horizon)
    target = series[first + horizon : known] - level[rows]
    if len(target) < 3 * design.shape[1]:
        return level
    size = np.maximum(np.std(design[rows], axis=0), 1e-12)
    size[0] = 1.0
    scaled = design[rows] / size
    # As much ridge as one independent stretch of the horizon's length would tell.
    ridge = horizon * np.eye(design.shape[1])
    weights = np.linalg.solve(scaled.T @ scaled + ridge, scaled.T @ target)
    return np.asarray(level + (design / size) @ weights)


def _waves(
    series: Array, level: Array, known: int, horizon: int, cell_s: float, harmonics: int
) -> Array:
    """A line and so many harmonics of a day through all of the past, from the newest level on.

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
    teller: Array, keeper: Array, horizon: int, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """1 - MSE / MSE of squares (n,), and its 99 % interval."""
    count = len(teller)
    block = min(max(horizon, count // 50, 1), max(count // 4, 1))
    pieces = -(-count // block)
    starts = rng.integers(0, count - block + 1, size=(_RESAMPLES, pieces))
    sums = [np.concatenate([[0.0], np.cumsum(s)]) for s in (teller, keeper)]
    drawn = [(total[starts + block] - total[starts]).sum(axis=1) for total in sums]
    skills = 1.0 - drawn[0] / np.maximum(drawn[1], 1e-300)
    low, high = np.quantile(skills, [0.005, 0.995])
    skill = 1.0 - float(np.mean(teller)) / max(float(np.mean(keeper)), 1e-300)
    return skill, (float(low), float(high))


def _filled(column: Array) -> Array:
    """The series with its gaps held at the last value before them, as a forecaster would."""
    there = np.isfinite(column)
    last = np.maximum.accumulate(np.where(there, np.arange(len(column)), -1))
    first = int(np.argmax(there))
    return np.asarray(column[np.maximum(last, first)])
