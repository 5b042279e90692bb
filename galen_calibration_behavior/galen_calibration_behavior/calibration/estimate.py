# SPDX-License-Identifier: Apache-2.0
"""From still poses to the tool's file, and its result for a person and for a program. No ROS."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import (
    CalibrationFileError,
    GalenError,
    IdentificationError,
    NotExcitedError,
    one_line,
)
from galen_model.files.calibration_file import (
    CalibrationFile,
    read_calibration,
    write_calibration,
    zeroed_at,
)
from galen_model.json_fields import LONGEST_SENTENCE
from galen_model.load.choice import choose_calibration
from galen_model.load.identification import Identification, KnownLoad, zeroing_fault
from galen_model.load.mounting import Mounting
from galen_model.load.mounting_worth import Calibrated, Worth, worth
from galen_model.setup_check.check import SetupError, require_setup
from galen_model.setup_check.readings import StillReadings

from galen_calibration_behavior.common.commands import CalibrationCode, Measurements

LONGEST_TOOL_M = 2.0
"""A slip of the unit or a made-up number is found before the arm moves, not after the sweep."""


class EstimateError(GalenError):
    """The measurements give no file; `code` says which error of the action it is."""

    def __init__(self, code: CalibrationCode, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class MountingRequest:
    """Groups of `galen_model.load.mounting` to estimate; what is known of the tool."""

    groups: tuple[str, ...]
    known: KnownLoad | None = None


@dataclass(frozen=True)
class Calibration:
    """A tool's file and where it belongs, and what it does not hold of the fit.

    worth: whether the mounting's parameters pay, where they were asked for.
    """

    path: Path
    content: CalibrationFile
    warnings: list[str]
    found: Identification
    worth: Worth | None = None

    def write(self) -> None:
        """Write the tool's file whole or not at all; raises EstimateError."""
        try:
            write_calibration(self.path, self.content)
        except CalibrationFileError as error:
            raise EstimateError(CalibrationCode.WRITE_FAILED, str(error)) from error


def check_writable(path: Path) -> None:
    """Find out before the arm moves whether a tool's file can be written; make its folder.

    Args:
        path: the file.

    Raises:
        CalibrationFileError: the folder can't be made, or nothing can be written to it.

    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationFileError(f"{path.parent}: can't be made: {error.strerror}") from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise CalibrationFileError(f"{path.parent}: can't be written to")


def choose_tip(tip_m: Array, path: Path, arm: Arm) -> tuple[Array, list[str]]:
    """Choose the tip for the new file.

    Args:
        tip_m: (3,) in ft_sensor, m, as asked for; all NaN: not given.
        path: the tool's file, whose tip is kept where none is given.
        arm: that of the file.

    Returns:
        The tip (3,), m in ft_sensor, (0, 0, 0) where neither is known; and warnings of that.

    Raises:
        GalenError: some values are not finite, or no tool reaches as far.

    """
    if np.all(np.isfinite(tip_m)):
        if np.max(np.abs(tip_m)) > LONGEST_TOOL_M:
            raise GalenError(
                f"tip_m is {tip_m.tolist()}: at most {LONGEST_TOOL_M:g} m along an axis; is it in"
                " m?"
            )
        return tip_m, []
    if not np.all(np.isnan(tip_m)):
        raise GalenError(
            f"tip_m is {tip_m.tolist()}: three finite numbers, or all NaN to keep the old"
        )
    nowhere = np.zeros(3)
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises where this says no
        return nowhere, [f"the tool's tip is not known: (0, 0, 0) in {arm.sensor_frame} is written"]
    try:
        return read_calibration(path, arm).tip_m, []
    except CalibrationFileError as error:
        return nowhere, [f"the old file's tip can't be kept, (0, 0, 0) is written: {error}"]


def estimate(
    path: Path,
    tool: str,
    tip_m: Array,
    measurements: Measurements,
    warnings: list[str],
    *,
    calibrated_at: datetime | None = None,
    mounting: MountingRequest | None = None,
    check_setup: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Identify the load and put the tool's file together, without writing it.

    Args:
        path: where the tool's file belongs; parts of an old one there that are lost get a warning.
        tool: its name.
        tip_m: its tip (3,), m in ft_sensor.
        measurements: still poses of one sweep or two.
        warnings: known from before.
        calibrated_at: when it was measured, with a time zone, for measurements that come out of a
            recording; None: now.
        mounting: estimate that as well, with a constant bias; None: models are compared.
        check_setup: a wrong set-up that explains the readings is an error.
        progress: called with what is compared; what it raises ends the comparison.

    Returns:
        The file's content, with all warnings.

    Raises:
        EstimateError: the measurements give no file; its code is the action's.

    """
    gain: Worth | None = None
    tool_poses = measurements.tool
    try:
        if check_setup:
            require_setup(StillReadings.of_poses(tool_poses), tool_poses.noise)
        if mounting is None:
            zero = measurements.zero_angles
            bare, zeroed = measurements.bare, measurements.zeroed
            found = choose_calibration(bare, measurements.tool, zero, progress, zeroed)
            warnings = [*warnings, *_turned(found.mounting)]
        else:
            _check_zeroed(measurements)
            measured = _with_mounting(measurements, mounting)
            found = measured.identify()
            gain = worth(measured, found)
    except NotExcitedError as error:
        raise EstimateError(CalibrationCode.NOT_EXCITED, str(error)) from error
    except (IdentificationError, SetupError) as error:
        raise EstimateError(CalibrationCode.IMPLAUSIBLE, str(error)) from error
    arm = tool_poses.arm
    content = CalibrationFile(
        tool=tool,
        load=found.load,
        adapter=found.adapter,
        tip_m=tip_m,
        rmse=found.rmse,
        poses_used=int(np.sum(found.used_tool)),
        calibrated_at=(calibrated_at or datetime.now(UTC)).isoformat(timespec="seconds"),
        residual_offset=found.offset,
        gravity_m_s2=arm.gravity_m_s2,
        arm=arm,
        zeroing=zeroed_at(measurements.zero_angles, arm=arm) if found.zeroed else None,
        poses_rejected=(*measurements.rejected, *_outliers(found, measurements)),
        unresolved=found.unresolved,
        mounting=found.mounting,
        model=one_line(found.model, LONGEST_SENTENCE),
        model_reason=one_line(found.reason, LONGEST_SENTENCE),
    )
    said = [*warnings, *measurements.warnings, *found.warnings, *_dropped(path, content)]
    if gain is not None and not gain.pays:
        said.append(gain.sentence)
    return Calibration(path, content, said, found, gain)


