"""Judge a long recording without contact: Allan deviation, forecasts, how long a tare holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.evidence.verdict import Limits
from rich.table import Table

from galen_gravcomp.evaluate.drift_series import DriftSeries
from galen_gravcomp.evaluate.drift_statistics import (
    KEEPERS,
    PREDICTORS,
    Allan,
    HorizonScore,
    allan_deviation,
    cell_for,
    score_forecasts,
)
from galen_gravcomp.evaluate.report import Report, table

GROUPS = {"force": slice(0, 3), "torque": slice(3, 6)}
_UNIT = {"force": (1.0, "N"), "torque": (1e3, "mN.m")}
_DELAYS = 60
_PREDICTOR_TEXT = {"line": "a straight line", "day": "the time of day"}


@dataclass(frozen=True)
class DriftResult:
    """Drift of a recording.

    allan: of each axis; rate_per_hour (6,): slope of a line through it all, N/h and N.m/h;
    delay_s (k,), change (k, 6): root mean square change of the reading over a delay; holds_s: by
    group, after which the worst axis' change is larger than its limit, None if it never is;
    scores, sentence: by group.
    """

    series: DriftSeries
    limits: Limits
    allan: tuple[Allan, ...]
    rate_per_hour: Array
    delay_s: Array
    change: Array
    holds_s: dict[str, float | None]
    scores: dict[str, list[HorizonScore]]
    forecast_cell_s: float
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
            "forecasts": {
                name: [
                    {
                        "horizon_s": score.horizon_s,
                        "rmse": score.rmse,
                        "keeper": score.keeper,
                        "predictor": score.predictor,
                        "skill": score.skill,
                        "interval99": list(score.interval),
                        "predictable": score.predictable,
                    }
                    for score in scores
                ]
                for name, scores in self.scores.items()
            },
            "answer": self.sentence,
        }


def judge_drift(series: DriftSeries, limits: Limits) -> DriftResult:
    """Judge a recording in all respects."""
    allan = tuple(allan_deviation(column, series.cell_s) for column in series.reading.T)
    delay_s, change = _changes(series)
    cell_s = cell_for(series.duration_s, series.cell_s)
    cells = series.every(cell_s)
    scores, holds, sentence = {}, {}, {}
    for name, axes in GROUPS.items():
        over = np.flatnonzero((change[:, axes] > limits.axes[axes]).any(axis=1))
        holds[name] = float(delay_s[over[0]]) if len(over) else None
        scores[name] = score_forecasts(cells[:, axes], cell_s)
        hold = _hold_text(name, holds[name], limits, series)
        sentence[name] = f"{name}: {_forecast_text(scores[name], change[:, axes])}; {hold}."
    time_h: Array = np.arange(float(len(series.reading))) * (series.cell_s / 3600.0)
    rate = np.array([_slope(time_h, column) for column in series.reading.T])
    return DriftResult(
        series, limits, allan, rate, delay_s, change, holds, scores, cell_s, sentence
    )


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


def _forecast_text(scores: list[HorizonScore], change: Array) -> str:
    if not scores:
        return "too short to say whether the bias drift can be predicted"
    predictable = [score for score in scores if score.predictable]
    if predictable:
        best = max(predictable, key=lambda score: score.skill)
        return (
            f"predictable; {_PREDICTOR_TEXT[best.predictor]} predicts {best.skill:.0%} of the"
            f" change over {duration_text(best.horizon_s)} (mean square, on hours that no fit has"
            f" seen; at {len(predictable)} of {len(scores)} horizons it beats keeping a value)"
        )
    # White noise: the change over the longest delays is that from one cell to the next.
    if np.all(change[-5:].mean(axis=0) < 1.1 * change[0]):
        return "white noise, nothing drifts: average longer"
    return (
        f"not predictable; no forecast up to {duration_text(scores[-1].horizon_s)} beats keeping"
        " the value of the last moments"
    )


def duration_text(seconds: float) -> str:
    """Return 40 s, 12 min, 3.5 h."""
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.3g} min"
    return f"{seconds / 3600.0:.3g} h"


def report(result: DriftResult, name: str) -> Report:
    """Make the report: the answer, then its reasons; forces in N, torques in mN.m."""

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
        _forecast_table(result),
        "zero: the value just after zeroing; last: the newest bin of"
        f" {result.forecast_cell_s:g} s; skill: of the better of line, day over that of zero, last,"
        " level, both chosen on the first half",
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


def _forecast_table(result: DriftResult) -> Table:
    names = (*KEEPERS, *PREDICTORS)
    made = table(
        "Forecasts on the second half: root mean square error (of three axes)",
        ("ahead", *names, "skill (99 %)"),
    )
    for group, (factor, unit) in _UNIT.items():
        if result.scores[group]:
            made.add_row(f"[bold]{group} ({unit})[/bold]")
        for score in result.scores[group]:
            values = [
                f"{score.rmse[name] * factor:.4f}" if name in score.rmse else "-" for name in names
            ]
            skill = f"{score.skill:+.2f} ({score.interval[0]:+.2f} ... {score.interval[1]:+.2f})"
            if score.predictable:
                skill = f"[green]{skill}[/green]"
            made.add_row(duration_text(score.horizon_s), *values, skill)
    return made
