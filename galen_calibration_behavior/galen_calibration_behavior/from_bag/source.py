"""A recording that a tool's calibration file is made from: how it is read, and when it ended."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from galen_bags.arrays.arm_recording import ArmRecording, ArmTopics, read_arm
from galen_model.errors import CalibrationFileError, GalenError
from galen_model.files.calibration_file import (
    CalibrationFile,
    age_text,
    calibration_path,
    read_calibration,
)
from tqdm import tqdm

from galen_calibration_behavior.calibration.estimate import check_writable

T = TypeVar("T")

# A stamp before this is not a date: a simulation's clock, or one that was never set.
_EARLIEST_DATE = datetime(2000, 1, 1, tzinfo=UTC)


def read_recording(options: argparse.Namespace, bag: str) -> ArmRecording:
    """Read a bag with the options' names of topics and joints; raises GalenError."""
    return read_arm(
        bag, ArmTopics(options.joint_states, options.wrench_raw, tuple(options.joint_names))
    )


def open_calibrated(options: argparse.Namespace) -> tuple[Path, CalibrationFile, ArmRecording]:
    """Open a calibrated tool's file and the recording that adds to it; raises GalenError."""
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path)
    if not options.dry_run:
        check_writable(path)
    recording = read_recording(options, options.bag)
    recorded = sample_time(int(recording.joint_stamp_ns[-1]), int(recording.joint_log_ns[-1]))
    check_not_newer(options, path, recorded)
    return path, tool, recording


def sample_time(stamp_ns: int, log_ns: int) -> datetime:
    """When a sample was taken: its stamp or, where that is no date, when it was received."""
    stamp = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    received = datetime.fromtimestamp(log_ns / 1e9, UTC)
    return stamp if stamp >= _EARLIEST_DATE else max(stamp, received)


def check_not_newer(options: argparse.Namespace, path: Path, recorded: datetime) -> None:
    """Raise GalenError where the file's calibration is newer than the recording's end.

    Nothing is raised where nothing is to be written, or `--replace-newer` allows it.
    """
    if options.dry_run or options.replace_newer:
        return
    try:
        held = read_calibration(path).calibrated_at
    except CalibrationFileError:
        return
    ended = recorded.isoformat(timespec="seconds")  # as precise as the file's
    if datetime.fromisoformat(ended) < datetime.fromisoformat(held):
        raise GalenError(
            f"{path}: not replaced: calibrated {held} ({age_text(held)}), after the recording's"
            f" end, {ended} ({age_text(ended)}); --replace-newer replaces it all the same"
        )


def progress(what: str, unit: str, work: list[T]) -> Iterable[T]:
    """Wrap work in a bar on standard error, where that is a terminal; it leaves no trace."""
    return tqdm(work, desc=what, unit=unit, file=sys.stderr, disable=None, leave=False)
