"""The share of a gap that its true cause closes, from the plant's noise-free readings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from scipy.spatial.transform import Rotation

_WRENCH_SIGMA = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])
_TRACKER_SIGMA = np.array([3e-5] * 3 + [1e-4] * 3)
"""Contract, section 1: noise of one sample; N, N.m, m, rad."""


def oracle_closed(file: Path) -> float | None:
    """1 - |full - cause|^2 / |full - nominal|^2 in units of the noise; None where there is no gap.

    `nominal`, `cause` and `full` are the readings of the nominal arm, of the nominal arm with the
    cause, and of the arm that was recorded, which has its tolerances beside. A constant in a
    channel over a bag is no gap: it is the sensor's zero, or where the tracker stands.
    """
    before = after = 0.0
    with np.load(file, allow_pickle=False) as stored:
        for name in (key.removesuffix("_full") for key in stored.files if key.endswith("_full")):
            nominal, cause, full = (stored[f"{name}_{x}"] for x in ("nominal", "cause", "full"))
            before += _energy(full, nominal)
            after += _energy(full, cause)
    return 1.0 - after / before if before > 0.0 else None


def _energy(full: Array, other: Array) -> float:
    """Sum of squares of the difference less its mean, in units of the noise of one sample.

    Columns: six of a wrench, or position and quaternion (x, y, z, w) of a marker.
    """
    if full.shape[1] == 6:
        difference = (full - other) / _WRENCH_SIGMA
    else:
        turned = Rotation.from_quat(full[:, 3:]) * Rotation.from_quat(other[:, 3:]).inv()
        difference = (
            np.concatenate([full[:, :3] - other[:, :3], turned.as_rotvec()], axis=1)
            / _TRACKER_SIGMA
        )
    return float(np.sum((difference - difference.mean(axis=0)) ** 2))
