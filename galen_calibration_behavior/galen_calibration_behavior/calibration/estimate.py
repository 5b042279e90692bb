"""From still poses to the tool's file: identify, put together, write. No ROS."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import (
    CalibrationFileError,
    GalenError,
    IdentificationError,
    NotExcitedError,
)
from galen_model.files.calibration_file import (
    CalibrationFile,
    read_calibration,
    write_calibration,
    zeroed_at,
)
from galen_model.load.bias.choice import BiasMode
from galen_model.load.bias.identification import (
    identify_one_sweep_drifting,
    identify_two_sweeps_drifting,
)
from galen_model.load.identification import (
    Identification,
    identify_one_sweep,
    identify_two_sweeps,
)
from galen_model.load.mounting.held_out import Calibrated, Worth, worth
from galen_model.load.mounting.identification import KnownLoad
from galen_model.load.mounting.mounting import Mounting

from galen_calibration_behavior.commands import CalibrationCode, Measurements

LONGEST_TOOL_M = 10.0
"""A slip of the unit or a made-up number is found before the arm moves, not after the sweep."""


class EstimateError(GalenError):
    """The measurements give no file; `code` says which error of the action it is."""

    def __init__(self, code: CalibrationCode, message: str) -> None:
        super().__init__(message)
        self.code = code


class TipError(GalenError):
    """A tip that is neither three numbers that a tool may have nor left out."""


@dataclass(frozen=True)
class MountingRequest:
    """Groups of `galen_model.load.mounting.mounting` to estimate; what is known of the tool."""

    groups: tuple[str, ...]
    known: KnownLoad | None = None


@dataclass(frozen=True)
class Calibration:
    """What was written, and where, and what the file does not hold of the fit.

    worth: whether the mounting's parameters pay, where they were asked for. notes: how it went.
    """

    path: Path
    content: CalibrationFile
    warnings: list[str]
    found: Identification
    worth: Worth | None = None
    notes: tuple[str, ...] = ()


def check_writable(path: Path) -> None:
    """Find out before the arm moves whether `path` can be written; raises CalibrationFileError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationFileError(f"{path.parent}: can't be made: {error.strerror}") from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise CalibrationFileError(f"{path.parent}: can't be written to")


def choose_tip(tip_m: Array, path: Path) -> tuple[Array, list[str]]:
    """Return the tip (3,) for the new file, m in ft_sensor, and warnings.

    `tip_m` itself or, where all of it is NaN, that of the old file at `path`, else (0, 0, 0).
    Raises TipError for a tip with some values that are not finite, or that no tool reaches.
    """
    if np.all(np.isfinite(tip_m)):
        if np.max(np.abs(tip_m)) > LONGEST_TOOL_M:
            raise TipError(f"tip_m is {tip_m.tolist()}: at most {LONGEST_TOOL_M:g} m along an axis")
        return tip_m, []
    if not np.all(np.isnan(tip_m)):
        raise TipError(
            f"tip_m is {tip_m.tolist()}: three finite numbers, or all NaN to keep the old"
        )
    nowhere = np.zeros(3)
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises where this says no
        return nowhere, ["the tool's tip is not known: (0, 0, 0) in ft_sensor is written"]
    try:
        return read_calibration(path).tip_m, []
    except CalibrationFileError as error:
        return nowhere, [f"the old file's tip can't be kept, (0, 0, 0) is written: {error}"]


def calibrate(
    path: Path,
    tool: str,
    tip_m: Array,
    measurements: Measurements,
    warnings: list[str],
    *,
    calibrated_at: datetime | None = None,
    mounting: MountingRequest | None = None,
) -> Calibration:
    """Identify the load and write the tool's file whole or not at all.

    `warnings` are known from before. `calibrated_at`, with a time zone, is when it was measured,
    for measurements that come out of a recording; None: now. `mounting`: estimate that as well.
    Raises EstimateError; the old file is then untouched.
    """
    done = estimate(
        path, tool, tip_m, measurements, warnings, calibrated_at=calibrated_at, mounting=mounting
    )
    try:
        write_calibration(path, done.content)
    except CalibrationFileError as error:
        raise EstimateError(CalibrationCode.WRITE_FAILED, str(error)) from error
    return done


