# SPDX-License-Identifier: Apache-2.0
"""Diagnoses one recording: from its rows to an answer with everything behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.estimation.evidence import Background, evidence
from scipy.linalg import block_diag

from galen_diagnosis.answer.answer import (
    NO_GAP,
    NONE,
    RESIDUAL,
    SURE,
    UNKNOWN,
    Answer,
    BudgetItem,
    Diagnosis,
    FoundCause,
    Interval,
    Verdict,
)
from galen_diagnosis.answer.localization import by_pose, localize
from galen_diagnosis.effects.registry import RECORDS, record_of, sought
from galen_diagnosis.experiment.next_experiment import Experiment, propose
from galen_diagnosis.experiment.separation import Alternative
from galen_diagnosis.inference.budget import budget, lies_within, tolerances_after
from galen_diagnosis.inference.earlier import after
from galen_diagnosis.inference.excluded import excluded_effects
from galen_diagnosis.inference.gap import Gap, covariance, held_out_gap, parameters
from galen_diagnosis.inference.posterior import (
    APART,
    Probabilities,
    Scored,
    Settings,
    excused,
    forgiven,
    load_settings,
    merge_equivalents,
    posterior,
    scored,
)
from galen_diagnosis.inference.refine import Hypothesis, refine
from galen_diagnosis.inference.search import Found, search
from galen_diagnosis.inference.structure import (
    BY_TIME,
    Structure,
    oscillation,
    own_past,
    remaining_energy,
    structures,
)
from galen_diagnosis.observation.observation import LEAST_NOISE, Observation
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.report.words import data_words, sentence

Progress = Callable[[str, float], None]

_LISTED, _WEIGHED = 0.05, 0.01
_CLEAR = 5.0
"""Log of the odds from which on remaining structure is reported."""
_LEAST_POSES = 4
_NOISE_STEPS, _HARDLY_LESS = 5, 0.9


@dataclass(frozen=True)
class Explored:
    """What was looked at, before any probability: enough for a posterior under any settings.

    floor: mean square of a row that noise alone gives; structures: in what the best fit leaves.
    alike: by a set of effects the others that the rows can't distinguish from it. within: by a set
    of effects those that lie within their limits as it is fitted, and so are no causes.
    """

    observation: Observation
    found: Found
    floor: float
    structures: tuple[Structure, ...]
    scored: tuple[Scored, ...]
    alike: dict[frozenset[str], tuple[frozenset[str], ...]] = field(default_factory=dict)
    within: dict[frozenset[str], frozenset[str]] = field(default_factory=dict)

    def beyond(self, names: Iterable[str]) -> frozenset[str]:
        """Return a set's effects that lie beyond their limits.

        Args:
            names: Identities of the set's effects.

        Returns:
            The set without those in `within`.

        """
        whole = frozenset(names)
        return whole - self.within.get(whole, frozenset())

    def equivalents(self, names: tuple[str, ...], effect: str) -> set[str]:
        """Return effects that take the place of one in a set that the rows can't distinguish.

        Args:
            names: Identities of the set's effects.
            effect: One of them.

        Returns:
            Identities.

        """
        whole = frozenset(names)
        return {
            name
            for other in self.alike.get(whole, ())
            if whole - other == {effect}
            for name in other - whole
        }


def explore(recording: DiagnosticRecording, progress: Progress | None = None) -> Explored:
    """Observe a recording and search for the effects behind it.

    Args:
        recording: What was read.
        progress: Called with what is done and the share of the whole, 0 ... 1.

    Returns:
        Hypotheses with all that a posterior needs.

    Raises:
        GalenError: The recording is too short, or doesn't show its noise.

    """
    say = progress or (lambda what, share: None)
    observation = Observation(recording)
    found = search(observation, progress)
    of = excused(found)
    first, best = of[0], of[0].hypothesis
    say("what the best fit leaves", 0.86)
    behind = found.behind.beside(best.columns).beside(first.off, 1.0)
    # What is rough in time and what depends on something else explain the same.
    seen = [
        one._replace(log_bayes=one.log_bayes - first.log_rough)
        for one in structures(observation, behind, best.raw_rows)
        if not (first.rough.shape[1] and one.name == BY_TIME)
    ]
    behind = behind.beside(first.rough, 1.0)
    varies = found.discrepancies.varying(behind, first)
    remaining, floor = remaining_energy(observation.rows, behind.left(best.raw_rows))
    healthy = found.forms.tolerances.effects(best.background)
    fast = oscillation(observation.streams_with((*best.effects, *healthy), best.unknowns))
    swing = 0.0
    if fast is not None and _swings(best.names):
        swing = max(fast.log_bayes, 0.0)
    elif fast is not None:
        seen.append(fast)
    clearest = max([one.log_bayes for one in seen], default=0.0)
    clear = first.answered(clearest, shaped=True)
    varied = max([one.log_bayes for one in varies], default=0.0)
    structure = max(clear, varied)
    left = max(first.answered(remaining), 2.0 * structure)
    sums = [
        one if _swings(one.names) else replace(one, energy=one.energy + 2.0 * swing)
        for one in scored(of, left, structure)
    ]
    sums = forgiven(sums, 2.0 * (clearest - clear))
    fitted = {one.names[0] for one in sums if len(one.names) == 1}
    past = None
    if recording.readings is None:
        past = own_past(observation, found.behind, found.none.raw_rows)
        alone = past.log_bayes
        sums = [
            one if one.names else replace(one, structure=max(one.structure, alone)) for one in sums
        ]
        # What remains of it is what it explains beyond the best that is listed.
        past = past._replace(log_bayes=past.log_bayes - first.log_bayes)
    sums, alike = merge_equivalents(found.behind, of, sums)
    least = min(one.energy for one in sums)
    none = next(one for one in sums if not one.names)
    for name, log in found.linear.items():
        if name not in fitted:
            # Not worth a fit: what its columns alone say.
            energy = max(none.energy - 2.0 * max(log, 0.0), least)
            sums.append(Scored((name,), energy, max(-log, 0.0)))
    all_seen = (*seen, *varies, *([past] if past else []))
    return Explored(observation, found, floor, all_seen, tuple(sums), alike)


def _swings(names: Iterable[str]) -> bool:
    return any(record_of(name).swings for name in names)


def diagnose_recording(
    recording: DiagnosticRecording,
    settings: Settings | None = None,
    progress: Progress | None = None,
    references: Sequence[DiagnosticRecording] = (),
) -> Diagnosis:
    """Diagnose a recording.

    Args:
        recording: What was read.
        settings: Of the posterior; None for the package's calibration.
        progress: Called with what is done and the share of the whole, 0 ... 1.
        references: Earlier recordings of the same arm, by time: what is diagnosed is what has
            changed.

    Returns:
        The answer and the residuals behind it.

    Raises:
        GalenError: A recording is too short or doesn't show its noise, or a reference's arm has
            other joints.

    """
    say = progress or (lambda what, share: None)
    settings = settings or load_settings()
    for one in references:
        if one.arm.joint_names != recording.arm.joint_names:
            raise GalenError(
                f"{one.name}: no reference of {recording.name}, since its arm has other joints:"
                f" {', '.join(one.arm.joint_names)}, not {', '.join(recording.arm.joint_names)}"
            )
    for number, one in enumerate(references):
        known = one
        if recording.earlier is not None:
            limits = recording.specification
            known = replace(one, earlier=recording.earlier, specification=limits)
        explored = explore(known, _part(say, number, len(references) + 1, f"{one.name}: "))
        fit = fit_of_causes(explored, settings)
        found = explored.found
        off = found.discrepancies.all_of(fit)
        tolerances = found.forms.tolerances
        numbers = tolerances_after(explored.observation, found.behind, tolerances, fit, off)
        recording = after(recording, known, tolerances, *numbers, fit)
    say = _part(say, len(references), len(references) + 1)
    say("reading against the nominal arm", 0.02)
    explored = explore(recording, say)
    for _ in range(_NOISE_STEPS):
        quieter = _less_noise(explored, settings)
        if quieter is None:
            break
        explored = explore(quieter, say)
    return conclude(explored, settings, say)


def _less_noise(explored: Explored, settings: Settings) -> DiagnosticRecording | None:
    """Return a table with the noise that its causes leave; None where that is hardly less.

    Noise that nothing has measured is at first what no map of gravity explains.
    """
    recording = explored.observation.recording
    if recording.readings is None or recording.readings.noise_known:
        return None
    fit = fit_of_causes(explored, settings)
    if not fit.parts:
        return None
    std, own = recording.readings.noise_std, explored.observation.unknown.shape[1]
    left = explored.found.behind.left(fit.raw_rows).reshape(-1, 2, 3) * std.reshape(2, 3)
    numbers = own + sum(len(values) for values in fit.values)
    freedom = 3 * len(left) - 0.5 * numbers
    if freedom < 3.0:
        return None
    square = np.sum(left**2, axis=(0, 2)) / freedom
    less = np.clip(np.repeat(np.sqrt(square), 3), LEAST_NOISE, std)
    if np.all(less > _HARDLY_LESS * std):
        return None
    name, bag = next(iter(recording.bags.items()))
    readings = replace(recording.readings, noise_std=less)
    return replace(recording, bags={name: replace(bag, readings=readings)})


def _part(say: Progress, number: int, parts: int, name: str = "") -> Progress:
    """Return the progress of one of several parts, which take as long each."""
    return lambda what, share: say(name + what, (number + share) / parts)


def conclude(explored: Explored, settings: Settings, say: Progress) -> Diagnosis:
    """Return probabilities, verdict, held-out gap, where it lies, what to do next.

    Args:
        explored: What was looked at.
        settings: Of the posterior.
        say: Called with what is done and the share of the whole, 0 ... 1.

    Returns:
        The answer and the residuals behind it.

    """
    observation, found = explored.observation, explored.found
    chances = posterior(explored.scored, settings)
    explored = replace(explored, within=within_limits(explored, chances))
    chances = _of_causes(explored, chances)
    verdict, chosen = _verdict(explored, chances)
    best = chosen or found.none
    plain = found.behind.first(observation.unknowns)
    say("held out", 0.88)
    gap = held_out_gap(observation, best, found.behind, explored.floor, say)
    if gap.fraction is not None and verdict in ("identified", "ambiguous"):
        closed = gap.fraction.low if verdict == "identified" else gap.fraction.value
        if (closed or 0.0) < 0.0:
            verdict = "unknown"  # what was fitted doesn't hold where it wasn't
    limits, readings = observation.recording.specification, observation.recording.readings
    say("what the gap is made of", 0.96)
    parts = _parts(explored, verdict, best)
    more = any(one.label == RESIDUAL and one.share.value > 1.0 for one in parts)
    # Where an arm stuck before it was pushed is a residual, too: of readings only.
    if more and readings is not None and verdict in ("identified", "ambiguous"):
        verdict = "unknown"  # with them more is left than without
        parts = _parts(explored, verdict, best)
    none = refine(observation, plain, (), ())
    whole = none
    if best.parts:
        whole = refine(observation, plain, best.parts, best.values, None, 0.0, best.nuisance)
    say("where", 0.97)
    healthy = _healthy(observation, found, plain)
    causes = _causes(explored, chances, verdict, best, gap)
    say("what next", 0.98)
    experiment = _next(explored, chances, verdict)
    answer = Answer(
        recording=observation.recording.name,
        verdict=verdict,
        causes=causes,
        ranking=_ranking(explored, chances),
        where=localize(observation.rows, none.rows, explored.floor, healthy),
        gap=gap.to_json(),
        next_experiment=None if experiment is None else experiment.to_json(),
        cannot_tell=_cannot_tell(observation),
        problems=observation.recording.problems,
        remaining=_remaining(explored),
        tested=excluded_effects(explored, chosen, causes, verdict, settings),
        data=data_words(observation.recording),
        reference=observation.recording.reference,
        notes=() if readings is None else readings.notes,
        budget=parts,
        specification={"name": limits.name, "source": limits.source},
    )
    return Diagnosis(
        answer=replace(answer, sentence=sentence(answer)),
        rows=observation.rows,
        held_out_before=gap.before,
        held_out_after=gap.after,
        streams_before=observation.streams_with((), none.unknowns),
        streams_after=observation.streams_with(whole.effects, whole.unknowns),
        effects=best.effects if verdict in ("identified", "ambiguous") else (),
        floor=explored.floor,
        experiment=experiment,
        healthy=healthy,
    )


def _parts(explored: Explored, verdict: Verdict, best: Hypothesis) -> tuple[BudgetItem, ...]:
    """Return what the gap is made of by a verdict."""
    found, within = explored.found, _in_budget(explored, verdict, best)
    parts = budget(
        explored.observation,
        found.behind,
        found.forms.tolerances,
        within,
        found.discrepancies.all_of(within),
        explored.floor,
    )
    if verdict == UNKNOWN:  # a healthy arm's deviations then stand for what is not on the list
        parts = tuple(replace(one, probability_beyond=None) for one in parts)
    return parts


def _healthy(observation: Observation, found: Found, plain: Background) -> Array:
    """How the rows change by each tolerance of a healthy arm, after the unknowns' fit: (N, q)."""
    first = observation.unknowns
    tolerances = found.behind.columns[:, first:] * found.behind.prior_std[first:]
    return plain.left(tolerances)


