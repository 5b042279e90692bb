# SPDX-License-Identifier: Apache-2.0
"""Inertia or a cable's pull, out of a recording, into a calibrated tool's file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_common.command import terminal
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.calibrated.cable_learning import (
    CableSweep,
    LearnedCable,
    check_same_tool,
    learn_cable,
    spread_out,
)
from galen_model.calibrated.inertia_identification import (
    InertiaFit,
    identify_inertia,
    motion_record,
    total_moments,
)
from galen_model.errors import GalenError
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    read_calibration,
    write_calibration,
)
from galen_model.load.cable import MAX_POSES, SUPPORT_M
from galen_model.load.inertia import INERTIA_NAMES, point_mass_inertia
from galen_model.rest.segments import PoseRecord

from galen_calibration_behavior.calibration.estimate import check_writable
from galen_calibration_behavior.from_bag.loads import (
    check_not_newer,
    progress,
    read_recording,
    sample_time,
)
from galen_calibration_behavior.from_bag.sweeps import SweepSorter
from galen_calibration_behavior.from_bag.visits import find_visits

if TYPE_CHECKING:
    from rich.table import Table

# What a lag must be to be worth a word: neither noise nor less than it does harm.
_LAG_SIGMAS, _LAG_S = 5.0, 0.0005
# Poses of one sweep at one place stand nearer to each other than this.
_PLACE_M = 0.01


@dataclass(frozen=True)
class Part:
    """A tool's file with a part added, what was found for JSON, and for a person."""

    tool: CalibrationFile
    fields: dict[str, Any]
    shown: Sequence[str | Table]
    warnings: Sequence[str]


def add_part(options: argparse.Namespace) -> dict[str, Any]:
    """Add inertia or cable to a tool's file.

    Args:
        options: of `calibrate_from_bag.parse`; `estimate` is one of the two. The file is written,
            but for `dry_run`.

    Returns:
        What was found, for JSON; SI.

    Raises:
        GalenError: the recording does not give it; the file is then untouched.

    """
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path, options.parameters.arm)
    if not options.dry_run:
        check_writable(path)
    recording = read_recording(options, options.bag)
    recorded = sample_time(int(recording.joint_stamp_ns[-1]), int(recording.joint_log_ns[-1]))
    check_not_newer(options, path, recorded)
    if not np.isfinite(recording.joints).any(axis=0).all():
        raise GalenError(
            f"{options.bag}: {options.joint_states} lacks some of"
            f" {' '.join(options.joint_names or options.parameters.arm.joint_names)}: all are"
            " needed (--joint-names)"
        )
    find = {"inertia": _inertia, "cable": _cable}["".join(options.estimate)]
    try:
        part = find(tool, recording, options)
    except GalenError as error:
        prefix = "" if str(error).startswith(f"{options.bag}: ") else f"{options.bag}: "
        raise GalenError(f"{prefix}{error}") from error
    if not options.dry_run:
        write_calibration(path, part.tool)
    if not options.json:
        console = terminal(100)
        for shown in part.shown:
            console.print(shown, soft_wrap=isinstance(shown, str))
        for warning in part.warnings:
            console.print(f"[yellow]{warning}[/yellow]", soft_wrap=True)
        written = "not written (--dry-run)" if options.dry_run else "written"
        console.print(f"{path}: {written}", soft_wrap=True)
    file = "" if options.dry_run else str(path)
    return {"tool": options.tool, "file": file, **part.fields, "warnings": list(part.warnings)}


def remove_cable(options: argparse.Namespace) -> dict[str, Any]:
    """Remove the cable from the tool's file.

    Args:
        options: of `calibrate_from_bag.parse`; the file is written, but for `dry_run`.

    Returns:
        Tool, file and whether it was removed, for JSON.

    Raises:
        GalenError: the file can't be read or written, or holds no cable.

    """
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path, options.parameters.arm)
    if tool.cable is None:
        raise GalenError(f"{path}: holds no cable")
    if not options.dry_run:
        write_calibration(path, replace(tool, cable=None))
    done = not options.dry_run
    if not options.json:
        print(f"{path}: {'the cable is removed' if done else 'not written (--dry-run)'}")
    return {"tool": options.tool, "file": str(path) if done else "", "removed": done}


