# SPDX-License-Identifier: Apache-2.0
"""Which effects explain blocks of readings: none, one, several, or something unknown.

A hypothesis is a set of effects with, beside them, noise alone or something unknown that hangs
together within a block. Its weight is how well it predicts each block from the others,

    score = eta sum_b elpd_b + ln prior,

and probabilities are the mean of the scores' softmax over Bayesian bootstraps of the blocks:
pseudo-BMA+ (Y. Yao et al., *Bayesian Analysis* 13(3), 2018, section 3.4).
Every effect is tried by itself; the best few are joined by a second and a third; and each effect of
the best set is exchanged for every other, to see what could stand in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.evidence.held_out import BlockEvidence, BlockHypothesis, Columns, Effects

NONE, UNKNOWN = "none", "unknown"
Progress = Callable[[str], None]

_MOST_WAYS = 8
_HALF = 0.5
_NEARLY_NATS = 1.0
_TOLD_APART_NATS = 2.3
"""Ten to one."""
# Chosen by hand; galen_diagnosis/README.md has how often answers were right.
_TEMPERING = 0.7
"""eta."""
_EFFECT_ODDS = 0.03
"""Of an effect being there, beforehand."""
_UNKNOWN_ODDS = 0.3
"""Of something unknown being there."""
_MOST = 3
"""Effects at once."""
_JOINED = 3
"""Best sets that get another."""
_DRAWS = 2000
_SEED = 0


@dataclass(frozen=True)
class SearchResult:
    """What the search tried, with probabilities; inclusion: of effects, "none", "unknown".

    best: the most probable hypothesis; equivalent: of its effects, what may stand in their place.
    """

    hypotheses: tuple[BlockHypothesis, ...]
    probability: Array
    inclusion: dict[str, float]
    best: BlockHypothesis
    equivalent: dict[str, tuple[str, ...]]


def search(
    evidence: BlockEvidence,
    effects: Effects,
    progress: Progress | None = None,
) -> SearchResult:
    """Try hypotheses and weigh them.

    Args:
        evidence: the rows, with their nominal columns.
        effects: what may be there.
        progress: called with the names of the effects that are tried next; None: not called.

    Returns:
        All hypotheses tried, their probabilities and the best one.

    """
    work = _Search(evidence, effects, progress or (lambda text: None))
    work.try_sets((), [()])
    for name, ways in effects.of.items():
        work.try_sets((name,), [(way,) for way in ways])
    work.prune()
    for size in range(2, _MOST + 1):
        for base in work.worth_joining(size - 1):
            for name in effects.of:
                if name not in base.effects:
                    work.join(base.effects, base.ways, name)
    best = work.weighed().best
    for place, name in enumerate(best.effects):
        others = tuple(other for other in best.effects if other != name)
        ways = tuple(way for k, way in enumerate(best.ways) if k != place)
        for other in effects.of:
            if other not in best.effects:
                work.join(others, ways, other)
    return work.weighed()


class _Search:
    def __init__(
        self,
        evidence: BlockEvidence,
        effects: Effects,
        progress: Progress,
    ) -> None:
        self.evidence, self.effects = evidence, effects
        self.progress = progress
        self.ways = {name: list(ways) for name, ways in effects.of.items()}
        self.tried: dict[tuple[frozenset[str], bool], BlockHypothesis] = {}

    def try_sets(self, names: tuple[str, ...], sets: Sequence[tuple[Columns, ...]]) -> None:
        self.progress(" + ".join(names) or NONE)
        for floor_only in (True, False):
            if floor_only and not self.evidence.rows.levels:
                continue
            key = (frozenset(names), floor_only)
            if key in self.tried:
                continue
            found = self.evidence.hypothesis(names, sets, floor_only)
            if found is not None:
                self.tried[key] = found
        self.evidence.forget()

    def prune(self) -> None:
        """From now on only such ways of an effect as weren't hopeless by themselves."""
        self.ways = {}
        for name, ways in self.effects.of.items():
            kept = {
                id(way): way
                for (names, _), one in self.tried.items()
                if names == {name}
                for (way,) in one.kept
            }
            self.ways[name] = list(kept.values()) or list(ways)[:_MOST_WAYS]

    def join(self, names: tuple[str, ...], ways: tuple[Columns, ...], name: str) -> None:
        """Effects in the ways they have, and another in any of its."""
        self.try_sets((*names, name), [(*ways, way) for way in self.ways[name]])

    def score(self, hypothesis: BlockHypothesis) -> float:
        return float(_TEMPERING * hypothesis.elpd.sum() + self._log_prior(hypothesis))

    def _log_prior(self, hypothesis: BlockHypothesis) -> float:
        unknown = 0.0 if hypothesis.floor_only else np.log(_UNKNOWN_ODDS)
        return float(len(hypothesis.effects) * np.log(_EFFECT_ODDS) + unknown)

    def best_sets(self, size: int) -> list[BlockHypothesis]:
        of_size = [one for one in self.tried.values() if len(one.effects) == size]
        ordered = sorted(of_size, key=self.score, reverse=True)
        kept: dict[frozenset[str], BlockHypothesis] = {}
        for one in ordered:
            kept.setdefault(frozenset(one.effects), one)
        return list(kept.values())[:_JOINED]

    def worth_joining(self, size: int) -> list[BlockHypothesis]:
        """Of the best sets of a size, those that are better than any smaller set, or nearly."""
        smaller = [self.score(one) for one in self.tried.values() if len(one.effects) < size]
        return [
            one for one in self.best_sets(size) if self.score(one) > max(smaller) - _NEARLY_NATS
        ]

    def weighed(self) -> SearchResult:
        every = tuple(self.tried.values())
        elpd = np.stack([one.elpd for one in every])
        prior = np.array([self._log_prior(one) for one in every])
        blocks = elpd.shape[1]
        random = np.random.default_rng(_SEED)
        weights = random.dirichlet(np.ones(blocks), _DRAWS) * blocks
        scores = _TEMPERING * weights @ elpd.T + prior
        scores -= scores.max(axis=1, keepdims=True)
        shares = np.exp(scores)
        probability = (shares / shares.sum(axis=1, keepdims=True)).mean(axis=0)
        inclusion = dict.fromkeys((*self.effects.of, NONE, UNKNOWN), 0.0)
        for one, share in zip(every, probability, strict=True):
            for name in one.effects or ((NONE if one.floor_only else UNKNOWN),):
                inclusion[name] += float(share)
        best = self._best(every, probability, inclusion)
        return SearchResult(every, probability, inclusion, best, self._equivalent(best))

    def _best(
        self, every: tuple[BlockHypothesis, ...], probability: Array, inclusion: dict[str, float]
    ) -> BlockHypothesis:
        """Of effects that are more likely there than not (M. Barbieri, J. Berger, 2004).

        *Annals of Statistics* 32(3): that set predicts best on average. Where no effect is, and
        neither are none and unknown, the most probable hypothesis.
        """
        likely = frozenset(name for name in self.effects.of if inclusion[name] > _HALF)
        ordered = np.argsort(probability)[::-1]
        if likely or max(inclusion[NONE], inclusion[UNKNOWN]) > _HALF:
            for k in ordered:
                if frozenset(every[k].effects) == likely:
                    return every[k]
        return every[ordered[0]]

    def _equivalent(self, best: BlockHypothesis) -> dict[str, tuple[str, ...]]:
        """Effects that predict the blocks as well in another's place, but for chance."""
        found = {}
        for name in best.effects:
            others = frozenset(best.effects) - {name}
            found[name] = tuple(
                other
                for other in self.effects.of
                if other not in best.effects
                and self._as_good(self.tried.get((others | {other}, best.floor_only)), best)
            )
        return found

    def _as_good(self, other: BlockHypothesis | None, best: BlockHypothesis) -> bool:
        if other is None:
            return False
        worse = float((best.elpd - other.elpd).sum())
        return _TEMPERING * worse < _TOLD_APART_NATS