def _sets(explored: Explored, chances: Probabilities) -> list[tuple[float, frozenset[str]]]:
    """Return sets of effects by probability, the likeliest first."""
    total: dict[frozenset[str], float] = {}
    for one, chance in zip(explored.scored, chances.hypotheses, strict=True):
        if key := explored.beyond(one.names):
            total[key] = total.get(key, 0.0) + chance
    return sorted(((chance, names) for names, chance in total.items()), key=lambda x: -x[0])


def _fitted(explored: Explored, names: frozenset[str]) -> Hypothesis | None:
    """Return the likeliest fit of a set of effects that are beyond their limits."""
    likeliest_first = explored.found.hypotheses
    fits = (one for one in likeliest_first if one.parts and explored.beyond(one.names) == names)
    return next(fits, None)


def fit_of_causes(explored: Explored, settings: Settings) -> Hypothesis:
    """Return the fit of the causes that are there, or of none.

    Args:
        explored: What was looked at.
        settings: Of the posterior.

    Returns:
        The likeliest set's fit, unless the verdict is none.

    """
    verdict, best = _verdict(explored, posterior(explored.scored, settings))
    return explored.found.none if best is None or verdict == NONE else best


def within_limits(
    explored: Explored, chances: Probabilities
) -> dict[frozenset[str], frozenset[str]]:
    """Return which effects of each set lie within their limits where it is fitted best.

    What a healthy arm's deviations are fitted of beside every cause lies beyond where it is one.

    Args:
        explored: What was looked at.
        chances: Probabilities of its hypotheses; unlikely sets are left out.

    Returns:
        By set of effects those of it that lie within.

    """
    out = {}
    for chance, names in _sets(explored, chances):
        fit = _fitted(explored, names)
        if chance < _WEIGHED or fit is None:
            continue
        off = explored.found.discrepancies.all_of(fit)
        spread = covariance(explored.observation, explored.found.behind, off, fit)
        within = [
            part.effect
            for part, values, where in zip(fit.parts, fit.values, fit.slices(), strict=True)
            if not record_of(part.effect).healthy
            and lies_within(explored.observation, part, values, spread[where, where])
        ]
        if within:
            out[names] = frozenset(within)
    return out


