# SPDX-License-Identifier: Apache-2.0
"""From what a search in a joint's runs found to the contract's answer.

Gaps are on blocks that no fit has seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.answer.answer import NONE, SURE, UNKNOWN, Answer, FoundCause, Interval, Verdict
from galen_diagnosis.report.words import sentence
from galen_diagnosis.tables.joint_evidence import (
    BlockEvidence,
    BlockHypothesis,
    LagRows,
    SearchResult,
    search,
)

_LAG = "lag"
_PART = 0.5
_DRAWS = 2000
_SEED = 0
_DISTINCT = 3.3
"""Sigma: below it two hypotheses can't be distinguished."""
_ABOVE_FLOOR = 1.25**2


def diagnose_runs(
    name: str, rows: LagRows, progress: Callable[[str], None] | None = None
) -> Answer:
    """Search, and return verdict, causes with intervals, gap before and after, where it lies.

    Args:
        name: Name of what is diagnosed.
        rows: Means of the lag, and the ways in which effects show.
        progress: Called with each hypothesis.

    Returns:
        The answer.

    """
    evidence = BlockEvidence(rows)
    found = search(evidence, progress)
    best = found.best
    # Without effects: if possible that of something unknown.
    bare = min((h for h in found.hypotheses if not h.effects), key=lambda h: h.floor_only)
    before = evidence.held_out(bare)
    after = evidence.held_out(best) if best.effects else before
    closed = closed_fraction(rows, before, after) if best.effects else None
    verdict = _verdict(found, closed)
    causes = [
        FoundCause(
            effect=effect,
            probability=round(found.inclusion[effect], 4),
            parameters=parameters,
            equivalent=found.equivalent.get(effect, ()),
            gap_closed=_alone(evidence, found, effect, before),
        )
        for effect, parameters in _parameters(evidence, best)
        if verdict not in (NONE, UNKNOWN) or found.inclusion[effect] >= SURE
    ]
    remains = not best.floor_only and np.mean(after**2) > _ABOVE_FLOOR
    if verdict == UNKNOWN or (best.effects and remains):
        pairs = zip(found.hypotheses, found.probability, strict=True)
        unknown = float(sum(share for one, share in pairs if not one.floor_only))
        causes.append(FoundCause(UNKNOWN, round(unknown, 4), {}, (), None))
    ranking = sorted(found.inclusion.items(), key=lambda item: -item[1])
    answer = Answer(
        recording=name,
        verdict=verdict,
        causes=tuple(causes),
        ranking=tuple((effect, round(share, 4)) for effect, share in ranking),
        where=_where(rows, before),
        gap={
            "before": _gap(rows, before),
            "after": _gap(rows, after),
            "floor": {"mean_square": 1.0, "rms": {_LAG: rows.floor}},
            "closed_fraction": None if closed is None else closed.to_json(),
        },
        cannot_tell=(*rows.cannot_tell, *_hidden(evidence)),
        notes=rows.notes,
    )
    return replace(answer, sentence=sentence(answer))


def closed_fraction(rows: LagRows, before: Array, after: Array) -> Interval:
    """Return (before - after) / (before - floor) of mean squares; 95 % by drawing blocks.

    Args:
        rows: n means of the lag.
        before: Held-out residuals without effects over the rows' floor, (n,).
        after: The same with them, (n,).

    Returns:
        1 for all of the gap.

    """
    blocks = len(rows.labels)
    sums = [np.bincount(rows.block, square, blocks) for square in (before**2, after**2)]
    totals = np.stack([*sums, np.bincount(rows.block, minlength=blocks)], axis=1)
    draws = np.random.default_rng(_SEED).integers(blocks, size=(_DRAWS, blocks))

    def fraction(total: Array) -> Array:
        square_before, square_after, count = total[..., 0], total[..., 1], total[..., 2]
        return np.asarray((square_before - square_after) / (square_before - count))

    low, high = np.nanquantile(fraction(totals[draws].sum(axis=1)), [0.025, 0.975])
    return Interval(float(fraction(totals.sum(axis=0))), float(low), float(high))


def _verdict(found: SearchResult, closed: Interval | None) -> Verdict:
    best = found.best
    if not best.effects:
        return "none" if best.floor_only else "unknown"
    if closed is not None and closed.high is not None and closed.high < _PART:
        return "unknown"
    sure = all(found.inclusion[effect] >= SURE for effect in best.effects)
    return "identified" if sure else "ambiguous"


def _hidden(evidence: BlockEvidence) -> list[str]:
    """Effects whose usual size is no more than what noise does to a fit."""
    return [
        f"{name}: its usual size would not show"
        for name, ways in evidence.rows.effects.items()
        if max(map(evidence.shows, ways)) < _DISTINCT
    ]


def _alone(
    evidence: BlockEvidence, found: SearchResult, effect: str, before: Array
) -> Interval | None:
    """Return what this effect closes by itself."""
    singles = [one for one in found.hypotheses if one.effects == (effect,)]
    if not singles:
        return None
    best = max(singles, key=lambda one: float(one.elpd.sum()))
    return closed_fraction(evidence.rows, before, evidence.held_out(best))


def _parameters(evidence: BlockEvidence, best: BlockHypothesis) -> list[tuple[str, dict[str, Any]]]:
    """Of each effect: its numbers with intervals.

    The interval is that of the fit's covariance or, where that is wider, of leaving out each block
    (Efron and Tibshirani, 1993, eq. 11.5), since blocks disagree by more than noise.
    """
    random = np.random.default_rng(_SEED)
    at = evidence.rows.nominal.size
    result = []
    for place, (effect, way) in enumerate(zip(best.effects, best.ways, strict=True)):
        part = slice(at, at + way.size)
        mean, covariance = best.fit.values[part], best.fit.covariance[part, part]
        drawn = random.multivariate_normal(mean, covariance, _DRAWS, method="eigh")
        folds = [weights[part] for ways, weights in best.folds if ways[place] is way]
        parameters = {
            name: _interval(number, mean, drawn, folds) for name, number in way.parameters.items()
        }
        result.append((effect, parameters))
        at += way.size
    return result


def _interval(
    number: Callable[[Array], Array], mean: Array, drawn: Array, folds: Sequence[Array]
) -> Interval:
    value = float(number(mean))
    low, high = np.quantile([float(number(one)) for one in drawn], [0.025, 0.975])
    wider = 1.0
    if len(folds) > 2:
        left_out = np.array([float(number(one)) for one in folds])
        about = left_out - left_out.mean()
        spread = np.sqrt((len(folds) - 1) / len(folds) * np.sum(about**2))
        wider = max(1.0, 1.96 * spread / max(0.5 * (high - low), 1e-300))
    return Interval(
        value, value - wider * (value - float(low)), value + wider * float(high - value)
    )


def _gap(rows: LagRows, residual: Array) -> dict[str, Any]:
    """Mean square in units of the noise; RMS in rad."""
    square = float(np.mean(residual**2))
    return {"mean_square": square, "rms": {_LAG: square**0.5 * rows.floor}}


def _where(rows: LagRows, before: Array) -> dict[str, Any]:
    """Shares of what is above the floor, by block."""
    beyond = np.maximum(np.bincount(rows.block, before**2 - 1.0, len(rows.labels)), 0.0)
    shares = beyond / max(beyond.sum(), 1e-300)
    poses = [
        {"pose": label, "share": float(share)}
        for label, share in zip(rows.labels, shares, strict=True)
    ]
    channels = {_LAG: float(np.mean(before**2) > 1.0)}
    return {"channels": channels, "bags": {}, "regimes": {}, "poses": poses}
