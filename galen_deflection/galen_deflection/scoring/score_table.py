"""Scores for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from galen_model.arrays import Array
from rich.table import Table

from galen_deflection.scoring.score import AXES, Score

_WIDE = 150
"""Characters that the table of all models takes."""

_GOOD_RATIO, _POOR_RATIO = 1.3, 2.0


def axis_table(score: Score, title: str = "") -> Table:
    """One prediction, an axis a row: errors, noise, coverage, and what is left at no load."""
    table = Table(title=title or None)
    for heading in ("", "unit", "RMSE", "95 % below", "noise", "RMSE / noise", "in 95 %"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for heading in ("left at no load", "its error", "its noise"):
        table.add_column(heading, justify="right")
    rests = score.rests
    for k, axis in enumerate(AXES):
        left = ["-"] * 3
        if rests is not None:
            rms = _rms(rests.measured), rests.error, _rms(rests.noise)
            left = [f"{1e3 * values[k]:.4f}" for values in rms]
        table.add_row(
            axis,
            "mm" if k < 3 else "mrad",
            *(f"{1e3 * v[k]:.4f}" for v in (score.rmse, score.percentile95, score.noise)),
            _ratio(float(score.ratio[k])),
            f"{100.0 * score.coverage[k]:.1f} %",
            *left,
        )
    table.caption = caption(score)
    return table


def caption(score: Score) -> str:
    """What isn't of one axis, in one sentence a thing."""
    lines = [
        f"{score.samples} samples, RMSE / noise of all axes {score.ratio_all:.2f}, "
        f"{100.0 * score.coverage_joint:.1f} % in the 95 % ellipsoid, "
        f"{100.0 * score.extrapolated:.1f} % extrapolated"
    ]
    if score.loops is not None:
        loops = score.loops.to_dict()
        share = loops["predicted_over_measured"]
        lines.append(
            f"loops of {loops['pushes']} pushes: {loops['measured_sum_mJ']:+.3f} mJ measured "
            f"(noise {loops['noise_of_sum_mJ']:.3f}), {loops['predicted_sum_mJ']:+.3f} predicted"
            + ("; lost in the noise" if share is None else f", {_percent(share)} %")
        )
    if score.rests is not None:
        for name, axes in (("translation", slice(0, 3)), ("rotation", slice(3, 6))):
            gain, wrong = score.rests.gain(axes), score.rests.error_share(axes)
            lines.append(
                f"left at no load, {name}: lost in the noise"
                if gain is None or wrong is None
                else f"left at no load, {name}: {_percent(gain[0])} +- {_percent(gain[1])} % "
                f"predicted, error {_percent(wrong)} %"
            )
    return "\n".join(lines)


def comparison_table(
    scores: Mapping[str, Score],
    title: str = "",
    more: Mapping[str, Mapping[str, str]] | None = None,
    width: int | None = None,
) -> Table:
    """Several predictions, a model a row, or one model's parts.

    `more`: further columns by their headings, each with cells by the rows' names. In less than a
    `width` of _WIDE characters the errors of each axis are left out, and the caption says so.
    """
    wide = width is None or width >= _WIDE
    more = more or {}
    table = Table(title=title or None)
    table.add_column("", no_wrap=True)  # cut short, names of models are alike
    if not wide:
        table.caption = "errors of each axis: in a wider terminal, or by --json"
    of_axes = [
        f"{what}, {unit}"
        for what in ("RMSE", "95 % below")
        for unit in ("mm\nx y z", "mrad\nrx ry rz")
    ]
    for heading in (
        *(of_axes if wide else []),
        "RMSE / noise\nall: trans. rot.",
        "in\n95 %",
        "loops",
        "left at\nno load",
        "extra-\npolated",
        *more,
    ):
        table.add_column(heading, justify="right")
    for name, score in scores.items():
        loops = None if score.loops is None else score.loops.share
        left = None if score.rests is None else score.rests.gain(slice(0, 3))
        table.add_row(
            name,
            *(
                _three(values[axes])
                for values in ((score.rmse, score.percentile95) if wide else ())
                for axes in (slice(0, 3), slice(3, 6))
            ),
            f"{_ratio(score.ratio_all)}: {score.ratio_of(slice(0, 3)):.2f}"
            f" {score.ratio_of(slice(3, 6)):.2f}",
            f"{100.0 * score.coverage_joint:.0f} %",
            "-" if loops is None else f"{_percent(loops)} %",
            "-" if left is None else f"{_percent(left[0])} +- {_percent(left[1])} %",
            f"{100.0 * score.extrapolated:.0f} %",
            *(cells.get(name, "-") for cells in more.values()),
        )
    return table


def overview_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Several recordings by several models, from `Score.to_dict`: a line each.

    Each row: {"name", "models": {name: score}, "problems"}, or {"name", "error"}.
    """
    table = Table(title="How well models predict")
    table.add_column("bag", overflow="fold")
    table.add_column("model", no_wrap=True)
    for heading in (
        "RMSE / noise\nall: trans. rot.",
        "95 % below, mm\nx y z",
        "95 % below, mrad\nrx ry rz",
        "in\n95 %",
        "left at\nno load",
        "extra-\npolated",
        "problems",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        if "error" in row:
            table.add_row(row["name"], "[bold red]broken[/bold red]", *("-",) * 7)
            continue
        for name, score in row["models"].items():
            left = None
            if score["rests"] is not None:
                left = score["rests"]["translation"]["predicted_over_measured"]
            table.add_row(
                row["name"],
                name,
                f"{_ratio(score['rmse_over_noise_all'])}:"
                f" {score['rmse_over_noise_translation']:.2f}"
                f" {score['rmse_over_noise_rotation']:.2f}",
                " ".join(f"{value:.3f}" for value in score["percentile95_mm"]),
                " ".join(f"{value:.3f}" for value in score["percentile95_mrad"]),
                f"{100.0 * score['coverage95_joint']:.0f} %",
                "-" if left is None else f"{_percent(left)} %",
                f"{100.0 * score['extrapolated']:.0f} %",
                str(len(row["problems"])),
            )
    return table


def _three(values: Array) -> str:
    return " ".join(f"{1e3 * value:.3f}" for value in values)


def _percent(share: float) -> str:
    return f"{round(100.0 * share)}"  # without the sign of a -0


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _ratio(value: float) -> str:
    colour = "green" if value <= _GOOD_RATIO else "yellow" if value <= _POOR_RATIO else "red"
    return f"[{colour}]{value:.2f}[/{colour}]"