def _of_causes(explored: Explored, chances: Probabilities) -> Probabilities:
    """Return probabilities of effects beyond their limits: what lies within is as good as none."""
    if not explored.within:
        return chances
    effects: dict[str, float] = {}
    none = chances.none
    for one, chance in zip(explored.scored, chances.hypotheses, strict=True):
        beyond = explored.beyond(one.names)
        none += chance if one.names and not beyond else 0.0
        for name in beyond:
            effects[name] = min(1.0, effects.get(name, 0.0) + chance)
    return replace(chances, none=min(1.0, none), effects=effects)


def _in_budget(explored: Explored, verdict: Verdict, best: Hypothesis | None) -> Hypothesis:
    """Return the fit whose effects, and what a healthy arm has, the gap is made of."""
    if verdict in ("identified", "ambiguous") and best is not None:
        return best
    within = {names for names in explored.within if not explored.beyond(names)}
    fits = (one for one in explored.found.hypotheses if frozenset(one.names) in within)
    none = explored.found.none
    return next(fits, none) if verdict == NONE else none


def _verdict(explored: Explored, chances: Probabilities) -> tuple[Verdict, Hypothesis | None]:
    sets = _sets(explored, chances)
    best = next((fit for _, names in sets if (fit := _fitted(explored, names)) is not None), None)
    if best is None or chances.none >= max(NO_GAP, chances.unknown):
        return ("unknown" if chances.unknown > chances.none else "none"), None
    if chances.unknown >= 0.5:
        return "unknown", best
    # Effects of equal columns hide behind one name: `_causes` lists them.
    names = explored.beyond(best.names)
    sure = sets[0][0] >= SURE and sets[0][1] == names and names not in explored.alike
    return ("identified" if sure else "ambiguous"), best


