# SPDX-License-Identifier: Apache-2.0
"""Which effects explain a recording: one, two, as many as the data resolve, by forward selection.

Every form of every effect is judged by its linear evidence first; the likeliest are fitted on the
simulator (`refine.py`). To the best of them every other effect is added, again linearly first, and
the best pairs are fitted; sets of more grow from the best in the same way. All are compared with
what their models may be off fitted beside (`discrepancy.py`): an effect is added for what it
explains beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, Evidence, evidence
from scipy.special import logsumexp

from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.forms import Forms
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.discrepancy import Discrepancies, Weighed
from galen_diagnosis.inference.refine import Hypothesis, nothing, refine
from galen_diagnosis.observation.observation import Observation

Progress = Callable[[str, float], None]

_WORTH = 2.0
_WORTH_MORE = 4.0
_HOPELESS = 15.0
_IDLE = 9.0
_BEHIND = 0.4
"""Part of the likeliest single effect's evidence below which no pair is grown from another one, and
no general effect is fitted."""
_MISSED = 0.1
"""Part of what a set's models may miss that the next effect has to explain beyond."""
_SINGLES, _PAIRS_FROM, _PAIRS, _MORE = 7, 3, 4, 1
_MOST_TOGETHER = 5


@dataclass(frozen=True)
class Found:
    """What a search leaves.

    weighed: hypotheses as fitted, the likeliest first, `none` among them; linear: log Bayes factor
    of every effect by its columns alone, against none.
    """

    forms: Forms
    discrepancies: Discrepancies
    weighed: tuple[Weighed, ...]
    linear: dict[str, float]
    none: Hypothesis

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """Those weighed, in their order."""
        return tuple(one.hypothesis for one in self.weighed)

    @property
    def behind(self) -> Background:
        """Unknowns and a healthy arm's tolerances."""
        return self.forms.behind


def search(observation: Observation, progress: Progress | None = None) -> Found:
    """Look for the effects behind the rows.

    Args:
        observation: What was measured.
        progress: Called with what is done and the share of the whole, 0 ... 1.

    Returns:
        Fitted hypotheses, and the linear evidence of every effect.

    """
    say = progress or (lambda what, share: None)
    say("effects' columns", 0.1)
    forms = Forms(observation)
    say("every effect alone", 0.4)
    none = nothing(observation, forms.behind)
    judged = forms.judged(none.raw_rows, forms.behind)
    say("the likeliest, on the simulator", 0.55)
    fits = _Fits(observation, forms, Discrepancies(observation, forms.behind), none)
    singles: list[Weighed] = []
    for log, candidate, theta in _shortlist(judged, _SINGLES, _WORTH):
        others = [one.log_bayes for one in singles if one.names != (candidate.effect,)]
        top = max(others, default=0.0)
        if not record_of(candidate.effect).general or log > _BEHIND * top:
            begun, start = _begun(candidate, theta)
            singles += fits.of([begun], [start])
    say("pairs", 0.7)
    seeds = best_of_each(singles)[:_PAIRS_FROM]
    seeds = [one for one in seeds if one.log_bayes > _BEHIND * seeds[0].log_bayes]
    larger = fits.grown(seeds, singles, _PAIRS)
    hypotheses = [fits.none, *singles, *larger]
    best = max((fits.none, *singles), key=lambda one: one.log_bayes)
    for count in range(3, _MOST_TOGETHER + 1):
        worth = best.log_bayes + max(_WORTH, _MISSED * best.missed())
        better = best_of_each([one for one in larger if one.log_bayes > worth])[:1]
        if not better:
            break
        say(f"{count} together", 0.85)
        best = better[0]
        larger = fits.grown(better, singles, _MORE)
        hypotheses += larger
    hypotheses += fits.exchanged(hypotheses, singles)
    hypotheses += fits.pruned(hypotheses)
    ordered = tuple(sorted(hypotheses, key=lambda one: -one.log_bayes))
    return Found(forms, fits.discrepancies, ordered, _by_effect(judged), none)


def _by_effect(judged: list[tuple[Candidate, Evidence]]) -> dict[str, float]:
    """Log of the mean Bayes factor over each effect's forms."""
    logs: dict[str, list[float]] = {}
    for candidate, found in judged:
        logs.setdefault(candidate.effect, []).append(found.log_bayes)
    return {name: float(logsumexp(each) - np.log(len(each))) for name, each in logs.items()}


def _shortlist(
    judged: list[tuple[Candidate, Evidence]], most: int, worth: float
) -> list[tuple[float, Candidate, Array]]:
    """Return the likeliest forms: a few effects, of each a few forms, and the linear answers."""
    ordered = sorted(judged, key=lambda pair: -pair[1].log_bayes)
    taken: dict[str, int] = {}
    out = []
    for candidate, found in ordered:
        if found.log_bayes < worth:
            break
        number, most_forms = taken.get(candidate.effect, 0), record_of(candidate.effect).most_forms
        if number >= most_forms or (number == 0 and len(taken) >= most):
            continue
        if candidate.linear == 1:
            begun, start = _begun(candidate, found.theta)
            if np.array_equal(start, begun.start):
                continue  # within its bounds it can't do what is seen
        taken[candidate.effect] = number + 1
        out.append((found.log_bayes, candidate, found.theta))
    return out


def _begun(candidate: Candidate, theta: Array) -> tuple[Candidate, Array]:
    """Where the fit begins: the linear answer, within limits, as far as it goes."""
    if candidate.into is not None:
        return candidate.into(theta)
    start = candidate.start.copy()
    start[: len(theta)] = theta
    return candidate, np.clip(start, *candidate.limits())


