"""A training's outcome for a person, and for a program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from galen_deflection.measurement.recordings import Recording
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import DeflectionModel
from galen_deflection.models.linear import LinearModel
from galen_deflection.networks.network import NetworkModel
from galen_deflection.scoring.options import print_problems
from galen_deflection.scoring.score import Score
from galen_deflection.scoring.score_table import comparison_table


def print_training(
    file: Path,
    recordings: Sequence[Recording],
    samples: DeflectionSamples,
    model: DeflectionModel,
    seconds: float,
    fit: Score,
    checked: Mapping[str, Score | str],
    pictures: Sequence[Path],
    to: Console,
) -> None:
    """Tables for a person. fit: on the samples fitted to; checked: by split."""
    print_problems(recordings, to)
    to.print(
        f"[bold]{model.name}[/bold], tool {recordings[0].tool.tool}: {len(samples)} samples at"
        f" {len(np.unique(samples.position))} positions out of {len(recordings)} recordings, fitted"
        f" in {seconds:.1f} s",
        soft_wrap=True,
    )
    if isinstance(model, LinearModel):
        to.print(_parameters_table(model))
    if isinstance(model, NetworkModel):
        curve = model.training
        check = f", {curve.check_loss[curve.best]:.2f} on what was held out"
        to.print(
            f"{len(curve.training_loss)} iterations, kept {curve.best + 1}: error / noise"
            f" {curve.training_loss[curve.best]:.2f}{check if curve.check_loss else ''}"
        )
    for note in model.notes:
        to.print(f"[yellow]{note}[/yellow]", soft_wrap=True)
    for name in _unresolved(model):
        to.print(
            f"[yellow]{name}: not identifiable from these samples; it keeps its prior[/yellow]",
            soft_wrap=True,
        )
    scores = {"fitted to": fit} | {
        f"held out: {name}": one for name, one in checked.items() if isinstance(one, Score)
    }
    to.print(comparison_table(scores, "How well it predicts", width=to.width))
    for name, one in checked.items():
        if isinstance(one, str):
            to.print(f"[yellow]not held out, {name}: {one}[/yellow]", soft_wrap=True)
    if not checked:
        to.print("[yellow]nothing was held out: the first row says little; --check does[/yellow]")
    for path in pictures:
        to.print(f"plot: {path}", soft_wrap=True)
    to.print(f"[bold green]model file: {file}[/bold green]", soft_wrap=True)
    to.print(
        f"next, on a recording that it was not fitted to: ros2 run galen_deflection evaluate BAG"
        f" --tool FILE --model {file}",
        soft_wrap=True,
    )


def to_dict(
    file: Path,
    recordings: Sequence[Recording],
    samples: DeflectionSamples,
    model: DeflectionModel,
    seconds: float,
    fit: Score,
    checked: Mapping[str, Score | str],
    pictures: Sequence[Path],
) -> dict[str, Any]:
    """The same as plain numbers and texts."""
    return {
        "kind": model.name,
        "file": str(file),
        "bags": [str(recording.path) for recording in recordings],
        "tool": recordings[0].tool.tool,
        "samples": len(samples),
        "positions": len(np.unique(samples.position)),
        "fit_s": seconds,
        "parameters": _parameters(model) if isinstance(model, LinearModel) else [],
        "unresolved": list(_unresolved(model)),
        "notes": list(model.notes),
        "problems": {str(recording.path): list(recording.problems) for recording in recordings},
        "fit": fit.to_dict(),
        "held_out": {
            name: {"error": one} if isinstance(one, str) else one.to_dict()
            for name, one in checked.items()
        },
        "plots": [str(path) for path in pictures],
    }


def _parameters(model: LinearModel) -> list[dict[str, Any]]:
    return [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "value": float(value),
            "std": float(std),
            # Beside a model of bare axes there is no nominal value.
            "nominal": parameter.prior or None,
        }
        for parameter, value, std in zip(
            model.basis.parameters, model.values, model.std, strict=True
        )
    ]


def _parameters_table(model: LinearModel) -> Table:
    table = Table()
    for heading in ("parameter", "unit"):
        table.add_column(heading)
    for heading in ("value", "+-", "nominal"):
        table.add_column(heading, justify="right")
    for row in _parameters(model):
        table.add_row(
            row["name"],
            row["unit"],
            f"{row['value']:.4g}",
            f"{row['std']:.2g}",
            "-" if row["nominal"] is None else f"{row['nominal']:.4g}",
        )
    return table


def _unresolved(model: DeflectionModel) -> Sequence[str]:
    return model.unresolved if isinstance(model, LinearModel) else ()
