"""What simpler methods answer from the same residual rows: the check's columns for comparison.

Each effect has one or more linear templates, columns of what its parameters change of the rows.
The least squares fit of each beside the columns of what isn't known leaves a sum of squares:

- largest RMSE drop: the effect that leaves the least; `none` where that is less than 1 %.
- naive BIC: n ln(RSS/n) + k ln n (G. Schwarz, Ann. Stat. 6, 1978), every row counted as new
  knowledge, nothing known of what a model may lack; probabilities as exp(-BIC/2).
- network: a small one on features of the residual (`network.py`).

Neither of the first two can say `unknown`, and none of them takes more than one cause.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.blind.baselines.features import features
from galen_diagnosis.blind.baselines.network import lacking, read_network
from galen_diagnosis.blind.baselines.templates import templates, unknown_columns
from galen_diagnosis.observation.observation import Observation

RMSE_DROP, NAIVE_BIC, NETWORK = "largest RMSE drop", "naive BIC", "network"
_LEAST_DROP = 0.01
_SAME = 1e-10
"""Eigenvalues below this part of the largest are columns that others make up."""


def answers(observation: Observation) -> dict[str, Any]:
    """Every baseline's answer, by its name; the network's only where there is one."""
    unknowns = unknown_columns(observation)
    rest = Rest(observation.nominal, unknowns)
    left: dict[str, tuple[float, int]] = {}
    for name, columns in templates(observation, unknowns):
        left[name] = min(rest.left_by(columns), left.get(name, (np.inf, 0)))
    found = simple_answers(len(observation.nominal), rest.sum_of_squares, left)
    if not lacking():
        described = features(observation.rows, rest.residual)
        found[NETWORK] = network_answer(read_network().probabilities(described))
    return found


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
    """Answers of the first two methods, in the form of `diagnosis.json`.

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


def network_answer(probabilities: Mapping[str, float]) -> dict[str, Any]:
    """The network's, in the same form."""
    return _answer(probabilities)


def _answer(weights: Mapping[str, float]) -> dict[str, Any]:
    """`identified` or what the first is; probabilities are the weights' shares."""
    total = float(sum(weights.values()))
    shares = {name: float(weight) / total for name, weight in weights.items()}
    first = max(shares, key=lambda name: shares[name])
    alone = first in (NONE, UNKNOWN)
    return {
        "verdict": first if alone else "identified",
        "causes": []
        if alone
        else [{"effect": first, "probability": shares[first], "parameters": {}}],
        "ranking": [{"effect": name, "probability": p} for name, p in shares.items()],
        "gap": {},
    }
