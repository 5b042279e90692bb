"""Parameters of what was found, with intervals, under the contract's names.

A fit's covariance counts every row as independent. What a law leaves is not, so intervals take the
larger of Laplace's covariance and the sandwich over blocks (White, Econometrica 50, 1982; Liang and
Zeger, Biometrika 73, 1986),

    H^-1 (sum_b g_b g_b^T) H^-1,    g_b = J_b^T r_b,

with J the columns of background and effects together. Nor is an effect's law quite the arm's: it
may be wrong along its own parameters, too, which leaves no trace. With the posterior's discrepancy
(`posterior.py`), nu directions whose variance is 1 + v beside noise's 1, Laplace's covariance
counts (1 + v) times. Beforehand v = kappa^2 (energy explained) / nu, which weighs as _FIRM
directions do; the energy L that the fit leaves tells of the others:

    v = (_FIRM kappa^2 E / nu + L) / (_FIRM + nu).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from galen_model.arm.kinematics import sensor_pose
from galen_model.arrays import Array
from galen_model.evidence.background import Background, factor
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.load import CableDrag
from galen_sim_driver.effects.registry import contract_parameters, extra_parameters
from scipy.linalg import cho_solve

from galen_diagnosis.answer.answer import Interval
from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.saturation import SaturationCandidate
from galen_diagnosis.effects.scans import JumpCandidate
from galen_diagnosis.inference.posterior import Settings
from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.observation.observation import Observation

_DRAWS = 400
_SEED = 1956
_FIRM = 9.0


def covariance(
    observation: Observation,
    behind: Background,
    hypothesis: Hypothesis,
    settings: Settings,
    left: float,
) -> Array:
    """Of all numbers of a hypothesis (p, p): Laplace's with its laws' errors, or the sandwich.

    left: energy that the fit leaves over the noise.
    """
    if not hypothesis.parts:
        return hypothesis.covariance
    laplace = hypothesis.covariance
    shares = hypothesis.energies_explained()
    wrong = np.empty(len(laplace))
    for part, where, share in zip(hypothesis.parts, hypothesis.slices(), shares, strict=True):
        before = _FIRM * settings.kappa_of(part.effect) ** 2 * share / settings.dof
        wrong[where] = np.sqrt(1.0 + (before + left) / (_FIRM + settings.dof))
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
    bread = cho_solve(factor(hessian), scores.T)[width:]
    sandwich = bread @ bread.T
    widen = np.sqrt(np.diag(sandwich) / np.maximum(np.diag(laplace), 1e-300))
    widen = np.maximum(widen, wrong)
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
            name: _interval(part, name, value, [draw[name] for draw in draws])
            for name, value in told.items()
        }
        out.append((named, extra_parameters(effect)))
    return out


def _root(spread: Array) -> Array:
    """The symmetric root, which is unique: the signs of eigenvectors are not."""
    values, vectors = np.linalg.eigh(spread)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _told(observation: Observation, effect: Effect) -> Mapping[str, Any]:
    told = contract_parameters(effect)
    if isinstance(effect, CableDrag):
        joints = np.concatenate([view.scene.joints for view in observation.views.values()])
        rotation, origin = sensor_pose(joints[:: max(len(joints) // 500, 1)])
        told["tension_N"] = float(np.mean(effect.tension(rotation, origin)))
    return told


def _interval(part: Candidate, name: str, value: Any, draws: list[Any]) -> Any:
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return {
            entry: _interval(part, entry, number, [draw.get(entry, 0.0) for draw in draws])
            for entry, number in value.items()
        }
    if name == "time_s" and isinstance(part, JumpCandidate):
        return Interval(float(value), part.from_s, part.to_s)
    if isinstance(part, SaturationCandidate):
        # Where readings pile up is known to the noise of one of them.
        return Interval(float(value), float(value) - part.noise, float(value) + part.noise)
    low, high = np.quantile(np.array(draws, dtype=float), [0.025, 0.975], axis=0)
    if isinstance(value, list | tuple):
        return [
            Interval(float(v), float(a), float(b)) for v, a, b in zip(value, low, high, strict=True)
        ]
    return Interval(float(value), float(low), float(high))
