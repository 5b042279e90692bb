# SPDX-License-Identifier: Apache-2.0
"""What was tested and not found: of each effect the largest size that would have been missed.

In the linear picture of a fit an effect of size theta has the strength (noncentrality)

    D = sqrt(theta^T G theta),    G = T^T P T,

with T how the rows change by the effect's numbers and P what is left of them beside the unknowns, a
healthy arm's tolerances and the effects that were found (`galen_model/estimation/evidence.py`).
Noise makes it D + z, z ~ N(0, 1). `detection_strength` asks the posterior itself for the D* from
which on the effect is answered; one of D* + 1.645 is missed in one recording of twenty (L. A.
Currie's detection limit, Analytical Chemistry 40, 1968). Each number is taken alone, the others
zero, with all of its form fitted; of an effect's forms (a knee, a side that a cable comes from, a
pair of axes) the one that is hardest to see counts. Jumps are those in the middle of a bag; nearer
to the recording's ends larger ones are missed. A linear picture: its sizes of a backlash or a cable
hold for small ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, evidence
from scipy.optimize import brentq

from galen_diagnosis.answer.answer import NO_GAP, UNKNOWN, Excluded, FoundCause
from galen_diagnosis.effects.candidates import Candidate, plain_form
from galen_diagnosis.effects.diagnosed_effect import no_forms
from galen_diagnosis.effects.forms import Forms
from galen_diagnosis.effects.registry import record_of, sought
from galen_diagnosis.inference.posterior import Scored, Settings, posterior
from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.observation.observation import Observation

if TYPE_CHECKING:
    from galen_diagnosis.inference.diagnosing import Explored

_FAR = 1e6
"""Energy that "none" leaves where something was found."""
_MISSED_ONCE_IN_20 = 1.645
_WEAKEST, _JUST_SEEN, _USUAL, _STRONGEST = 1.0, 10.0, 30.0, 1e3
"""Strengths that are tried; effects that are just seen have one of about 10."""
_Key = tuple[str, Any]
"""A parameter's name, and its place in a list or mapping, None for neither."""
_Form = tuple[Candidate, Array]
"""An effect in one form, G (p, p) of its numbers."""
_Words = tuple[tuple[_Key, str], ...]
_HIDDEN = "something unlisted is there and may hide it"


def detection_strength(settings: Settings, effect: str, occam: float, beside: Scored) -> float:
    """Return the strength from which on the posterior answers an effect.

    Args:
        settings: Of the posterior.
        effect: Its identity.
        occam: 1/2 log det of its numbers.
        beside: What is there already, with all that it leaves of the noise as `energy`; of nothing
            a `Scored` without names.

    Returns:
        D*, at least 1; infinite where it never does.

    """

    def short(strength: float) -> float:
        more = strength**2
        of = [Scored((), more + (_FAR if beside.names else 0.0), 0.0)]
        if beside.names:
            of.append(Scored(beside.names, more, beside.occam))
        of.append(Scored((*beside.names, effect), 0.0, beside.occam + occam))
        return posterior(of, settings).effects[effect] - (1.0 - NO_GAP)

    if short(_WEAKEST) > 0.0:
        return _WEAKEST
    for most in (_USUAL, _STRONGEST):
        if short(most) > 0.0:
            return float(brentq(short, _WEAKEST, most, xtol=0.02))
    return np.inf


def excluded_effects(
    explored: Explored,
    chosen: Hypothesis | None,
    causes: Sequence[FoundCause],
    verdict: str,
    settings: Settings,
) -> tuple[Excluded, ...]:
    """Return every effect that was sought and not found, with the size that it may have.

    Args:
        explored: What was looked at.
        chosen: The fit that was answered; None for none.
        causes: Those of the answer.
        verdict: That of the answer.
        settings: Of the posterior.

    Returns:
        One for each effect, in the order of `sought`.

    """
    observation, found = explored.observation, explored.found
    behind, beside = found.behind, Scored((), 0.0, 0.0)
    if chosen is not None:
        off = explored.found.discrepancies.all_of(chosen)
        behind = behind.beside(chosen.columns).beside(off, 1.0)
        fits = [one for one in explored.scored if set(one.names) == set(chosen.names)]
        beside = min(fits, key=lambda one: one.energy)
    forms = _forms(explored, behind) if verdict != UNKNOWN else {}
    named = {cause.label for cause in causes if verdict != UNKNOWN}
    alike = {name: cause.label for cause in causes for name in cause.equivalent}
    out = []
    for name in sought(observation.recording):
        if name in named:
            continue
        if verdict == UNKNOWN:
            out.append(Excluded(name, because=_HIDDEN))
        elif name in alike:
            out.append(Excluded(name, because=f"can't be distinguished from {alike[name]}"))
        elif record_of(name).limits is not no_forms:
            reached = np.max(
                [abs(b.wrenches).max(0) for b in observation.recording.bags.values()], 0
            )
            out.append(Excluded(name, missed_above={"limit": reached.tolist()}))
        elif name not in forms:
            out.append(Excluded(name, because=_why_unseen(name)))
        else:
            out.append(_missed(observation, forms[name], name, beside, settings))
    return tuple(out)


