"""Which effects explain a recording: singles, pairs and triples, by forward selection.

Every form of every effect is judged by its linear evidence first; the likeliest are fitted on the
simulator (`refine.py`). To the best of them every other effect is added, again linearly first, and
the best pairs are fitted; triples grow from pairs in the same way. The cable, whose pull is far
from linear in where it is held, is fitted from its few best starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.linear import Background, Evidence, evidence
from scipy.special import logsumexp

from galen_diagnosis.effects.candidates import (
    Candidate,
    background,
    candidates,
    tolerance,
    unknown_columns,
)
from galen_diagnosis.effects.scans import (
    crosstalk_candidates,
    drift_candidates,
    jump_candidate,
    saturation_candidates,
    scan_shifts,
    scan_steps,
)
from galen_diagnosis.inference.refine import Hypothesis, nothing, refine
from galen_diagnosis.observation.observation import Observation

Progress = Callable[[str, float], None]

_LINEAR_FORMS = {"cable_drag": 1, "backlash": 1}
"""Of some effects only the first numbers are linear from the start."""

_WORTH = 2.0
_WORTH_MORE = 4.0
_HOPELESS = 15.0
_IDLE = 9.0
_SINGLES, _PAIRS_FROM, _PAIRS, _TRIPLES = 7, 3, 4, 2
_FORMS_EACH = {"cable_drag": 3, "deflection_hysteresis": 2, "crosstalk": 2, "sensor_drift": 2}


@dataclass(frozen=True)
class Found:
    """What a search leaves.

    hypotheses: fitted, the likeliest first, `none` among them; linear: log Bayes factor of every
    effect by its columns alone, against none; columns: of every candidate by effect and form.
    """

    behind: Background
    hypotheses: tuple[Hypothesis, ...]
    linear: dict[str, float]
    none: Hypothesis
    columns: dict[tuple[str, str], Array]
    typical: dict[tuple[str, str], Array]


class _Forms:
    """All candidates with their columns at nominal."""

    def __init__(self, observation: Observation) -> None:
        self.observation = observation
        self.unknowns = unknown_columns(observation)
        self.all = candidates(observation)
        self.columns = {one.key: _columns(observation, one) for one in self.all}
        self.behind = background(observation, self.unknowns, self.columns)
        zero = self.unknowns[:, :6]
        linear = [*crosstalk_candidates(observation, zero), *drift_candidates(observation, zero)]
        self.all += linear
        self.columns |= {one.key: _columns(observation, one) for one in linear}
        for columns in self.columns.values():
            self.behind.remember(columns)
        self.limits = saturation_candidates(observation, zero)

    def judged(self, rows: Array, behind: Background) -> list[tuple[Candidate, Evidence]]:
        """Every form's evidence on rows (N,) beside a background, jumps in time included."""
        out = []
        for candidate in self.all:
            columns = self.columns[candidate.key]
            gram, along = behind.reduced(columns, rows)
            out.append((candidate, evidence(gram, along, candidate.typical[: len(along)])))
        for limit in self.limits:
            clipped = rows - self.observation.change([limit.base])
            gained = behind.sum_of_squares(rows) - behind.sum_of_squares(clipped)
            gram, along = behind.reduced(_columns(self.observation, limit), clipped)
            beyond = evidence(gram, along, limit.typical)
            log = beyond.log_bayes + 0.5 * gained + limit.bonus
            out.append((limit, replace(beyond, log_bayes=log, gain=beyond.gain + gained)))
        zero, marker = self.unknowns[:, :6], self.unknowns[:, 12:]
        for scan, columns in (
            (scan_steps(self.observation, zero, rows, behind), zero),
            (scan_shifts(self.observation, marker, rows, behind), marker),
        ):
            if scan is not None:
                best = scan.best()
                candidate = jump_candidate(self.observation, scan, columns, best)
                # Where the time is not known, a jump at any of them shares the probability.
                found = replace(scan.found[best], log_bayes=scan.log_bayes)
                out.append((candidate, found))
        return out


def _columns(observation: Observation, candidate: Candidate) -> Array:
    """How the prediction changes (N, p) from nominal by a candidate's linear numbers."""
    first = _LINEAR_FORMS.get(candidate.effect, len(candidate.start))
    part = replace(
        candidate,
        free=candidate.free[:first],
        start=candidate.start[:first],
        typical=candidate.typical[:first],
        probe=candidate.probe[:first],
    )
    return part.jacobian(observation, lambda values: [part.at(values)], part.start)


def healthy_background(observation: Observation) -> Background:
    """Return unknowns and a healthy arm's tolerances, without any search."""
    columns = {
        one.key: _columns(observation, one)
        for one in candidates(observation)
        if tolerance(observation, *one.key) is not None
    }
    return background(observation, unknown_columns(observation), columns)


