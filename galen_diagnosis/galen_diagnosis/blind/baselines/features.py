"""Numbers that describe a recording's residual, for the network beside the diagnosis."""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.observation.rows import BAGS, CHANNELS, Rows

_TESTS = (
    "1", "time", "roll", "tilt", "sin roll", "cos roll", "sin tilt", "cos tilt", "roll*tilt",
    "roll rate", "tilt rate", "sign of roll rate", "sign of tilt rate", "late",
)  # fmt: skip
_BLOCKS = tuple(
    (bag, channel)
    for bag in range(len(BAGS))
    for channel in range(len(CHANNELS))
    if bag == BAGS.index("push") or channel < 6
)
FEATURES = len(_BLOCKS) * (len(_TESTS) + 2)
"""How many there are."""


def features(rows: Rows, residual: Array) -> Array:
    """Features (FEATURES,) of whitened residual rows (N,).

    For each channel of each bag: the residual's projections on unit vectors of simple courses over
    time, angles and rates, N(0, 1) each where there is noise alone; its mean square; the mean
    product of neighbours. Each as sign(x) ln(1 + |x|), since gaps span decades. 0 where a bag or
    the tracker is missing.
    """
    out = np.zeros((len(_BLOCKS), len(_TESTS) + 2))
    for number, (bag, channel) in enumerate(_BLOCKS):
        chosen = np.flatnonzero((rows.bag == bag) & (rows.channel == channel))
        if len(chosen) < 2:
            continue
        part = residual[chosen]
        courses = _courses(rows, chosen)
        norm = np.linalg.norm(courses, axis=1)
        out[number, : len(_TESTS)] = np.divide(
            courses @ part, norm, out=np.zeros(len(courses)), where=norm > 0.0
        )
        root = np.sqrt(len(part))
        out[number, -2] = (np.mean(part**2) - 1.0) * root
        out[number, -1] = np.mean(part[1:] * part[:-1]) * root
    flat = out.ravel()
    return np.sign(flat) * np.log1p(np.abs(flat))


def _courses(rows: Rows, chosen: np.ndarray) -> Array:
    """Courses (tests, n), in the order of `_TESTS`; all but the first without their mean."""
    time = rows.bag_s[chosen]
    roll, tilt = rows.joints[chosen, 3], rows.joints[chosen, 4]
    roll_rate, tilt_rate = rows.rate[chosen, 3], rows.rate[chosen, 4]
    one = np.ones_like(time)
    courses = np.stack(
        [
            one, time, roll, tilt, np.sin(roll), np.cos(roll), np.sin(tilt), np.cos(tilt),
            roll * tilt, roll_rate, tilt_rate, np.sign(roll_rate), np.sign(tilt_rate),
            (time > np.median(time)).astype(float),
        ]
    )  # fmt: skip
    courses[1:] -= courses[1:].mean(axis=1, keepdims=True)
    return courses
