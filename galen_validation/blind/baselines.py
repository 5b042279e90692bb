# SPDX-License-Identifier: Apache-2.0
"""What simpler methods answer from the same residual rows: the check's columns for comparison.

Each effect has one or more linear templates, columns of what its parameters change of the rows:
plainer than the diagnosis' own, with a steady drift, steps at ten-second marks, a cable's mean
pull. The least squares fit of each beside the columns of the unknowns leaves a sum of squares:

- largest RMSE drop: the effect that leaves the least; `none` where that is less than 1 %.
- naive BIC: n ln(RSS/n) + k ln n (G. Schwarz, Ann. Stat. 6, 1978), every row counted as new
  knowledge, no discrepancy of any model; probabilities as exp(-BIC/2).

Neither can answer `unknown`, or more than one cause.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.forms import candidates, unknown_columns
from galen_diagnosis.effects.sensor import crosstalk_candidate, crosstalks
from galen_diagnosis.observation.observation import UNKNOWNS, Observation
from galen_diagnosis.observation.rows import BAGS
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background
from galen_sim_driver.effects.sensor import SensorSaturation

RMSE_DROP, NAIVE_BIC = "largest_rmse_drop", "naive_bic"
_LEAST_DROP = 0.01
_STEP_S = 10.0
_CLIPS = (0.5, 0.7, 0.9)
"""Limits tried, as shares of an axis' largest reading."""


def answers(observation: Observation) -> dict[str, Any]:
    """Return every baseline's answer to one recording.

    Args:
        observation: The recording's residual rows, as the diagnosis takes them.

    Returns:
        Answers in the form of `diagnosis.json`, by the baseline's name.

    """
    rows = observation.nominal
    unknowns = unknown_columns(observation)
    behind = Background(unknowns, np.full(unknowns.shape[1], np.inf))
    before = behind.sum_of_squares(rows)
    left: dict[str, tuple[float, int]] = {}
    for name, columns in templates(observation, unknowns):
        found = before - explained(behind, columns, rows), columns.shape[1]
        left[name] = min(found, left.get(name, found))
    return simple_answers(len(rows), before, left)


def explained(behind: Background, columns: Array, rows: Array) -> float:
    """Return by how much a fit of columns beside the background lowers the sum of squares.

    Columns that others make up, or the background takes whole, add nothing.

    Args:
        behind: Columns of the unknowns, fitted beside.
        columns: A template, (N, k).
        rows: Whitened residuals, (N,).

    Returns:
        The decrease of the sum of squares, at least 0.

    """
    norms = np.linalg.norm(columns, axis=0)
    if not np.any(norms):
        return 0.0
    gram, projection = behind.reduced(columns[:, norms > 0.0] / norms[norms > 0.0], rows)
    size, vectors = np.linalg.eigh(gram)
    good = size > 1e-9
    return float(np.sum((vectors[:, good].T @ projection) ** 2 / size[good]))


def simple_answers(n: int, before: float, left: Mapping[str, tuple[float, int]]) -> dict[str, Any]:
    """Return answers of both methods.

    Args:
        n: Number of rows.
        before: Sum of squares with the unknowns alone.
        left: By effect, sum of squares and number of parameters of its best template.

    Returns:
        Answers in the form of `diagnosis.json`, by the method's name.

    """
    drop = {name: 1.0 - np.sqrt(max(rss, 0.0) / before) for name, (rss, _) in left.items()}
    drop = {NONE: _LEAST_DROP, **drop}
    bic = {NONE: n * np.log(before / n)}
    bic |= {name: n * np.log(rss / n) + k * np.log(n) for name, (rss, k) in left.items()}
    least = min(bic.values())
    weight = {name: np.exp(-0.5 * (value - least)) for name, value in bic.items()}
    return {RMSE_DROP: _answer(drop), NAIVE_BIC: _answer(weight)}


def _answer(weights: Mapping[str, float]) -> dict[str, Any]:
    """Answer `identified` or `none`; probabilities are the weights' shares."""
    total = float(sum(weights.values()))
    ranking = [{**_at(name), "probability": float(w) / total} for name, w in weights.items()]
    first = max(weights, key=lambda name: weights[name])
    cause = {**_at(first), "probability": float(weights[first]) / total, "parameters": {}}
    found = first != NONE
    return {
        "schema_version": 1,
        "verdict": "identified" if found else NONE,
        "causes": [cause] if found else [],
        "ranking": ranking,
    }


def _at(identity: str) -> dict[str, str]:
    effect, _, joint = identity.partition(":")
    return {"effect": effect, "joint": joint} if joint else {"effect": effect}


def templates(observation: Observation, unknowns: Array) -> Iterator[tuple[str, Array]]:
    """Yield linear templates of the effects, an effect as often as it has forms.

    Args:
        observation: The recording's rows.
        unknowns: Columns of the unknowns as `unknown_columns` returns them, (N, UNKNOWNS).

    Yields:
        The effect's name, with its joint where it has one, and columns (N, k).

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
