# SPDX-License-Identifier: Apache-2.0
"""Which effects explain the lag of a joint's runs: none, one, several, or something unknown.

What may be in the lag is linear: columns, scaled so that one unit is what is usual (the prior's
standard deviation). A block (a run, a stretch of time) is held out as a whole, and predicted by the
others with the density Z(all) / Z(others) (`galen_model.estimation.evidence`), parameters'
uncertainty included. Where an effect shows in one of several ways, Z is their mean. The noise's
form, K, is chosen where it makes Z of all blocks largest; weights are not in that, being integrated
out.

A hypothesis is a set of effects with, beside them, noise alone or something unknown that hangs
together within a block. Its weight is how well it predicts each block from the others,

    score = eta sum_b elpd_b + ln prior,

and probabilities are the mean of the scores' softmax over Bayesian bootstraps of the blocks:
pseudo-BMA+ (Y. Yao et al., *Bayesian Analysis* 13(3), 2018, section 3.4).
Every effect is tried by itself; the best few are joined by a second and a third; and each effect of
the best set is exchanged for every other, to see what could stand in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import LOG_2PI, Posterior, Prior, log_evidence, posterior
from galen_model.estimation.least_squares import Information

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.effects.joint_terms import Columns

Progress = Callable[[str], None]

_LEVELS = (0.8, 1.0, 1.25)
"""How many times the floor noise alone may be."""
_SIZES = (0.7, 2.0, 6.0, 18.0, 50.0, 150.0)
_NEGLIGIBLE_NATS = 15.0
_MORE_THAN_NOISE_NATS = 4.0
"""What the evidence must gain before it counts as more than noise."""
_MOST_WAYS = 8
_HALF = 0.5
_NEARLY_NATS = 1.0
_TOLD_APART_NATS = 2.3
"""Ten to one."""
_TEMPERING = 0.7
"""eta, chosen by hand."""
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
class LagRows:
    """n means of a joint's lag, and what may be in it.

    residual (n,), rad: lag less its mean. floor: standard deviation that noise alone gives one.
    at_s (n,); block (n,): 0 ... B - 1; labels: of the blocks. memories_s: how long what a model
    lacks may hang together. nominal: columns that are always fitted. effects: of each the ways in
    which it shows (one of them holds). cannot_tell: sentences on effects that can't be shown.
    """

    residual: Array
    floor: float
    at_s: Array
    block: np.ndarray
    labels: tuple[str, ...]
    memories_s: tuple[float, ...]
    nominal: Columns
    effects: Mapping[str, Sequence[Columns]]
    cannot_tell: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Noise:
    """Covariance within a block in units of the floor squared: noise, and what a model lacks."""

    white: float
    size: float = 0.0
    memory_s: float = 1.0

    def covariance(self, at_s: Array) -> Array:
        """Return it at times (m,), (m, m)."""
        lacking = np.exp(-np.abs(at_s[:, None] - at_s[None, :]) / self.memory_s)
        # A little of it is white: a formula that isn't quite the right one scatters as well.
        lacking = 0.98 * lacking + 0.02 * np.eye(len(at_s))
        return np.asarray(self.white**2 * np.eye(len(at_s)) + self.size**2 * lacking)


@dataclass(frozen=True)
class BlockHypothesis:
    """Some effects, and whether noise alone is what they leave.

    ways, fit: as fitted to all blocks; form: of the noise. elpd (B,): log density of each block by
    the others. folds: of each block, the ways and the weights that the others chose. kept: the sets
    of ways that are not negligible.
    """

    effects: tuple[str, ...]
    floor_only: bool
    ways: tuple[Columns, ...]
    fit: Posterior
    form: int
    elpd: Array
    folds: tuple[tuple[tuple[Columns, ...], Array], ...]
    kept: tuple[tuple[Columns, ...], ...]


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


class BlockEvidence:
    """Evidence of hypotheses on one joint's runs, in units of the floor throughout."""

    def __init__(self, rows: LagRows) -> None:
        self.rows = rows
        self.residual = rows.residual / rows.floor
        lacking = [_Noise(1.0, size, memory) for memory in rows.memories_s for size in _SIZES]
        self.forms = (*map(_Noise, _LEVELS), *lacking)
        self._where = [np.flatnonzero(rows.block == b) for b in range(len(rows.labels))]
        self._whiteners: list[Array] = []  # of each block (F, m, m)
        self._normalisation = np.zeros((len(self.forms), len(rows.labels)))
        for b, where in enumerate(self._where):
            factors = np.stack(
                [np.linalg.cholesky(form.covariance(rows.at_s[where])) for form in self.forms]
            )
            self._whiteners.append(np.linalg.inv(factors))
            log_size = 2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
            self._normalisation[:, b] = log_size + len(where) * LOG_2PI
        self._nominal = self._whitened(np.column_stack([self.residual, self._scaled(rows.nominal)]))

    def _scaled(self, columns: Columns) -> Array:
        return columns.values / self.rows.floor

    def _whitened(self, columns: Array) -> list[Array]:
        """Return columns (n, a) by block, (F, m, a)."""
        pairs = zip(self._whiteners, self._where, strict=True)
        return [whitener @ columns[where] for whitener, where in pairs]

    def information(self, ways: Sequence[Columns]) -> Information:
        """Sum over the rows of the nominal columns and those of `ways`.

        Args:
            ways: One way of each effect.

        Returns:
            Sums by form and block, (F, B).

        """
        more = np.concatenate([np.zeros((len(self.residual), 0)), *map(self._scaled, ways)], axis=1)
        pairs = zip(self._nominal, self._whitened(more), strict=True)
        whole = [np.concatenate(pair, axis=2) for pair in pairs]
        gram = np.stack([np.swapaxes(one, 1, 2) @ one for one in whole], axis=1)
        rest = gram[..., 0, 0] + self._normalisation
        return Information(gram[..., 1:, 1:], gram[..., 1:, 0], rest)

    def shows(self, way: Columns) -> float:
        """Compute how far the usual size of an effect is away from all nominal ones.

        Args:
            way: A way in which the effect shows.

        Returns:
            Distance in sigma of the noise, along the direction that shows most.

        """
        information = self.information((way,)).part(_LEVELS.index(1.0)).total().matrix
        size = self.rows.nominal.size
        among = information[:size, :size] + np.eye(size)
        across = information[:size, size:]
        left = information[size:, size:] - across.T @ np.linalg.solve(among, across)
        return float(np.sqrt(max(np.linalg.eigvalsh(left)[-1], 0.0)))

    def hypothesis(
        self, effects: tuple[str, ...], sets: Sequence[tuple[Columns, ...]], floor_only: bool
    ) -> BlockHypothesis | None:
        """Fit a hypothesis that holds in one of several sets of ways.

        Args:
            effects: Names of its effects.
            sets: Alternatives, each with one way of every effect, in the order of `effects`.
            floor_only: Noise alone is what the effects leave; otherwise something unknown as well.

        Returns:
            The fitted hypothesis; None where no set has weights that are allowed, or where, without
            `floor_only`, noise alone is found all the same.

        """
        allowed = slice(0, len(_LEVELS) if floor_only else None)
        doubt = np.zeros(len(self.forms[allowed]))
        doubt[len(_LEVELS) :] = _MORE_THAN_NOISE_NATS
        found = []
        for ways in sets:
            each = self.information(ways)
            prior = Prior.unit(each.right.shape[-1])
            form = int(np.argmax(log_evidence(each.part(allowed).total(), prior) - doubt))
            blocks = each.part(form)
            fit = posterior(blocks.total(), prior)
            if self._allowed(ways, fit):
                whole = float(log_evidence(blocks.total(), prior))
                found.append((whole, ways, form, fit, blocks, prior))
        if not found:
            return None
        best = max(found, key=lambda one: one[0])
        if best[2] < len(_LEVELS) and not floor_only:
            return None  # the same as with the floor only
        kept = [one for one in found if one[0] > best[0] - _NEGLIGIBLE_NATS]
        left_out = [one[4].without_each() for one in kept]
        # (ways, B): evidence of all blocks but one
        seen = np.stack([log_evidence(o, one[5]) for o, one in zip(left_out, kept, strict=True)])
        of_all = np.array([one[0] for one in kept])
        elpd = np.logaddexp.reduce(of_all) - np.logaddexp.reduce(seen, axis=0)
        folds = []
        for b, k in enumerate(np.argmax(seen, axis=0)):
            others = left_out[k].part(b)
            weights = np.linalg.solve(others.matrix + kept[k][5].precision, others.right)
            folds.append((kept[k][1], weights))
        likely = tuple(one[1] for one in kept)
        return BlockHypothesis(
            effects, floor_only, best[1], best[3], best[2], elpd, tuple(folds), likely
        )

    def _allowed(self, ways: tuple[Columns, ...], fit: Posterior) -> bool:
        at = self.rows.nominal.size
        for way in ways:
            if not way.allowed(fit.values[at : at + way.size]):
                return False
            at += way.size
        return True

    def held_out(self, hypothesis: BlockHypothesis) -> Array:
        """Compute residuals, each block by the fit to the others.

        Args:
            hypothesis: Fitted on these rows.

        Returns:
            Residuals (n,), in floor units.

        """
        left = self.residual.copy()
        for (ways, weights), where in zip(hypothesis.folds, self._where, strict=True):
            columns = [self._scaled(one)[where] for one in (self.rows.nominal, *ways)]
            left[where] -= np.concatenate(columns, axis=1) @ weights
        return left


