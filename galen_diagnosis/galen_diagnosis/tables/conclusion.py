"""From what a search found to the contract's answer, with gaps on blocks that no fit has seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.blocks import BlockRows, Effects
from galen_model.evidence.held_out import BlockEvidence, BlockHypothesis
from galen_model.evidence.search import SearchResult

from galen_diagnosis.answer.answer import NONE, UNKNOWN, Answer, Cause, Interval, Verdict

SURE = 0.9
"""Probability from which an effect counts as found."""
_PART = 0.5
_NAMED = 0.05
_DRAWS = 2000
_PARTS = 3
_TOLD_APART = 3.3
"""Sigma: below it two hypotheses can't be told apart."""
_OF_TIME = {"sensor_drift", "bias_step"}
_ABOVE_FLOOR = 1.25**2


@dataclass(frozen=True)
class BlockDiagnosis:
    """The answer and the residuals behind it, in units of the floor: before, after (n, C)."""

    answer: Answer
    rows: BlockRows
    before: Array
    after: Array
    found: SearchResult
    words: tuple[str, ...]


def conclude(
    name: str,
    evidence: BlockEvidence,
    found: SearchResult,
    effects: Effects,
    words: Sequence[str] = (),
    seed: int = 0,
) -> BlockDiagnosis:
    """Verdict, causes with intervals, gap before and after, where it lies.

    Whole blocks are held out; with an effect of time among those found, thirds of blocks, and what
    is closed of whole blocks is told beside.
    """
    cannot_tell = effects.cannot_tell
    rows, best = evidence.rows, found.best
    bare = min((one for one in found.hypotheses if not one.effects), key=lambda one: one.floor_only)
    before = evidence.held_out(bare)
    after = before if not best.effects else evidence.held_out(best)
    floor = 1.0 if rows.floor_known else 0.0
    whole = closed_fraction(rows, before, after, floor, seed) if best.effects else None
    parts = _in_parts(evidence, best)
    closed = whole
    if parts is not None:
        before, after = parts
        closed = closed_fraction(rows, before, after, floor, seed)
    verdict = _verdict(found, closed)
    remains = not best.floor_only and _mean_square(after) > max(floor, 1e-12) * _ABOVE_FLOOR
    causes = [
        Cause(
            effect=effect,
            probability=round(found.inclusion[effect], 4),
            parameters=told,
            equivalent=found.equivalent.get(effect, ()),
            gap_closed=_alone(evidence, found, effect, floor, seed),
            extra=extra,
        )
        for effect, told, extra in _parameters(evidence, best, seed)
        if verdict != UNKNOWN or found.inclusion[effect] >= SURE
    ]
    if verdict == UNKNOWN or (best.effects and remains and rows.floor_known):
        causes.append(Cause(UNKNOWN, round(_rest(found), 4), {}, (), None))
    ranking = sorted(found.inclusion.items(), key=lambda item: -item[1])
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
        next_experiment=None,
        sentence=_sentence(
            verdict, found, closed, None if parts is None else whole, remains and rows.floor_known
        ),
        cannot_tell=(*cannot_tell, *_hidden(evidence, effects)),
        problems=()
        if rows.floor_known
        else ("the noise floor isn't known: closed fractions are of the whole residual",),
    )
    return BlockDiagnosis(answer, rows, before, after, found, tuple(words))


def closed_fraction(
    rows: BlockRows, before: Array, after: Array, floor: float, seed: int = 0
) -> Interval:
    """(before - after) / (before - floor) of mean squares; 95 % by drawing blocks.

    Channels count alike in units of the floor; where none is known, in units of what channels of
    the same unit had before.
    """
    if not rows.floor_known:
        square = np.mean((before * rows.floor) ** 2, axis=0)
        alike = np.array([[a == b for b in rows.units] for a in rows.units])
        scale = np.sqrt(alike @ square / alike.sum(axis=1)) / rows.floor
        before, after = before / scale, after / scale
    blocks = len(rows.labels)
    sums = np.array(
        [
            [
                np.sum(before[rows.block == b] ** 2),
                np.sum(after[rows.block == b] ** 2),
                np.sum(rows.block == b) * before.shape[1],
            ]
            for b in range(blocks)
        ]
    )
    draws = np.random.default_rng(seed).integers(blocks, size=(_DRAWS, blocks))

    def fraction(total: Array) -> Array:
        square_before, square_after, count = total[..., 0], total[..., 1], total[..., 2]
        return np.asarray((square_before - square_after) / (square_before - floor * count))

    low, high = np.nanquantile(fraction(sums[draws].sum(axis=1)), [0.025, 0.975])
    return Interval(float(fraction(sums.sum(axis=0))), float(low), float(high))


def _verdict(found: SearchResult, closed: Interval | None) -> Verdict:
    best = found.best
    if not best.effects:
        return "none" if best.floor_only else "unknown"
    if closed is not None and closed.high is not None and closed.high < _PART:
        return "unknown"
    if all(found.inclusion[effect] >= SURE for effect in best.effects):
        return "identified"
    return "ambiguous"


def _in_parts(evidence: BlockEvidence, best: BlockHypothesis) -> tuple[Array, Array] | None:
    """Before and after where thirds of blocks are held out; None but for effects of time.

    Nobody predicts a bias drift's course in a stop from other stops; from the rest of the stop one
    can.
    """
    if not _OF_TIME & set(best.effects) or len(evidence.rows) <= len(evidence.rows.labels):
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
        if max(evidence.shows(way) for way in ways) < _TOLD_APART
    ]