def _why_unseen(name: str) -> str:
    needed = record_of(name).needs
    return f"no {needed}" if needed else "too short a recording"


def _forms(explored: Explored, behind: Background) -> dict[str, list[_Form]]:
    """Return the forms of each effect by identity, those that hold a smaller one left out."""
    observation = explored.observation
    nothing = sought(observation.recording)
    out: dict[str, list[_Form]] = {}
    for one, gram, _ in explored.found.forms.reduced(behind, np.zeros(len(observation.rows))):
        if one.wider:
            continue
        form = one
        if one.make is not None:
            form = replace(plain_form(nothing[one.effect]), typical=one.typical)
        out.setdefault(one.effect, []).append((form, gram))
    for form, gram in _jumps(observation, behind, explored.found.forms):
        out.setdefault(form.effect, []).append((form, gram))
    return out


def _jumps(observation: Observation, behind: Background, forms: Forms) -> Iterator[_Form]:
    """Yield jumps in the middle of each bag."""
    jumps = [record_of(name).jump for name in sought(observation.recording)]
    unknowns = forms.behind.first(observation.unknowns).columns
    for name, view in observation.views.items():
        at_s = 0.5 * float(view.scene.wrench_s[-1])
        after = (observation.rows.session_s >= view.scene.start_s + at_s).astype(float)[:, None]
        for jump in jumps:
            if jump is not None and (view.tracks or not jump.tracked):
                columns = unknowns[:, jump.unknowns] * after
                yield plain_form(jump.effect(name, at_s)), behind.projected(columns).gram


def _missed(
    observation: Observation,
    forms: Sequence[_Form],
    name: str,
    beside: Scored,
    settings: Settings,
) -> Excluded:
    """Return the largest size missed, of forms with other words (axes, a joint, a bag) the largest.

    Words of which no size is seen are named.
    """
    parameters = record_of(name).parameters
    largest: dict[_Words, dict[_Key, tuple[float, Any]]] = {}
    for form, gram in forms:
        highest = form.limits()[1]
        plain = _flat(parameters(observation, form.base))
        words = tuple((key, value) for key, value in plain.items() if isinstance(value, str))
        of_words = largest.setdefault(words, {})
        for number in range(len(gram)):
            size = _size(gram, number, form.typical[: len(gram)], name, beside, settings)
            seen = bool(np.isfinite(size) and form.start[number] + size <= highest[number])
            moved = form.start.copy()
            moved[number] += size if seen else form.typical[number]
            changed = form.at(moved)
            for key, value in _flat(parameters(observation, changed)).items():
                relative = size / form.typical[number] if seen else np.inf
                if value != plain.get(key) and relative >= of_words.get(key, (0.0, None))[0]:
                    of_words[key] = relative, float(f"{value:.3g}") if seen else None
    hardest = {
        words: max((ratio for ratio, value in found.values() if value is not None), default=np.inf)
        for words, found in largest.items()
    }
    unseen = [words for words, ratio in hardest.items() if np.isinf(ratio)]
    if len(unseen) == len(largest):
        return Excluded(name, because="not seen in this recording at any size that it may have")
    worst = max(hardest.keys() - unseen, key=lambda words: hardest[words])
    values = {key: value for key, (_, value) in largest[worst].items()}
    own = {key: word for key, word in worst if key[0] != "joint" or ":" not in name}
    ways = ", ".join(" ".join(f"{key[0]} {word}" for key, word in words) for words in unseen)
    return Excluded(name, _nested({**own, **values}), because=f"not seen: {ways}" if ways else "")


def _size(
    gram: Array, number: int, typical: Array, name: str, beside: Scored, settings: Settings
) -> float:
    """Return how large one number is at the detection limit; infinite where it isn't seen.

    What a fit's numbers cost hardly depends on how large the effect is: it is taken of one that is
    just seen, which changes the size by 1 % or so.
    """
    per_unit = float(np.sqrt(max(gram[number, number], 0.0)))
    if per_unit * typical[number] < 1e-6:
        return np.inf
    theta = np.zeros(len(gram))
    theta[number] = _JUST_SEEN / per_unit
    log = evidence(gram, gram @ theta, typical).log_bayes
    occam = max(0.5 * _JUST_SEEN**2 - log, 0.0)
    strength = detection_strength(settings, name, occam, beside)
    return (strength + _MISSED_ONCE_IN_20) / per_unit


def _flat(parameters: Mapping[str, Any]) -> dict[_Key, Any]:
    """Return numbers and words one by one."""
    flat: dict[_Key, Any] = {}
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            flat |= {(name, entry): part for entry, part in value.items()}
        elif isinstance(value, list):
            flat |= {(name, place): part for place, part in enumerate(value)}
        else:
            flat[name, None] = value
    return flat


def _nested(flat: Mapping[_Key, Any]) -> dict[str, Any]:
    """Undo `_flat`."""
    out: dict[str, Any] = {}
    for (name, place), value in flat.items():
        if place is None:
            out[name] = value
        elif isinstance(place, int):
            out.setdefault(name, []).append(value)
        else:
            out.setdefault(name, {})[place] = value
    return out
