"""A table's evaluation for a person, and for a program."""

from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from rich.console import Console
from rich.table import Table

from galen_gravcomp.evaluate.table.evaluation import Evaluation

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
        "drifting_bias": _drifting(result),
        "left_out": (np.flatnonzero(~result.fit.used) + 1).tolist(),
        "scatter_within_phases": None if result.scatter is None else result.scatter.tolist(),
        "scores": {
            split: {
                name: {
                    "rmse": _by_axis(score.rmse),
                    "groups": score.groups,
                    "rejected": list(score.rejected),
                }
                for name, score in models.items()
            }
            for split, models in result.scores.items()
        },
    }
    if result.mounted is not None:
        load = result.mounted.single.load
        content["mounted"] = result.mounted.mounting.to_json() | {
            "load": {"mass_kg": load.mass_kg, "com_m": load.com_m.tolist()},
            "pays": None if result.worth is None else result.worth.pays,
            "gain": None if result.worth is None else result.worth.gain,
            "gain_std": None if result.worth is None else result.worth.gain_std,
        }
    if result.tool is not None and result.tool_residuals is not None:
        rmse = np.sqrt(np.mean(result.tool_residuals**2, axis=0))
        content["tool"] = {
            "name": result.tool.tool,
            "rmse": _by_axis(rmse),
        }
    return content


def _drifting(result: Evaluation) -> dict[str, Any] | None:
    """What a bias that may drift makes of the load; None where it can't be told."""
    found = result.drifting
    if found is None or found.choice is None:
        return None
    return {
        "force": str(found.choice.shapes[0]),
        "torque": str(found.choice.shapes[1]),
        "mass_kg": found.load.mass_kg,
        "mass_std_kg": found.load.mass_std_kg,
        "com_m": found.load.com_m.tolist(),
        "offset_at_end": found.bias_end.tolist(),
    }


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
    if result.mounted is not None:
        found.add_section()
        mounted = result.mounted.single.load
        mass, std = mounted.mass_kg * 1e3, mounted.mass_std_kg * 1e3
        found.add_row("with sensor and mounting: mass (g)", f"{mass:.2f}", f"{std:.2f}")
        for name, value, deviation, unit in result.mounted.mounting.rows:
            found.add_row(f"{name} ({unit})", f"{value:.3f}", f"{deviation:.3f}")
    console.print(found)
    if result.drifting is not None:
        drifting = result.drifting.load
        console.print(
            f"bias over the readings, chosen by held-out blocks: {result.drifting.choice}; with it"
            f" {drifting.mass_kg * 1e3:.2f} ± {drifting.mass_std_kg * 1e3:.2f} g, the weight"
            f" {(drifting.mass_kg / load.mass_kg - 1.0) * 100.0:+.2f} %"
        )
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
            if score.rejected:
                console.print(
                    f"[yellow]{split}, {name}: {len(score.rejected)} of {score.groups} could not be"
                    f" scored; {score.rejected[0]}[/yellow]"
                )
    if result.worth is not None:
        colour = "green" if result.worth.pays else "yellow"
        console.print(f"[{colour}]{result.worth.sentence}[/{colour}]")
    for note in result.notes:
        console.print(f"[yellow]{note}[/yellow]")


def _cells(rmse: Array) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in rmse * _SHOWN]
