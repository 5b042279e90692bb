"""Loads of adapter and tool out of recorded sweeps: the file, and the result for a person."""

from __future__ import annotations

import argparse
import functools
import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import LoadEstimate, calibration_path, read_calibration
from galen_model.load.identification import Identification
from galen_model.load.mounting.identification import KnownLoad
from galen_model.rest.pose import PoseRecord

from galen_calibration_behavior.calibration.estimate import (
    Calibration,
    EstimateError,
    MountingRequest,
    calibrate,
    check_writable,
    choose_tip,
    estimate,
)
from galen_calibration_behavior.calibration.result_text import (
    calibration_fields,
    format_mounting,
    format_result,
    mounting_fields,
)
from galen_calibration_behavior.commands import CalibrationCode
from galen_calibration_behavior.from_bag.recorded_sweeps import RecordedSweeps, SweepSorter
from galen_calibration_behavior.from_bag.source import (
    check_not_newer,
    progress,
    read_recording,
    sample_time,
)
from galen_calibration_behavior.from_bag.visits import RecordingError, Visit, Visits, find_visits


def estimate_loads(options: argparse.Namespace) -> dict[str, Any]:
    """Calibrate as the options say, print it unless as JSON; raises GalenError."""
    try:
        sweeps, calibration = run(options)
    except EstimateError as error:
        raise GalenError(f"{error.code.name}: {error}") from error
    fields = result_fields(options, sweeps, calibration)
    if not options.json:
        if options.poses:
            print(format_poses(fields["poses"]) + "\n")
        print(f"{format_sweeps(sweeps)}\n{format_mounting(calibration)}")
        if fields["bias"] is not None:
            print(f"bias of the sensor, as held-out poses choose it: {fields['bias']}\n")
        print(format_result(SimpleNamespace(**fields)))
    return fields


def mounting_request(options: argparse.Namespace) -> MountingRequest | None:
    """What the options ask of the mounting; raises IdentificationError for what can't be known."""
    if not options.estimate:
        return None
    if options.known_mass_kg is None:
        return MountingRequest(options.estimate)
    com = None if options.known_com_m is None else np.array(options.known_com_m)
    known = KnownLoad(
        options.known_mass_kg, options.known_mass_std_kg, com, options.known_com_std_m
    )
    return MountingRequest(options.estimate, known)


def find_sweeps(options: argparse.Namespace) -> RecordedSweeps:
    """Read the recordings and sort their still poses into sweeps; raises GalenError."""
    settings = options.parameters

    def visits(bag: str) -> Visits:
        return find_visits(
            read_recording(options, bag),
            settings,
            whole_phases=options.whole_phases,
            progress=functools.partial(progress, Path(bag).name, "phase"),
        )

    sorter = SweepSorter(settings, (settings.Rhome, settings.Thome))
    if options.bag is None:
        return sorter.two_recordings(visits(options.bare), visits(options.with_tool))
    if options.one_sweep:
        return sorter.one_sweep(visits(options.bag), _known_adapter(options.adapter_from))
    return sorter.two_sweeps(visits(options.bag), options.tool_on_at_s)


def _known_adapter(path: str | None) -> LoadEstimate | None:
    if path is None:
        return None
    tool = read_calibration(path)
    if tool.unresolved:
        raise RecordingError(
            f"{path}: its adapter is not distinguished from its tool: it came from one sweep"
        )
    return tool.adapter


def measured_at(last: Visit) -> datetime:
    """When the last sample was taken."""
    return sample_time(last.window_ns[1], last.log_ns)


def run(options: argparse.Namespace) -> tuple[RecordedSweeps, Calibration]:
    """Calibrate as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    path = calibration_path(options.tools_dir, options.tool)
    if not options.dry_run:
        check_writable(path)
    tip, warnings = choose_tip(np.array(options.tip or [math.nan] * 3), path)
    sweeps = find_sweeps(options)
    recorded = measured_at(sweeps.last)
    check_not_newer(options, path, recorded)
    make = estimate if options.dry_run else calibrate
    return sweeps, make(
        path,
        options.tool,
        tip,
        replace(sweeps.measurements, bias_mode=options.bias),
        warnings,
        calibrated_at=recorded,
        mounting=mounting_request(options),
    )


def result_fields(
    options: argparse.Namespace, sweeps: RecordedSweeps, calibration: Calibration
) -> dict[str, Any]:
    """The fields of a live calibration's result, and what only a recording has; for JSON."""
    border = sweeps.border
    fields = {
        "error_code": int(CalibrationCode.NONE),
        "error_msg": "",
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration.path),
    } | calibration_fields(calibration)
    bias_drift = calibration.found.bias_drift
    return fields | {
        "bias": None if bias_drift is None else str(bias_drift.choice),
        "bias_mass_growth": None if bias_drift is None else bias_drift.mass_growth,
        "calibrated_at": calibration.content.calibrated_at,
        "tool_on_s": sweeps.tool_on_s,
        "next_border_worse_sigmas": None if border is None else border.next_worse,
        "one_load_worse_ratio": None if border is None else border.ratio,
        "mounting": mounting_fields(calibration),
        "poses": pose_rows(sweeps, calibration),
    }


