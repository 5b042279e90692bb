"""The deflection that the tracker measured: where the tip is, and where the joints say it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from galen_model.arm.kinematics import tip_pose
from galen_model.arrays import Array
from galen_model.registration.rigid import Transform

from galen_deflection.errors import RegistrationError
from galen_deflection.measurement.push_recording import PushRecording
from galen_deflection.measurement.registration import Registration, register
from galen_deflection.measurement.registration_fit import RegistrationSettings
from galen_deflection.measurement.rest_poses import rest_poses
from galen_deflection.measurement.samples import DeflectionSamples

_LEAST_NOISE = 1e-6
_CLEARLY = 5.0
_BIAS_DRIFTS = 1.5
_MAD_TO_STD = 1.4826
_FAR_OFF = 6.0 * _MAD_TO_STD


@dataclass(frozen=True)
class MeasuredDeflection:
    """Samples (n) with their recording's rows (n,), and how they were registered.

    untouched, zero_load (n,): as in `PushRecording`. registrations: one for each stand of the
    base's marker, None where it has no rest to register on. problems: sentences about all of it.
    """

    samples: DeflectionSamples
    rows: np.ndarray
    untouched: np.ndarray
    zero_load: np.ndarray
    registrations: tuple[Registration | None, ...]
    problems: tuple[str, ...]


def measure_deflection(
    recording: PushRecording,
    settings: RegistrationSettings | None = None,
    *,
    from_rest: bool = False,
) -> MeasuredDeflection:
    """Register the recording and take its deflections; raises RegistrationError.

    The set numbers are the visits of each position. Where the base's marker moved, each of its
    stands is registered on its own, and the samples of those without a rest are left out.
    `from_rest`: count each visit's deflection from its own mean before the first push instead of
    from where the joints say: it takes away what is wrong with the arm's geometry, and also what
    earlier pushes left of a deflection; visits without such a phase are left out.
    """
    settings = settings or RegistrationSettings()
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
            registration = register(rests, recording.tool.tip_m, settings)
        except RegistrationError as error:
            why = "" if rests else "".join(f"; {problem}" for problem in recording.problems)
            raise RegistrationError(f"{recording.path}: {error}{why}") from None
        registrations.append(registration)
        problems += registration.problems
        tip = Transform(*tip_pose(recording.joints[here], recording.tool.tip_m, settings.arm))
        deflection[here] = registration.tip(recording.marker[here]).displacement_from(tip)
    problems += _what_moved(recording, registrations)
    if all(registration is None for registration in registrations):
        register([], recording.tool.tip_m, settings)

    noise, bias_drift = _noise(deflection, recording)
    if bias_drift > _BIAS_DRIFTS:
        problems.append(
            f"without contact the tip that the tracker sees scatters {bias_drift:.1f}"
            " times as much as from sample to sample: do its stamps lie off from the joints', or"
            " does it drift? Neither errors nor noise can be relied on then"
        )
    if from_rest:
        deflection = _from_rest(deflection, recording)
    rows = np.flatnonzero(np.isfinite(deflection).all(axis=1))
    samples = DeflectionSamples(
        stamp_ns=recording.stamp_ns[rows],
        segment=recording.segment[rows],
        position=recording.position[rows],
        set_number=recording.visit[rows],
        joints=recording.joints[rows],
        wrench=recording.wrench[rows],
        deflection=deflection[rows],
        tip_m=np.asarray(recording.tool.tip_m, dtype=float),
        noise=noise,
    )
    return MeasuredDeflection(
        samples,
        rows,
        recording.untouched[rows],
        recording.zero_load[rows],
        tuple(registrations),
        tuple(problems),
    )


def _what_moved(
    recording: PushRecording, registrations: Sequence[Registration | None]
) -> list[str]:
    """Whether the base's marker moved on the arm, or the tracker before both, as sentences.

    The marker's place in base_link stays if the tracker moved, the arm's place before the tracker
    if the marker did.
    """
    known = [
        (stand, registration.base_marker)
        for stand, registration in zip(recording.stands, registrations, strict=True)
        if registration is not None
    ]
    said = []
    for (before, marker_before), (after, marker_after) in pairwise(known):
        on_arm = marker_after.displacement_from(marker_before)
        arm_seen = (after.pose @ marker_after.inverse()).displacement_from(
            before.pose @ marker_before.inverse()
        )
        noise = np.maximum(before.std, _LEAST_NOISE)
        marker, tracker = (float(np.linalg.norm(step / noise)) for step in (on_arm, arm_seen))
        if max(marker, tracker) > _CLEARLY * min(marker, tracker):
            at_s = (after.start_ns - recording.start_ns) * 1e-9
            what = "the base's marker on the arm" if marker > tracker else "the tracker"
            said.append(
                f"by the registrations before and after, it was {what} that moved by {at_s:.2f} s"
            )
    return said


def _visits(recording: PushRecording) -> Sequence[np.ndarray]:
    """Rows of each visit's untouched phase, by stand of the base's marker."""
    which = np.stack([recording.position, recording.visit, recording.stand], axis=1)
    keys, number = np.unique(which, axis=0, return_inverse=True)
    number = number.reshape(-1)
    return [np.flatnonzero((number == k) & recording.untouched) for k in range(len(keys))]


def _noise(deflection: Array, recording: PushRecording) -> tuple[Array, float]:
    """Standard deviation (6,) of one sample about its untouched phase's mean, over all phases.

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


def _from_rest(deflection: Array, recording: PushRecording) -> Array:
    """Deflections less their visit's mean before the first push, NaN where there is none."""
    found = np.full_like(deflection, np.nan)
    for rows in _visits(recording):
        if not len(rows):
            continue
        first = rows[0]
        visit = (
            (recording.position == recording.position[first])
            & (recording.visit == recording.visit[first])
            & (recording.stand == recording.stand[first])
        )
        found[visit] = deflection[visit] - deflection[rows].mean(axis=0)
    return found