# How each part of a tool's file that a calibration does not find is found.
_FOUND_BY = {
    "inertia": "--estimate inertia",
    "cable": "--estimate cable",
    "mounting": "--estimate GROUPS",
}


def _dropped(path: Path, content: CalibrationFile) -> list[str]:
    """Say which parts of the old file the new one does not have: they belong to the old load."""
    try:
        old = read_calibration(path, content.arm)
    except CalibrationFileError:
        return []
    lost = [part for part in old.parts if part not in content.parts]
    if not lost:
        return []
    again = ", ".join(f"{part} ({_FOUND_BY[part]})" for part in lost)
    return [f"the old file's {again} belongs to its load and is not in the new file: find it again"]


def _turned(mounting: Mounting | None) -> list[str]:
    """Warn of a rotation that was chosen and not asked for: it turns a push's reading, too."""
    if mounting is None or not np.any(mounting.sensor_rotvec_rad):
        return []
    x, y, z = np.degrees(mounting.sensor_rotvec_rad)
    return [
        f"the sensor is taken as turned in its mount by ({x:.2f}, {y:.2f}, {z:.2f}) deg about x, y,"
        " z, and a push's reading is turned back: wrong where a joint's zero or the base is the"
        " cause; check with a push of known direction"
    ]


def _check_zeroed(measurements: Measurements) -> None:
    """Raise IdentificationError where one sweep's mounting lacks the zeroing that it assumes."""
    if measurements.bare is not None or measurements.zeroed:
        return
    zero = measurements.tool.arm.gravity_in_sensor(measurements.zero_angles)
    why = "by the parameter zeroing"
    if measurements.zeroed is None:
        why = zeroing_fault(measurements.tool, zero)
    if why:
        raise IdentificationError(
            f"the sensor was not zeroed with the adapter alone ({why}), which the estimate of a"
            " mounting from one sweep assumes: record both sweeps"
        )


def _with_mounting(measurements: Measurements, request: MountingRequest) -> Calibrated:
    return Calibrated(
        measurements.bare,
        measurements.tool,
        request.groups,
        measurements.zero_angles,
        request.known,
    )


def _outliers(found: Identification, measurements: Measurements) -> list[str]:
    """Name the fit's outliers by their place in the sweep; the fit counts only the still poses."""
    indices = {"bare": measurements.bare_indices, "tool": measurements.tool_indices}
    return [
        f"{sweep}/{indices[sweep][pose]}: {sigmas:.1f} sigma off the common load"
        for sweep, pose, sigmas in found.outliers
    ]


