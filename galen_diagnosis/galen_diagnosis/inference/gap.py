# SPDX-License-Identifier: Apache-2.0
"""How far the gap shrinks on blocks that no fit has seen, and the numbers found, with intervals.

**Gap.** Blocks (a pose with its move, three seconds) are dealt to folds; effects, unknowns and a
healthy arm's tolerances are fitted on the others, and the simulator with the effects predicts the
one held out. "Before" is the same arm without the effects: its tolerances stay as fitted beside
them, unknowns are fitted anew, so that tolerances neither close a gap nor hide that it is closed.
With mean squares E of whitened rows, before, after and of noise alone,

    closed fraction = (E_before - E_after) / (E_before - E_floor),

with an interval from drawing blocks with replacement, before and after from the same draw. What
isn't a number of a fit was chosen on all blocks: which effects, in which form, when a jump was, how
white the noise is. Loads beyond a clipped axis are fitted to the block held out itself.

**Numbers.** A fit's covariance counts every row as independent. What a model leaves is not, so
intervals take the larger of Laplace's covariance and the sandwich over blocks (White, Econometrica
50, 1982; Liang and Zeger, Biometrika 73, 1986),

    H^-1 (sum_b g_b g_b^T) H^-1,    g_b = J_b^T r_b,

with J the effects' columns less what the background takes of them. Nor is an effect's model quite
the arm's: what it may be off (`discrepancy.py`) is part of the background here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background
from scipy.sparse import csc_array, diags_array

from galen_diagnosis.answer.answer import Interval
from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.refine import Hypothesis, refine
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import FOLDS, ResidualRows

_DRAWS = 400
_GAP_SEED, _PARAMETER_SEED = 20191, 1956


@dataclass(frozen=True)
class Gap:
    """before, after (N,): held-out rows; floor: mean square of noise; the closed fraction.

    fraction is None where nothing is closed: without effects, or E_before isn't above the floor.
    """

    before: Array
    after: Array
    floor: float
    fraction: Interval | None

    def to_json(self) -> dict[str, object]:
        """Return the contract's `gap`: mean squares in units of the noise."""
        return {
            "before": {"mean_square": float(np.mean(self.before**2))},
            "after": {"mean_square": float(np.mean(self.after**2))},
            "floor": {"mean_square": self.floor},
            "closed_fraction": None if self.fraction is None else self.fraction.to_json(),
        }


def held_out_gap(
    observation: Observation,
    hypothesis: Hypothesis,
    behind: Background,
    floor: float,
    progress: Callable[[str, float], None] | None = None,
) -> Gap:
    """Predict every row from the folds that it isn't in; the fit starts at the hypothesis'.

    Args:
        observation: What was measured.
        hypothesis: Effects as fitted to all rows.
        behind: Unknowns and tolerances.
        floor: Mean square of a row that noise alone gives.
        progress: Called with the part and the share of the whole, 0 ... 1.

    Returns:
        Rows without and with the effects, and the closed fraction.

    """
    rows = observation.rows
    before, after = np.zeros(len(rows)), np.zeros(len(rows))
    for fold in range(FOLDS):
        if progress is not None:
            progress(f"held out, part {fold + 1} of {FOLDS}", 0.9 + 0.02 * fold)
        out = rows.fold == fold
        if not out.any() or out.all():
            continue
        fitted = refine(
            observation,
            _only(behind, ~out),
            hypothesis.parts,
            hypothesis.values,
            ~out,
            none_cost=0.0,
            nuisance=hypothesis.nuisance,
        )
        first = observation.unknowns
        healthy = behind.times(np.concatenate([np.zeros(first), fitted.background[first:]]))
        before[out] = without_unknowns(observation, behind, observation.nominal - healthy, out)
        everywhere = observation.residual(fitted.effects, fitted.unknowns) - healthy
        for part in fitted.parts:
            if part.inputs and part.columns is not None and part.columns.shape[1]:
                beyond = part.columns[out]
                seen = np.any(beyond != 0.0, axis=0)
                loads = np.linalg.lstsq(beyond[:, seen], everywhere[out], rcond=None)[0]
                everywhere[out] -= beyond[:, seen] @ loads
        after[out] = everywhere[out]
    if not hypothesis.parts:
        return Gap(before, after, floor, None)
    return Gap(before, after, floor, closed_fraction(rows, before, after, floor))


def closed_fraction(
    rows: ResidualRows, before: Array, after: Array, floor: float
) -> Interval | None:
    """Return which part of the gap is closed, with its interval by drawing blocks.

    Args:
        rows: N rows.
        before: Held-out rows without the effects, (N,).
        after: The same with them, (N,).
        floor: Mean square of a row that noise alone gives.

    Returns:
        1 for all; None where what is before isn't above the floor.

    """
    blocks = int(rows.block.max()) + 1
    sums = [np.bincount(rows.block, part, blocks) for part in (before**2, after**2)]
    number = np.bincount(rows.block, minlength=blocks).astype(float)
    value = _fraction(sums[0].sum(), sums[1].sum(), floor * number.sum())
    chance = 3.0 * floor * np.sqrt(2.0 * len(before))
    if sums[0].sum() - floor * number.sum() <= chance or value is None:
        return None
    generator = np.random.default_rng(_GAP_SEED)
    draws = generator.integers(0, blocks, (_DRAWS, blocks))
    fractions = [
        _fraction(sums[0][draw].sum(), sums[1][draw].sum(), floor * number[draw].sum())
        for draw in draws
    ]
    known = np.array([one for one in fractions if one is not None])
    if len(known) < _DRAWS // 2:
        return Interval(value, None, None)
    low, high = np.quantile(known, [0.025, 0.975])
    return Interval(value, float(low), float(high))


