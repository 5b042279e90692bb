"""Several recordings of pushes with one tool, as samples to fit or to check on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from galen_bags.many.inputs import calibration_of_bag
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile

from galen_deflection.errors import PushRecordingError
from galen_deflection.measurement.arm_positions import PositionSettings
from galen_deflection.measurement.measured_deflection import measure_deflection
from galen_deflection.measurement.push_recording import PushSettings, read_pushes
from galen_deflection.measurement.registration_fit import RegistrationSettings
from galen_deflection.measurement.samples import DeflectionSamples, joined


@dataclass(frozen=True)
class ReadSettings:
    """How bags become samples.

    tool: the tool's file, or, where `tool_beside` is true, its name in each bag's directory or the
    one above. from_rest: as in `measure_deflection`.
    """

    tool: Path
    tool_beside: bool = False
    pushes: PushSettings = field(default_factory=PushSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    from_rest: bool = False


@dataclass(frozen=True)
class Recording:
    """One bag's samples; positions (p, 5): joints of the positions by their numbers, m and rad."""

    path: Path
    tool: CalibrationFile
    samples: DeflectionSamples
    positions: Array
    problems: tuple[str, ...]


def find_tool(path: Path, settings: ReadSettings) -> CalibrationFile:
    """The tool that a bag was recorded with; raises GalenError that names the file."""
    return calibration_of_bag(path, settings.tool, beside=settings.tool_beside)


def read_recording(
    path: Path,
    settings: ReadSettings,
    on_progress: Callable[[int, int | None], None] | None = None,
) -> Recording:
    """Read and register one bag; raises GalenError that names the bag or the tool's file."""
    tool = find_tool(path, settings)
    recording = read_pushes(path, tool, settings.pushes, on_progress)
    measured = measure_deflection(recording, settings.registration, from_rest=settings.from_rest)
    if not len(measured.samples):
        raise PushRecordingError(f"{path}: no deflection could be measured in it")
    return Recording(path, tool, measured.samples, recording.positions, measured.problems)


def join_recordings(
    recordings: Sequence[Recording], settings: PositionSettings | None = None
) -> DeflectionSamples:
    """All samples of recordings with one tool; the same place has the same number in all.

    A position's number is that of the nearest one known so far whose joints are within the
    settings' tolerance, else a new one. Raises GalenError for another tool.
    """
    tolerance = (settings or PositionSettings()).tolerance
    first = recordings[0]
    known: list[Array] = []
    parts = []
    for recording in recordings:
        _same_tool(first, recording)
        number = np.empty(len(recording.positions), dtype=int)
        taken: set[int] = set()
        for own, joints in enumerate(recording.positions):
            away = [float(np.max(np.abs(joints - k) / tolerance)) for k in known]
            near = [k for k, far in enumerate(away) if far <= 1.0 and k not in taken]
            if near:
                number[own] = min(near, key=away.__getitem__)
            else:
                number[own] = len(known)
                known.append(joints)
            taken.add(int(number[own]))
        samples = recording.samples
        parts.append(replace(samples, position=number[samples.position]))
    return joined(parts)


def _same_tool(first: Recording, other: Recording) -> None:
    if other.tool.tool != first.tool.tool:
        raise GalenError(
            f"{first.path} was recorded with the tool {first.tool.tool}, {other.path} with"
            f" {other.tool.tool}: a model is of one tool; call this once for each"
        )
    one, another = (np.asarray(recording.tool.tip_m) for recording in (first, other))
    if not np.allclose(one, another, atol=1e-9):
        raise GalenError(
            f"the tool {first.tool.tool} has its tip at {one.tolist()} m in the file for"
            f" {first.path}, but at {another.tolist()} m in that for {other.path}"
        )
