"""From a recording of free motion to the key `inertia` of a tool's file. No ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.inertia.identification import InertiaFit, identify_inertia, total_moments
from galen_model.load.inertia.inertial import inertial_regressor, point_mass_inertia
from galen_model.load.inertia.motion_record import MotionRecord, motion_record

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
