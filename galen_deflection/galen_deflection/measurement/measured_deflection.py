# SPDX-License-Identifier: Apache-2.0
"""The deflection that the tracker measured, as samples: the tip's pose over that by the joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.registration import Transform

from galen_deflection.measurement.arm_track import same_position
from galen_deflection.measurement.push_recording import PushRecording, read_pushes
from galen_deflection.measurement.registration import (
    Registration,
    RegistrationError,
    register,
    rest_poses,
)
from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples, joined

_LEAST_NOISE = 1e-6
_BIAS_DRIFTS = 1.5
_MAD_TO_STD = 1.4826
_FAR_OFF = 6.0 * _MAD_TO_STD


@dataclass(frozen=True)
class Recording:
    """One bag's samples (n), and how they were registered.

    rows (n,): those of the `PushRecording`. positions (p, j): joints of the positions by their
    numbers, m and rad. registrations: one for each stand of the base's marker, None where it has no
    rest to register on. problems: sentences about all of it.
    """

    path: Path
    tool: CalibrationFile
    samples: DeflectionSamples
    positions: Array
    problems: tuple[str, ...] = ()
    rows: np.ndarray | None = None
    registrations: tuple[Registration | None, ...] = ()


def read_recording(
    path: Path,
    tool: CalibrationFile,
    marker_offset: bool = False,
    on_progress: Callable[[int, int | None], None] | None = None,
    *,
    arm: Arm,
) -> Recording:
    """Read and register one bag of an arm.

    Args:
        path: bag to read.
        tool: calibration of the tool that was on.
        marker_offset: estimate the tool marker's own offset from the tip; else it is at the tip.
        on_progress: called with the arm's messages read so far and their number, None where that is
            not known.
        arm: the arm that was recorded.

    Returns:
        The measured deflections, at least one.

    Raises:
        GalenError: the bag can't be used; the message names it.

    """
    recording = measure_deflection(
        read_pushes(path, tool, on_progress, arm=arm), marker_offset=marker_offset
    )
    if not len(recording.samples):
        raise DeflectionError(f"{path}: no deflection could be measured in it")
    return recording


def measure_deflection(recording: PushRecording, *, marker_offset: bool = False) -> Recording:
    """Register the recording and return its deflections.

    The set numbers are the visits of each position. Where the base's marker moved, each of its
    stands is registered on its own, and the samples of those without a rest are left out.

    Args:
        recording: n samples of pushes.
        marker_offset: estimate the tool marker's own offset from the tip; else it is at the tip.

    Returns:
        Samples with the deflection of tool_tip in base_link, m and rad.

    Raises:
        RegistrationError: no stand has a rest, or a registration does not hold.

    """
    arm, tip_m = recording.arm, np.asarray(recording.tool.tip_m, dtype=float)
    registrations: list[Registration | None] = []
    problems = list(recording.problems)
    deflection = np.full((len(recording), 6), np.nan)
    for number, stand in enumerate(recording.stands):
        here = recording.stand == number
        rests = rest_poses(recording, number)
        if not rests and len(recording.stands) > 1:
            registrations.append(None)
            if here.any():
                at_s = max(0.0, (stand.start_ns - recording.start_ns) * 1e-9)
                problems.append(
                    f"{int(here.sum())} samples left out from {at_s:.2f} s on: the base's marker"
                    " moved, and nothing registers it before it moves again or the recording ends"
                )
            continue
        try:
            registration = register(rests, tip_m, marker_offset, arm=arm)
        except RegistrationError as error:
            why = "" if rests else "".join(f"; {problem}" for problem in recording.problems)
            raise RegistrationError(f"{recording.path}: {error}{why}") from None
        registrations.append(registration)
        problems += registration.problems
        tip = Transform(*arm.tip_pose(recording.joints[here], tip_m))
        deflection[here] = registration.tip(recording.marker[here]).displacement_from(tip)
    if all(registration is None for registration in registrations):
        register([], tip_m, arm=arm)  # raises

    noise, bias_drift = _noise(deflection, recording)
    if bias_drift > _BIAS_DRIFTS:
        problems.append(
            f"without contact the tip that the tracker sees scatters {bias_drift:.1f}"
            " times as much as from sample to sample: do its stamps lie off from the joints', or"
            " does it drift? Neither errors nor noise can be relied on then"
        )
    rows = np.flatnonzero(np.isfinite(deflection).all(axis=1))
    samples = DeflectionSamples(
        stamp_ns=recording.stamp_ns[rows],
        segment=recording.segment[rows],
        position=recording.position[rows],
        set_number=recording.visit[rows],
        joints=recording.joints[rows],
        wrench=recording.wrench[rows],
        deflection=deflection[rows],
        tip_m=tip_m,
        noise=noise,
        arm=arm,
    )
    return Recording(
        recording.path,
        recording.tool,
        samples,
        recording.positions,
        tuple(problems),
        rows,
        tuple(registrations),
    )


def join_recordings(recordings: Sequence[Recording]) -> DeflectionSamples:
    """Join recordings with one tool; the same place has the same number in all.

    A position's number is that of the nearest one known so far that is the same, else a new one.

    Args:
        recordings: one or more, of one arm.

    Returns:
        All samples.

    Raises:
        GalenError: the recordings are of different tools or tips.

    """
    first = recordings[0]
    arm = first.samples.arm
    same = same_position(arm)
    known: list[Array] = []
    parts = []
    for recording in recordings:
        _check_same_tool(first, recording)
        number = np.empty(len(recording.positions), dtype=int)
        taken: set[int] = set()
        for own, joints in enumerate(recording.positions):
            away = [float(np.max(np.abs(arm.nearest(joints, k) - k) / same)) for k in known]
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


def _check_same_tool(first: Recording, other: Recording) -> None:
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


def _visits(recording: PushRecording) -> Sequence[np.ndarray]:
    """Rows of each visit's untouched phase, by stand of the base's marker."""
    which = np.stack([recording.position, recording.visit, recording.stand], axis=1)
    keys, number = np.unique(which, axis=0, return_inverse=True)
    number = number.reshape(-1)
    return [np.flatnonzero((number == k) & recording.untouched) for k in range(len(keys))]


def _noise(deflection: Array, recording: PushRecording) -> tuple[Array, float]:
    """Return the standard deviation (6,) of one sample about its untouched phase's mean.

    Without samples that are far off, and what it is with them over that from sample to sample, at
    most of the axes: 1 for white noise, more for what goes on and for what is far off.

    The base marker's noise is not in it: its mean is the same for all samples of a stand, and the
    registration has taken its error up. The lever from the marker to the tip is, as the tip's
    own displacements are what is looked at.
    """
    near, every, steps = [np.zeros((0, 6))], [np.zeros((0, 6))], [np.zeros((0, 6))]
    freedom = 0
    for rows in _visits(recording):
        part = deflection[rows]
        part = part[np.isfinite(part).all(axis=1)]
        if len(part) < 2:
            continue
        off = np.abs(part - np.median(part, axis=0))
        typical = np.median(off, axis=0)  # zero where the tracker's steps are coarse
        kept = part[np.all((off <= _FAR_OFF * typical) | (typical == 0.0), axis=1)]
        near.append(kept - kept.mean(axis=0))
        every.append(part - part.mean(axis=0))
        steps.append(np.diff(part, axis=0) / np.sqrt(2.0))
        freedom += max(len(kept) - 1, 0)
    noise = np.sqrt(np.sum(np.concatenate(near) ** 2, axis=0) / max(freedom, 1))
    if not freedom:
        return noise, 0.0
    scatter, step = (np.concatenate(parts) for parts in (every, steps))
    usual = _MAD_TO_STD * np.median(np.abs(step), axis=0)
    usual = np.maximum(np.where(usual > 0.0, usual, np.std(step, axis=0)), _LEAST_NOISE)
    return noise, float(np.max(np.std(scatter, axis=0) / usual))
