# SPDX-License-Identifier: Apache-2.0
"""From one joint's runs to blocks of rows and effects.

Of a joint's two angles and torque, the lag is the motor's angle less the link's. Nominal is a rigid
gear: a constant, the encoders' zeros. What effects add to it is in `effects/transmission.py`;
plays, velocity and direction are those of `galen_model.transmission`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from galen_model.arrays import Array
from galen_model.play import PlayOperators
from galen_model.transmission import TERMS, JointRun, Parts, Scales, design, noise_of

from galen_diagnosis.effects.joint_terms import Columns, JointTerms
from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.tables.joint_evidence import LagRows

_MOST_ROWS = 700
_GAPS = np.geomspace(0.08, 2.2, 14)
"""Thresholds of plays of the motion over half of the lag's range."""
_APART_S = 1e4
_VELOCITY_WINDOW_S = 0.1


def rows_of_runs(runs: Sequence[JointRun], parts: Parts) -> LagRows:
    """Return means of the lag of a joint's runs, and how effects show in them.

    Args:
        runs: Angles at both ends, rad, torque, N.m, and time, s.
        parts: Parts of the runs; a part is a block.

    Returns:
        The lag, rad; the ways in which effects show; sentences.

    """
    every = [np.ones(len(run), dtype=bool) for run in runs]
    scales = Scales.of(runs, every, _VELOCITY_WINDOW_S)
    gaps = scales.lag_half_range * _GAPS
    terms = np.concatenate([design(run, scales) for run in runs])
    lost = np.concatenate([_lost(run, gaps) for run in runs])
    lag = np.concatenate([run.lag for run in runs])
    torque_rate = np.concatenate([np.gradient(run.torque, run.time_s) for run in runs])
    at_s = np.concatenate([run.time_s + k * _APART_S for k, run in enumerate(runs)])
    label = np.concatenate(parts.label)
    window, size = _windows(runs, label)
    count = np.bincount(window)

    def mean(values: Array) -> Array:
        sums = np.zeros((len(count), *values.shape[1:]))
        np.add.at(sums, window, values)
        return sums / count.reshape(-1, *[1] * (values.ndim - 1))

    noise = noise_of(list(runs))
    floor = float(np.hypot(noise.quantisation, noise.jitter / np.sqrt(size)))
    wide = 100.0 * scales.lag_half_range
    residual = mean(lag)
    step_s = size * runs[0].step_s
    span_s = sum(float(run.time_s[-1] - run.time_s[0]) for run in runs) / len(parts.names)
    column = dict(zip(TERMS, mean(terms).T, strict=True))
    data = JointTerms(residual, column, mean(torque_rate), mean(lost), gaps, scales)
    of: dict[str, Sequence[Columns]] = {}
    cannot_tell = []
    for name, record in RECORDS.items():
        found = record.in_joint_runs(data)
        if isinstance(found, str):
            cannot_tell.append(f"{name}: {found}")
        elif found:
            of[name] = found
    return LagRows(
        residual=residual - residual.mean(),
        floor=max(floor, 1e-9 * scales.lag_half_range),
        at_s=mean(at_s),
        block=np.round(mean(label.astype(float))).astype(int),
        labels=parts.names,
        memories_s=(2.0 * step_s, max(span_s / 10.0, 4.0 * step_s), span_s),
        nominal=Columns(np.full((len(residual), 1), wide)),
        effects=of,
        cannot_tell=tuple(cannot_tell),
        notes=(
            f"{len(residual)} means over {size} readings of {len(runs)} runs",
            "floor: encoders' steps and the lag's jitter",
        ),
    )


def _windows(runs: Sequence[JointRun], label: np.ndarray) -> tuple[np.ndarray, int]:
    """Of each reading its window, which stays within a run and a part; readings in one."""
    total = sum(len(run) for run in runs)
    size = max(1, -(-total // _MOST_ROWS))
    run_of = np.concatenate([np.full(len(run), k) for k, run in enumerate(runs)])
    place = np.concatenate([np.arange(len(run)) for run in runs])
    edges = [0, *(np.flatnonzero((np.diff(run_of) != 0) | (np.diff(label) != 0)) + 1), total]
    window = np.zeros(total, dtype=int)
    first = 0
    for start, end in pairwise(edges):
        window[start:end] = first + (place[start:end] - place[start]) // size
        first = window[end - 1] + 1
    return window, size


def _lost(run: JointRun, thresholds: Array) -> Array:
    """Return what each play of the motion leaves behind (n, p), rad; from amid the gap."""
    motion = np.repeat((run.motor - run.motor[0])[:, None], len(thresholds), axis=1)
    return np.asarray(motion - PlayOperators(thresholds).run(motion).output)
