"""Linear templates of every effect on a recording's rows, for the baselines alone.

They are plainer than the diagnosis' own: a steady drift, steps at ten-second marks, a cable's mean
pull, everything at its smallest.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_sim_driver.effects.sensor.sensor_saturation import SensorSaturation

from galen_diagnosis.effects.candidates import (
    Candidate,
    candidates,
    crosstalk_candidate,
    crosstalks,
)
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns
from galen_diagnosis.observation.rows import BAGS

_STEP_S = 10.0
_CLIPS = (0.5, 0.7, 0.9)
"""Limits tried, as shares of an axis' largest reading."""
_UNIT = np.array([1e-3] * 6 + [1e-4] * 12)


def unknown_columns(observation: Observation) -> Array:
    """What the recording's unknowns change of the rows (N, UNKNOWNS)."""
    return np.stack(
        [
            observation.change([], Unknowns(unit)) / step
            for unit, step in zip(np.diag(_UNIT), _UNIT, strict=True)
        ],
        axis=1,
    )


def templates(observation: Observation, unknowns: Array) -> Iterator[tuple[str, Array]]:
    """Effects' names with columns (N, k) each, an effect as often as it has forms.

    unknowns (N, UNKNOWNS): `unknown_columns`.
    """
    for one in candidates(observation):
        yield one.effect, _columns(observation, one)
    for _, _, crosstalk in crosstalks():
        yield "crosstalk", _columns(observation, crosstalk_candidate(crosstalk))
    rows = observation.rows
    offsets, marker = unknowns[:, :6], unknowns[:, UNKNOWNS - 6 :]
    yield "sensor_drift", offsets * rows.session_s[:, None]
    for bag in np.unique(rows.bag):
        times = rows.bag_s[rows.bag == bag]
        for at_s in np.arange(times.min() + 0.5 * _STEP_S, times.max(), _STEP_S):
            later = (rows.bag > bag) | ((rows.bag == bag) & (rows.bag_s >= at_s))
            yield "bias_step", offsets * later[:, None]
            if BAGS[bag] == "push" and marker.any():
                yield "base_shift", marker * later[:, None]
    readings = np.concatenate([view.scene.reading for view in observation.views.values()])
    for axis, largest in zip(WRENCH_AXES, np.abs(readings).max(axis=0), strict=True):
        for share in _CLIPS:
            clip = SensorSaturation(limit=float(share * largest), axis=axis)
            yield "sensor_saturation", observation.change([clip])[:, None]


def _columns(observation: Observation, one: Candidate) -> Array:
    """By differences about the start; of a cable the pull alone, the rest bends it only."""
    if one.effect == "cable_drag":
        values = one.start.copy()
        values[0] += one.probe[0]
        return observation.change([one.at(values)])[:, None] / one.probe[0]
    return one.jacobian(observation, lambda values: [one.at(values)], one.start)