def _causes(
    explored: Explored,
    chances: Probabilities,
    verdict: Verdict,
    best: Hypothesis,
    gap: Gap,
) -> tuple[FoundCause, ...]:
    """Return the best fit's effects and, where ambiguous, those of other likely fits."""
    if verdict == NONE:
        return ()
    found = explored.found
    causes: dict[str, FoundCause] = {}
    fits = [best]
    if verdict == "ambiguous":
        for chance, names in _sets(explored, chances):
            fit = _fitted(explored, names)
            if chance >= _LISTED and fit is not None and fit is not best:
                fits.append(fit)
    for number, fit in enumerate(fits):
        off = explored.found.discrepancies.all_of(fit)
        spread = covariance(explored.observation, found.behind, off, fit)
        found_parameters = parameters(explored.observation, fit, spread)
        for index, (part, named) in enumerate(zip(fit.parts, found_parameters, strict=True)):
            if part.effect in causes or part.effect not in explored.beyond(fit.names):
                continue
            closed = gap.fraction if number == 0 and len(fit.parts) == 1 else None
            joint = named.pop("joint", None)
            causes[part.effect] = FoundCause(
                effect=part.effect.partition(":")[0],
                joint=joint,
                probability=chances.effects.get(part.effect, 0.0),
                parameters=named,
                equivalent=_equivalent(explored, fit, index),
                model=part.model,
                gap_closed=closed or (_share_closed(gap, fit, index) if number == 0 else None),
            )
    return tuple(sorted(causes.values(), key=lambda cause: -cause.probability))