def search(evidence: BlockEvidence, progress: Progress | None = None) -> SearchResult:
    """Try hypotheses and weigh them.

    Args:
        evidence: The rows, with the effects that may be there.
        progress: Called with the names of the effects that are tried next; None: not called.

    Returns:
        All hypotheses tried, their probabilities and the best one.

    """
    work = _Search(evidence, progress or (lambda text: None))
    work.try_sets((), [()])
    for name, ways in work.effects.items():
        work.try_sets((name,), [(way,) for way in ways])
    work.prune()
    for size in range(2, _MOST + 1):
        for base in work.worth_joining(size - 1):
            for name in work.effects:
                if name not in base.effects:
                    work.join(base.effects, base.ways, name)
    best = work.weighed().best
    for place, name in enumerate(best.effects):
        others = tuple(other for other in best.effects if other != name)
        ways = tuple(way for k, way in enumerate(best.ways) if k != place)
        for other in work.effects:
            if other not in best.effects:
                work.join(others, ways, other)
    return work.weighed()


class _Search:
    def __init__(self, evidence: BlockEvidence, progress: Progress) -> None:
        self.evidence, self.progress = evidence, progress
        self.effects = evidence.rows.effects
        self.ways = {name: list(ways) for name, ways in self.effects.items()}
        self.tried: dict[tuple[frozenset[str], bool], BlockHypothesis] = {}

    def try_sets(self, names: tuple[str, ...], sets: Sequence[tuple[Columns, ...]]) -> None:
        self.progress(" + ".join(names) or NONE)
        for floor_only in (True, False):
            key = (frozenset(names), floor_only)
            if key not in self.tried:
                found = self.evidence.hypothesis(names, sets, floor_only)
                if found is not None:
                    self.tried[key] = found

    def prune(self) -> None:
        """From now on only such ways of an effect as weren't hopeless by themselves."""
        for name, ways in self.effects.items():
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

    def worth_joining(self, size: int) -> list[BlockHypothesis]:
        """Of the best sets of a size, those that are better than any smaller set, or nearly."""
        of_size = [one for one in self.tried.values() if len(one.effects) == size]
        kept: dict[frozenset[str], BlockHypothesis] = {}
        for one in sorted(of_size, key=self.score, reverse=True):
            kept.setdefault(frozenset(one.effects), one)
        smaller = [self.score(one) for one in self.tried.values() if len(one.effects) < size]
        least = max(smaller) - _NEARLY_NATS
        return [one for one in list(kept.values())[:_JOINED] if self.score(one) > least]

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
        inclusion = dict.fromkeys((*self.effects, NONE, UNKNOWN), 0.0)
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
        likely = frozenset(name for name in self.effects if inclusion[name] > _HALF)
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
                for other in self.effects
                if other not in best.effects
                and self._as_good(self.tried.get((others | {other}, best.floor_only)), best)
            )
        return found

    def _as_good(self, other: BlockHypothesis | None, best: BlockHypothesis) -> bool:
        if other is None:
            return False
        worse = float((best.elpd - other.elpd).sum())
        return _TEMPERING * worse < _TOLD_APART_NATS
