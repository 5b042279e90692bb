"""A cable's pull at the tool, out of a recorded sweep with the cable on, into its file."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_model.arm.galen import WRENCH_AXES
from galen_model.errors import GalenError
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    read_calibration,
    write_calibration,
)
from galen_model.load.cable.drag import MAX_POSES, SUPPORT_M
from galen_model.load.cable.fit import CableSweep, spread_out
from galen_model.load.cable.learning import CableScore, LearnedCable, learn_cable
from galen_model.load.cable.rivals import check_same_tool, doubts, rivals
from galen_model.rest.pose import PoseRecord
from galen_ros.command import check_folder, terminal, writing

from galen_calibration_behavior.from_bag.recorded_sweeps import SweepSorter
from galen_calibration_behavior.from_bag.source import open_calibrated, progress, sample_time
from galen_calibration_behavior.from_bag.visits import RecordingError, find_visits
from galen_calibration_behavior.parameters import CalibrationParameters

if TYPE_CHECKING:
    from rich.console import Console

# Poses of one sweep at one place stand nearer to each other than this.
_PLACE_M = 0.01


@dataclass(frozen=True)
class CableResult:
    """The tool's file with the cable in it, what was learned, of which poses, and what is odd.

    others: how well what is no cable explains the same poses held out, by name.
    """

    tool: CalibrationFile
    learned: LearnedCable
    sweep: CableSweep
    others: dict[str, CableScore]
    warnings: tuple[str, ...]


def estimate_cable(
    tool: CalibrationFile,
    recording: ArmRecording,
    settings: CalibrationParameters,
    *,
    whole_phases: bool = False,
    phase_progress: Callable[[list[slice]], Iterable[slice]] = iter,
    fit_progress: Callable[[list[tuple[str, int]]], Iterable[tuple[str, int]]] = iter,
) -> CableResult:
    """Learn what a sweep with the cable on reads beyond the tool's file; writes nothing.

    The cable that the file may already hold is not looked at. Raises RecordingError, and
    galen_model.load.cable.learning's errors where there is no cable, or too few poses.
    """
    if not np.isfinite(recording.joints).any(axis=0).all():
        raise RecordingError(
            f"{recording.path}: the platform's position is not in it, and a cable's pull hangs on"
            " all five joints"
        )
    visits = find_visits(recording, settings, whole_phases=whole_phases, progress=phase_progress)
    sorter = SweepSorter(settings, tool.zero_pose_rad)
    poses, warnings = sorter.still_poses(visits)
    warnings += [f"pose {p.number} at {p.time_s:.1f} s: {p.fault}" for p in poses if p.fault]
    used = [pose for pose in poses if isinstance(pose.visit.outcome, PoseRecord) and not pose.fault]
    records = [pose.visit.outcome for pose in used if isinstance(pose.visit.outcome, PoseRecord)]
    joints = np.array([record.joints for record in records])
    wrench = np.array([record.wrench for record in records])
    sweep = CableSweep(
        joints=joints,
        wrench=wrench - tool.predict(joints[:, 3], joints[:, 4]),
        std_of_mean=np.array([record.std_of_mean for record in records]),
        noise=np.median([record.wrench_std for record in records], axis=0),
        time_s=np.array([pose.time_s for pose in used]),
    )
    if len(sweep) > MAX_POSES:
        warnings.append(f"of {len(sweep)} poses the {MAX_POSES} that lie farthest apart are used")
        sweep = sweep.part(spread_out(sweep.joints, MAX_POSES))
    warnings += check_same_tool(tool, sweep)
    when = sample_time(used[-1].visit.window_ns[1], used[-1].visit.log_ns).isoformat(
        timespec="seconds"
    )
    learned = learn_cable(sweep, when, progress=fit_progress)
    if np.ptp(sweep.joints[:, :3], axis=0).max() < _PLACE_M:
        warnings.append(
            "all poses have one place of the platform: the pull is subtracted whole up to"
            f" {0.6 * SUPPORT_M:.2g} m from it, and less and less beyond"
        )
    others = rivals(tool, sweep, learned)
    warnings += doubts(sweep, learned, others)
    return CableResult(replace(tool, cable=learned.drag), learned, sweep, others, tuple(warnings))


def remove_cable(options: argparse.Namespace) -> dict[str, Any]:
    """Remove the cable from the tool's file; raises GalenError where there is none."""
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path)
    if tool.cable is None:
        raise GalenError(f"{path}: holds no cable")
    if not options.dry_run:
        write_calibration(path, replace(tool, cable=None))
    done = not options.dry_run
    if not options.json:
        print(f"{path}: {'the cable is removed' if done else 'not written (--dry-run)'}")
    return {"tool": options.tool, "file": str(path) if done else "", "removed": done}


