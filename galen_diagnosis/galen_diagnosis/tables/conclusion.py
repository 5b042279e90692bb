# SPDX-License-Identifier: Apache-2.0
"""From what a search found to the contract's answer, with gaps on blocks that no fit has seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.held_out import BlockEvidence, BlockHypothesis, BlockRows, Effects
from galen_model.evidence.search import SearchResult, search

from galen_diagnosis.answer.answer import NONE, SURE, UNKNOWN, Answer, FoundCause, Interval, Verdict
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.report.words import sentence

_PART = 0.5
_DRAWS = 2000
_SEED = 0
_PARTS = 3
_DISTINCT = 3.3
"""Sigma: below it two hypotheses can't be distinguished."""
_ABOVE_FLOOR = 1.25**2


def diagnose_blocks(
    name: str,
    rows: BlockRows,
    effects: Effects,
    notes: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Answer:
    """Search, and return verdict, causes with intervals, gap before and after, where it lies.

    Whole blocks are held out; with an effect of time among those found, thirds of blocks, and what
    is closed of whole blocks is beside it in the answer.

    Args:
        name: Name of what is diagnosed.
        rows: n readings of C channels.
        effects: Nominal columns, and the ways in which effects show.
        notes: How rows were made.
        progress: Called with each hypothesis.

    Returns:
        The answer.

    """
    evidence = BlockEvidence(rows, effects.nominal)
    found = search(evidence, effects, progress=progress)
    best = found.best
    bare = _bare(found)
    before = evidence.held_out(bare)
    after = before if not best.effects else evidence.held_out(best)
    floor = 1.0 if rows.floor_known else 0.0
    whole = closed_fraction(rows, before, after, floor) if best.effects else None
    parts = _in_parts(evidence, best)
    closed = whole
    if parts is not None:
        before, after = parts
        closed = closed_fraction(rows, before, after, floor)
    verdict = _verdict(found, closed, rows.floor_known)
    remains = not best.floor_only and np.mean(after**2) > max(floor, 1e-12) * _ABOVE_FLOOR
    causes = [
        FoundCause(
            effect=effect,
            probability=round(found.inclusion[effect], 4),
            parameters=parameters,
            equivalent=found.equivalent.get(effect, ()),
            gap_closed=_alone(evidence, found, effect, floor),
        )
        for effect, parameters in _parameters(evidence, best)
        if verdict not in (NONE, UNKNOWN) or found.inclusion[effect] >= SURE
    ]
    if verdict == UNKNOWN or (best.effects and remains and rows.floor_known):
        causes.append(FoundCause(UNKNOWN, round(_unexplained(found), 4), {}, (), None))
    ranking = sorted(found.inclusion.items(), key=lambda item: -item[1])
    no_floor = (
        "the noise isn't known (--noise): what hangs together with nothing is taken for it, closed"
        " fractions are of the whole residual"
    )
    answer = Answer(
        recording=name,
        verdict=verdict,
        causes=tuple(causes),
        ranking=tuple((effect, round(share, 4)) for effect, share in ranking),
        where=_where(rows, before, floor),
        gap={
            "before": _gap(rows, before),
            "after": _gap(rows, after),
            "floor": {"mean_square": floor, "rms": _named(rows, rows.floor * floor)},
            "closed_fraction": None if closed is None else closed.to_json(),
            "closed_fraction_of_whole_blocks": None if whole is None else whole.to_json(),
        },
        cannot_tell=(*effects.cannot_tell, *_hidden(evidence, effects)),
        problems=() if rows.floor_known else (no_floor,),
        notes=tuple(notes),
    )
    return replace(answer, sentence=sentence(answer))


def _bare(found: SearchResult) -> BlockHypothesis:
    """Return the hypothesis without effects, if possible that of something unknown."""
    return min((one for one in found.hypotheses if not one.effects), key=lambda one: one.floor_only)


def closed_fraction(rows: BlockRows, before: Array, after: Array, floor: float) -> Interval:
    """Return (before - after) / (before - floor) of mean squares; 95 % by drawing blocks.

    Channels count alike in units of the floor; where none is known, in units of what channels of
    the same unit had before.

    Args:
        rows: n readings of C channels.
        before: Held-out residuals without effects over the rows' floor, (n, C).
        after: The same with them, (n, C).
        floor: Mean square that noise alone gives a row; 0 where that isn't known.

    Returns:
        1 for all of the gap.

    """
    if not rows.floor_known:
        square = np.mean((before * rows.floor) ** 2, axis=0)
        alike = np.array([[a == b for b in rows.units] for a in rows.units])
        scale = np.sqrt(alike @ square / alike.sum(axis=1)) / rows.floor
        before, after = before / scale, after / scale
    blocks = len(rows.labels)
    squares = [np.bincount(rows.block, np.sum(x**2, axis=1), blocks) for x in (before, after)]
    count = np.bincount(rows.block, minlength=blocks) * before.shape[1]
    sums = np.stack([*squares, count], axis=1)
    draws = np.random.default_rng(_SEED).integers(blocks, size=(_DRAWS, blocks))

    def fraction(total: Array) -> Array:
        square_before, square_after, count = total[..., 0], total[..., 1], total[..., 2]
        return np.asarray((square_before - square_after) / (square_before - floor * count))

    low, high = np.nanquantile(fraction(sums[draws].sum(axis=1)), [0.025, 0.975])
    return Interval(float(fraction(sums.sum(axis=0))), float(low), float(high))


def _verdict(found: SearchResult, closed: Interval | None, floor_known: bool) -> Verdict:
    best = found.best
    if not best.effects:
        return "none" if best.floor_only else "unknown"
    sure = all(found.inclusion[effect] >= SURE for effect in best.effects)
    if closed is not None and closed.high is not None and closed.high < _PART:
        if floor_known or not best.floor_only:
            return "unknown"
        if not sure:  # the rest is noise, of which these may be
            return "none"
    return "identified" if sure else "ambiguous"


def _in_parts(evidence: BlockEvidence, best: BlockHypothesis) -> tuple[Array, Array] | None:
    """Before and after where thirds of blocks are held out; None but for effects of time.

    A bias drift's course in a block can't be predicted from other blocks, but from its other parts.
    """
    of_time = any(record_of(name).of_time for name in best.effects)
    if not of_time or len(evidence.rows) <= len(evidence.rows.labels):
        return None
    finer = BlockEvidence(evidence.rows.finer(_PARTS), evidence.nominal)
    bare = finer.hypothesis((), [()], False) or finer.hypothesis((), [()], True)
    again = finer.hypothesis(best.effects, [best.ways], best.floor_only)
    if bare is None or again is None:
        return None
    return finer.held_out(bare), finer.held_out(again)


def _hidden(evidence: BlockEvidence, effects: Effects) -> list[str]:
    """Effects whose usual size is no more than what noise does to a fit."""
    if not evidence.rows.floor_known:
        return []
    return [
        f"{name}: its usual size would not show"
        for name, ways in effects.of.items()
        if max(evidence.shows(way) for way in ways) < _DISTINCT
    ]


def _unexplained(found: SearchResult) -> float:
    """Probability that something unknown is there."""
    pairs = zip(found.hypotheses, found.probability, strict=True)
    return float(sum(share for one, share in pairs if not one.floor_only))


def _alone(
    evidence: BlockEvidence, found: SearchResult, effect: str, floor: float
) -> Interval | None:
    """Return what this effect closes by itself."""
    singles = [one for one in found.hypotheses if one.effects == (effect,)]
    if not singles:
        return None
    best = max(singles, key=lambda one: float(one.elpd.sum()))
    left = _in_parts(evidence, best)
    if left is None:
        left = evidence.held_out(_bare(found)), evidence.held_out(best)
    return closed_fraction(evidence.rows, *left, floor)


def _parameters(evidence: BlockEvidence, best: BlockHypothesis) -> list[tuple[str, dict[str, Any]]]:
    """Of each effect: its numbers with intervals.

    The interval is that of the fit's covariance or, where that is wider, of leaving out each block
    (Efron and Tibshirani, 1993, eq. 11.5), since blocks disagree by more than noise.
    """
    random = np.random.default_rng(_SEED)
    at = evidence.nominal.size
    result = []
    for place, (effect, way) in enumerate(zip(best.effects, best.ways, strict=True)):
        part = slice(at, at + way.size)
        mean, covariance = best.fit.values[part], best.fit.covariance[part, part]
        drawn = random.multivariate_normal(mean, covariance, _DRAWS, method="eigh")
        folds = [weights[part] for ways, weights in best.folds if ways[place] is way]
        parameters: dict[str, Any] = dict(way.words)
        for name, number in way.parameters.items():
            numbers = _interval(number, mean, drawn, folds)
            parameters[name] = numbers[0] if np.ndim(number(mean)) == 0 else numbers
        result.append((effect, parameters))
        at += way.size
    return result


def _interval(
    number: Callable[[Array], Array], mean: Array, drawn: Array, folds: Sequence[Array]
) -> list[Interval]:
    value = np.atleast_1d(number(mean))
    numbers = np.array([np.atleast_1d(number(one)) for one in drawn])
    low, high = np.quantile(numbers, [0.025, 0.975], axis=0)
    wider = np.ones(len(value))
    if len(folds) > 2:
        left_out = np.array([np.atleast_1d(number(one)) for one in folds])
        about = left_out - left_out.mean(axis=0)
        spread = np.sqrt((len(folds) - 1) / len(folds) * np.sum(about**2, axis=0))
        wider = np.maximum(wider, 1.96 * spread / np.maximum(0.5 * (high - low), 1e-300))
    return [
        Interval(float(v), float(v - k * (v - a)), float(v + k * (b - v)))
        for v, a, b, k in zip(value, low, high, wider, strict=True)
    ]


def _named(rows: BlockRows, values: Array) -> dict[str, float]:
    return {name: float(value) for name, value in zip(rows.channels, values, strict=True)}


def _gap(rows: BlockRows, residual: Array) -> dict[str, Any]:
    """Mean square in units of the noise; RMS of each channel in its own unit."""
    rms = np.sqrt(np.mean(residual**2, axis=0)) * rows.floor
    return {"mean_square": float(np.mean(residual**2)), "rms": _named(rows, rms)}


def _where(rows: BlockRows, before: Array, floor: float) -> dict[str, Any]:
    """Shares of what is above the floor, by channel and by block."""
    by_channel = np.maximum(np.mean(before**2, axis=0) - floor, 0.0)
    beyond = np.sum(before**2 - floor, axis=1)
    by_block = np.maximum(np.bincount(rows.block, beyond, len(rows.labels)), 0.0)
    shares = by_block / max(by_block.sum(), 1e-300)
    return {
        "channels": _named(rows, by_channel / max(by_channel.sum(), 1e-300)),
        "bags": {},
        "regimes": {},
        "poses": [
            {"pose": label, "share": float(share)}
            for label, share in zip(rows.labels, shares, strict=True)
        ],
    }
