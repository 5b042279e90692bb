"""A table's evaluation for a person, and for a program."""

from typing import Any

import numpy as np
from galen_model.arm import WRENCH_AXES
from galen_model.arrays import Array
from rich.console import Console
from rich.table import Table

from galen_gravcomp.table_evaluation import Evaluation

_SHOWN = np.array([1e3] * 6)  # N and N.m are printed as mN and mN.m
_UNITS = ("mN", "mN", "mN", "mN.m", "mN.m", "mN.m")


def to_json(result: Evaluation) -> dict[str, Any]:
    """The evaluation for a program; SI units."""
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
            "weight_N": load.mass_kg * 9.80665,
        },
        "offset": result.fit.offset.tolist(),
        "left_out": (np.flatnonzero(~result.fit.used) + 1).tolist(),
        "scatter_within_phases": None if result.scatter is None else result.scatter.tolist(),
        "scores": {
            split: {
                name: {
                    "rmse": _by_axis(score.rmse),
                    "groups": score.groups,
                    "refused": list(score.refused),
                }
                for name, score in models.items()
            }
            for split, models in result.scores.items()
        },
    }
    if result.tool is not None and result.tool_residuals is not None:
        rmse = np.sqrt(np.mean(result.tool_residuals**2, axis=0))
        content["tool"] = {
            "name": result.tool.tool,
            "rmse": _by_axis(rmse),
        }
    return content


def _by_axis(rmse: Array) -> dict[str, float] | None:
    """By axis; None when there is nothing to score."""
    if not np.all(np.isfinite(rmse)):
        return None
    return dict(zip(WRENCH_AXES, rmse.tolist(), strict=True))


def print_report(result: Evaluation, console: Console) -> None:
    """Tables for a person."""
    load = result.fit.load
    source = f"{result.source_rows} rows"
    if result.phases is not None:
        source += f", {len(result.table)} averages in {result.phases} still phases"
    console.print(
        f"[bold]{result.table.path}[/bold]: {source}; orientation from {result.table.orientation}"
    )
    found = Table(title="Load, from all readings", title_justify="left")
    for name in ("", "value", "standard deviation"):
        found.add_column(name, justify="right" if name else "left")
    found.add_row("mass (g)", f"{load.mass_kg * 1e3:.2f}", f"{load.mass_std_kg * 1e3:.2f}")
    for axis, com, std in zip("xyz", load.com_m, load.com_std_m, strict=True):
        found.add_row(f"centre {axis} (mm)", f"{com * 1e3:.2f}", f"{std * 1e3:.2f}")
    console.print(found)
    scores = Table(
        title="Root mean square of what is left over on readings that the fit has not seen",
        title_justify="left",
    )
    scores.add_column("held out, model", no_wrap=True)
    for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True):
        scores.add_column(f"{axis} ({unit})", justify="right")
    for split, models in result.scores.items():
        scores.add_row(f"[bold]{split}[/bold]")
        for name, score in models.items():
            scores.add_row(f"  {name}", *_cells(score.rmse))
        scores.add_section()
    if result.tool is not None and result.tool_residuals is not None:
        rmse = np.sqrt(np.mean(result.tool_residuals**2, axis=0))
        scores.add_row(f"tool file {result.tool.tool}, no fit", *_cells(rmse))
    if result.scatter is not None:
        scores.add_row("scatter within still phases", *_cells(result.scatter))
    console.print(scores)
    for split, models in result.scores.items():
        for name, score in models.items():
            if score.refused:
                console.print(
                    f"[yellow]{split}, {name}: {len(score.refused)} of {score.groups} could not be "
                    f"scored; {score.refused[0]}[/yellow]"
                )
    for note in result.notes:
        console.print(f"[yellow]{note}[/yellow]")


def _cells(rmse: Array) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in rmse * _SHOWN]