def best_of_each(hypotheses: Sequence[Weighed]) -> list[Weighed]:
    """Return the likeliest of each set of effects.

    Args:
        hypotheses: In any order.

    Returns:
        Those of them, the likeliest first.

    """
    out: dict[frozenset[str], Weighed] = {}
    for one in sorted(hypotheses, key=lambda one: -one.log_bayes):
        out.setdefault(frozenset(one.names), one)
    return list(out.values())


class _Fits:
    """Fits of one recording."""

    def __init__(
        self,
        observation: Observation,
        forms: Forms,
        discrepancies: Discrepancies,
        none: Hypothesis,
    ) -> None:
        self._observation = observation
        self._forms = forms
        self.discrepancies = discrepancies
        self._none_cost = none.cost
        self.none = self._weighed(none)

    def _weighed(self, fit: Hypothesis) -> Weighed:
        return self.discrepancies.weigh(self._forms.behind, fit, self._none_cost)

    def of(self, parts: Sequence[Candidate], start: Sequence[Array]) -> list[Weighed]:
        """Return effects as fitted together; nothing where one of them isn't plausible so."""
        behind, none_cost = self._forms.behind, self._none_cost
        nuisance = self.discrepancies.on_the_way(parts, start)
        fit = refine(self._observation, behind, parts, start, None, none_cost, nuisance)
        each = zip(parts, fit.effects, strict=True)
        recording = self._observation.recording
        plausible = all(record_of(one.effect).plausible(e, recording) for one, e in each)
        return [self._weighed(fit)] if plausible else []

    def exchanged(self, hypotheses: list[Weighed], singles: list[Weighed]) -> list[Weighed]:
        """Return the likeliest set with other forms of its effects, as they were fitted alone.

        The form that fits best alone needn't be that which fits best beside others.
        """
        best = max(hypotheses, key=lambda one: one.log_bayes).hypothesis
        if len(best.parts) < 2:
            return []
        out: list[Weighed] = []
        for k, old in enumerate(best.parts):
            alone = [one for one in singles if one.names == (old.effect,)]
            top = max((one.log_bayes for one in alone), default=0.0)
            for one in alone:
                (part,), (values,) = one.hypothesis.parts, one.hypothesis.values
                if part.key != old.key and one.log_bayes > top - _HOPELESS:
                    parts = [*best.parts[:k], part, *best.parts[k + 1 :]]
                    out += self.of(parts, [*best.values[:k], values, *best.values[k + 1 :]])
        return out

    def pruned(self, hypotheses: list[Weighed]) -> list[Weighed]:
        """Return the likeliest set without those of its effects that do next to nothing in it.

        A third effect may have helped the other two on their way to where they fit, and be idle.
        """
        best = max(hypotheses, key=lambda one: one.log_bayes).hypothesis
        explained = zip(best.energies_explained(), best.values, strict=True)
        idle = [energy < _IDLE * len(values) for energy, values in explained]
        if len(best.parts) < 2 or not any(idle) or all(idle):
            return []
        kept = [k for k, is_idle in enumerate(idle) if not is_idle]
        parts, start = [best.parts[k] for k in kept], [best.values[k] for k in kept]
        known = {frozenset(part.key for part in one.hypothesis.parts) for one in hypotheses}
        if frozenset(part.key for part in parts) in known:
            return []
        return self.of(parts, start)

    def _beside(
        self, behind: Background, seed: Hypothesis, single: Hypothesis
    ) -> tuple[float, Array]:
        """Return the log evidence that a fitted effect adds to a seed, and its numbers there.

        Linear about where the effect was fitted alone: a cable's pull is far from linear at none.
        """
        (part,) = single.parts
        change = self._observation.change(single.effects)
        rows = seed.raw_rows - change - part.unsimulated(single.values[0])
        gained = behind.sum_of_squares(seed.raw_rows) - behind.sum_of_squares(rows)
        gram, along = behind.reduced(single.columns, rows)
        found = evidence(gram, along, part.typical[: len(along)])
        low, high = part.limits()
        start = np.clip(single.values[0] + found.theta, low, high)
        return found.log_bayes + 0.5 * gained, start

    def grown(self, seeds: list[Weighed], singles: list[Weighed], most: int) -> list[Weighed]:
        """Return seeds with one more effect each, the likeliest fitted.

        An effect has to explain what neither the seed's effects nor what their models are off does.
        """
        chances: list[tuple[float, Hypothesis, Candidate, Array]] = []
        for seed in seeds:
            fit, behind = seed.hypothesis, self._forms.behind.beside(seed.hypothesis.columns)
            behind = behind.beside(seed.off, 1.0).beside(seed.rough, 1.0)
            judged = self._forms.judged(fit.raw_rows, behind)
            judged = [pair for pair in judged if pair[0].effect not in seed.names]
            for log, candidate, theta in _shortlist(judged, most, _WORTH_MORE):
                chances.append((seed.log_bayes + log, fit, candidate, theta))
            for single in singles:
                if single.names[0] not in seed.names:
                    log, start = self._beside(behind, fit, single.hypothesis)
                    if log > _WORTH_MORE:
                        part = single.hypothesis.parts[0]
                        chances.append((seed.log_bayes + log, fit, part, start))
        chances.sort(key=lambda chance: -chance[0])
        # Linear evidence of a nonlinear effect may fall short, but not without end.
        top = max((seed.log_bayes for seed in seeds), default=0.0)
        chances = [chance for chance in chances if chance[0] > top - _HOPELESS]
        out: list[Weighed] = []
        seen = set()
        for _, fit, candidate, theta in chances:
            if len(out) >= most:
                break
            begun, start = _begun(candidate, theta)
            key = frozenset(part.key for part in (*fit.parts, begun))
            if key not in seen:
                seen.add(key)
                out += self.of((*fit.parts, begun), (*fit.values, start))
        return out
