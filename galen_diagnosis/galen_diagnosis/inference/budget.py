# SPDX-License-Identifier: Apache-2.0
"""What the whole gap is made of: every effect that the data resolve, within its limit or beyond.

To the causes that were chosen, at their fitted numbers, a healthy arm's deviations are added with
their priors, and all are fitted together to other folds than the one that they are scored on. With
b the rows held out less the unknowns (fitted without any effect), c_k what effect k changes of them
less what the unknowns take of that, and a what is left, b = a + sum_k c_k, so that

    |b|^2 - |a|^2 = sum_k <c_k, b + a>:

shares <c_k, b + a> / (|b|^2 - floor) add up to one with the residual's, (|a|^2 - floor) over the
same. (Of two effects that change rows alike each gets half of what they do together, as of Shapley
and of Pratt's measure; J. W. Pratt, Proc. 2nd Int. Tampere Conf. Statistics, 1987.)

An effect is resolved where its numbers are not zero by chance, chi-square of their covariance.
Of several of which only a combination is resolved the one that explains most alone is the entry,
with others that explain nearly as much as equivalent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.estimation.evidence import Background
from scipy.sparse import csc_array

from galen_diagnosis.answer.answer import RESIDUAL, BudgetItem, Interval
from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.forms import Tolerances
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.gap import drawn, parameters_of, sandwich, without_unknowns
from galen_diagnosis.inference.posterior import APART
from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import FOLDS
from galen_diagnosis.observation.specification import Specification

_RESOLVED = 1e-3
"""Chance below which numbers are not zero."""
_DRAWS, _SEED = 400, 1987
_FAR = 10.0
"""Standard deviations of a cause's fit, which is next to no prior and keeps near it."""
_AS_GOOD = 0.01
_LEAST_NOISES = 3.0
"""Standard deviations of chance that the whole gap is at least."""


@dataclass(frozen=True, eq=False)
class _Part:
    """An effect in one form: at values (p,) it changes the rows by `change` (N,).

    places: of its numbers among all that are fitted (m,), in steps from there; which: of its values
    each of these is (m,).
    """

    candidate: Candidate
    values: Array
    change: Array
    places: np.ndarray
    which: np.ndarray

    def sums(self, numbers: Array) -> Array:
        """Return its numbers (..., p) with all that is fitted (..., n)."""
        out = np.broadcast_to(self.values, (*numbers.shape[:-1], len(self.values))).copy()
        for place, k in zip(self.places, self.which, strict=True):
            out[..., k] += numbers[..., place]
        return out


def budget(
    observation: Observation,
    behind: Background,
    tolerances: Tolerances,
    best: Hypothesis,
    off: csc_array,
    floor: float,
) -> tuple[BudgetItem, ...]:
    """Return what the whole gap is made of.

    Args:
        observation: What was measured.
        behind: Unknowns, places and tolerances, as they are fitted beside every cause.
        tolerances: A healthy arm's deviations, the last columns of `behind`.
        best: The causes that were chosen, or none.
        off: What their models may be off, (N, M).
        floor: Mean square of a row that noise alone gives.

    Returns:
        Effects and the residual, the largest share first; () where there is no gap.

    """
    whole = behind.first(observation.unknowns).left(observation.nominal)
    spread = _LEAST_NOISES * floor * np.sqrt(2.0 * len(whole))
    if whole @ whole - floor * len(whole) <= spread:
        return ()
    together = _together(observation, behind, tolerances, best)
    everything = np.arange(len(together.gram))
    mean, covariance = together.posterior(observation, best, everything)
    chosen = _resolved(together, mean, covariance)
    if off.shape[1]:
        covariance = together.with_models(best, off).posterior(observation, best, everything)[1]
    parts = [together.parts[k] for k in chosen]
    shares = _shares(observation, together, best, parts, floor)
    if shares is None:
        return ()
    # What only makes up for what another does too much is a part where without it more is left.
    fewer = [
        part
        for part, share in zip(parts, shares, strict=False)
        if share.value > 0.0 or np.any(part.change)
    ]
    if len(fewer) < len(parts):
        without = _shares(observation, together, best, fewer, floor)
        if without is not None and without[-1].value < shares[-1].value + _AS_GOOD:
            parts, shares = fewer, without
    # Of few readings effects together may predict others worse than none does.
    while shares[-1].value > 1.0:
        each = enumerate(zip(parts, shares, strict=False))
        healthy = [(share.value, k) for k, (part, share) in each if not np.any(part.change)]
        if not healthy:
            break
        del parts[min(healthy)[1]]
        without = _shares(observation, together, best, parts, floor)
        if without is None:
            return ()
        shares = without
    generator = np.random.default_rng(_SEED)
    items = []
    for part, share in zip(parts, shares, strict=False):
        alone, equivalent = chosen[together.parts.index(part)]
        values = mean if alone is None else alone
        items.append(_item(observation, part, values, covariance, share, equivalent, generator))
    items.append(BudgetItem(RESIDUAL, shares[-1]))
    return tuple(sorted(items, key=lambda one: -one.share.value))


