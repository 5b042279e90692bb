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
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_sim_driver.effects.sensor import SensorSaturation

from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.effects.candidates import (
    Candidate,
    candidates,
    crosstalk_candidate,
    crosstalks,
)
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns
from galen_diagnosis.observation.rows import BAGS

RMSE_DROP, NAIVE_BIC = "largest RMSE drop", "naive BIC"
_LEAST_DROP = 0.01
_SAME = 1e-10
"""Eigenvalues below this part of the largest are columns that others make up."""
_STEP_S = 10.0
_CLIPS = (0.5, 0.7, 0.9)
"""Limits tried, as shares of an axis' largest reading."""
_UNIT = np.array([1e-3] * 6 + [1e-4] * 12)


def answers(observation: Observation) -> dict[str, Any]:
    """Every baseline's answer, by its name."""
    unknowns = unknown_columns(observation)
    rest = Rest(observation.nominal, unknowns)
    left: dict[str, tuple[float, int]] = {}
    for name, columns in templates(observation, unknowns):
        left[name] = min(rest.left_by(columns), left.get(name, (np.inf, 0)))
    return simple_answers(len(observation.nominal), rest.sum_of_squares, left)


class Rest:
    """What the columns of unknowns (n, u) leave of a residual (n,)."""

    def __init__(self, residual: Array, unknowns: Array) -> None:
        self._basis = _basis(unknowns)
        self.residual = self._without(residual)
        self.sum_of_squares = float(self.residual @ self.residual)

    def left_by(self, columns: Array) -> tuple[float, int]:
        """The sum of squares that columns (n, k) leave beside the unknowns, and k."""
        norms = np.linalg.norm(columns, axis=0)
        own = self._without(columns[:, norms > 0.0] / norms[norms > 0.0])
        # What the unknowns take whole leaves rounding errors, which would explain something.
        own = own[:, np.linalg.norm(own, axis=0) > 1e-9]
        if not own.shape[1]:
            return self.sum_of_squares, columns.shape[1]
        # By the Gram matrix: a drift has hundreds of columns, of which a decomposition takes longer
        # than a whole diagnosis.
        size, vectors = np.linalg.eigh(own.T @ own)
        good = size > _SAME * size[-1]
        part = vectors[:, good].T @ (own.T @ self.residual) / np.sqrt(size[good])
        return float(self.sum_of_squares - part @ part), columns.shape[1]

    def _without(self, columns: Array) -> Array:
        return np.asarray(columns - self._basis @ (self._basis.T @ columns))


def _basis(columns: Array) -> Array:
    """Orthonormal columns of the same span; those that say nothing are left out."""
    norms = np.linalg.norm(columns, axis=0)
    if not norms.any():
        return np.zeros((len(columns), 0))
    scaled = columns[:, norms > 0.0] / norms[norms > 0.0]
    left, size, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size[0]])


def simple_answers(n: int, before: float, left: Mapping[str, tuple[float, int]]) -> dict[str, Any]:
    """Answers of both methods, in the form of `diagnosis.json`.

    n: rows. before: sum of squares with the unknowns alone. left: sum of squares and number of
    parameters of each effect's best template.
    """
    drop = {name: 1.0 - np.sqrt(max(rss, 0.0) / before) for name, (rss, _) in left.items()}
    drop = {NONE: _LEAST_DROP, **drop}
    bic = {NONE: n * np.log(before / n)}
    bic |= {name: n * np.log(rss / n) + k * np.log(n) for name, (rss, k) in left.items()}
    least = min(bic.values())
    weight = {name: np.exp(-0.5 * (value - least)) for name, value in bic.items()}
    return {RMSE_DROP: _answer(drop), NAIVE_BIC: _answer(weight)}


def _answer(weights: Mapping[str, float]) -> dict[str, Any]:
    """`identified` or `none`; probabilities are the weights' shares."""
    total = float(sum(weights.values()))
    shares = {name: float(weight) / total for name, weight in weights.items()}
    first = max(shares, key=lambda name: shares[name])
    alone = first == NONE
    return {
        "verdict": first if alone else "identified",
        "causes": []
        if alone
        else [{"effect": first, "probability": shares[first], "parameters": {}}],
        "ranking": [{"effect": name, "probability": p} for name, p in shares.items()],
        "gap": {},
    }


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