def format_sweeps(sweeps: RecordedSweeps) -> str:
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


def pose_rows(sweeps: RecordedSweeps, calibration: Calibration) -> list[dict[str, Any]]:
    """One row a visit, SI units, ready for JSON.

    `time_s` from the recording's begin; roll and tilt in rad, averaged; `wrench` the averaged
    reading and `residual` what the fit leaves of it, (6,) N and N.m, None where there is no
    average; `used`, and `fault`, why not.
    """
    found = calibration.found
    fit = {"bare": iter(found.used_bare.tolist()), "tool": iter(found.used_tool.tolist())}
    off = {"bare": iter(_off(calibration, "bare")), "tool": iter(_off(calibration, "tool"))}
    curve = {name: iter(_bias_drift(found, name)) for name in ("bare", "tool")}
    rows = []
    for pose in sweeps.poses:
        outcome = pose.visit.outcome
        joints, wrench, residual = pose.visit.joints, None, None
        if isinstance(outcome, PoseRecord):
            joints, wrench = outcome.joints, outcome.wrench
            residual = wrench - _predicted(calibration, pose.sweep, joints)
            if not pose.fault:
                residual -= next(curve[pose.sweep], 0.0)
        fault = pose.fault or ("" if next(fit[pose.sweep]) else next(off[pose.sweep]))
        rows.append(
            {
                "sweep": pose.sweep,
                "pose": pose.number,
                "time_s": pose.time_s,
                "roll": float(joints[3]),
                "tilt": float(joints[4]),
                "wrench": None if wrench is None else wrench.tolist(),
                "residual": None if residual is None else residual.tolist(),
                "used": not fault,
                "fault": fault,
            }
        )
    return rows


def format_poses(rows: list[dict[str, Any]]) -> str:
    """The rows as a table: forces in N, torques in mN.m (N.mm), angles in degrees."""
    units = ["N"] * 3 + ["mN.m"] * 3
    heads = [f"{axis} [{unit}]" for axis, unit in zip(WRENCH_AXES, units, strict=True)]
    lines = [
        f"{'pose':8}{'t [s]':>8}{'roll [deg]':>12}{'tilt [deg]':>12}  residual"
        + "".join(f"{head:>11}" for head in heads)
    ]
    for row in rows:
        angles = "".join(f"{np.degrees(row[name]):12.3f}" for name in ("roll", "tilt"))
        residual = np.array(row["residual"] or [])
        residual[3:] *= 1e3
        values = "".join(f"{value:11.4f}" for value in residual)
        name = f"{row['sweep']}/{row['pose']}"
        lines.append(
            f"{name:8}{row['time_s']:8.1f}{angles}{'':10}{values}  {row['fault']}".rstrip()
        )
    return "\n".join(lines)


def _bias_drift(found: Identification, sweep: str) -> Array | list[Array]:
    """How far (n, 6) the bias was from that at the sweep's end, pose by pose; [] if it is constant.

    N and N.m.
    """
    bias_drift = found.bias_drift
    if bias_drift is None or bias_drift.tool is None:
        return []
    if sweep == "tool":
        return bias_drift.tool - found.offset
    if bias_drift.bare is None or found.offset_change is None:
        return []
    return bias_drift.bare - (found.offset - found.offset_change)


def _off(calibration: Calibration, sweep: str) -> list[str]:
    return [
        f"{o.sigmas:.1f} sigma off the common load"
        for o in calibration.found.outliers
        if o.sweep == sweep
    ]


def _predicted(calibration: Calibration, sweep: str, joints: Array) -> Array:
    """What the fit expects at joints (5,): reading (6,), N and N.m, in the sensor's own axes."""
    file, found = calibration.content, calibration.found
    if sweep != "bare" or found.offset_change is None:
        return file.predict(joints[3], joints[4])
    bare = replace(file, load=replace(file.load, mass_kg=0.0))
    return bare.predict(joints[3], joints[4]) - found.offset_change