def tolerances_after(
    observation: Observation,
    behind: Background,
    tolerances: Tolerances,
    best: Hypothesis,
    off: csc_array,
) -> tuple[Array, Array]:
    """Return a healthy arm's deviations as a fit with the causes shows them.

    Deviations are those that the gap is made of, else zero; the covariance is beside all.

    Args:
        observation: What was measured.
        behind: Unknowns, places and tolerances, as they are fitted beside every cause.
        tolerances: A healthy arm's deviations, the last columns of `behind`.
        best: The causes that were chosen, or none.
        off: What their models may be off, (N, M).

    Returns:
        Numbers of the tolerances, (q,), and their covariance, (q, q).

    """
    together = _together(observation, behind, tolerances, best).with_models(best, off)
    mean, covariance = together.posterior(observation, best, np.arange(len(together.gram)))
    kept = [together.parts[k].places for k in _resolved(together, mean, covariance)]
    mean, _ = together.posterior(
        observation, best, np.sort(np.concatenate([np.zeros(0, dtype=int), *kept]))
    )
    count = tolerances.size
    return mean[:count], covariance[:count, :count]


@dataclass(frozen=True)
class _Together:
    """All that is fitted together: columns (N, n), what is left of them, normal equations."""

    columns: Array
    precision: Array
    parts: list[_Part]
    beside: Background
    known: Background
    own: Array
    gram: Array
    along: Array

    @classmethod
    def of(
        cls,
        columns: Array,
        precision: Array,
        parts: list[_Part],
        beside: Background,
        known: Background,
        best: Hypothesis,
    ) -> _Together:
        """Set up the normal equations."""
        own = known.left(columns)
        return cls(
            columns, precision, parts, beside, known, own, own.T @ columns, own.T @ best.raw_rows
        )

    def with_models(self, best: Hypothesis, off: csc_array) -> _Together:
        """Return the same beside what the causes' models may be off (N, M)."""
        known = self.beside.beside(off, 1.0)
        return self.of(self.columns, self.precision, self.parts, self.beside, known, best)

    def posterior(
        self, observation: Observation, best: Hypothesis, kept: np.ndarray
    ) -> tuple[Array, Array]:
        """Return numbers (n,) and covariance (n, n), of those that are kept; else zero."""
        inside = np.ix_(kept, kept)
        laplace = np.linalg.inv(self.gram[inside] + self.precision[inside])
        mean, covariance = np.zeros(len(self.gram)), np.zeros_like(self.gram)
        mean[kept] = laplace @ self.along[kept]
        left = self.known.left(best.raw_rows - self.columns @ mean)
        covariance[inside] = sandwich(observation.rows.block, self.own[:, kept], left, laplace)
        return mean, covariance


def _together(
    observation: Observation, behind: Background, tolerances: Tolerances, best: Hypothesis
) -> _Together:
    columns, precision, parts = _joined(observation, tolerances, best)
    first = len(behind.prior_std) - tolerances.size
    beside = behind.first(first)
    return _Together.of(columns, precision, parts, beside, beside, best)


def _joined(
    observation: Observation, tolerances: Tolerances, best: Hypothesis
) -> tuple[Array, Array, list[_Part]]:
    """Columns (N, n) of a healthy arm's deviations and of causes, precision (n, n), parts."""
    columns = np.concatenate([tolerances.columns, best.columns], axis=1)
    first = tolerances.size
    precision = np.zeros((columns.shape[1],) * 2)
    precision[:first, :first] = tolerances.precision
    # Where a cause's columns hold.
    precision[first:, first:] = np.linalg.pinv(best.covariance, hermitian=True) / _FAR**2
    parts, taken = [], set()
    for part, values, where, change in zip(
        best.parts, best.values, best.slices(), best.changes(observation), strict=True
    ):
        places = [*range(first + where.start, first + where.stop)]
        which = [*range(len(values))]
        for number, (own, place) in enumerate(tolerances.each):
            if own.effect == part.effect and (own.label == part.label or part.wider):
                at = [list(part.free).index(k) for k in own.free if k in part.free]
                if len(at) == len(own.free) and type(own.base) is type(part.base):
                    taken.add(number)
                    places += range(place.start, place.stop)
                    which += at
        numbers = np.array([places, which], dtype=int)  # of a limit that no push reaches, none
        parts.append(_Part(part, values, change, *numbers))
    nothing = np.zeros(len(observation.rows))
    for number, (own, place) in enumerate(tolerances.each):
        if number not in taken:
            each = np.arange(place.start, place.stop)
            parts.append(_Part(own, own.start.copy(), nothing, each, np.arange(len(each))))
    return columns, precision, parts


