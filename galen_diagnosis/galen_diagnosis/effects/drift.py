# SPDX-License-Identifier: Apache-2.0
"""Effects of the sensor that come with time: a drift of any shape, and a step."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import contract_parameters
from galen_sim_driver.effects.sensor import BiasStep, SensorDrift
from scipy.sparse import csc_array, hstack

from galen_diagnosis.effects.candidates import Candidate, linear_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, no_forms
from galen_diagnosis.effects.jumps import Jump
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import ResidualRows

_HOUR_S = 3600.0
_KNOT_S = 20.0
_MOST_PIECES = 80
"""Of a drift: bags may lie hours apart, and six columns a piece fill the memory."""
_BUMP = np.array([0.007] * 3 + [2e-4] * 3)
_BENDS, _BEND = 2, 3.0
"""Of a smooth drift: half waves over the recording, and their usual size over that of a bump."""
_RATE = np.array([1.0] * 3 + [0.02] * 3)
_HALVINGS = 2
"""How often the time between knots is halved."""


def drift_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return a steady drift, a smooth one, and one of any shape.

    Args:
        observation: What was measured.
        zero: Columns of the sensor's zero, (N, 6).

    Returns:
        Three forms; none of a recording shorter than 40 s.

    """
    at_s = observation.rows.session_s
    length = float(at_s.max())
    if length < 2.0 * _KNOT_S:
        return []
    knots = np.linspace(0.0, length, min(max(round(length / _KNOT_S), 2), _MOST_PIECES) + 1)
    line = knots[:, None] / _HOUR_S
    bent = np.sin(np.pi * knots[:, None] / length * np.arange(1, _BENDS + 1))
    hats = np.eye(len(knots))[:, 1:-1]
    found = []
    for label, times, shapes, size in (
        ("steady", knots[[0, -1]], line[[0, -1]], _BUMP),
        ("smooth", knots, np.hstack([line, bent]), _BEND * _BUMP),
        ("any shape", knots, np.hstack([line, hats]), _BUMP),
    ):
        courses = [np.interp(at_s, times, shape) for shape in shapes.T]
        columns = np.concatenate([zero * course[:, None] for course in courses], axis=1)
        typical = np.concatenate([_RATE, np.tile(size, len(courses) - 1)])
        one = linear_form(SensorDrift(), label, columns, typical)
        make = partial(_drift, times, shapes)
        found.append(replace(one, make=make, model=f"drift, {label}", wider=label != "steady"))
    return found


def _drift(knots_s: Array, shapes: Array, values: Array) -> Effect:
    """Return a drift of shapes (k, m) at knots (k,), by their sizes (6 m,) in the axes."""
    return SensorDrift.through(knots_s, shapes @ values.reshape(-1, 6))


def _between_knots(drift: SensorDrift, rows: ResidualRows, zero: Array) -> csc_array:
    """Return hats between a drift's knots, in each axis; zero (N, 6): columns of the zero.

    None (N, 0) for a steady drift.
    """
    if len(drift.knots_s) <= 2:
        return csc_array((len(zero), 0))
    knots, levels = np.array(drift.knots_s), np.reshape(drift.levels, (-1, 6))
    std = np.sqrt(np.mean(np.diff(levels, 2, axis=0) ** 2, axis=0) / 8.0)
    parts = []
    for level in range(_HALVINGS):
        # Between two knots a hat rises from 0 to 1 and falls again.
        at = np.interp(rows.session_s, knots, np.arange(len(knots)) * 2.0**level)
        hat = np.minimum(np.floor(at), (len(knots) - 1) * 2**level - 1)
        height = 1.0 - np.abs(2.0 * (at - hat) - 1.0)
        size = height[:, None] * zero * (std / 2.0 ** (0.5 * level))
        column = hat.astype(np.int64)[:, None] * 6 + np.arange(6)
        row = np.repeat(np.arange(len(at)), 6)
        shape = (len(at), 6 * (len(knots) - 1) * 2**level)
        parts.append(csc_array((size.ravel(), (row, column.ravel())), shape=shape))
    whole = hstack(parts, format="csc")
    return whole[:, np.flatnonzero(abs(whole).sum(axis=0))]


SENSOR_DRIFT = DiagnosedEffect(
    name=SensorDrift.name,
    title="drifting sensor",
    sentence="the sensor drifts, by {rate_per_hour}",
    remedy="let the sensor warm up, and zero it more often",
    forms=no_forms,
    columns=drift_candidates,
    healthy=True,
    most_forms=3,
    general=True,
    between_knots=_between_knots,
    # It goes on, but not as before.
    later=lambda effect: SensorDrift(rate_per_hour=tuple(effect.vector().tolist())),
    of_time=True,
    mujoco="rate_per_hour t / 3600 s or, where there are knots, the line through levels at knots_s"
    " is added to the reading, t since the recording's start",
    gazebo="a random one: `<noise><dynamic_bias_stddev>`; else the same formula",
)


def _step_parameters(observation: Observation, effect: BiasStep) -> dict[str, Any]:
    found = contract_parameters(effect)
    return found if observation.recording.readings is None else {**found, "bag": "the readings"}


BIAS_STEP = DiagnosedEffect(
    name=BiasStep.name,
    title="jump of the sensor's reading",
    sentence="the sensor's reading jumps by {step} at {time_s} of {bag}",
    remedy="look for a knock, an overload or a moved plug at that time; zero the sensor",
    forms=no_forms,
    jump=Jump(
        effect=lambda bag, at_s: BiasStep(bag=bag, time_s=at_s),
        unknowns=slice(0, 6),
        typical=np.array([0.1] * 3 + [3e-3] * 3),
        grid_s={"sweep": 0.4, "motion": 0.25, "push": 0.4},
    ),
    known="firm",
    parameters=_step_parameters,
    of_time=True,
    mujoco="step is added to the reading from time_s of bag on",
    gazebo="no such thing: the same formula",
)
