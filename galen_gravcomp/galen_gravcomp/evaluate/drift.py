# SPDX-License-Identifier: Apache-2.0
"""Judge a long recording without contact: noise, Allan deviation, how long a tare holds.

The overlapping Allan deviation of a reading, with its confidence band and fitted coefficients:

With y cells of tau_0 and their means over m neighbours, tau = m tau_0,

    AVAR(tau) = mean over i of (ybar_{i+m} - ybar_i)^2 / 2,   all starts i (overlapping)

(Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065, 2008, section 5.2.4). Cells that
are missing leave out the pairs that need them. The band is chi-squared's, with the degrees of
freedom of table 5 there, by the noise that the slope indicates. IEEE Std 952-1997, annex C, has the
terms of a sensor:

    AVAR = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2

white noise N (N/sqrt(Hz)), bias instability B (N), random walk K (N/sqrt(s)), ramp R (N/s); fitted
with non-negative least squares, each tau weighted by its degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.errors import GalenError
from galen_model.load.verdict import Limits
from rich.table import Table

from galen_gravcomp.evaluate.drift_series import DriftSeries
from galen_gravcomp.evaluate.report import Report, table

GROUPS = {"force": slice(0, 3), "torque": slice(3, 6)}
_UNIT = {"force": (1.0, "N"), "torque": (1e3, "mN.m")}
_DELAYS = 60
_PER_DECADE = 8
_FEWEST_PAIRS = 3  # whole, that don't overlap


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
    """Compute the overlapping Allan deviation of one channel.

    Args:
        cells: (n,) means of the reading, in its unit; NaN where there is none.
        cell_s: length of a cell, s.

    Returns:
        Deviation with its 95 % band and fitted coefficients.

    Raises:
        GalenError: at no averaging time there are neighbouring means.

    """
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
    if not rows:
        raise GalenError(
            f"{there.sum()} of {len(cells)} cells of {cell_s:g} s hold readings, and too few of"
            " them are neighbours: give a larger --cell-s"
        )
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
        squares = scipy.optimize.nnls(weighted / size, variance * weight)[0] / size
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


@dataclass(frozen=True)
class DriftResult:
    """Drift of a recording.

    allan: of each axis; rate_per_hour (6,): slope of a line through it all, N/h and N.m/h;
    delay_s (k,), change (k, 6): root mean square change of the reading over a delay; holds_s: by
    group, after which the worst axis' change is larger than its limit, None if it never is;
    sentence: by group.
    """

    series: DriftSeries
    limits: Limits
    allan: tuple[Allan, ...]
    rate_per_hour: Array
    delay_s: Array
    change: Array
    holds_s: dict[str, float | None]
    sentence: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Everything but the samples; SI units, axes by name."""
        series = self.series
        return {
            "duration_s": series.duration_s,
            "samples": series.samples,
            "contact_s": [list(span) for span in series.contact_s],
            "steps": [{"time_s": at, "change": change.tolist()} for at, change in series.steps],
            "notes": list(series.notes),
            "axes": {
                axis: {
                    "noise": float(series.noise[index]),
                    "rate_per_hour": float(self.rate_per_hour[index]),
                    "white_per_sqrt_hz": allan.white,
                    "bias_instability": allan.instability,
                    "random_walk_per_sqrt_h": allan.walk * 60.0,
                    "ramp_per_h": allan.ramp * 3600.0,
                    "allan": {
                        name: getattr(allan, name).tolist()
                        for name in ("tau_s", "deviation", "low", "high")
                    },
                }
                for index, (axis, allan) in enumerate(zip(WRENCH_AXES, self.allan, strict=True))
            },
            "holds_s": self.holds_s,
            "answer": self.sentence,
        }


def judge_drift(series: DriftSeries, limits: Limits) -> DriftResult:
    """Judge a recording: noise, drift, and how long a tare holds.

    Args:
        series: the recording.
        limits: how far a tare may be off, 1 sigma.

    Returns:
        The judgement, with an answer in words for forces and for torques.

    """
    allan = tuple(allan_deviation(column, series.cell_s) for column in series.reading.T)
    delay_s, change = _changes(series)
    holds, sentence = {}, {}
    for name, axes in GROUPS.items():
        over = np.flatnonzero((change[:, axes] > limits.axes[axes]).any(axis=1))
        holds[name] = float(delay_s[over[0]]) if len(over) else None
        hold = _hold_text(name, holds[name], limits, series)
        # White noise: the change over the longest delays is that from one cell to the next.
        if np.all(change[-5:, axes].mean(axis=0) < 1.1 * change[0, axes]):
            hold = f"white noise, nothing drifts: average longer; {hold}"
        sentence[name] = f"{name}: {hold}."
    time_h: Array = np.arange(float(len(series.reading))) * (series.cell_s / 3600.0)
    rate = np.array([_slope(time_h, column) for column in series.reading.T])
    return DriftResult(series, limits, allan, rate, delay_s, change, holds, sentence)


