# SPDX-License-Identifier: Apache-2.0
"""How well an experiment would separate hypotheses, before it is done.

A hypothesis i is some effects with parameters theta_i, known to the covariance C_i. Linearised
there, what its experiment would show (`galen_diagnosis.experiment.trial.signature`, in units of
the noise) is

    y = d_i + S_i dtheta + L a + N b + e,   dtheta ~ N(0, C_i), a ~ N(0, 1), b free, e ~ N(0, 1)

with N the nuisances that are free and L those of which something is known. With all projected on
the complement of N, y is normal with mean d_i and covariance V_i = 1 + S_i C_i S_i^T + L L^T. Where
i is the truth, what hypothesis j leaves after its parameters were fitted again is

    D_ij^2 = min over dtheta, a of |d_i - d_j - S_j dtheta - L a|^2 + |C_j^-1/2 dtheta|^2 + |a|^2
           = (d_i - d_j)^T V_j^-1 (d_i - d_j)

(Woodbury). For two hypotheses without free parameters the error rate of the better choice is
Phi(-D/2). `expected_probability` is the probability that the truth would have after the experiment,
mean over truths by their probabilities and over the noise: of these hypotheses alone, and as far as
their models are the arm's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_sim_driver.effects.effect import Effect

from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.experiment.trial import Trial, free_columns, load_columns, signature

_STEP = 1e-2
_DRAWS = 256
_SEED = 6
_EXCHANGES = 4
_RIDGE = 1e-9


@dataclass(frozen=True)
class Alternative:
    """A hypothesis that is left: effects as fitted, none for "nothing is missing".

    covariance (k, k): of all their `vector()`s one after the other.
    """

    effects: tuple[Effect, ...]
    probability: float
    covariance: Array

    @property
    def name(self) -> str:
        """As it is called in sentences."""
        return " and ".join(effect.identity for effect in self.effects) or "none"

    def vector(self) -> Array:
        """Return all parameters (k,)."""
        return np.concatenate([np.zeros(0), *(effect.vector() for effect in self.effects)])

    def with_vector(self, vector: Array) -> tuple[Effect, ...]:
        """Return the effects with other numbers.

        Args:
            vector: All their `vector()`s one after the other, (k,).

        Returns:
            The effects in the same order.

        """
        effects, at = [], 0
        for effect in self.effects:
            size = len(effect.vector())
            effects.append(effect.with_vector(vector[at : at + size]))
            at += size
        return tuple(effects)

    def spread(self) -> Array:
        """Return the symmetric square root (k, k) of the covariance."""
        values, vectors = np.linalg.eigh(np.asarray(self.covariance, dtype=float))
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)

    def in_another_session(self) -> Alternative:
        """Return what stays of it when something else is recorded.

        A jump or a shift happened once. A bias drift goes on, but not as before: its rate is only
        known to be about as large.
        """
        effects: list[Effect] = []
        kept: list[int] = []
        loose: list[tuple[int, float]] = []
        at = 0
        for effect in self.effects:
            vector = effect.vector()
            rows = range(at, at + len(vector))
            at += len(vector)
            record = RECORDS.get(effect.name)
            if record is not None and record.jump is not None:
                continue
            later = effect if record is None else record.later(effect)
            if later is not effect:
                loose += zip(rows, vector.tolist(), strict=True)
            effects.append(later)
            kept += rows
        covariance = np.array(self.covariance, dtype=float)
        for row, size in loose:
            alone = covariance[row, row] + size**2
            covariance[row, :] = covariance[:, row] = 0.0
            covariance[row, row] = alone
        return Alternative(tuple(effects), self.probability, covariance[np.ix_(kept, kept)])


def typical_sizes(effects: Sequence[Effect]) -> Array:
    """Return the fitted parameters' usual sizes.

    Args:
        effects: Effects of one hypothesis.

    Returns:
        Sizes in the order of the effects' numbers, (k,), in the parameters' units.

    """
    sizes = [part.typicals for effect in effects for part in effect.fitted]
    return np.concatenate([np.zeros(0), *sizes])


def linearise(trials: Sequence[Trial], alternative: Alternative) -> tuple[Array, Array]:
    """Return what a hypothesis shows in an experiment, and how that changes by its numbers.

    By central differences, a hundredth of a parameter's typical size to either side.

    Args:
        trials: The experiment's recordings.
        alternative: The hypothesis, with the covariance of its numbers.

    Returns:
        Signature (n,), and columns for deviations of unit variance, (n, k), in units of the noise.

    """

    def shown(vector: Array) -> Array:
        effects = alternative.with_vector(vector)
        return np.concatenate([signature(trial, effects) for trial in trials])

    at = alternative.vector()
    here = shown(at)
    slope = np.zeros((len(here), len(at)))
    for k, typical in enumerate(typical_sizes(alternative.effects)):
        step = np.zeros(len(at))
        step[k] = _STEP * typical
        slope[:, k] = (shown(at + step) - shown(at - step)) / (2.0 * step[k])
    return here, slope @ alternative.spread()


def separate(
    trials: Sequence[Trial], alternatives: Sequence[Alternative], tool: CalibrationFile
) -> tuple[Array, float]:
    """Return how well an experiment separates hypotheses.

    Args:
        trials: The experiment's recordings.
        alternatives: h hypotheses with their probabilities.
        tool: The tool's file, whose load is known to its covariance.

    Returns:
        D_ij (h, h) of truth i, hypothesis j, and the expected probability of the truth.

    """
    linear = [linearise(trials, alternative) for alternative in alternatives]
    free, _ = np.linalg.qr(free_columns(trials))
    columns = [part for shown, spread in linear for part in (shown[:, None], spread)]
    stacked = np.hstack([*columns, load_columns(trials, tool)])
    stacked -= free @ (free.T @ stacked)
    # All that differs lies in the columns' own space; the noise stays white there.
    reduced = np.linalg.qr(stacked, mode="r")
    ends = np.cumsum([part.shape[1] for part in columns])
    parts = np.split(reduced, ends, axis=1)
    means = [parts[2 * k][:, 0] for k in range(len(linear))]
    known = parts[-1] @ parts[-1].T + np.eye(len(reduced))
    covariances = [parts[2 * k + 1] @ parts[2 * k + 1].T + known for k in range(len(linear))]
    distance = np.array(
        [
            [_length(one - other, within) for other, within in zip(means, covariances, strict=True)]
            for one in means
        ]
    )
    prior = np.array([alternative.probability for alternative in alternatives])
    return distance, _expected(means, covariances, prior / prior.sum())


def _length(difference: Array, covariance: Array) -> float:
    square = float(difference @ np.linalg.solve(covariance, difference))
    return math.sqrt(max(square, 0.0))


def _expected(means: Sequence[Array], covariances: Sequence[Array], prior: Array) -> float:
    """Probability of the truth after the experiment, by draws that are the same at each call."""
    roots = [np.linalg.cholesky(covariance) for covariance in covariances]
    inverses = [np.linalg.inv(root) for root in roots]
    normal = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(means[0])))
    normal = np.concatenate([normal, -normal])
    expected = 0.0
    for truth, probability in enumerate(prior):
        drawn = means[truth] + normal @ roots[truth].T
        log = np.stack(
            [
                np.log(prior[k])
                - 0.5 * np.sum(((drawn - means[k]) @ inverses[k].T) ** 2, axis=1)
                - np.sum(np.log(np.diag(roots[k])))
                for k in range(len(means))
            ]
        )
        weight = np.exp(log - log.max(axis=0))
        expected += probability * float(np.mean(weight[truth] / weight.sum(axis=0)))
    return expected


def choose_units(
    trial: Trial, alternatives: Sequence[Alternative], tool: CalibrationFile, count: int
) -> list[int]:
    """Choose the units (poses, positions) of a trial that make the smallest D_ij largest.

    Everything that D holds are sums over units; so poses are taken one by one, the best first, and
    then exchanged until none is better (Fedorov's exchange, as in `galen_model.poses.design`).

    Args:
        trial: A recording of all units that there are to choose from.
        alternatives: Two or more hypotheses.
        tool: The tool's file, whose load is known to its covariance.
        count: How many units; at most all.

    Returns:
        Numbers of the units, sorted.

    """
    linear = [linearise([trial], alternative) for alternative in alternatives]
    free, known = free_columns([trial]), load_columns([trial], tool)
    units = int(trial.row_units.max()) + 1
    order = np.argsort(trial.row_units, kind="stable")
    sizes = np.bincount(trial.row_units, minlength=units)
    pairs = []
    for i, one in enumerate(linear):
        for j, other in enumerate(linear):
            if i != j:
                rows = np.column_stack([one[0] - other[0], other[1], known, free])
                parts = np.split(rows[order], np.cumsum(sizes)[:-1])
                sums = np.stack([part.T @ part for part in parts])
                weak = np.ones(rows.shape[1] - 1)
                weak[-free.shape[1] :] = _RIDGE * np.trace(sums.sum(axis=0)[1:, 1:])
                pairs.append((sums, np.diag(weak)))

    def worth(some: list[int], more: Array) -> Array:
        """Smallest D^2 (u,) with each of `more` beside some."""
        values = np.full(len(more), np.inf)
        for sums, prior in pairs:
            total = sums[some].sum(axis=0) + sums[more]
            right = total[:, 1:, 0]
            fitted = np.linalg.solve(total[:, 1:, 1:] + prior, right[..., None])[..., 0]
            values = np.minimum(values, total[:, 0, 0] - np.sum(right * fitted, axis=1))
        return values

    everything = np.arange(units)
    chosen: list[int] = []
    while len(chosen) < min(count, units):
        left = np.setdiff1d(everything, chosen)
        chosen.append(int(left[np.argmax(worth(chosen, left))]))
    for _ in range(_EXCHANGES):
        before = list(chosen)
        for place in range(len(chosen)):
            rest = chosen[:place] + chosen[place + 1 :]
            left = np.setdiff1d(everything, rest)
            chosen[place] = int(left[np.argmax(worth(rest, left))])
        if chosen == before:
            break
    return sorted(chosen)
