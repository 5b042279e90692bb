"""Parameters of what was found, with intervals, under the contract's names.

A fit's covariance counts every row as independent. What a law leaves is not, so intervals take the
larger of Laplace's covariance and the sandwich over blocks (White, Econometrica 50, 1982; Liang and
Zeger, Biometrika 73, 1986),

    H^-1 (sum_b g_b g_b^T) H^-1,    g_b = J_b^T r_b,

with J the columns of background and effects together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.kinematics import sensor_pose
from galen_sim_driver.effects.cable_drag import CableDrag
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import contract_parameters, extra_parameters

from galen_diagnosis.answer import Interval
from galen_diagnosis.linear import Background
from galen_diagnosis.observation import Observation
from galen_diagnosis.refine import Hypothesis

_DRAWS = 400
_SEED = 1956
_TIMES = {"bias_step": 0.5, "base_shift": 0.3}
"""By how much a jump's time may lie off, s: the grid's step, and that a jump takes a moment."""


def covariance(observation: Observation, behind: Background, hypothesis: Hypothesis) -> Array:
    """Of all numbers of a hypothesis (p, p): Laplace's, widened to the sandwich."""
    if not hypothesis.parts:
        return hypothesis.covariance
    laplace = hypothesis.covariance
    columns = np.concatenate([behind.columns, hypothesis.columns], axis=1)
    width = behind.columns.shape[1]
    precision = np.zeros(columns.shape[1])
    precision[:width] = behind.precision
    hessian = columns.T @ columns + np.diag(precision)
    own = np.linalg.pinv(laplace, hermitian=True)
    reduced = hessian[width:, width:] - hessian[width:, :width] @ behind.solve(
        hessian[:width, width:]
    )
    hessian[width:, width:] += np.maximum(own - reduced, 0.0) * np.eye(len(own))
    blocks = observation.rows.block
    order = np.argsort(blocks, kind="stable")
    edges = np.flatnonzero(np.diff(blocks[order])) + 1
    weighted = columns[order] * hypothesis.rows[order, None]
    scores = np.add.reduceat(weighted, np.concatenate([[0], edges]), axis=0)
    silent = np.diag(hessian) <= 0.0
    hessian[silent, silent] = 1.0
    bread = np.linalg.solve(hessian, scores.T)[width:]
    sandwich = bread @ bread.T
    widen = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(laplace), 1e-300), 1.0))
    return np.asarray(laplace * np.outer(widen, widen))


def parameters(
    observation: Observation, hypothesis: Hypothesis, spread: Array
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Of each effect: the contract's parameters with intervals, and the rest as numbers."""
    generator = np.random.default_rng(_SEED)
    out = []
    for part, values, where, effect in zip(
        hypothesis.parts, hypothesis.values, hypothesis.slices(), hypothesis.effects, strict=True
    ):
        root = _root(spread[where, where])
        drawn = [
            part.at(values + root @ generator.standard_normal(len(values))) for _ in range(_DRAWS)
        ]
        told = _told(observation, effect)
        draws = [_told(observation, one) for one in drawn]
        named = {
            name: _interval(part.effect, name, value, [draw[name] for draw in draws])
            for name, value in told.items()
        }
        if part.effect == "joint_compliance":
            named = {name: value for name, value in named.items() if value != Interval(0.0, 0, 0)}
        out.append((named, extra_parameters(effect)))
    return out


def _root(spread: Array) -> Array:
    values, vectors = np.linalg.eigh(spread)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _told(observation: Observation, effect: Effect) -> Mapping[str, Any]:
    told = contract_parameters(effect)
    if isinstance(effect, CableDrag):
        joints = np.concatenate([view.scene.joints for view in observation.views.values()])
        rotation, origin = sensor_pose(joints[:: max(len(joints) // 500, 1)])
        told["tension_N"] = float(np.mean(effect.tension(rotation, origin)))
    return told


def _interval(effect: str, name: str, value: Any, draws: list[Any]) -> Any:
    if isinstance(value, str):
        return value
    if name == "time_s":
        near = _TIMES[effect]
        return Interval(float(value), max(0.0, float(value) - near), float(value) + near)
    low, high = np.quantile(np.array(draws, dtype=float), [0.025, 0.975], axis=0)
    if isinstance(value, list | tuple):
        return [
            Interval(float(v), float(a), float(b)) for v, a, b in zip(value, low, high, strict=True)
        ]
    return Interval(float(value), float(low), float(high))