def _changes(series: DriftSeries) -> tuple[Array, Array]:
    """Delays (k,), s, and the root mean square change (k, 6) of the cells over them."""
    count = len(series.reading)
    steps = np.unique(np.round(np.logspace(0, np.log10(max(count // 3, 2)), _DELAYS)).astype(int))
    rows, kept = [], []
    for step in steps:
        change = series.reading[step:] - series.reading[:-step]
        if np.isfinite(change[:, 0]).sum() >= 3:
            kept.append(step)
            rows.append(np.sqrt(np.nanmean(change**2, axis=0)))
    return np.array(kept) * series.cell_s, np.array(rows)


def _slope(time_h: Array, column: Array) -> float:
    there = np.isfinite(column)
    return float(np.polyfit(time_h[there], column[there], 1)[0])


def _hold_text(name: str, holds_s: float | None, limits: Limits, series: DriftSeries) -> str:
    factor, unit = _UNIT[name]
    limit = limits.axes[GROUPS[name].start] * factor
    if holds_s is None:
        longest = duration_text(series.duration_s / 3.0)
        return f"a tare stays within {limit:g} {unit} (1 sigma) for {longest}, the longest delay"
    if holds_s <= 3.0 * series.cell_s:
        cell = duration_text(series.cell_s)
        return f"two means of {cell} next to each other differ by more than {limit:g} {unit} anyway"
    return f"re-tare every {duration_text(holds_s)} to stay within {limit:g} {unit} (1 sigma)"


def duration_text(seconds: float) -> str:
    """Return a duration in words: 40 s, 12 min, 3.5 h.

    Args:
        seconds: the duration.

    Returns:
        Three digits and a unit.

    """
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.3g} min"
    return f"{seconds / 3600.0:.3g} h"


def report(result: DriftResult, name: str) -> Report:
    """Make the report: the answer, then its reasons; forces in N, torques in mN.m.

    Args:
        result: the judged recording.
        name: of the recording; begins the picture's name.

    Returns:
        The report.

    """

    def plot(directory: Path) -> Path:
        from galen_gravcomp.evaluate.plots import plot_drift  # slow to import

        return plot_drift(result, directory, name)

    return Report(result.to_json(), _shown(result), plot)


def _shown(result: DriftResult) -> list[str | Table]:
    series = result.series
    notes = []
    if series.contact_s:
        total = sum(end - begin for begin, end in series.contact_s)
        first = ", ".join(f"{begin:.0f}-{end:.0f} s" for begin, end in series.contact_s[:3])
        more = ", ..." if len(series.contact_s) > 3 else ""
        spans = f"{len(series.contact_s)} spans, {total:.0f} s in all ({first}{more})"
        notes.append(f"left out for contact: {spans}")
    for at, change in series.steps:
        force = ", ".join(f"{value:+.3f}" for value in change[:3])
        notes.append(f"the level jumps at {at:.0f} s and stays: force {force} N")
    return [
        *(f"[bold]{sentence}[/bold]" for sentence in result.sentence.values()),
        f"{duration_text(series.duration_s)}, {series.samples} readings",
        *(f"[yellow]{note}[/yellow]" for note in (*notes, *series.notes)),
        _noise_table(result),
    ]


def _noise_table(result: DriftResult) -> Table:
    heads = ("", "one reading", "white, /sqrt(Hz)", "instability", "walk, /sqrt(h)", "line, /h")
    made = table("Noise and drift of the reading", heads)
    for index, (axis, allan) in enumerate(zip(WRENCH_AXES, result.allan, strict=True)):
        factor, unit = (1.0, "N") if index < 3 else (1e3, "mN.m")
        values = (
            result.series.noise[index],
            allan.white,
            allan.instability,
            allan.walk * 60.0,
            result.rate_per_hour[index],
        )
        made.add_row(f"{axis} ({unit})", *(f"{value * factor:.4f}" for value in values))
    return made