def calibration_fields(calibration: Calibration) -> dict[str, Any]:
    """Return a CalibrateTool.Result's fields by name, for JSON too; SI units.

    Args:
        calibration: a tool's file, written or not.

    Returns:
        All fields but `tool`, `file` and the error.

    """
    file = calibration.content
    return {
        "mass_kg": file.load.mass_kg,
        "mass_std_kg": file.load.mass_std_kg,
        "com_m": file.load.com_m.tolist(),
        "com_std_m": file.load.com_std_m.tolist(),
        "adapter_mass_kg": file.adapter.mass_kg,
        "adapter_mass_std_kg": file.adapter.mass_std_kg,
        "adapter_com_m": file.adapter.com_m.tolist(),
        "adapter_com_std_m": file.adapter.com_std_m.tolist(),
        "rmse_force_n": file.rmse[:3].tolist(),
        "rmse_torque_nm": file.rmse[3:].tolist(),
        "poses_used": file.poses_used,
        "poses_rejected": list(file.poses_rejected),
        "warnings": list(calibration.warnings),
        "model": file.model,
        "model_reason": file.model_reason,
    }


def format_result(result: Any) -> str:
    """Format a successful calibration as a table; one standard deviation after +-.

    Args:
        result: a CalibrateTool.Result, or what has its fields. Without a `file` nothing was
            written.

    Returns:
        Several lines, in g, mm, N and mN.m.

    """
    lines = [
        f"{'':18}{'mass [g]':>18}   centre x, y, z in the sensor [mm]",
        _load_line(result.tool, result.mass_kg, result.mass_std_kg, result.com_m, result.com_std_m),
        _adapter_line(result),
        "",
        "RMSE force  [N]    " + "".join(f"{v:10.4f}" for v in result.rmse_force_n),
        "RMSE torque [mN.m] " + "".join(f"{1e3 * v:10.4f}" for v in result.rmse_torque_nm),
        f"poses used         {result.poses_used:10d}",
        f"poses rejected     {len(result.poses_rejected):10d}",
    ]
    lines += [f"  {text}" for text in result.poses_rejected]
    if result.model:
        lines.append(f"model: {result.model} - {result.model_reason}")
    lines += [f"warning: {text}" for text in result.warnings]
    lines.append(f"written: {result.file}" if result.file else "nothing is written")
    return "\n".join(lines)


def _adapter_line(result: Any) -> str:
    if not result.adapter_mass_kg:
        return f"{'adapter':18}(in the load above)"
    return _load_line(
        "adapter",
        result.adapter_mass_kg,
        result.adapter_mass_std_kg,
        result.adapter_com_m,
        result.adapter_com_std_m,
    )


def _load_line(name: str, mass: float, mass_std: float, com: Any, com_std: Any) -> str:
    centre = "   ".join(
        f"{1e3 * value:8.3f} +- {1e3 * std:.3f}" for value, std in zip(com, com_std, strict=True)
    )
    return f"{name[:17]:18}{1e3 * mass:9.3f} +- {1e3 * mass_std:.3f}  {centre}"


def mounting_fields(calibration: Calibration) -> dict[str, Any] | None:
    """Return what the file holds of the mounting, for JSON; SI units.

    Args:
        calibration: a tool's file, written or not.

    Returns:
        The mounting; where it was asked for, also how it did on held-out poses. None: there is
        none.

    """
    mounting, worth = calibration.content.mounting, calibration.worth
    if mounting is None:
        return None
    if worth is None:
        return mounting.to_json()
    return mounting.to_json() | {
        "held_out": {
            "blocks": worth.blocks,
            "rmse": {
                name: dict(zip(WRENCH_AXES, [_finite(v) for v in rmse], strict=True))
                for name, rmse in worth.rmse.items()
            },
            "against": worth.against,
            "gain": worth.gain,
            "gain_std": worth.gain_std,
            "pays": worth.pays,
        }
    }


def format_mounting(calibration: Calibration) -> str:
    """Format what the file holds of the mounting as tables, in deg, %, mN and mN.m.

    Args:
        calibration: a tool's file, written or not.

    Returns:
        Several lines; empty where there is no mounting.

    """
    mounting, worth = calibration.content.mounting, calibration.worth
    if mounting is None:
        return ""
    scores = "" if worth is None else f"\n{_mounting_scores(worth)}\n{worth.sentence}\n"
    return f"\n{_mounting_rows(mounting)}\n{scores}"


def _mounting_rows(mounting: Mounting) -> str:
    lines = [f"{'estimated with the load':48}{'value':>10}{'std':>9}"]
    lines += [f"{n:48}{value:10.4f}{std:9.4f} {unit}" for n, value, std, unit in mounting.rows]
    return "\n".join(lines)


def _mounting_scores(worth: Worth) -> str:
    heads = [f"{axis} [{'mN' if axis[0] == 'f' else 'mN.m'}]" for axis in WRENCH_AXES]
    lines = [f"{'RMSE on held-out poses':24}" + "".join(f"{head:>11}" for head in heads)]
    for name, rmse in worth.rmse.items():
        cells = "".join(f"{1e3 * v:11.3f}" if np.isfinite(v) else f"{'-':>11}" for v in rmse)
        lines.append(f"{name:24}{cells}")
    return "\n".join(lines)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
