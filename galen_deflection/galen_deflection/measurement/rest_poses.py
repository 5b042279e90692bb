"""Poses of the marker at rest and without contact: the tracker is registered on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.registration.rigid import Transform, mean_pose

from galen_deflection.measurement.push_recording import PushRecording

_BLOCK = 10
_LEAST_SAMPLES = 10


@dataclass(frozen=True)
class RestPose:
    """The arm at rest, without contact, for some samples.

    joints (5,): m, rad. marker: mean of the tool's marker in the base's. noise (6,): standard
    deviation of one sample along the base marker's axes, m and rad; covariance (6, 6) of the mean,
    along these axes: of the tracker's noise alone.
    """

    position: int
    visit: int
    joints: Array
    marker: Transform
    samples: int
    noise: Array
    covariance: Array


def rest_poses(recording: PushRecording, stand: int | None = None) -> list[RestPose]:
    """One for each visit's phase before its first push; of one `stand` of the base's marker only.

    The covariance counts how much the noise goes on from sample to sample.
    """
    rows = recording.untouched
    if stand is not None:
        rows = rows & (recording.stand == stand)
    found = []
    which = np.stack([recording.position, recording.visit, recording.stand], axis=1)
    for key in np.unique(which[rows], axis=0):
        here = np.flatnonzero(rows & np.all(which == key, axis=1))
        if len(here) < _LEAST_SAMPLES:
            continue
        mean = mean_pose(recording.marker[here])
        off = recording.marker[here][mean.used].displacement_from(mean.pose)
        found.append((key, here, mean, off))
    if not found:
        return []
    more = _correlation([off for *_, off in found])
    return [
        RestPose(
            int(key[0]),
            int(key[1]),
            recording.joints[here].mean(axis=0),
            mean.pose,
            len(off),
            mean.std,
            more * (off.T @ off) / (len(off) - 1) / len(off),
        )
        for key, here, mean, off in found
    ]


def _correlation(parts: Sequence[Array]) -> float:
    """How much larger the variance of a mean is than by white noise, at least 1."""
    ratios, weights = [], []
    for off in parts:
        count = len(off) // _BLOCK
        if count < 2:
            continue
        blocks = off[: count * _BLOCK].reshape(count, _BLOCK, 6).mean(axis=1)
        variance = np.maximum(off.var(axis=0, ddof=1), 1e-30)
        ratios.append(np.mean(_BLOCK * blocks.var(axis=0, ddof=1) / variance))
        weights.append(count - 1)
    return float(max(1.0, np.average(ratios, weights=weights))) if ratios else 1.0