def add_cable(options: argparse.Namespace) -> dict[str, Any]:
    """Learn as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    check_folder(options.plots)
    path, tool, recording = open_calibrated(options)
    try:
        result = estimate_cable(
            tool,
            recording,
            options.parameters,
            whole_phases=options.whole_phases,
            phase_progress=functools.partial(progress, "averaging", "phase"),
            fit_progress=functools.partial(progress, "learning", "fit"),
        )
    except GalenError as error:
        prefix = "" if str(error).startswith(f"{options.bag}: ") else f"{options.bag}: "
        raise GalenError(f"{prefix}{error}") from error
    if options.plots is not None:
        from galen_calibration_behavior.from_bag.cable_plots import plot_cable  # slow to import

        with writing(options.plots):
            plot_cable(result, options.plots, options.tool)
    if not options.dry_run:
        write_calibration(path, result.tool)
    if not options.json:
        print_result(options, result, terminal(100))
    return result_fields(options, result)


def _scores(result: CableResult) -> dict[str, CableScore]:
    learned = result.learned
    return {
        "the tool's file": learned.file,
        "ten-parameter least squares": learned.least_squares,
        **learned.forms,
        **result.others,
    }


def result_fields(options: argparse.Namespace, result: CableResult) -> dict[str, Any]:
    """The result as plain numbers and texts, SI units."""
    learned, drag = result.learned, result.learned.drag
    return {
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration_path(options.tools_dir, options.tool)),
        "form": drag.form,
        "poses": len(result.sweep),
        "blocks": int(learned.block.max()) + 1,
        "pull_rms": dict(zip(WRENCH_AXES, _rms(result.sweep.wrench).tolist(), strict=True)),
        "attachment_m": None if drag.form == "free" else drag.attachment_m.tolist(),
        "length_rad": drag.length_rad.tolist(),
        "scatter": learned.scatter,
        "inflation": drag.inflation,
        "held_out": {
            name: {
                "rmse": dict(zip(WRENCH_AXES, score.rmse.tolist(), strict=True)),
                "times_noise": score.chi,
                "coverage95": None if np.isnan(score.coverage) else score.coverage,
            }
            for name, score in _scores(result).items()
        },
        "warnings": list(result.warnings),
    }


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def print_result(options: argparse.Namespace, result: CableResult, console: Console) -> None:
    """Print tables for a person."""
    from rich.table import Table  # slow to import, and `--json` needs none

    learned, drag = result.learned, result.learned.drag
    blocks = int(learned.block.max()) + 1
    table = Table(
        title=f"{options.tool}: residual at poses held out, {blocks} blocks of {len(result.sweep)}"
        " poses, mN and mN.m"
    )
    table.add_column("")
    for axis in WRENCH_AXES:
        table.add_column(axis, justify="right")
    table.add_column("within 95 %", justify="right")
    for name, score in _scores(result).items():
        mark = " *" if name == drag.form else ""
        share = "" if np.isnan(score.coverage) else f"{100.0 * score.coverage:.0f} %"
        table.add_row(name + mark, *(f"{1e3 * value:.2f}" for value in score.rmse), share)
    console.print(table)
    pull = _rms(result.sweep.wrench)
    console.print(
        f"The cable pulls {np.linalg.norm(pull[:3]):.2g} N and {1e3 * np.linalg.norm(pull[3:]):.2g}"
        f" mN.m (rms over the poses); learned as '{drag.form}' (*)",
        soft_wrap=True,
        highlight=False,
    )
    if drag.form != "free":
        at = " ".join(f"{1e3 * value:.0f}" for value in drag.attachment_m)
        console.print(f"It pulls at ({at}) mm in ft_sensor", highlight=False)
    for warning in result.warnings:
        console.print(f"[yellow]{warning}[/yellow]", soft_wrap=True, highlight=False)
    written = "not written (--dry-run)" if options.dry_run else "written"
    console.print(f"{calibration_path(options.tools_dir, options.tool)}: {written}", soft_wrap=True)
