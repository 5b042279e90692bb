# SPDX-License-Identifier: Apache-2.0
"""Report of a table: its load and held-out scores."""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arm.galen import WRENCH_AXES
from rich.markup import escape
from rich.table import Table

from galen_gravcomp.evaluate.report import Report, axes_table, axis_cells, by_axis, table
from galen_gravcomp.evaluate.residual import rms
from galen_gravcomp.evaluate.table_scores import TableEvaluation

_COLOURS = {True: "green", None: "yellow", False: "red"}


def scores_report(result: TableEvaluation) -> Report:
    """Make the report of a table.

    Args:
        result: the table's fits and scores.

    Returns:
        The report, without a plot.

    """
    return Report(_content(result), _shown(result))


def _content(result: TableEvaluation) -> dict[str, Any]:
    load = result.fit.load
    content: dict[str, Any] = {
        "table": result.table.path,
        "rows": result.source_rows,
        "readings": len(result.table),
        "still_phases": result.phases,
        "load": {
            "mass_kg": load.mass_kg,
            "com_m": load.com_m.tolist(),
            "covariance": load.covariance.tolist(),
            "weight_N": load.mass_kg * STANDARD_GRAVITY_M_S2,
        },
        "offset": result.fit.offset.tolist(),
        "fits": result.fits,
        "verdict": result.verdict,
        "setup": None if result.setup is None else result.setup.to_json(),
        "rows_left_out": result.table.left_out,
        "left_out": (np.flatnonzero(~result.fit.used) + 1).tolist(),
        "scatter_within_phases": None if result.scatter is None else result.scatter.tolist(),
        "scores": {
            split: {
                name: {
                    "rmse": by_axis(score.rmse),
                    "groups": score.groups,
                    "rejected": list(score.rejected),
                }
                for name, score in models.items()
            }
            for split, models in result.scores.items()
        },
    }
    chosen = result.chosen
    content["chosen"] = {
        "force": chosen.names[0],
        "torque": chosen.names[1],
        "model": chosen.words,
        "reason": chosen.reason,
        "rmse": {name: by_axis(score) for name, score in (chosen.scores or {}).items()},
    }
    if result.mounted is not None and result.mounted.mounting is not None:
        load, worth = result.mounted.load, result.worth
        content["mounted"] = result.mounted.mounting.to_json() | {
            "load": {"mass_kg": load.mass_kg, "com_m": load.com_m.tolist()},
            "pays": None if worth is None else worth.pays,
            "gain": None if worth is None else worth.gain,
            "gain_std": None if worth is None else worth.gain_std,
        }
    if result.tool is not None and result.tool_residuals is not None:
        content["tool"] = {"name": result.tool.tool, "rmse": by_axis(rms(result.tool_residuals))}
    return content


def _shown(result: TableEvaluation) -> list[str | Table]:
    source = f"{result.source_rows} rows"
    if result.phases is not None:
        source += f", {len(result.table)} averages in {result.phases} rest segments"
    shown: list[str | Table] = [
        f"[bold]{result.table.path}[/bold]: {source}; orientation from {result.table.orientation}",
        f"[{_COLOURS[result.fits]}]{escape(result.verdict)}[/]",
        _load_table(result),
    ]
    shown.append(f"chosen: {result.chosen.words}; {result.chosen.reason}")
    shown.append(_score_table(result))
    for split, models in result.scores.items():
        for name, score in models.items():
            if score.rejected:
                shown.append(
                    f"[yellow]{split}, {name}: {len(score.rejected)} of {score.groups} could not be"
                    f" scored; {score.rejected[0]}[/yellow]"
                )
    if result.worth is not None:
        colour = "green" if result.worth.pays else "yellow"
        shown.append(f"[{colour}]{result.worth.sentence}[/{colour}]")
    return [*shown, *(f"[yellow]{note}[/yellow]" for note in result.notes)]


def _load_table(result: TableEvaluation) -> Table:
    load = result.fit.load
    made = table("Load, from all readings", ("", "value", "standard deviation"))
    made.add_row("mass (g)", f"{load.mass_kg * 1e3:.2f}", f"{load.mass_std_kg * 1e3:.2f}")
    for axis, com, std in zip("xyz", load.com_m, load.com_std_m, strict=True):
        made.add_row(f"centre {axis} (mm)", f"{com * 1e3:.2f}", f"{std * 1e3:.2f}")
    made.add_section()
    for axis, value in zip(WRENCH_AXES, result.fit.offset, strict=True):
        unit, scale = ("N", 1.0) if axis[0] == "f" else ("mN.m", 1e3)
        made.add_row(f"bias {axis} ({unit})", f"{value * scale:.3f}", "")
    if result.mounted is not None and result.mounted.mounting is not None:
        made.add_section()
        mounted = result.mounted.load
        mass, std = mounted.mass_kg * 1e3, mounted.mass_std_kg * 1e3
        made.add_row("with sensor and mounting: mass (g)", f"{mass:.2f}", f"{std:.2f}")
        for name, value, deviation, unit in result.mounted.mounting.rows:
            made.add_row(f"{name} ({unit})", f"{value:.3f}", f"{deviation:.3f}")
    return made


def _score_table(result: TableEvaluation) -> Table:
    made = axes_table(
        "Residual on readings that the fit has not seen, root mean square", "held out, model"
    )
    for split, models in result.scores.items():
        made.add_row(f"[bold]{split}[/bold]")
        for name, score in models.items():
            made.add_row(f"  {name}", *axis_cells(score.rmse))
        made.add_section()
    if result.tool is not None and result.tool_residuals is not None:
        name = f"calibration file {result.tool.tool}, no fit"
        made.add_row(name, *axis_cells(rms(result.tool_residuals)))
    if result.scatter is not None:
        made.add_row("scatter within rest segments", *axis_cells(result.scatter))
    return made