def _resolved(
    together: _Together, mean: Array, covariance: Array
) -> dict[int, tuple[Array | None, tuple[str, ...]]]:
    """Return the parts that the gap is made of, by number.

    They are those that are resolved beside all others and, one after the other, those that alone
    explain most of what these leave: of them all numbers without the others, and what explains
    nearly as much.
    """
    parts = together.parts
    chosen: dict[int, tuple[Array | None, tuple[str, ...]]] = {
        k: (None, ()) for k, part in enumerate(parts) if _is_there(part, mean, covariance)
    }
    left = [k for k in range(len(parts)) if k not in chosen]
    near: dict[int, list[int]] = {}
    while left:
        gains, chances, numbers = [], [], []
        for k in left:
            kept = np.sort(np.concatenate([parts[n].places for n in (*chosen, k)]))
            inside = np.ix_(kept, kept)
            laplace = np.linalg.inv(together.gram[inside] + together.precision[inside])
            alone = np.zeros(len(mean))
            alone[kept] = laplace @ together.along[kept]
            own = np.searchsorted(kept, parts[k].places)
            value = alone[parts[k].places]
            gains.append(float(value @ np.linalg.solve(laplace[np.ix_(own, own)], value)))
            chances.append(float(chi2_sf(gains[-1], len(own))))
            numbers.append(alone)
        first = int(np.argmin(chances))
        if chances[first] > _RESOLVED:
            break
        near[left[first]] = [
            k for k, gain in zip(left, gains, strict=True) if gain > gains[first] - APART**2
        ]
        chosen[left[first]] = numbers[first], ()
        left.remove(left[first])
    for number, others in near.items():
        label = parts[number].candidate.effect
        names = dict.fromkeys(parts[k].candidate.effect for k in others if k in left)
        chosen[number] = chosen[number][0], tuple(name for name in names if name != label)
    return chosen


def _is_there(part: _Part, mean: Array, covariance: Any) -> bool:
    """Whether a part's numbers are not zero by chance; a cause is there."""
    if np.any(part.change):
        return True
    value, spread = mean[part.places], covariance[np.ix_(part.places, part.places)]
    if not np.any(spread):
        return False
    size = float(value @ np.linalg.pinv(spread, hermitian=True) @ value)
    return float(chi2_sf(size, len(value))) < _RESOLVED


def _shares(
    observation: Observation,
    together: _Together,
    best: Hypothesis,
    parts: Sequence[_Part],
    floor: float,
) -> list[Interval] | None:
    """Return each part's share of the gap and the residual's, on rows that the fit hasn't seen."""
    beside, columns, precision = together.beside, together.columns, together.precision
    kept = np.sort(np.concatenate([np.zeros(0, dtype=int), *(part.places for part in parts)]))
    rows = observation.rows
    every = np.concatenate([beside.columns, columns[:, kept]], axis=1)
    prior = np.zeros((every.shape[1],) * 2)
    count = len(beside.prior_std)
    prior[:count, :count] = np.diag(beside.precision)
    prior[count:, count:] = precision[np.ix_(kept, kept)]
    gram, along = every.T @ every, every.T @ best.raw_rows
    does = np.zeros((len(rows), len(parts)))
    before = np.zeros(len(rows))
    for fold in range(FOLDS):
        out = rows.fold == fold
        if not out.any() or out.all():
            continue
        held = every[out]
        inner = gram - held.T @ held + prior
        silent = np.diag(inner) <= 0.0
        inner[silent, silent] = 1.0
        numbers = np.zeros(columns.shape[1])
        numbers[kept] = np.linalg.solve(inner, along - held.T @ best.raw_rows[out])[count:]
        changes = np.stack(
            [part.change + columns[:, part.places] @ numbers[part.places] for part in parts], axis=1
        ) if parts else np.zeros((len(rows), 0))  # fmt: skip
        both = np.column_stack([observation.nominal, changes])
        both = without_unknowns(observation, beside, both, out)
        before[out], does[out] = both[:, 0], both[:, 1:]
    after = before - does.sum(axis=1)
    block = rows.block
    number = np.bincount(block).astype(float)
    made: list[Any] = [np.bincount(block, part * (before + after)) for part in does.T]
    made.append(np.bincount(block, after**2) - floor * number)
    gap = np.bincount(block, before**2) - floor * number
    if gap.sum() <= 0.0:
        return None
    draws = np.random.default_rng(_SEED).integers(0, len(gap), (_DRAWS, len(gap)))
    totals = gap[draws].sum(axis=1)
    out_ = []
    for one in made:
        low, high = np.quantile(one[draws].sum(axis=1) / totals, [0.025, 0.975])
        out_.append(Interval(float(one.sum() / gap.sum()), float(low), float(high)))
    return out_