def _rest(found: SearchResult) -> float:
    """Probability that something is left that nobody knows."""
    return float(
        sum(
            share
            for one, share in zip(found.hypotheses, found.probability, strict=True)
            if not one.floor_only
        )
    )


def _alone(
    evidence: BlockEvidence,
    found: SearchResult,
    effect: str,
    floor: float,
    seed: int,
) -> Interval | None:
    """What this effect closes by itself."""
    singles = [one for one in found.hypotheses if one.effects == (effect,)]
    if not singles:
        return None
    best = max(singles, key=lambda one: float(one.elpd.sum()))
    bare = min((one for one in found.hypotheses if not one.effects), key=lambda one: one.floor_only)
    left = _in_parts(evidence, best) or (evidence.held_out(bare), evidence.held_out(best))
    return closed_fraction(evidence.rows, *left, floor, seed)


# --- parameters ---------------------------------------------------------------------------------


def _parameters(
    evidence: BlockEvidence, best: BlockHypothesis, seed: int
) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Of each effect: its numbers with intervals, and those that the contract doesn't name.

    The interval is that of the fit's covariance or, where that is wider, of leaving out each block
    (Efron and Tibshirani, 1993, eq. 11.5), since blocks disagree by more than noise.
    """
    random = np.random.default_rng(seed)
    at = evidence.nominal.size
    result = []
    for place, (effect, way) in enumerate(zip(best.effects, best.ways, strict=True)):
        part = slice(at, at + way.size)
        mean, covariance = best.fit.values[part], best.fit.covariance[part, part]
        drawn = random.multivariate_normal(mean, covariance, _DRAWS, method="eigh")
        folds = [fit.values[part] for ways, fit in best.folds if ways[place] is way]
        told: dict[str, Any] = dict(way.words)
        extra: dict[str, Any] = {}
        for name, number in way.parameters.items():
            numbers = _interval(number, mean, drawn, folds)
            if name in way.beyond:
                extra[name] = [one.to_json() for one in numbers]
            else:
                told[name] = numbers[0] if np.ndim(number(mean)) == 0 else numbers
        result.append((effect, told, extra))
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


# --- where and how much -------------------------------------------------------------------------


def _mean_square(residual: Array) -> float:
    return float(np.mean(residual**2))


def _named(rows: BlockRows, values: Array) -> dict[str, float]:
    return {name: float(value) for name, value in zip(rows.channels, values, strict=True)}


def _gap(rows: BlockRows, residual: Array) -> dict[str, Any]:
    """Mean square in units of the noise; RMS of each channel in its own unit."""
    rms = np.sqrt(np.mean(residual**2, axis=0)) * rows.floor
    return {"mean_square": _mean_square(residual), "rms": _named(rows, rms)}


def _where(rows: BlockRows, before: Array, floor: float) -> dict[str, Any]:
    """Shares of what is above the floor, by channel and by block."""
    by_channel = np.maximum(np.mean(before**2, axis=0) - floor, 0.0)
    by_block = np.array(
        [
            max(float(np.sum(before[rows.block == b] ** 2 - floor)), 0.0)
            for b in range(len(rows.labels))
        ]
    )
    return {
        "channels": _named(rows, by_channel / max(by_channel.sum(), 1e-300)),
        "bags": {},
        "regimes": {},
        "poses": [
            {"pose": label, "share": float(share)}
            for label, share in zip(
                rows.labels, by_block / max(by_block.sum(), 1e-300), strict=True
            )
        ],
    }


def _sentence(
    verdict: Verdict,
    found: SearchResult,
    closed: Interval | None,
    whole: Interval | None,
    remains: bool,
) -> str:
    best = found.best
    if verdict == NONE:
        return "Nothing above the noise: the nominal model holds on blocks that it hasn't seen."
    sure = [effect for effect in best.effects if found.inclusion[effect] >= SURE]
    if verdict == UNKNOWN and not sure:
        return "Something is missing, and no effect on the list explains it."
    named = " and ".join(
        f"{effect} ({100 * found.inclusion[effect]:.0f} %)" for effect in best.effects
    )
    closes = "It closes" if len(best.effects) == 1 else "They close"
    unseen = "unseen blocks" if whole is None else "unseen thirds of blocks"
    part = "" if closed is None else f" {closes} {_told(closed)} of the gap on {unseen}"
    if whole is not None:
        part += f", {_told(whole)} on whole unseen blocks"
    part += "." if part else ""
    others = sorted(
        (share, effect)
        for effect, share in found.inclusion.items()
        if effect not in best.effects and share > _NAMED and effect not in (NONE, UNKNOWN)
    )[::-1]
    more = f" It may as well be {', '.join(effect for _, effect in others)}." if others else ""
    rest = " What is left is more than noise, and unknown." if remains else ""
    start = {
        "identified": "Found",
        "ambiguous": "Not sure",
        "unknown": "Mostly unknown, in part",
    }
    return f"{start[verdict]}: {named}.{part}{more}{rest}"


def _told(closed: Interval) -> str:
    digits = 3 if closed.value > 0.99 else 2
    if closed.low is None or closed.high is None:
        return f"{closed.value:.{digits}f}"
    return f"{closed.value:.{digits}f} ({closed.low:.{digits}f} to {closed.high:.{digits}f})"
