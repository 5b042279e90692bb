"""Options of `train` and `evaluate`: reading recordings of pushes, fitting models."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from galen_bags.formats.find import find_bags
from galen_ros.command import progress, whole
from rich.console import Console

from galen_deflection.measurement.recordings import ReadSettings, Recording, read_recording
from galen_deflection.measurement.registration_fit import RegistrationSettings
from galen_deflection.models.interface import FitSettings

TABLE_WIDTH = 170
"""Columns of the tables where standard output is no terminal."""


def add_recordings(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """Add how deflections are measured in recordings."""
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
        help="estimate where the tool's marker sits, instead of taking it to be at the tip;"
        " needs positions with different orientations",
    )
    group.add_argument(
        "--from-rest",
        action="store_true",
        help="count each visit's deflection from before its first push, instead of from where the"
        " joints say",
    )


def add_fit(options: argparse._ArgumentGroup) -> None:
    """Add how models are fitted."""
    options.add_argument(
        "--seed",
        type=whole(0),
        default=FitSettings.seed,
        metavar="N",
        help="of the networks' random numbers (default: %(default)s)",
    )
    options.add_argument(
        "--iterations",
        type=whole(1),
        metavar="N",
        help="of a network's training (default: 150)",
    )


def read_settings(arguments: argparse.Namespace) -> ReadSettings:
    """Make the settings from the options of `add_recordings`."""
    beside = arguments.tool is None
    return ReadSettings(
        tool=Path(arguments.tool_beside) if beside else arguments.tool,
        tool_beside=beside,
        registration=RegistrationSettings(estimate_tool_marker=arguments.marker_offset),
        from_rest=arguments.from_rest,
    )


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    """Make the settings from the options of `add_fit`."""
    return FitSettings(seed=arguments.seed, iterations=arguments.iterations)


def read_all(paths: Sequence[Path], settings: ReadSettings, quiet: bool) -> list[Recording]:
    """Read the recordings at or below these paths; raises GalenError for the first bad one."""
    bags = find_bags(paths)
    with progress(len(bags), "bag", quiet=quiet) as bar:
        found = []
        for bag in bags:
            bar.set_description(f"reading {bag.name}")
            found.append(read_recording(bag, settings))
            bar.update()
    return found


def print_problems(recordings: Sequence[Recording], to: Console) -> None:
    """Print the problems of each recording, one a line."""
    for recording in recordings:
        for problem in recording.problems:
            to.print(f"[yellow]{recording.path}: {problem}[/yellow]", soft_wrap=True)