def _share_closed(gap: Gap, fit: Hypothesis, index: int) -> Interval | None:
    """Return an effect's part of what a fit of several closes: by how much F rises without it."""
    if gap.fraction is None:
        return None
    energies = fit.energies_explained()
    share = energies[index] / max(sum(energies), 1e-12)
    value = gap.fraction.value * share
    return Interval(float(value), None, None)


def _equivalent(explored: Explored, fit: Hypothesis, index: int) -> tuple[str, ...]:
    """Effects that do the same as this one to the rows, but for less than APART of noise."""
    found = explored.found
    part = fit.parts[index]
    where_ = fit.slices()[index]
    does = fit.columns[:, where_] @ (fit.values[index] - part.start)
    whole = found.behind.sum_of_squares(does)
    if whole < APART**2:
        return ()  # it does next to nothing: everything does the same
    out: set[str] = set()
    for one, gram, along in found.forms.reduced(found.behind, does):
        if one.effect not in fit.names and one.effect not in out:
            got = evidence(gram, along, 30.0 * one.typical[: len(along)])
            if whole - got.gain < APART**2:
                out.add(one.effect)
    out |= explored.equivalents(fit.names, part.effect)
    return tuple(name for name in sought(explored.observation.recording) if name in out)


def _ranking(explored: Explored, chances: Probabilities) -> tuple[tuple[str, float], ...]:
    each = {name: chances.effects.get(name, 0.0) for name in sought(explored.observation.recording)}
    # What can't be distinguished is as likely.
    for chance, names in _sets(explored, chances):
        for effect in names:
            for other in explored.equivalents(tuple(names), effect):
                each[other] = max(each.get(other, 0.0), chance)
    each[NONE], each[UNKNOWN] = chances.none, chances.unknown
    return tuple(sorted(each.items(), key=lambda pair: -pair[1]))


