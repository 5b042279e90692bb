"""The inertia of tool and adapter, out of a recording of free motion, into the tool's file."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_model.arm.galen import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    write_calibration,
)
from galen_model.load.inertia.identification import InertiaFit, identify_inertia, total_moments
from galen_model.load.inertia.inertial import (
    INERTIA_NAMES,
    inertial_regressor,
    point_mass_inertia,
)
from galen_model.load.inertia.motion_record import MotionRecord, motion_record
from galen_ros.command import terminal

from galen_calibration_behavior.from_bag.source import open_calibrated

if TYPE_CHECKING:
    from rich.console import Console

# What a lag must be to be worth a word: neither noise nor less than it does harm.
_LAG_SIGMAS, _LAG_S = 5.0, 0.0005


@dataclass(frozen=True)
class HeldOut:
    """RMS (6,) of the filtered readings of each half of a recording, by a fit to the other half.

    static: without inertial forces; points: with the inertia of two points at the centres;
    inertia: with the estimated one. N and N.m.
    """

    static: Array
    points: Array
    inertia: Array


@dataclass(frozen=True)
class InertiaResult:
    """The tool with its inertia, the fit, the scores; warnings are sentences for a person."""

    tool: CalibrationFile
    fit: InertiaFit
    held_out: HeldOut | None
    warnings: tuple[str, ...]


def estimate_inertia(tool: CalibrationFile, recording: ArmRecording) -> InertiaResult:
    """Estimate the inertia of tool and adapter.

    Raises IdentificationError, and NotExcitedError where the motion doesn't tell it.
    """
    record = motion_record(
        recording.joint_stamp_ns,
        recording.joints,
        recording.wrench_stamp_ns,
        recording.wrenches,
        tool.mounting,
    )
    # Another place's gravity, as the file has it.
    scale = tool.gravity_m_s2[2] / GRAVITY_M_S2[2]
    record = replace(record, gravity=record.gravity * scale)
    moments, covariance = total_moments(tool)
    fit = identify_inertia(record, moments, covariance)
    warnings = list(recording.problems)
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
    return InertiaResult(
        replace(tool, inertia=fit.inertia),
        fit,
        _held_out(record, tool, moments, covariance),
        tuple(warnings),
    )


def _held_out(
    record: MotionRecord, tool: CalibrationFile, moments: Array, covariance: Array
) -> HeldOut | None:
    """Halves in turn; None where one half alone doesn't tell the inertia."""
    middle_s = (record.time_s[0] + record.time_s[-1]) / 2.0
    first = record.time_s < middle_s
    points = point_mass_inertia(tool.load.load, tool.adapter.load)
    left: dict[str, list[Array]] = {"static": [], "points": [], "inertia": []}
    try:
        for known in (first, ~first):
            fit = identify_inertia(record.take(known), moments, covariance)
            asked = record.take(~known)
            zero = np.zeros((len(asked), 3))
            moving = asked.gravity - asked.acceleration_m_s2
            rates = (asked.velocity_rad_s, asked.acceleration_rad_s2)
            for name, specific, turning, inertia in (
                ("static", asked.gravity, (zero, zero), points),
                ("points", moving, rates, points),
                ("inertia", moving, rates, fit.inertia.about_sensor_kg_m2),
            ):
                expected = inertial_regressor(specific, *turning) @ np.r_[moments, inertia]
                left[name].append(asked.wrench - expected - fit.offset)
    except IdentificationError:
        return None
    rms = {
        name: np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)) for name, parts in left.items()
    }
    return HeldOut(**rms)


def add_inertia(options: argparse.Namespace) -> dict[str, Any]:
    """Estimate as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    path, tool, recording = open_calibrated(options)
    if not np.isfinite(recording.joints).any(axis=0).all():
        raise GalenError(
            f"{options.bag}: {options.joint_states} lacks the platform's position: of"
            f" {' '.join(options.joint_names)} all five are needed (--joint-names)"
        )
    try:
        result = estimate_inertia(tool, recording)
    except GalenError as error:
        raise GalenError(f"{options.bag}: {error}") from error
    if not options.dry_run:
        write_calibration(path, result.tool)
    if not options.json:
        print_result(options, result, terminal(100))
    return result_fields(options, result)


def result_fields(options: argparse.Namespace, result: InertiaResult) -> dict[str, Any]:
    """The result as plain numbers and texts, SI units."""
    fit, held = result.fit, result.held_out
    scores = None
    if held is not None:
        scores = {
            name: dict(zip(WRENCH_AXES, getattr(held, name).tolist(), strict=True))
            for name in ("static", "points", "inertia")
        }
    return {
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration_path(options.tools_dir, options.tool)),
        "inertia": fit.inertia.to_json(),
        "std_kg_m2": fit.inertia.std_kg_m2.tolist(),
        "point_masses_kg_m2": _points(result).tolist(),
        "mass_kg": float(fit.moments[0]),
        "agrees_with_file": not fit.disagrees,
        "lag_s": fit.lag_s,
        "lag_std_s": fit.lag_std_s,
        "blocks": fit.blocks,
        "blocks_left_out": fit.touched,
        "held_out_rms": scores,
        "warnings": list(result.warnings),
    }


def _points(result: InertiaResult) -> np.ndarray:
    return point_mass_inertia(result.tool.load.load, result.tool.adapter.load)


def print_result(options: argparse.Namespace, result: InertiaResult, console: Console) -> None:
    """Print tables for a person."""
    from rich.table import Table  # slow to import, and `--json` needs none

    fit = result.fit
    table = Table(title=f"Inertia of {options.tool} and adapter about ft_sensor, 1e-6 kg m^2")
    table.add_column("")
    for name in INERTIA_NAMES:
        table.add_column(name, justify="right")
    for label, values in (
        ("estimated", fit.inertia.about_sensor_kg_m2),
        ("one standard deviation", fit.inertia.std_kg_m2),
        ("points at the centres", _points(result)),
    ):
        table.add_row(label, *(f"{1e6 * value:.1f}" for value in values))
    console.print(table)
    if result.held_out is None:
        console.print("Half of the recording alone does not tell the inertia: nothing is held out")
    else:
        table = Table(title="Residual below 10 Hz, each half by a fit to the other, mN and mN.m")
        table.add_column("")
        for axis in WRENCH_AXES:
            table.add_column(axis, justify="right")
        for label, rms in (
            ("weight only", result.held_out.static),
            ("points at the centres", result.held_out.points),
            ("inertia", result.held_out.inertia),
        ):
            table.add_row(label, *(f"{1e3 * value:.2f}" for value in rms))
        console.print(table)
    for warning in result.warnings:
        console.print(f"[yellow]{warning}[/yellow]", soft_wrap=True, highlight=False)
    written = "not written (--dry-run)" if options.dry_run else "written"
    console.print(f"{calibration_path(options.tools_dir, options.tool)}: {written}", soft_wrap=True)