def _item(
    observation: Observation,
    part: _Part,
    mean: Array,
    covariance: Array,
    share: Interval,
    equivalent: tuple[str, ...],
    generator: np.random.Generator,
) -> BudgetItem:
    one = part.candidate
    values = part.sums(mean)
    turn = np.zeros((len(values), len(mean)))
    turn[part.which, part.places] = 1.0
    spread = turn @ covariance @ turn.T
    named, limits, chance = _beside_limits(observation, one, values, spread, generator)
    joint = named.pop("joint", None)
    name = one.effect.partition(":")[0]
    label = f"{name}:{joint}" if joint else name
    return BudgetItem(label, share, named, limits, chance, tuple(dict.fromkeys(equivalent)))


def lies_within(observation: Observation, one: Candidate, values: Array, spread: Array) -> bool:
    """Return whether a fitted effect is likelier within its limit than beyond.

    One without a limit is there, and never within.

    Args:
        observation: Its recording has the specification.
        one: The effect's form.
        values: Its fitted numbers, (p,).
        spread: Their covariance, (p, p).

    Returns:
        True where fewer than half of draws are beyond.

    """
    generator = np.random.default_rng(_SEED)
    *_, chance = _beside_limits(observation, one, values, spread, generator)
    return chance is not None and chance < 0.5


def _beside_limits(
    observation: Observation,
    one: Candidate,
    values: Array,
    spread: Array,
    generator: np.random.Generator,
) -> tuple[dict[str, Any], dict[str, Any], float | None]:
    """Return the contract's parameters of a fit, their limits and the chance to lie beyond."""
    numbers = drawn(values, spread, generator)
    named = parameters_of(observation, one, values, numbers)
    limits = limits_of(observation.recording.specification, one, named)
    return named, limits, beyond_chance(observation, one, numbers, limits)


def limits_of(
    specification: Specification, one: Candidate, named: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a specification's limits by the contract's parameters that they are of.

    Those of an effect's vector, by name; of another form that of the contract's first number.

    Args:
        specification: The limits.
        one: The effect's form.
        named: The contract's parameters, intervals among them.

    Returns:
        Limits in the parameters' units, a list of a vector; {} where one of the effect's numbers
        has none.

    """
    name, parts = one.effect.partition(":")[0], one.base.limit_parts
    limits = [specification.limit(name, part) for part in parts]
    if any(limit is None for limit in limits):
        return {}
    known = [limit * one.limit_unit for limit in limits if limit is not None]
    found: dict[str, Any] = {}
    at = 0
    for fitted in one.base.fitted:
        own = known[at : at + fitted.size]
        at += fitted.size
        field = one.base.contract_names.get(fitted.name, fitted.name)
        if own and field in named and (record_of(name).healthy or not found):
            found[field] = own if fitted.size > 1 else own[0]
    first = next((key for key, value in named.items() if isinstance(value, Interval)), None)
    return found or ({} if first is None else {first: known[0]})


def beyond_chance(
    observation: Observation, one: Candidate, numbers: Array, limits: Mapping[str, Any]
) -> float | None:
    """Return how many of an effect's draws are beyond its limit.

    Args:
        observation: Its recording has the specification.
        one: The effect's form.
        numbers: Draws of the free numbers, (n, p).
        limits: As `limits_of` returns them.

    Returns:
        Share of draws beyond, of the number that is beyond most often; None without a limit.

    """
    record = record_of(one.effect)
    parts = one.base.limit_parts
    std = None
    if record.healthy and len(one.free) == numbers.shape[1] and max(one.free) < len(parts):
        own = tuple(parts[k] for k in one.free)
        std = observation.recording.specification.std(record.name, own)
    if std is not None:
        sizes = np.abs(numbers) / (2.0 * np.array(std) * one.limit_unit)
    elif limits:
        named = [record.parameters(observation, one.at(row)) for row in numbers]
        each: list[Any] = [
            np.stack([np.abs(np.atleast_1d(row[name])) for row in named]) / np.atleast_1d(limit)
            for name, limit in limits.items()
        ]
        sizes = np.concatenate(each, axis=1)
    else:
        return None
    return float(np.max(np.mean(sizes > 1.0, axis=0)))
