# SPDX-License-Identifier: Apache-2.0
"""Hypotheses: some effects together, fitted on the simulator itself.

Gauss and Newton's method on the penalised sum of squares

    F(theta, nu) = |r(theta, xi) - N nu|^2 + nu^T V^-1 nu + (theta - c)^T L^-1 (theta - c),

with r the rows under the effects' numbers theta, N nu as in `Background`, xi the pose of base_link
in the tracker, which is followed nonlinearly, c and L the prior of theta. A step that doesn't
lower F is halved. The evidence is Laplace's at the minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, factor
from galen_sim_driver.effects.effect import Effect
from scipy.linalg import cho_solve
from scipy.sparse import csc_array

from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns

_BASE = slice(6, 12)
_MOST_STEPS = 12
_ENOUGH = 0.02
_LEAST_SCALE, _MOST_SCALE = 0.1, 10.0


@dataclass(frozen=True)
class Hypothesis:
    """Effects together, as fitted.

    parts, values: candidates and their numbers; covariance (p, p) of all numbers in this order;
    columns (N, p): how the rows' prediction changes with them; effects; unknowns; background (n,):
    its columns' numbers, the unknowns' first; rows (N,) after the fit, background's part taken
    away; cost: F at the minimum; log_bayes: against none. nuisance (N, M): columns that were fitted
    beside on the way there.
    """

    parts: tuple[Candidate, ...]
    values: tuple[Array, ...]
    covariance: Array
    columns: Array
    effects: tuple[Effect, ...]
    unknowns: Unknowns
    background: Array
    rows: Array
    raw_rows: Array
    cost: float
    log_bayes: float
    nuisance: csc_array | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return tuple(part.effect for part in self.parts)

    def energies_explained(self) -> tuple[float, ...]:
        """Of each part theta_i^T cov_ii^-1 theta_i: by how much F rises without it, linearly."""
        energies = []
        for part, values, where in zip(self.parts, self.values, self.slices(), strict=True):
            off = values - part.start
            block = np.linalg.pinv(self.covariance[where, where], hermitian=True)
            energies.append(float(off @ block @ off))
        return tuple(energies)

    def changes(self, observation: Observation) -> list[Array]:
        """Return what each effect changes of the rows beside the others.

        Args:
            observation: What was measured.

        Returns:
            Changes in the rows' units, each (N,), in the effects' order.

        """
        whole = observation.change(self.effects)
        out = []
        for part, values, one in zip(self.parts, self.values, self.effects, strict=True):
            others = [other for other in self.effects if other is not one]
            alone = whole - observation.change(others) if others else whole
            out.append(alone + part.unsimulated(values))
        return out

    def slices(self) -> list[slice]:
        """Where each part's numbers are among all."""
        ends = np.cumsum([len(values) for values in self.values])
        return [
            slice(int(end) - len(values), int(end))
            for end, values in zip(ends, self.values, strict=True)
        ]


def nothing(observation: Observation, behind: Background) -> Hypothesis:
    """Return the fit of no effect.

    Args:
        observation: What was measured.
        behind: Unknowns and tolerances.

    Returns:
        A hypothesis without parts.

    """
    return refine(observation, behind, (), ())


