# SPDX-License-Identifier: Apache-2.0
"""Effects of the sensor that come with time: a drift of any shape, and a step."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.held_out import Columns
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.sensor import BiasStep, SensorDrift
from scipy.sparse import csc_array, hstack

from galen_diagnosis.effects.candidates import Candidate, linear_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, no_forms
from galen_diagnosis.effects.jumps import Jump
from galen_diagnosis.effects.table_data import LEVER_M, TablePlant
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
_TABLE_LENGTHS = (1.0, 0.25, 0.08)
"""Over the table's span; what bends faster than this, in s, is no bias drift."""
_FASTEST_S, _FASTEST_READINGS = 10.0, 5.0
_TABLE_SIZES_N = (0.03, 0.2)
_KEPT = 0.999
_MOST_STEPS = 24


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


def drift_columns(at_s: Array, by_order: bool = False) -> list[Columns]:
    """Return smooth courses of all six axes, of several lengths and sizes.

    The leading eigenvectors of exp(-(t - t')^2 / 2 l^2) at the readings' times.

    Args:
        at_s: Times of the readings, (n,), s.
        by_order: Whether the order of readings is all that is known of time.

    Returns:
        Ways with values (n, 6, k), N and N.m, and the parameter `rate_per_hour`.

    """
    span = float(at_s[-1] - at_s[0])
    ways = []
    for share in _TABLE_LENGTHS:
        fastest = _FASTEST_READINGS * span / len(at_s) if by_order else _FASTEST_S
        if share < 1.0 and share * span < fastest:
            continue
        apart = (at_s[:, None] - at_s[None, :]) / (share * span)
        value, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
        kept = np.cumsum(value[::-1]) < _KEPT * value.sum()
        count = int(kept.sum()) + 1
        shapes = vectors[:, ::-1][:, :count] * np.sqrt(np.maximum(value[::-1][:count], 0.0))
        shapes = shapes - shapes.mean(axis=0)
        for size_n in _TABLE_SIZES_N:
            sizes = size_n * np.repeat([1.0, LEVER_M], 3)
            values = np.einsum("nk,cd->ncdk", shapes, np.diag(sizes)).reshape(len(at_s), 6, -1)
            ends = (shapes[-1] - shapes[0]) / span * _HOUR_S

            def rate(w: Array, ends: Array = ends, sizes: Array = sizes) -> Array:
                return np.asarray(sizes * (w.reshape(6, -1) @ ends))

            ways.append(Columns(values, {"rate_per_hour": rate}, {"bends_every_s": share * span}))
    return ways


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
    in_table=lambda plant: drift_columns(plant.at_s, plant.by_order),
    mujoco="rate_per_hour t / 3600 s or, where there are knots, the line through levels at knots_s"
    " is added to the reading, t since the recording's start",
    gazebo="a random one: `<noise><dynamic_bias_stddev>`; else the same formula",
)


def _steps_in_table(plant: TablePlant) -> list[Columns]:
    """Return a step between any two readings, or some of many."""
    at_s, typical = plant.at_s, BiasStep.fitted[0].typicals
    gaps = np.arange(1, len(at_s))
    if len(gaps) > _MOST_STEPS:
        gaps = np.unique(np.linspace(1, len(at_s) - 1, _MOST_STEPS).round().astype(int))
    ways = []
    for first in gaps:
        after = (np.arange(len(at_s)) >= first).astype(float)
        values = np.einsum("n,cd->ncd", after, np.diag(typical))
        time_s = float((at_s[first - 1] + at_s[first]) / 2.0)
        ways.append(Columns(values, {"step": lambda w: typical * w}, {"time_s": time_s}))
    return ways


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
    of_time=True,
    in_table=_steps_in_table,
    mujoco="step is added to the reading from time_s of bag on",
    gazebo="no such thing: the same formula",
)