def search(observation: Observation, progress: Progress | None = None) -> Found:
    """Look for the effects behind the rows."""
    say = progress or (lambda what, share: None)
    say("effects' columns", 0.1)
    forms = _Forms(observation)
    say("every effect alone", 0.4)
    none = nothing(observation, forms.behind)
    judged = forms.judged(none.raw_rows, forms.behind)
    say("the likeliest, on the simulator", 0.55)
    singles = [
        refine(observation, forms.behind, [candidate], [_start(candidate, found)], None, none.cost)
        for candidate, found in _shortlist(judged, _SINGLES, _WORTH)
    ]
    say("pairs", 0.7)
    pairs = _grown(observation, forms, _best(singles, _PAIRS_FROM), _PAIRS, none.cost)
    say("three together", 0.85)
    top = max((single.log_bayes for single in singles), default=0.0)
    best_pairs = _best([pair for pair in pairs if pair.log_bayes > top + _WORTH], 1)
    triples = _grown(observation, forms, best_pairs, _TRIPLES, none.cost)
    hypotheses = [none, *singles, *pairs, *triples]
    hypotheses += _pruned(observation, forms, hypotheses, none.cost)
    return Found(
        forms.behind,
        tuple(sorted(hypotheses, key=lambda hypothesis: -hypothesis.log_bayes)),
        _by_effect(judged),
        none,
        forms.columns,
        {one.key: one.typical for one in forms.all},
    )


def _by_effect(judged: list[tuple[Candidate, Evidence]]) -> dict[str, float]:
    """Log of the mean Bayes factor over each effect's forms."""
    logs: dict[str, list[float]] = {}
    for candidate, found in judged:
        logs.setdefault(candidate.effect, []).append(found.log_bayes)
    return {name: float(logsumexp(each) - np.log(len(each))) for name, each in logs.items()}


def _shortlist(
    judged: list[tuple[Candidate, Evidence]], most: int, worth: float
) -> list[tuple[Candidate, Evidence]]:
    """Return the likeliest forms: a few effects, of each a few forms."""
    ordered = sorted(judged, key=lambda pair: -pair[1].log_bayes)
    taken: dict[str, int] = {}
    out = []
    for candidate, found in ordered:
        if found.log_bayes < worth:
            break
        number = taken.get(candidate.effect, 0)
        if number >= _FORMS_EACH.get(candidate.effect, 1) or (number == 0 and len(taken) >= most):
            continue
        taken[candidate.effect] = number + 1
        out.append((candidate, found))
    return out


def _start(candidate: Candidate, found: Evidence) -> Array:
    """Where the fit begins: the linear answer, within limits, as far as it goes."""
    start = candidate.start.copy()
    start[: len(found.theta)] = found.theta
    low, high = candidate.limits()
    return np.clip(start, low, high)


def _best(hypotheses: list[Hypothesis], most: int) -> list[Hypothesis]:
    """Return the likeliest, one of each set of effects."""
    out: dict[frozenset[str], Hypothesis] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: -h.log_bayes):
        out.setdefault(frozenset(hypothesis.names), hypothesis)
    return list(out.values())[:most]


def _pruned(
    observation: Observation, forms: _Forms, hypotheses: list[Hypothesis], none_cost: float
) -> list[Hypothesis]:
    """Return the best fit without those of its effects that do next to nothing in it.

    A third effect may have helped the other two on their way to where they fit, and be idle there.
    """
    best = min(hypotheses, key=lambda hypothesis: hypothesis.cost)
    explained = zip(best.energies_explained(), best.values, strict=True)
    idle = [energy < _IDLE * len(values) for energy, values in explained]
    if len(best.parts) < 2 or not any(idle) or all(idle):
        return []
    kept = [k for k, is_idle in enumerate(idle) if not is_idle]
    parts, start = [best.parts[k] for k in kept], [best.values[k] for k in kept]
    return [refine(observation, forms.behind, parts, start, None, none_cost)]


def _grown(
    observation: Observation,
    forms: _Forms,
    seeds: list[Hypothesis],
    most: int,
    none_cost: float,
) -> list[Hypothesis]:
    """Seeds with one more effect each, the likeliest fitted."""
    chances: list[tuple[float, Hypothesis, Candidate, Evidence]] = []
    for seed in seeds:
        behind = forms.behind.with_free(seed.columns)
        judged = [
            pair for pair in forms.judged(seed.raw_rows, behind) if pair[0].effect not in seed.names
        ]
        for candidate, found in _shortlist(judged, most, _WORTH_MORE):
            chances.append((seed.log_bayes + found.log_bayes, seed, candidate, found))
    chances.sort(key=lambda chance: -chance[0])
    # Linear evidence of a nonlinear effect may fall short, but not without end.
    top = max((seed.log_bayes for seed in seeds), default=0.0)
    chances = [chance for chance in chances if chance[0] > top - _HOPELESS]
    out: list[Hypothesis] = []
    seen = set()
    for _, seed, candidate, found in chances:
        key = (frozenset((*seed.names, candidate.effect)), candidate.label)
        if key in seen or len(out) >= most:
            continue
        seen.add(key)
        parts, start = (*seed.parts, candidate), (*seed.values, _start(candidate, found))
        out.append(refine(observation, forms.behind, parts, start, None, none_cost))
    return out