def refine(
    observation: Observation,
    behind: Background,
    parts: Sequence[Candidate],
    start: Sequence[Array],
    keep: np.ndarray | None = None,
    none_cost: float | None = None,
    nuisance: csc_array | None = None,
) -> Hypothesis:
    """Fit effects together on the simulator.

    Args:
        observation: What was measured.
        behind: What is fitted beside; with `keep`, its other rows have to be zero.
        parts: Forms of the effects.
        start: Numbers of each form where the fit begins, (p,).
        keep: The rows that count, (N,) bool; None for all.
        none_cost: F without effects, from which the evidence counts; None to leave F out of it.
        nuisance: Columns (N, M) with unit priors that are fitted beside, too, on the way to the
            minimum; F, there, is without them.

    Returns:
        The hypothesis at the minimum of F, or after 12 steps.

    """
    weight = None if keep is None else keep.astype(float)
    whole = behind
    if nuisance is not None:
        shown = nuisance if weight is None else nuisance.multiply(weight[:, None]).tocsc()
        behind = behind.beside(shown, 1.0)
    sizes = [len(values) for values in start]  # of a limit that no push reaches, none
    cuts = np.cumsum(sizes)[:-1]
    theta = _joined(start)
    centre, typical = _joined([p.start for p in parts]), _joined([p.typical for p in parts])
    low, high = (_joined([part.limits()[k] for part in parts]) for k in (0, 1))
    scale = _scale(theta, centre, typical, sizes)

    def effects(numbers: Array) -> list[Effect]:
        split = np.split(numbers, cuts) if parts else []
        return [part.at(values) for part, values in zip(parts, split, strict=True)]

    def rows_at(numbers: Array, base: Array) -> Array:
        unknown = Unknowns(np.concatenate([np.zeros(6), base, np.zeros(UNKNOWNS - 12)]))
        rows = observation.residual(effects(numbers), unknown)
        for part, values in zip(parts, np.split(numbers, cuts) if parts else [], strict=True):
            rows = rows - part.unsimulated(values)
        return rows if weight is None else rows * weight

    def cost_of(rows: Array, numbers: Array) -> float:
        return behind.sum_of_squares(rows) + float(
            np.sum(((numbers - centre) / (typical * scale)) ** 2)
        )

    base = np.zeros(6)
    rows = rows_at(theta, base)
    cost = cost_of(rows, theta)
    columns = np.zeros((len(rows), len(theta)))
    projected = behind.projected(columns)
    linear = all(part.columns is not None for part in parts)
    for step in range(_MOST_STEPS):
        move = np.zeros(0)
        if parts:
            if step == 0 or (not linear and (step == 1 or step % 2 == 0)):
                columns = _jacobian(observation, parts, theta, cuts)
                if weight is not None:
                    columns = columns * weight[:, None]
                projected = behind.projected(columns)
            precision = np.diag(1.0 / (typical * scale) ** 2)
            towards = projected.along(rows) - precision @ (theta - centre)
            move = cho_solve(factor(projected.gram + precision), towards)
        nu = behind.fit(rows - columns @ move)
        turn = nu[_BASE]
        lowered = False
        for fraction in (1.0, 0.5, 0.25, 0.1):
            new_theta = np.clip(theta + fraction * move, low, high)
            new_base = base + fraction * turn
            new_rows = rows_at(new_theta, new_base)
            new_cost = cost_of(new_rows, new_theta)
            if new_cost < cost:
                lowered = True
                break
        if not lowered:
            break
        gained = cost - new_cost
        theta, base, rows, cost = new_theta, new_base, new_rows, new_cost
        new_scale = _scale(theta, centre, typical, sizes)
        if parts and not np.array_equal(new_scale, scale):
            scale = new_scale
            cost = cost_of(rows, theta)
            continue
        if gained < _ENOUGH:
            break
    if nuisance is not None:
        behind = whole
        cost = cost_of(rows, theta)
    nu = behind.fit(rows)
    after = rows - behind.times(nu)
    covariance = np.zeros((0, 0))
    log_bayes = 0.0
    if parts:
        spread = typical * scale
        inner = np.eye(len(theta)) + projected.gram * np.outer(spread, spread)
        covariance = np.linalg.inv(inner) * np.outer(spread, spread)
        log_bayes = -0.5 * float(np.linalg.slogdet(inner)[1])
    log_bayes += sum(part.bonus for part in parts)
    if none_cost is not None:
        log_bayes += 0.5 * (none_cost - cost)
    first = observation.unknowns
    unknown = nu[:first].copy()
    unknown[_BASE] += base
    split = tuple(np.split(theta, cuts)) if parts else ()
    return Hypothesis(
        tuple(parts),
        split,
        covariance,
        columns,
        tuple(effects(theta)),
        Unknowns(unknown),
        np.concatenate([unknown, nu[first:]]),
        after,
        rows,
        cost,
        log_bayes,
        nuisance,
    )


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate([np.zeros(0), *parts])


def _jacobian(
    observation: Observation,
    parts: Sequence[Candidate],
    theta: Array,
    cuts: np.ndarray,
) -> Array:
    split = np.split(theta, cuts)
    fixed = [part.at(values) for part, values in zip(parts, split, strict=True)]
    columns = []
    for number, (part, values) in enumerate(zip(parts, split, strict=True)):

        def with_values(own: Array, number: int = number, part: Candidate = part) -> list[Effect]:
            return [part.at(own) if k == number else other for k, other in enumerate(fixed)]

        columns.append(part.jacobian(observation, with_values, values))
    return np.concatenate(columns, axis=1)


def _scale(theta: Array, centre: Array, typical: Array, sizes: Sequence[int]) -> Array:
    """Return the prior's scale of each part, from its present size: one of 0.1, 0.3, 1, 3, 10."""
    out, at = [], 0
    for size in sizes:
        part = slice(at, at + size)
        if not size:
            continue
        ratio = float(np.sqrt(np.mean(((theta[part] - centre[part]) / typical[part]) ** 2)))
        level = 10.0 ** (0.5 * np.round(2.0 * np.log10(max(ratio, 1e-9))))
        out.append(np.full(size, np.clip(level, _LEAST_SCALE, _MOST_SCALE)))
        at += size
    return np.concatenate(out) if out else np.zeros(0)