def _next(explored: Explored, chances: Probabilities, verdict: Verdict) -> Experiment | None:
    """Return the experiment for the fits that are left, where more than one is."""
    if verdict != "ambiguous":
        return None
    left = []
    for whole, names in _sets(explored, chances)[:3]:
        alike = (names, *explored.alike.get(names, ()))
        chance = whole / len(alike)
        fits = [fit for one in alike if (fit := _fitted(explored, one)) is not None]
        if chance >= _LISTED:
            left += [Alternative(fit.effects, chance, _full_covariance(fit)) for fit in fits]
    if len(left) < 2:
        return None
    stood = _stood(explored.observation)
    return propose(left, explored.observation.recording.tool, stood) if len(stood) else None


def _stood(observation: Observation) -> Array:
    """Return joints (n, joints) where the arm stood; none of too few poses to choose from."""
    if observation.recording.readings is not None:
        return np.array([])  # of a table's arm nothing is known
    if observation.recording.arm.joint_names == GALEN.joint_names:
        return GALEN.home[None]  # its experiments are on a grid
    found = [list(one["joints"].values()) for one in by_pose(observation.rows).details]
    return np.array(found if len(found) >= _LEAST_POSES else [])


def _full_covariance(fit: Hypothesis) -> Array:
    """Of the effects' whole vectors: zero where a number wasn't fitted."""
    blocks = []
    for part, where_, effect in zip(fit.parts, fit.slices(), fit.effects, strict=True):
        size = len(effect.vector())
        block = np.zeros((size, size))
        free = part.free if len(part.free) <= size else np.arange(size)
        if not part.inputs:
            inner = fit.covariance[where_, where_][: len(free), : len(free)]
            block[np.ix_(free, free)] = inner
        blocks.append(block)
    return np.asarray(block_diag(*blocks))


def _remaining(explored: Explored) -> tuple[dict[str, Any], ...]:
    """Return structure in what the best fit leaves, as far as that is no chance."""
    clear = [one for one in explored.structures if one.log_bayes > _CLEAR]
    return tuple(
        {"what": one.name, "energy": one.energy, "log_bayes": one.log_bayes}
        for one in sorted(clear, key=lambda one: -one.log_bayes)
    )


def _cannot_tell(observation: Observation) -> tuple[str, ...]:
    """Return what is missing, and which effects it hides."""
    recording = observation.recording
    if recording.readings is not None:
        reasons: dict[str, list[str]] = {}
        for name, reason in recording.readings.hidden.items():
            reasons.setdefault(reason, []).append(name)
        return tuple(f"{', '.join(names)}: {reason}" for reason, names in reasons.items())
    out = [f"no {name}: not diagnosed" for name in recording.missing]
    if not any(view.tracks for view in observation.views.values()):
        out.append(f"no tracker: {_needing('tracker', sought(recording))} can't be seen")
    if "motion" in recording.missing and "sweep" in recording.missing:
        out.append(f"no motion: {_needing('motion', sorted(RECORDS))} can't be seen")
    if not len(_stood(observation)):
        out.append(
            f"still at fewer than {_LEAST_POSES} poses: no next experiment is proposed, since where"
            " else the arm may stand is not known"
        )
    return tuple(out)


def _needing(what: str, names: Iterable[str]) -> str:
    return ", ".join(name for name in names if record_of(name).needs == what)
