# SPDX-License-Identifier: Apache-2.0
"""Probabilities of hypotheses: none, effects alone and together, and something that isn't listed.

The few numbers of the evidence that are not physics are calibrated on simulated recordings:
`python -m galen_validation.calibrate_diagnosis` makes `calibration.json`; sessions and unknown
kinds there are others than those of `blind_check`.

With E_h the energy that a hypothesis' fit leaves, what its models may be off (`discrepancy.py`, on
the likeliest of a few scales) fitted beside it, the log likelihood is

    l_h = -1/2 E_h - Occam_h,

with Occam_h = 1/2 log det(1 + L G) of the effects' numbers and of what their models may be off.
"Unknown" is something unlisted beside one of these, or alone: nu directions with the variance that
fits best, which take what the best fit leaves, L,

    l_u = max_h l_h(E_h - L) - 1/2 (nu + nu log(L / nu)),

and all of E_0 where nothing listed is there; or, where that is more, structure of log evidence S
that was found alone or in what the best fit leaves (`structure.py`), l_u = l_h + S. Probabilities
go as exp(eta l - c), with c what effects and unknown ones cost beforehand: eta < 1 tempers evidence
that is never as good as its formula (Grünwald, van Ommen, Bayesian Analysis 12, 2017). Energies are
counted from the noise, with the structure that the best fit leaves.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources

import numpy as np
from galen_model.estimation.evidence import Background

from galen_diagnosis.inference.discrepancy import Weighed
from galen_diagnosis.inference.search import Found, best_of_each


@dataclass(frozen=True)
class Settings:
    """unknown_dof, unknown_cost: of the hypothesis that something else is there.

    effect_cost: of an effect; more_cost: of each beyond the first. temper: power of the evidence.
    """

    unknown_dof: float = 20.0
    unknown_cost: float = 5.0
    effect_cost: float = 5.0
    more_cost: float = 3.0
    temper: float = 0.5


def load_settings() -> Settings:
    """Return those of the package's calibration."""
    file = resources.files(__package__) / "calibration.json"
    if not file.is_file():
        return Settings()
    return Settings(**json.loads(file.read_text(encoding="utf-8"))["settings"])


_FULL, _REST = 30.0, 0.1
_AS_LIKELY = 10.0
APART = 3.3
"""Two causes nearer than this in units of the noise can't be distinguished (study of diagnosis)."""


@dataclass(frozen=True)
class Scored:
    """What a posterior needs of a hypothesis, and nothing else (so that settings can be fitted).

    names; energy: what it leaves over the noise; occam: 1/2 log det; structure: log evidence of
    something unlisted in what it leaves, where that was looked for.
    """

    names: tuple[str, ...]
    energy: float
    occam: float
    structure: float = 0.0


@dataclass(frozen=True)
class Probabilities:
    """probability of each hypothesis in the order given, of none and unknown; by effect."""

    hypotheses: tuple[float, ...]
    none: float
    unknown: float
    effects: dict[str, float]


def excused(found: Found) -> list[Weighed]:
    """Return all hypotheses, without what a fuller set gains that their models may miss.

    What an effect gains beside others may be what their models miss (`looks_like`).

    Args:
        found: What a search left.

    Returns:
        Hypotheses with what their models may be off, the likeliest first.

    """
    fuller = best_of_each(found.weighed)
    least: dict[frozenset[str], Weighed] = {}
    for one in sorted(found.weighed, key=lambda one: one.energy):
        least.setdefault(frozenset(one.names), one)
    out = []
    for one in found.weighed:
        less = 0.0
        if one is least[frozenset(one.names)]:  # one that fits badly is no better for it
            less = max(_excuse(one, of) for of in fuller)
        log_bayes = one.log_bayes + 0.5 * less
        out.append(replace(one, energy=one.energy - less, log_bayes=log_bayes))
    return sorted(out, key=lambda one: -one.log_bayes)


def _excuse(one: Weighed, of: Weighed) -> float:
    """Return how much of what a set of one effect more gains the models of `one` may miss."""
    more = set(of.names) - set(one.names)
    if not one.names or len(more) != 1 or len(of.names) != len(one.names) + 1:
        return 0.0
    k = of.names.index(more.pop())
    return max(one.energy - of.energy, 0.0) * of.looks_like(of.shown[k], k)


def scored(of: Sequence[Weighed], left: float, structure: float) -> list[Scored]:
    """Return hypotheses as a posterior sees them.

    Energies count from the least of those about as likely as the first: unlikely ones buy theirs by
    what models miss.

    Args:
        of: Hypotheses, the likeliest first.
        left: Energy of the structure that the first leaves.
        structure: Log evidence of that structure.

    Returns:
        The same in the same order.

    """
    least = min(one.energy for one in of if one.log_bayes > of[0].log_bayes - _AS_LIKELY)
    found = [
        Scored(one.hypothesis.names, max(one.energy - least, 0.0) + left, one.occam) for one in of
    ]
    return [replace(found[0], structure=structure), *found[1:]]