def _table(title: str, heads: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Table:
    from rich.table import Table  # slow to import, and `--json` needs none

    table = Table(title=title)
    table.add_column("")
    for head in heads:
        table.add_column(head, justify="right")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    return table


# Inertia


def _inertia(tool: CalibrationFile, recording: ArmRecording, options: argparse.Namespace) -> Part:
    """Inertia of tool and adapter; raises IdentificationError."""
    record = motion_record(
        recording.joint_stamp_ns,
        recording.joints,
        recording.wrench_stamp_ns,
        recording.wrenches,
        tool.mounting,
        arm=tool.arm,
    )
    # Another place's gravity, as the file has it.
    scale = np.linalg.norm(tool.gravity_m_s2) / np.linalg.norm(tool.arm.gravity_m_s2)
    record = replace(record, gravity=record.gravity * scale)
    moments, covariance = total_moments(tool)
    fit = identify_inertia(record, moments, covariance)
    points = point_mass_inertia(tool.load.load, tool.adapter.load)
    rows = {
        "estimated": fit.inertia.about_sensor_kg_m2,
        "one standard deviation": fit.inertia.std_kg_m2,
        "points at the centres": points,
    }
    table = _table(
        f"Inertia of {options.tool} and adapter about {tool.sensor_frame}, 1e-6 kg m^2",
        INERTIA_NAMES,
        {name: [f"{1e6 * value:.1f}" for value in values] for name, values in rows.items()},
    )
    fields = {
        "inertia": fit.inertia.to_json(),
        "std_kg_m2": fit.inertia.std_kg_m2.tolist(),
        "point_masses_kg_m2": points.tolist(),
        "mass_kg": float(fit.moments[0]),
        "agrees_with_file": not fit.disagrees,
        "lag_s": fit.lag_s,
        "lag_std_s": fit.lag_std_s,
        "blocks": fit.blocks,
        "blocks_left_out": fit.touched,
    }
    warnings = [*recording.problems, *_inertia_warnings(fit, moments)]
    return Part(replace(tool, inertia=fit.inertia), fields, [table], warnings)


def _inertia_warnings(fit: InertiaFit, moments: Array) -> list[str]:
    warnings = []
    if fit.disagrees:
        mass_g = 1e3 * (fit.moments[0] - moments[0])
        shift_mm = 1e3 * (fit.moments[1:] / fit.moments[0] - moments[1:] / moments[0])
        warnings.append(
            f"mass and centre in this recording are not the file's: {mass_g:+.1f} g,"
            f" {' '.join(f'{v:+.1f}' for v in shift_mm)} mm: recalibrate, or it is another tool"
        )
    if abs(fit.lag_s) > max(_LAG_SIGMAS * fit.lag_std_s, _LAG_S):
        warnings.append(
            f"the wrench comes {1e3 * fit.lag_s:.2f} +- {1e3 * fit.lag_std_s:.2f} ms after the"
            f" joints: run gravcomp_node with motion_lag_s:={fit.lag_s:.4f}"
        )
    if fit.touched:
        warnings.append(
            f"{fit.touched} of {fit.blocks} blocks of half a second disagree with the rest and"
            " were left out"
        )
    return warnings


# A cable's pull


def _cable(tool: CalibrationFile, recording: ArmRecording, options: argparse.Namespace) -> Part:
    """Return a cable's pull, from a sweep with the cable on; raises GalenError.

    The cable that the file may already hold is not looked at.
    """
    sweep, when, warnings = _cable_sweep(tool, recording, options)
    warnings += check_same_tool(tool, sweep)
    learned = learn_cable(sweep, when, progress=progress("learning", "fit"))
    sliding = [k for k in range(len(tool.arm.joints)) if k not in tool.arm.turning]
    if sliding and np.ptp(sweep.joints[:, sliding], axis=0).max() < _PLACE_M:
        warnings.append(
            "all poses have one place of the platform: the pull is subtracted whole up to"
            f" {0.6 * SUPPORT_M:.2g} m from it, and less and less beyond"
        )
    fields = _cable_fields(sweep, learned)
    shown = _cable_shown(options.tool, sweep, learned)
    return Part(replace(tool, cable=learned.drag), fields, shown, warnings)


def _cable_sweep(
    tool: CalibrationFile, recording: ArmRecording, options: argparse.Namespace
) -> tuple[CableSweep, str, list[str]]:
    """Return the poses of the recorded sweep, the time of the last one, and warnings."""
    settings = options.parameters
    visits = find_visits(recording, settings, progress("averaging", "rest segment"))
    poses, warnings = SweepSorter(settings, tool.zero_angles).still_poses(visits)
    warnings += [f"pose {p.number} at {p.time_s:.1f} s: {p.fault}" for p in poses if p.fault]
    used = [pose.visit for pose in poses if not pose.fault]
    records = [visit.outcome for visit in used if isinstance(visit.outcome, PoseRecord)]
    joints = np.array([record.joints for record in records])
    wrench = np.array([record.wrench for record in records])
    sweep = CableSweep(
        joints=joints,
        wrench=wrench - tool.predict(settings.arm.angles(joints)),
        std_of_mean=np.array([record.std_of_mean for record in records]),
        noise=np.median([record.wrench_std for record in records], axis=0),
        arm=tool.arm,
    )
    if len(sweep) > MAX_POSES:
        warnings.append(f"of {len(sweep)} poses the {MAX_POSES} that lie farthest apart are used")
        sweep = sweep.part(spread_out(sweep.joints, MAX_POSES, tool.arm))
    when = sample_time(used[-1].window_ns[1], used[-1].log_ns).isoformat(timespec="seconds")
    return sweep, when, warnings


def _cable_fields(sweep: CableSweep, learned: LearnedCable) -> dict[str, Any]:
    drag = learned.drag
    return {
        "form": drag.form,
        "poses": len(sweep),
        "blocks": int(learned.block.max()) + 1,
        "pull_rms": dict(zip(WRENCH_AXES, _rms(sweep.wrench).tolist(), strict=True)),
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
            for name, score in learned.scores.items()
        },
    }


def _cable_shown(name: str, sweep: CableSweep, learned: LearnedCable) -> list[str | Table]:
    drag, pull = learned.drag, _rms(sweep.wrench)
    rows = {}
    for kind, score in learned.scores.items():
        share = "" if np.isnan(score.coverage) else f"{100.0 * score.coverage:.0f} %"
        mark = " *" if kind == drag.form else ""
        rows[kind + mark] = [*(f"{1e3 * value:.2f}" for value in score.rmse), share]
    title = (
        f"{name}: residual at poses held out, {int(learned.block.max()) + 1} blocks of"
        f" {len(sweep)} poses, mN and mN.m"
    )
    shown: list[str | Table] = [
        _table(title, [*WRENCH_AXES, "within 95 %"], rows),
        f"The cable pulls {np.linalg.norm(pull[:3]):.2g} N and {1e3 * np.linalg.norm(pull[3:]):.2g}"
        f" mN.m (rms over the poses); learned as '{drag.form}' (*)",
    ]
    if drag.form != "free":
        at = " ".join(f"{1e3 * value:.0f}" for value in drag.attachment_m)
        shown.append(f"It pulls at ({at}) mm in {sweep.arm.sensor_frame}")
    return shown


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
