# SPDX-License-Identifier: Apache-2.0
"""Loads of adapter and tool out of recorded sweeps: the file, and the result for a person.

How a recording is read, and when it ended.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording, read_arm, topics_of
from galen_model.errors import CalibrationFileError, GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.calibration_file import (
    age_text,
    calibration_path,
    read_calibration,
)
from galen_model.load.identification import KnownLoad
from galen_model.load.verdict import wrench_text
from galen_model.setup_check.stamps import check_stamps

from galen_calibration_behavior.calibration.estimate import (
    Calibration,
    EstimateError,
    MountingRequest,
    calibration_fields,
    check_writable,
    choose_tip,
    estimate,
    format_mounting,
    format_result,
    mounting_fields,
)
from galen_calibration_behavior.common.commands import CalibrationCode
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.sweeps import RecordedSweeps, SweepSorter
from galen_calibration_behavior.from_bag.visits import Visits, find_visits
from galen_common import command

T = TypeVar("T")

# A stamp before this is not a date: a simulation's clock, or one that was never set.
_EARLIEST_DATE = datetime(2000, 1, 1, tzinfo=UTC)


def read_recording(options: argparse.Namespace, bag: str) -> ArmRecording:
    """Read a bag with the options' names of topics and joints.

    A sensor frame that the options name is taken as that of wrenches with one other `frame_id`.

    Args:
        options: of `calibrate_from_bag.parse`.
        bag: rosbag2 directory, .mcap or .db3.

    Returns:
        Joint states and wrenches of the whole recording.

    Raises:
        GalenError: the bag can't be read, or lacks a topic.

    """
    topics, arm = topics_of(options), options.parameters.arm
    recording = read_arm(
        bag, topics, arm=arm, progress=progress(f"reading {Path(bag).name}", "block")
    )
    frames = recording.frame_ids
    if not options.sensor_frame or len(frames) > 1 or frames[0] == arm.sensor_frame:
        return recording
    odd = (
        f"{recording.topics[1]} has frame_id {frames[0]!r}"
        + (", the base's" if frames[0] == arm.base_frame else "")
        + f"; its wrenches are taken as written in {arm.sensor_frame!r} (--sensor-frame)"
    )
    return replace(recording, frame_ids=(arm.sensor_frame,), problems=(*recording.problems, odd))


def sample_time(stamp_ns: int, log_ns: int) -> datetime:
    """Return when a sample was taken: its stamp or, where that is no date, when it was received.

    Args:
        stamp_ns: its stamp, ns since the epoch; before 2000 it is no date.
        log_ns: its log time, ns since the epoch.

    Returns:
        The time, UTC.

    """
    stamp = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    received = datetime.fromtimestamp(log_ns / 1e9, UTC)
    return stamp if stamp >= _EARLIEST_DATE else max(stamp, received)


def check_not_newer(options: argparse.Namespace, path: Path, recorded: datetime) -> None:
    """Check that the file's calibration is not newer than the recording's end.

    Nothing is checked where nothing is to be written, or `--replace-newer` allows it; a file that
    can't be read is not newer.

    Args:
        options: of `calibrate_from_bag.parse`.
        path: the tool's file.
        recorded: the recording's end, with a time zone.

    Raises:
        GalenError: it is newer.

    """
    if options.dry_run or options.replace_newer:
        return
    try:
        held = read_calibration(path, options.parameters.arm).calibrated_at
    except CalibrationFileError:
        return
    ended = recorded.isoformat(timespec="seconds")  # as precise as the file's
    if datetime.fromisoformat(ended) < datetime.fromisoformat(held):
        raise GalenError(
            f"{path}: not replaced: calibrated {held} ({age_text(held)}), after the recording's"
            f" end, {ended} ({age_text(ended)}); --replace-newer replaces it all the same"
        )


def progress(what: str, unit: str) -> Callable[[Iterable[T]], Iterator[T]]:
    """Wrap work in a bar on standard error, where that is a terminal; it leaves no trace.

    Args:
        what: the bar's label.
        unit: what it counts.

    Returns:
        A function that passes parts on, one by one, as they are worked through.

    """

    def work(parts: Iterable[T]) -> Iterator[T]:
        total = len(parts) if isinstance(parts, Sized) else None
        with command.progress(total, unit, what) as bar:
            for part in parts:
                yield part
                bar.update()

    return work


def estimate_loads(options: argparse.Namespace) -> dict[str, Any]:
    """Calibrate as the options say, and print the result unless as JSON.

    Args:
        options: of `calibrate_from_bag.parse`; the file and its page are written, but for
            `dry_run`.

    Returns:
        Fields of a live calibration's result, and what only a recording has, for JSON; SI.

    Raises:
        GalenError: the recordings give no file, or it can't be written.

    """
    try:
        sweeps, calibration = _run(options)
    except EstimateError as error:
        raise GalenError(f"{error.code.name}: {error}") from error
    fields = _result_fields(options, sweeps, calibration)
    if not options.json:
        print(f"{_format_sweeps(sweeps)}\n{format_mounting(calibration)}")
        print(format_result(SimpleNamespace(**fields)))
        if not calibration.found.zeroed:
            print(f"the sensor's offset: {wrench_text(calibration.content.residual_offset)}")
        if fields["page"]:
            print(f"written: {fields['page']}")
    return fields


def _mounting_request(options: argparse.Namespace) -> MountingRequest | None:
    """Return what the options ask of the mounting; raises IdentificationError."""
    if not options.estimate:
        return None
    if options.known_mass_kg is None:
        return MountingRequest(options.estimate)
    com = None if options.known_com_m is None else np.array(options.known_com_m)
    known = KnownLoad(
        options.known_mass_kg, options.known_mass_std_kg, com, options.known_com_std_m
    )
    return MountingRequest(options.estimate, known)


def _find_sweeps(options: argparse.Namespace) -> RecordedSweeps:
    """Read the recordings and sort their still poses into sweeps; raises GalenError."""
    settings = options.parameters

    def visits(bag: str) -> Visits:
        return find_visits(
            read_recording(options, bag),
            settings,
            progress=progress(f"averaging {Path(bag).name}", "rest segment"),
        )

    given = [options.bare, options.with_tool] if options.bag is None else [options.bag]
    recorded = [visits(bag) for bag in given]
    if not settings.has_home and recorded[0].visits:
        # A live calibration zeroes where it begins; what was not zeroed is in the offsets.
        settings = replace(settings, present=recorded[0].visits[0].joints)
    sorter = SweepSorter(settings, settings.home_angles)
    try:
        if options.bag is None:
            return sorter.two_recordings(*recorded)
        if options.one_sweep:
            return sorter.one_sweep(recorded[0])
        return sorter.two_sweeps(recorded[0], options.tool_on_at_s)
    except GalenError as error:  # of a recording that was cut off that is the reason
        odd = [text for one in recorded for text in one.recording.problems]
        odd += _stamps_apart(recorded[-1].recording, settings)
        raise GalenError("; ".join([str(error), *odd])) from error


def _stamps_apart(recording: ArmRecording, settings: CalibrationParameters) -> list[str]:
    """Say in a sentence that stamps are apart, where that explains why no load fits."""
    if not settings.check_setup or not len(recording.joints) or not len(recording.wrenches):
        return []
    first_ns = recording.joint_stamp_ns[0]
    found = check_stamps(
        (recording.joint_stamp_ns - first_ns) * 1e-9,
        recording.joints,
        (recording.wrench_stamp_ns - first_ns) * 1e-9,
        recording.wrenches,
        settings.arm,
    )
    return [] if found is None else [found.sentence]


def _run(options: argparse.Namespace) -> tuple[RecordedSweeps, Calibration]:
    """Calibrate as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    path = calibration_path(options.tools_dir, options.tool)
    if not options.dry_run:
        check_writable(path)
    arm = options.parameters.arm
    tip, warnings = choose_tip(np.array(options.tip or [math.nan] * 3), path, arm)
    sweeps = _find_sweeps(options)
    recorded = sample_time(sweeps.last.window_ns[1], sweeps.last.log_ns)
    check_not_newer(options, path, recorded)
    try:
        calibration = estimate(
            path,
            options.tool,
            tip,
            sweeps.measurements,
            warnings,
            calibrated_at=recorded,
            mounting=_mounting_request(options),
            check_setup=options.parameters.check_setup,
        )
    except EstimateError as error:
        odd = _stamps_apart(sweeps.recordings[-1].recording, options.parameters)
        raise EstimateError(error.code, "; ".join([str(error), *odd])) from error
    if not options.dry_run:
        calibration.write()
        from galen_calibration_behavior.from_bag.page import calibration_page  # slow to import

        page = path.with_suffix(".html")
        with command.writing(page):
            write_whole(page, calibration_page(sweeps, calibration, options.parameters))
    return sweeps, calibration