def _fraction(before: float, after: float, floor: float) -> float | None:
    return None if before <= floor else float((before - after) / (before - floor))


def without_unknowns(
    observation: Observation, behind: Background, rows: Array, out: np.ndarray
) -> Array:
    """Return rows held out, less the unknowns as fitted to the other rows.

    Args:
        observation: What was measured.
        behind: Unknowns first, then what else is fitted beside every cause.
        rows: All rows, (N,) or (N, k).
        out: Which of them are held out, (N,) bool.

    Returns:
        The m rows held out, (m,) or (m, k).

    """
    unknown = behind.first(observation.unknowns)
    fitted = _only(unknown, ~out).fit(rows)
    return np.asarray((rows - unknown.times(fitted))[out])


def _only(behind: Background, keep: np.ndarray) -> Background:
    return behind.averaged(diags_array(keep.astype(float), format="csc"))


# Numbers


def covariance(
    observation: Observation, behind: Background, off: csc_array, hypothesis: Hypothesis
) -> Array:
    """Return the covariance of a hypothesis' numbers: Laplace's, or the sandwich.

    Args:
        observation: Its blocks are the sandwich's.
        behind: Unknowns and tolerances.
        off: What the effects' models may be off, (N, M).
        hypothesis: Effects as fitted.

    Returns:
        Covariance of all numbers in their order, (p, p).

    """
    if not hypothesis.parts:
        return hypothesis.covariance
    columns = hypothesis.columns
    prior = np.linalg.pinv(hypothesis.covariance, hermitian=True)
    prior = prior - behind.reduced(columns, hypothesis.raw_rows)[0]
    beside = behind.beside(off, 1.0)
    own = beside.left(columns)
    precision = own.T @ columns + np.diag(np.maximum(np.diag(prior), 0.0))
    laplace = np.linalg.pinv(0.5 * (precision + precision.T), hermitian=True)
    return sandwich(observation.rows.block, own, beside.left(hypothesis.raw_rows), laplace)


def sandwich(block: np.ndarray, own: Array, left: Array, laplace: Array) -> Array:
    """Return Laplace's covariance, widened to the sandwich's deviations where they are more.

    Args:
        block: Number of each row's block, (N,).
        own: Columns less what the background takes of them, (N, p).
        left: Rows after the fit, (N,).
        laplace: Laplace's covariance, (p, p).

    Returns:
        Covariance with the same correlations, (p, p).

    """
    order = np.argsort(block, kind="stable")
    edges = np.flatnonzero(np.diff(block[order])) + 1
    weighted = own[order] * left[order, None]
    scores = np.add.reduceat(weighted, np.concatenate([[0], edges]), axis=0)
    bread = laplace @ scores.T
    squares = np.einsum("ij,ij->i", bread, bread)
    widen = np.sqrt(np.maximum(squares / np.maximum(np.diag(laplace), 1e-300), 1.0))
    return np.asarray(laplace * np.outer(widen, widen))


def parameters(
    observation: Observation, hypothesis: Hypothesis, spread: Array
) -> list[dict[str, Any]]:
    """Return the contract's parameters of each effect, with intervals.

    Args:
        observation: What was measured.
        hypothesis: Effects as fitted.
        spread: Covariance of all its numbers, (p, p).

    Returns:
        Parameters by name, for each effect.

    """
    generator = np.random.default_rng(_PARAMETER_SEED)
    each = zip(hypothesis.parts, hypothesis.values, hypothesis.slices(), strict=True)
    return [
        parameters_of(observation, part, values, drawn(values, spread[where, where], generator))
        for part, values, where in each
    ]


def drawn(values: Array, spread: Array, generator: np.random.Generator) -> Array:
    """Draw numbers of a normal distribution.

    Args:
        values: Mean, (p,).
        spread: Covariance, (p, p).
        generator: Random generator, advanced by 400 p numbers.

    Returns:
        400 draws, (400, p).

    """
    return np.asarray(values + generator.standard_normal((_DRAWS, len(values))) @ _root(spread))


def parameters_of(
    observation: Observation, part: Candidate, values: Array, numbers: Array
) -> dict[str, Any]:
    """Return the contract's parameters of one effect, with intervals.

    Args:
        observation: What was measured.
        part: The effect's form.
        values: Its fitted numbers, (p,).
        numbers: Draws of them, (n, p), whose quantiles are the intervals.

    Returns:
        Parameters by name: intervals, lists or mappings of them, and words as they are.

    """
    named_by = record_of(part.effect).parameters
    draws = [named_by(observation, part.at(one)) for one in numbers]
    return {
        name: _interval(part, name, value, [draw[name] for draw in draws if name in draw])
        for name, value in named_by(observation, part.at(values)).items()
    }


def _root(spread: Array) -> Array:
    """Return the symmetric root, which is unique: the signs of eigenvectors are not."""
    values, vectors = np.linalg.eigh(spread)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _interval(part: Candidate, name: str, value: Any, draws: list[Any]) -> Any:
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return {
            # A draw that is the nominal arm names no entry.
            entry: _interval(part, entry, number, [d[entry] for d in draws if entry in d] or number)
            for entry, number in value.items()
        }
    if name in part.known:
        return Interval(float(value), *part.known[name])
    every = np.array(draws, dtype=float)
    if name == "phase_rad":
        every = value + np.angle(np.exp(1j * (every - value)))
    low, high = np.quantile(every, [0.025, 0.975], axis=0)
    if isinstance(value, list | tuple):
        return [
            Interval(float(v), float(a), float(b)) for v, a, b in zip(value, low, high, strict=True)
        ]
    return Interval(float(value), float(low), float(high))