def forgiven(of: Sequence[Scored], missed: float) -> list[Scored]:
    """Return hypotheses, the smaller ones without what the first one's models are seen to miss.

    What models miss in one way they may miss in another: an effect that explains less beside the
    first's others than the structure that all of them leave, and may miss, is no cause for it.

    Args:
        of: Hypotheses, the likeliest first.
        missed: Energy of that structure.

    Returns:
        The same in the same order.

    """
    first = of[0]
    smaller = [bool(one.names) and set(one.names) < set(first.names) for one in of]
    return [
        replace(one, energy=min(one.energy, max(one.energy - missed, first.energy)))
        if within
        else one
        for one, within in zip(of, smaller, strict=True)
    ]


def merge_equivalents(
    behind: Background, of: Sequence[Weighed], sums: Sequence[Scored]
) -> tuple[list[Scored], dict[frozenset[str], tuple[frozenset[str], ...]]]:
    """Make one hypothesis of those that the rows can't distinguish.

    Sets of as many effects whose fits leave the same rows, but for less than `APART` of noise, are
    one answer with several names: it is as likely beforehand as one set, whatever number of them
    there are, and Occam's factor is that of the member with the least. One that needs far more
    chosen numbers for it (`_AS_LIKELY`) is none of them: they would be a coincidence.

    Args:
        behind: unknowns and a healthy arm's tolerances, which count for nothing.
        of: hypotheses, the likeliest first.
        sums: the same as a posterior sees them.

    Returns:
        The likeliest of each class, and the others' sets of names by the likeliest's.

    """
    classes: list[list[int]] = []
    for k, one in enumerate(of):
        for group in classes:
            first = of[group[0]].hypothesis
            if len(first.names) != len(one.hypothesis.names) or not first.names:
                continue
            if abs(sums[k].occam - sums[group[0]].occam) > _AS_LIKELY:
                continue
            apart = first.raw_rows - one.hypothesis.raw_rows
            if behind.sum_of_squares(apart) < APART**2:
                group.append(k)
                break
        else:
            classes.append([k])
    merged: list[Scored] = []
    alike: dict[frozenset[str], tuple[frozenset[str], ...]] = {}
    for group in classes:
        members = [sums[k] for k in group]
        merged.append(
            replace(
                members[0],
                energy=min(one.energy for one in members),
                occam=min(one.occam for one in members),
            )
        )
        names, *others = dict.fromkeys(frozenset(one.names) for one in members)
        if others:
            alike[names] = tuple(others)
    return merged, alike


def _relief(of: Sequence[Scored]) -> float:
    """Return how much of Occam's factor counts for no listed effect against none and unknown.

    That of the likeliest beyond _FULL, but for a rest. A bias drift of any shape takes a hundred
    numbers, because it is one; "unknown" has a few directions whatever it is of, and would be
    cheaper than the truth.
    """
    listed = [one for one in of if one.names]
    best = min(listed, key=lambda one: 0.5 * one.energy + one.occam, default=None)
    return 0.0 if best is None else (1.0 - _REST) * max(best.occam - _FULL, 0.0)


def posterior(of: Sequence[Scored], settings: Settings) -> Probabilities:
    """Return the hypotheses' probabilities.

    Args:
        of: Hypotheses, none among them.
        settings: Costs and temper.

    Returns:
        Probabilities that sum to one over the hypotheses and unknown, and those of each effect.

    """
    relief = _relief(of)
    logs = np.array([_log(one, one.energy, relief) for one in of])
    costs = np.array([_cost(len(one.names), settings) for one in of])
    # Evidence is tempered, what is likely beforehand is not.
    everything = settings.temper * logs - costs
    left = min(one.energy for one in of)
    beside = [
        settings.temper * _log_beside(one, left, relief, settings) - cost
        for one, cost in zip(of, costs, strict=True)
    ]
    everything = np.append(everything, max(beside) - settings.unknown_cost)
    weights = np.exp(everything - np.max(everything))
    weights = weights / np.sum(weights)
    effects: dict[str, float] = {}
    for one, weight in zip(of, weights, strict=False):
        for name in one.names:
            effects[name] = effects.get(name, 0.0) + float(weight)
    # Sums of many that are one but for rounding.
    effects = {name: min(1.0, chance) for name, chance in effects.items()}
    at_none = sum(float(w) for one, w in zip(of, weights, strict=False) if not one.names)
    return Probabilities(
        tuple(float(w) for w in weights[:-1]), at_none, float(weights[-1]), effects
    )


def _log_beside(one: Scored, left: float, relief: float, settings: Settings) -> float:
    """Of something unlisted beside a hypothesis; all that is there, where there is no other."""
    taken = left if one.names else one.energy
    spread = 1.0 + np.log(max(taken / settings.unknown_dof, 1.0))
    beside = _log(one, one.energy - taken, relief)
    any_shape = beside - 0.5 * float(settings.unknown_dof * spread)
    if not one.names:  # what structure there is alone has paid for itself, as listed ones have
        return max(any_shape, relief - 0.5 * one.energy + one.structure)
    return max(any_shape, _log(one, one.energy, relief) + one.structure)


def _log(one: Scored, energy: float, relief: float) -> float:
    """Of a hypothesis, with so much energy left that it has to answer for."""
    return -0.5 * energy + (relief - one.occam if one.names else 0.0)


def _cost(effects: int, settings: Settings) -> float:
    """Minus the log of how likely so many effects are beforehand, none being 0."""
    return settings.effect_cost + settings.more_cost * (effects - 1) if effects else 0.0