def _result_fields(
    options: argparse.Namespace, sweeps: RecordedSweeps, calibration: Calibration
) -> dict[str, Any]:
    """Return the fields of a live calibration's result, and what only a recording has; for JSON."""
    border = sweeps.border
    fields = {
        "error_code": int(CalibrationCode.NONE),
        "error_msg": "",
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration.path),
        "page": "" if options.dry_run else str(calibration.path.with_suffix(".html")),
    } | calibration_fields(calibration)
    return fields | {
        "calibrated_at": calibration.content.calibrated_at,
        "residual_offset": calibration.content.residual_offset.tolist(),
        "tool_on_s": sweeps.tool_on_s,
        "next_border_worse_sigmas": None if border is None else border.next_worse,
        "one_load_worse_ratio": None if border is None else border.ratio,
        "mounting": mounting_fields(calibration),
    }


def _format_sweeps(sweeps: RecordedSweeps) -> str:
    """How many poses there are, and where the tool came on, in words."""
    counts = [
        f"{len({p.number for p in sweeps.poses if p.sweep == name})} poses {words}"
        for name, words in (("bare", "without the tool"), ("tool", "with it"))
        if any(p.sweep == name for p in sweeps.poses)
    ]
    text = ", ".join(counts)
    if sweeps.tool_on_s is not None:
        text += f"; it came on between {sweeps.tool_on_s[0]:.1f} s and {sweeps.tool_on_s[1]:.1f} s"
    if sweeps.border is not None:
        text += (
            f"\n(the next best place is {sweeps.border.next_worse:.0f} standard deviations worse,"
            f" one load for all poses {sweeps.border.ratio:.0f} times)"
        )
    return text
