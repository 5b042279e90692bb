# SPDX-License-Identifier: Apache-2.0
"""Options, tables and JSON that `train` and `evaluate` share."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from galen_bags.formats.files import find_bags
from galen_bags.many import calibration_of_bag
from galen_common.arm import add_arm, chosen_arm
from galen_common.command import progress
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from rich.console import Console
from rich.table import Table

from galen_deflection.measurement.measured_deflection import (
    Recording,
    read_recording,
)
from galen_deflection.models.file import DeflectionModel
from galen_deflection.models.spring_model import SpringModel
from galen_deflection.scoring.score import ROTATION, TRANSLATION, Score

TABLE_WIDTH = 170
"""Columns of the tables where standard output is no terminal."""

_GOOD_RATIO, _POOR_RATIO = 1.3, 2.0


def add_recordings(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Add how deflections are measured in recordings.

    Args:
        parser: the parser of `train` or `evaluate`.
        required: whether argparse requires one of the options for the tool.

    """
    group = parser.add_argument_group("recordings")
    tool = group.add_mutually_exclusive_group(required=required)
    tool.add_argument("--tool", type=Path, metavar="FILE", help="the tool's calibration file")
    tool.add_argument(
        "--tool-beside",
        metavar="NAME",
        help="use the file of this name in each bag's directory or above it",
    )
    group.add_argument(
        "--marker-offset",
        action="store_true",
        help="estimate the offset of the tool's marker from the tip, instead of taking it to be"
        " at the tip; needs positions with different orientations",
    )
    add_arm(parser)


def tool_of(bag: Path, arguments: argparse.Namespace, arm: Arm) -> CalibrationFile:
    """Return the tool that a bag was recorded with.

    Args:
        bag: the recording.
        arguments: options of `add_recordings`.
        arm: the arm that was recorded.

    Returns:
        The tool's calibration.

    Raises:
        GalenError: the file is missing or invalid; the message names it.

    """
    beside = arguments.tool is None
    tool = Path(arguments.tool_beside) if beside else arguments.tool
    return calibration_of_bag(bag, tool, beside=beside, arm=arm)


def read_all(paths: Sequence[Path], arguments: argparse.Namespace) -> list[Recording]:
    """Read the recordings at or below these paths.

    Args:
        paths: bags, or folders that hold some.
        arguments: options of `add_recordings`, and `json`, without the progress bar.

    Returns:
        The recordings, sorted by path.

    Raises:
        GalenError: for the first bad one.

    """
    arm, bags = chosen_arm(arguments), find_bags(paths)
    with progress(len(bags), "bag", quiet=arguments.json) as bar:
        found = []
        for bag in bags:
            bar.set_description(f"reading {bag.name}")
            tool = tool_of(bag, arguments, arm)
            found.append(read_recording(bag, tool, arguments.marker_offset, arm=arm))
            bar.update()
    return found


def print_problems(recordings: Sequence[Recording], to: Console) -> None:
    """Print the problems of each recording, one a line.

    Args:
        recordings: the recordings.
        to: console to print to.

    """
    for recording in recordings:
        for problem in recording.problems:
            to.print(f"[yellow]{recording.path}: {problem}[/yellow]", soft_wrap=True)


def score_table(
    scores: Mapping[str, Score], title: str, more: Mapping[str, Mapping[str, str]] | None = None
) -> Table:
    """Return a table of predictions, one a row.

    Args:
        scores: by the rows' names.
        title: line above the table.
        more: further columns by their headings, each with cells by the rows' names; None: no more.

    Returns:
        The table.

    """
    more = more or {}
    table = Table(title=title)
    table.add_column("", no_wrap=True)  # cut short, names of models are alike
    for heading in (
        "RMSE / noise\nall: trans. rot.",
        "95 % below, mm\nx y z",
        "95 % below, mrad\nrx ry rz",
        "in\n95 %",
        "residual at no load,\npredicted: trans. rot.",
        "extra-\npolated",
        *more,
    ):
        table.add_column(heading, justify="right")
    for name, score in scores.items():
        rests = score.rests
        residuals = ("-", "-")
        if rests is not None:
            residuals = _gain(rests.gain(TRANSLATION)), _gain(rests.gain(ROTATION))
        table.add_row(
            name,
            f"{_ratio(score.ratio_of())}: {score.ratio_of(TRANSLATION):.2f}"
            f" {score.ratio_of(ROTATION):.2f}",
            _three(score.percentile95[TRANSLATION]),
            _three(score.percentile95[ROTATION]),
            f"{100.0 * score.coverage_joint:.0f} %",
            ", ".join(residuals),
            f"{100.0 * score.extrapolated:.0f} %",
            *(cells.get(name, "-") for cells in more.values()),
        )
    return table


def parameter_rows(model: DeflectionModel) -> list[dict[str, Any]]:
    """Return the parameters of a model of springs, for JSON.

    Args:
        model: a fitted model.

    Returns:
        For each parameter its name, unit, value, standard deviation and nominal value (None: it has
        none); nothing for a network.

    """
    if not isinstance(model, SpringModel):
        return []
    return [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "value": float(value),
            "std": float(std),
            # An operator's weight has no nominal value.
            "nominal": parameter.prior or None,
        }
        for parameter, value, std in zip(
            model.basis.parameters, model.values, model.std, strict=True
        )
    ]


def parameter_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of parameters.

    Args:
        rows: as `parameter_rows` returns them.

    Returns:
        The table.

    """
    table = Table()
    for heading in ("parameter", "unit"):
        table.add_column(heading)
    for heading in ("value", "+-", "nominal"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["name"],
            row["unit"],
            f"{row['value']:.4g}",
            f"{row['std']:.2g}",
            "-" if row["nominal"] is None else f"{row['nominal']:.4g}",
        )
    return table


def _three(values: Array) -> str:
    return " ".join(f"{1e3 * value:.3f}" for value in values)


def _gain(found: tuple[float, float] | None) -> str:
    if found is None:
        return "-"
    share, noise = (round(100.0 * value) for value in found)  # without the sign of a -0
    return f"{share} +- {noise} %"


def _ratio(value: float) -> str:
    colour = "green" if value <= _GOOD_RATIO else "yellow" if value <= _POOR_RATIO else "red"
    return f"[{colour}]{value:.2f}[/{colour}]"