def estimate(
    path: Path,
    tool: str,
    tip_m: Array,
    measurements: Measurements,
    warnings: list[str],
    *,
    calibrated_at: datetime | None = None,
    mounting: MountingRequest | None = None,
) -> Calibration:
    """As `calibrate`, and writes nothing; raises EstimateError."""
    mounted: Mounting | None = None
    gain: Worth | None = None
    try:
        if mounting is None:
            found = _identify(measurements)
        else:
            measured = _with_mounting(measurements, mounting)
            both = measured.identify()
            found, mounted, gain = both.found, both.mounting, worth(measured, both)
    except NotExcitedError as error:
        raise EstimateError(CalibrationCode.NOT_EXCITED, str(error)) from error
    except IdentificationError as error:
        raise EstimateError(CalibrationCode.IMPLAUSIBLE, str(error)) from error
    content = CalibrationFile(
        tool=tool,
        load=found.load,
        adapter=found.adapter,
        tip_m=tip_m,
        rmse=found.rmse,
        poses_used=int(np.sum(found.used_tool)),
        calibrated_at=(calibrated_at or datetime.now(UTC)).isoformat(timespec="seconds"),
        residual_offset=found.offset,
        zeroing=zeroed_at(measurements.zero_roll, measurements.zero_tilt),
        poses_rejected=(*measurements.rejected, *_outliers(found, measurements)),
        unresolved=found.unresolved,
        mounting=mounted,
    )
    said = [*warnings, *measurements.warnings, *found.warnings, *_dropped(path, content)]
    if gain is not None and not gain.pays:
        said.append(gain.sentence)
    return Calibration(path, content, said, found, gain, tuple(measurements.notes))


# How each part of a tool's file that a calibration does not find is found.
_FOUND_BY = {
    "inertia": "--estimate inertia",
    "cable": "--estimate cable",
    "mounting": "--estimate GROUPS",
}


def _dropped(path: Path, content: CalibrationFile) -> list[str]:
    """Say which parts of the old file the new one does not have: they belong to the old load."""
    try:
        old = read_calibration(path)
    except CalibrationFileError:
        return []
    lost = [part for part in old.parts if part not in content.parts]
    if not lost:
        return []
    again = ", ".join(f"{part} ({_FOUND_BY[part]})" for part in lost)
    return [f"the old file's {again} belongs to its load and is not in the new file: find it again"]


def _identify(measurements: Measurements) -> Identification:
    roll, tilt = measurements.zero_roll, measurements.zero_tilt
    mode, bare, tool = measurements.bias_mode, measurements.bare, measurements.tool
    if mode is not BiasMode.CONSTANT:
        if bare is None:
            return identify_one_sweep_drifting(tool, roll, tilt, measurements.known_adapter, mode)
        return identify_two_sweeps_drifting(bare, tool, roll, tilt, mode)
    if bare is None:
        return identify_one_sweep(tool, roll, tilt, measurements.known_adapter)
    return identify_two_sweeps(bare, tool, roll, tilt)


def _with_mounting(measurements: Measurements, request: MountingRequest) -> Calibrated:
    return Calibrated(
        measurements.bare,
        measurements.tool,
        request.groups,
        measurements.zero_roll,
        measurements.zero_tilt,
        request.known,
        measurements.known_adapter,
    )


def _outliers(found: Identification, measurements: Measurements) -> list[str]:
    """Name the fit's outliers by their place in the sweep; the fit counts only the still poses."""
    indices = {"bare": measurements.bare_indices, "tool": measurements.tool_indices}
    return [
        f"{o.sweep}/{indices[o.sweep][o.pose]}: {o.sigmas:.1f} sigma off the common load"
        for o in found.outliers
    ]
