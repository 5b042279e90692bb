"""What `train`, `evaluate` and `compare` share: their recordings, how they are read, their ends."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from galen_bags.arrays.arm_recording import ArmTopics
from galen_bags.formats.find import find_bags
from galen_model.errors import GalenError
from rich.console import Console
from tqdm import tqdm

from galen_deflection.measurement.push_recording import PushSettings, PushTopics
from galen_deflection.measurement.recordings import ReadSettings, Recording, read_recording
from galen_deflection.measurement.registration_fit import RegistrationSettings
from galen_deflection.models.interface import FitSettings

_TABLE_WIDTH = 170


def add_bags(parser: argparse.ArgumentParser) -> None:
    """The recordings, and how deflections are taken from them."""
    parser.add_argument(
        "bags",
        nargs="+",
        type=Path,
        metavar="BAG",
        help="recording of pushes with the tracker: rosbag2 directory, .mcap, .db3, ROS 1 .bag, or"
        " a folder that is searched for them",
    )
    tool = parser.add_mutually_exclusive_group(required=True)
    tool.add_argument("--tool", type=Path, metavar="FILE", help="the tool's file")
    tool.add_argument(
        "--tool-beside",
        metavar="NAME",
        help="use the file of this name in each bag's directory or above it",
    )
    group = parser.add_argument_group("recordings")
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
    arm, topics = ArmTopics(), PushTopics()
    for option, default, what in (
        ("--joint-states", arm.joint_states, "the joint states"),
        ("--wrench-raw", arm.wrench_raw, "the raw wrench"),
        ("--tool-pose", topics.tool_pose, "the tool's marker"),
        ("--base-pose", topics.base_pose, "the base's marker"),
    ):
        group.add_argument(
            option,
            default=default,
            metavar="TOPIC",
            help=f"topic of {what} (default: %(default)s, in any one namespace)",
        )


def add_fit(parser: argparse.ArgumentParser) -> None:
    """How models are fitted."""
    group = parser.add_argument_group("fits")
    group.add_argument(
        "--seed",
        type=_whole(0),
        default=FitSettings.seed,
        metavar="N",
        help="of what networks draw by chance (default: %(default)s)",
    )
    group.add_argument(
        "--iterations",
        type=_whole(1),
        metavar="N",
        help="of a network's training (default: its kind's own number)",
    )
    group.add_argument(
        "--patience",
        type=_whole(1),
        metavar="N",
        help="stop a training that has not become better for so many iterations (default: never)",
    )


def read_settings(arguments: argparse.Namespace) -> ReadSettings:
    """From the options of `add_bags`."""
    beside = arguments.tool is None
    arm = replace(ArmTopics(), joint_states=arguments.joint_states, wrench_raw=arguments.wrench_raw)
    return ReadSettings(
        tool=Path(arguments.tool_beside) if beside else arguments.tool,
        tool_beside=beside,
        pushes=PushSettings(topics=PushTopics(arm, arguments.tool_pose, arguments.base_pose)),
        registration=RegistrationSettings(estimate_tool_marker=arguments.marker_offset),
        from_rest=arguments.from_rest,
    )


def fit_settings(arguments: argparse.Namespace) -> FitSettings:
    """From the options of `add_fit`."""
    return FitSettings(
        seed=arguments.seed,
        iterations=arguments.iterations,
        patience=arguments.patience,
    )


def read_all(paths: Sequence[Path], settings: ReadSettings, quiet: bool) -> list[Recording]:
    """The recordings at or below these paths, in order; raises GalenError for the first bad one."""
    bags = find_bags(paths)
    with progress(len(bags), "bag", quiet) as bar:
        found = []
        for bag in bags:
            bar.set_description(f"reading {bag.name}")
            found.append(read_recording(bag, settings))
            bar.update()
    return found


def progress(total: int, unit: str, quiet: bool) -> Any:
    """A bar on standard error, where that is a terminal."""
    return tqdm(total=total, unit=unit, disable=quiet or not sys.stderr.isatty())


def written(draw: Callable[[], list[Path]], folder: Path) -> list[Path]:
    """Draw into the folder; raises GalenError where it can't be written."""
    try:
        return draw()
    except OSError as error:
        raise GalenError(f"{folder}: can't be written: {error.strerror}") from error


def console() -> Console:
    """To standard output; wide enough for tables where that is no terminal."""
    return Console(width=None if sys.stdout.isatty() else _TABLE_WIDTH)


def print_problems(recordings: Sequence[Recording], to: Console) -> None:
    """What was found in each, a line each."""
    for recording in recordings:
        for problem in recording.problems:
            to.print(f"[yellow]{recording.path}: {problem}[/yellow]", soft_wrap=True)


def _whole(least: int) -> Callable[[str], int]:
    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{text} is below {least}")
        return value

    return read
