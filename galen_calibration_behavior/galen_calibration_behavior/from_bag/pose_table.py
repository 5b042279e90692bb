"""The poses of a calibration from a recording, one by one: reading, residual, verdict."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.load.identification import Identification
from galen_model.rest.pose import PoseRecord

from galen_calibration_behavior.calibration.estimate import Calibration
from galen_calibration_behavior.from_bag.recorded_sweeps import RecordedSweeps


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
