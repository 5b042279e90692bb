"""Answers against labels: every number of the blind check's table. Nothing is read or written here.

One recording is one unit of every rate. Where an answer is missing (a diagnosis that failed) it
counts as wrong, and as failed beside.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from scipy.optimize import linear_sum_assignment

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.blind.answers import Label, ParsedAnswer
from galen_diagnosis.blind.scoring.rates import (
    Calibration,
    ParameterError,
    Rate,
    calibration,
    compare,
    rate,
)

STRENGTHS = ("faint", "clear", "gross")
SURE = ("clear", "gross")
"""Strengths that a diagnosis must get right; a faint one it may leave open."""
FALSE_POSITIVES = 0.05
CLOSED_WITHIN = 0.03
"""How near to the oracle's the closed fraction should come."""


@dataclass(frozen=True)
class Answered:
    """A label and the answer to it, None where the diagnosis failed."""

    label: Label
    said: ParsedAnswer | None


@dataclass(frozen=True)
class ClassScore:
    """Of one class by strength (the empty word where a class has none).

    top1: the ranking's first is the truth. accepted: or can't be separated from it by this
    recording.
    """

    name: str
    top1: Mapping[str, Rate]
    accepted: Mapping[str, Rate]


def sure_rate(by_strength: Mapping[str, Rate]) -> Rate:
    """Over clear and gross ones; over all where a class has no strengths."""
    found = [by_strength[s] for s in (*SURE, "") if s in by_strength]
    return Rate(sum(r.hits for r in found), sum(r.of for r in found))


@dataclass(frozen=True)
class Score:
    """The whole of it. Rates are of recordings.

    classes: none, every effect's singles, unknown. top1, accepted: of singles, by strength, as in
    ClassScore. named: singles of clear and gross strength whose effect, or one that this recording
    can't separate from it, the answer names. by_class, by_class_accepted: the mean over classes at
    clear and gross strength. confusion (k, k): counts, row the truth,
    column the ranking's first, in the order of `names`; predicted (k, k): the sums of the
    probabilities in place of the first. false_alarms: healthy ones with a verdict other than none.
    unknown_at_5: unknown ones found at the threshold of P(unknown) that 5 % of the known ones
    pass; unknown_own: by the verdict; unknown_wrongly: known ones with that verdict.
    wrong_and_sure: faint singles with the verdict identified and the effect not among the named
    ones; faint_missed: those with the verdict none; faint_open: ambiguous or unknown.
    pair_f1: 2 TP / (2 TP + FP + FN) over the causes of all pairs; pair_whole: both and no other.
    Of recordings that can't separate their one effect from others, but for faint ones,
    ambiguous_held: all of these are named; ambiguous_alone: a subset of them named as identified
    without the others, or a wrong one. abstained: verdicts ambiguous and
    unknown, by kind. calibration: of the ranking's first; calibration_sure: without the faint ones.
    closed_error: closed fraction less the oracle's, of singles
    and pairs of clear and gross strength; closed_near: within 0.03.
    """

    cases: int
    failed: int
    classes: tuple[ClassScore, ...]
    top1: Mapping[str, Rate]
    accepted: Mapping[str, Rate]
    named: Rate
    by_class: float | None
    by_class_accepted: float | None
    names: tuple[str, ...]
    confusion: np.ndarray
    predicted: Array
    false_alarms: Rate
    unknown_at_5: Rate
    unknown_threshold: float | None
    unknown_own: Rate
    unknown_wrongly: Rate
    by_unknown: Mapping[str, Rate]
    wrong_and_sure: Rate
    faint_missed: Rate
    faint_open: Rate
    pair_f1: float | None
    pair_precision: Rate
    pair_recall: Rate
    pair_whole: Rate
    ambiguous_held: Rate
    ambiguous_alone: Rate
    abstained: Mapping[str, Rate]
    calibration: Calibration | None
    calibration_sure: Calibration | None
    errors: tuple[ParameterError, ...]
    words: Rate
    covered: Rate
    error_rms_sigma: float | None
    closed_error: Array
    closed_near: Rate
    seconds: Array


def score(cases: Sequence[Answered], effects: Sequence[str]) -> Score:
    """Score all; effects: the names of the list, in its order."""
    names = (NONE, *effects, UNKNOWN)
    singles = [c for c in cases if c.label.kind == "single"]
    sure = [c for c in singles if c.label.strength in SURE]
    faint = [c for c in singles if c.label.strength == "faint"]
    healthy = [c for c in cases if c.label.kind == NONE]
    unknown = [c for c in cases if c.label.kind == UNKNOWN]
    known = [c for c in cases if c.label.kind != UNKNOWN]
    pairs = [c for c in cases if c.label.kind == "pair"]
    twins = [
        c
        for c in cases
        if c.label.kind in ("single", "ambiguous")
        and c.label.strength != "faint"
        and len(c.label.accepted) > 1
    ]
    plain = [*healthy, *singles, *unknown]
    classes = tuple(_class(name, plain) for name in names)
    confusion, predicted = _confusion(plain, names)
    threshold = _threshold([_unknown(c) for c in known])
    told, of_told, of_true, f1 = _pairs(pairs)
    errors, words = _parameters([*singles, *pairs])
    in_sigma = [e.in_sigma for e in errors if e.in_sigma is not None]
    closed = np.array(
        [
            c.said.closed - c.label.oracle_closed
            for c in cases
            if c.said is not None
            and c.said.closed is not None
            and c.label.oracle_closed is not None
            and c.label.kind in ("single", "pair")
            and c.label.strength in SURE
        ]
    )
    return Score(
        cases=len(cases),
        failed=sum(c.said is None for c in cases),
        classes=classes,
        top1={s: rate(_right(c) for c in singles if c.label.strength == s) for s in STRENGTHS},
        accepted={
            s: rate(_accepted(c) for c in singles if c.label.strength == s) for s in STRENGTHS
        },
        named=rate(_named(c) for c in sure),
        by_class=_mean_of_classes([c.top1 for c in classes if c.name in effects]),
        by_class_accepted=_mean_of_classes([c.accepted for c in classes if c.name in effects]),
        names=names,
        confusion=confusion,
        predicted=predicted,
        false_alarms=rate(_verdict(c) != NONE for c in healthy),
        unknown_at_5=rate(threshold is not None and _unknown(c) > threshold for c in unknown),
        unknown_threshold=threshold,
        unknown_own=rate(_verdict(c) == UNKNOWN for c in unknown),
        unknown_wrongly=rate(_verdict(c) == UNKNOWN for c in known),
        by_unknown={
            kind: rate(_verdict(c) == UNKNOWN for c in unknown if c.label.unknown == kind)
            for kind in sorted({c.label.unknown for c in unknown})
        },
        wrong_and_sure=rate(_verdict(c) == "identified" and not _named(c) for c in faint),
        faint_missed=rate(_verdict(c) == NONE for c in faint),
        faint_open=rate(_verdict(c) in ("ambiguous", UNKNOWN) for c in faint),
        pair_f1=f1,
        pair_precision=of_told,
        pair_recall=of_true,
        pair_whole=told,
        ambiguous_held=rate(_holds(c) for c in twins),
        ambiguous_alone=rate(_verdict(c) == "identified" and not _holds(c) for c in twins),
        abstained={
            kind: rate(_verdict(c) in ("ambiguous", UNKNOWN) for c in cases if c.label.kind == kind)
            for kind in dict.fromkeys(c.label.kind for c in cases)
        },
        calibration=_calibration(plain),
        calibration_sure=_calibration([c for c in plain if c.label.strength != "faint"]),
        errors=errors,
        words=words,
        covered=rate(e.covered for e in errors if e.covered is not None),
        error_rms_sigma=float(np.sqrt(np.mean(np.square(in_sigma)))) if in_sigma else None,
        closed_error=closed,
        closed_near=rate(abs(error) <= CLOSED_WITHIN for error in closed),
        seconds=np.array(
            [c.said.seconds for c in cases if c.said is not None and c.said.seconds is not None]
        ),
    )


def wrong_answers(cases: Sequence[Answered]) -> list[str]:
    """Say which answers are wrong, one line each.

    Healthy and unlisted causes need their verdict, others all their effects or twins of these
    named, as identified where no twin is. A faint cause may be left open or missed.
    """
    return [
        f"{case.label.recording}: {_words(case)} of {' and '.join(case.label.names) or NONE}"
        for case in cases
        if not _answer_is_right(case)
    ]


def _words(case: Answered) -> str:
    if case.said is None:
        return "no answer"
    return f"verdict {case.said.verdict} ({', '.join(case.said.causes) or 'no cause'})"


def _answer_is_right(case: Answered) -> bool:
    label, answer = case.label, case.said
    if answer is None:
        return False
    if label.kind in (NONE, UNKNOWN):
        return answer.verdict == label.kind
    if label.strength == "faint":
        return answer.verdict != "identified" or _named(case)
    wanted = [set(names) | {own} for own, names in _wanted(label)]
    alone = all(len(names) == 1 for names in wanted)
    verdicts = ("identified",) if alone else ("identified", "ambiguous")
    found = _matched(wanted, sorted(answer.named))
    return answer.verdict in verdicts and found == len(wanted)


def _calibration(cases: Sequence[Answered]) -> Calibration | None:
    answered = [(dict(c.said.ranking), c.label.answer) for c in cases if c.said is not None]
    return calibration([ranking for ranking, _ in answered], [truth for _, truth in answered])


def _right(case: Answered) -> bool:
    return case.said is not None and case.said.first == case.label.answer


def _accepted(case: Answered) -> bool:
    return case.said is not None and case.said.first in case.label.accepted


def _named(case: Answered) -> bool:
    return case.said is not None and bool(case.label.accepted & case.said.named)


def _verdict(case: Answered) -> str:
    """A failed diagnosis has a verdict that is never right."""
    return "" if case.said is None else case.said.verdict


def _unknown(case: Answered) -> float:
    return 0.0 if case.said is None else case.said.probability(UNKNOWN)


def _holds(case: Answered) -> bool:
    return case.said is not None and case.label.accepted - {NONE} <= case.said.named


def _mean_of_classes(classes: Iterable[Mapping[str, Rate]]) -> float | None:
    shares = [share for one in classes if (share := sure_rate(one).value) is not None]
    return float(np.mean(shares)) if shares else None


def _class(name: str, plain: Sequence[Answered]) -> ClassScore:
    own = [(c, c.label.strength if c.label.kind == "single" else "") for c in plain]
    own = [(c, strength) for c, strength in own if c.label.answer == name]
    strengths = dict.fromkeys(strength for _, strength in own)
    return ClassScore(
        name,
        {s: rate(_right(c) for c, strength in own if strength == s) for s in strengths},
        {s: rate(_accepted(c) for c, strength in own if strength == s) for s in strengths},
    )


def _confusion(plain: Sequence[Answered], names: Sequence[str]) -> tuple[np.ndarray, Array]:
    place = {name: number for number, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), dtype=int)
    sums = np.zeros((len(names), len(names)))
    for case in plain:
        if case.said is None:
            continue
        row = place[case.label.answer]
        if case.said.first in place:
            counts[row, place[case.said.first]] += 1
        for name, probability in case.said.ranking.items():
            if name in place:
                sums[row, place[name]] += probability
    return counts, sums


def _threshold(of_known: Sequence[float]) -> float | None:
    """What at most 5 % of the known ones exceed: the smallest such value among theirs."""
    if not of_known:
        return None
    allowed = int(FALSE_POSITIVES * len(of_known))
    return sorted(of_known, reverse=True)[allowed]


def _pairs(pairs: Sequence[Answered]) -> tuple[Rate, Rate, Rate, float | None]:
    """Both found and no other; share of the told that is true, of the true that is told; F1.

    A cause counts for an effect that this recording can't separate from it, each once.
    """
    hits = told = true = whole = 0
    for case in pairs:
        wanted = [set(names) | {own} for own, names in _wanted(case.label)]
        causes = set() if case.said is None else set(case.said.causes)
        found = _matched(wanted, sorted(causes))
        hits += found
        told += len(causes)
        true += len(wanted)
        whole += found == len(causes) == len(wanted)
    f1 = 2.0 * hits / (told + true) if true else None
    return Rate(whole, len(pairs)), Rate(hits, told), Rate(hits, true), f1


def _wanted(label: Label) -> list[tuple[str, tuple[str, ...]]]:
    same = label.acceptable or tuple((name,) for name in label.names)
    return list(zip(label.names, same, strict=True))


def _matched(wanted: Sequence[set[str]], causes: Sequence[str]) -> int:
    """The most causes that can each be given to another one of the wanted sets."""
    if not wanted or not causes:
        return 0
    fits = np.array([[float(cause in names) for cause in causes] for names in wanted])
    rows, columns = linear_sum_assignment(-fits)
    return int(fits[rows, columns].sum())


def _parameters(cases: Sequence[Answered]) -> tuple[tuple[ParameterError, ...], Rate]:
    """Of causes that were found: numbers against their truth, words right or not."""
    errors: list[ParameterError] = []
    words: list[bool] = []
    for case in cases:
        if case.said is None:
            continue
        for name, effect in zip(case.label.names, case.label.effects, strict=True):
            if name not in case.said.causes:
                continue
            compared = compare(
                case.label.recording, name, effect["parameters"], case.said.causes[name]
            )
            errors += compared.numbers
            if compared.words is not None:
                words.append(compared.words)
    return tuple(errors), rate(words)


def to_json(found: Score) -> dict[str, Any]:
    """All numbers, for `blind_check.json`."""
    return {
        "cases": found.cases,
        "failed": found.failed,
        "top1_by_class_clear_and_gross": found.by_class,
        "top1_by_class_clear_and_gross_twins_as_one": found.by_class_accepted,
        "top1": {strength: r.to_json() for strength, r in found.top1.items()},
        "top1_twins_as_one": {strength: r.to_json() for strength, r in found.accepted.items()},
        "named_clear_and_gross": found.named.to_json(),
        "classes": {
            c.name: {strength or "all": r.to_json() for strength, r in c.top1.items()}
            for c in found.classes
            if c.top1
        },
        "confusion": {
            "names": list(found.names),
            "first": found.confusion.tolist(),
            "probabilities": np.round(found.predicted, 4).tolist(),
        },
        "false_alarms": found.false_alarms.to_json(),
        "unknown": {
            "found_at_5_percent_false_positives": found.unknown_at_5.to_json(),
            "threshold": found.unknown_threshold,
            "found_by_verdict": found.unknown_own.to_json(),
            "known_called_unknown": found.unknown_wrongly.to_json(),
            "by_kind": {kind: r.to_json() for kind, r in found.by_unknown.items()},
        },
        "faint": {
            "wrong_and_sure": found.wrong_and_sure.to_json(),
            "called_none": found.faint_missed.to_json(),
            "left_open": found.faint_open.to_json(),
        },
        "pairs": {
            "f1": found.pair_f1,
            "precision": found.pair_precision.to_json(),
            "recall": found.pair_recall.to_json(),
            "both_and_no_other": found.pair_whole.to_json(),
        },
        "ambiguous": {
            "whole_set_named": found.ambiguous_held.to_json(),
            "sure_of_less": found.ambiguous_alone.to_json(),
        },
        "abstained": {kind: r.to_json() for kind, r in found.abstained.items()},
        "calibration": None if found.calibration is None else found.calibration.to_json(),
        "calibration_without_faint": (
            None if found.calibration_sure is None else found.calibration_sure.to_json()
        ),
        "parameters": {
            "coverage_of_95_percent_intervals": found.covered.to_json(),
            "rms_error_in_own_sigma": found.error_rms_sigma,
            "words_right": found.words.to_json(),
            "errors": [
                {
                    "recording": e.recording, "effect": e.effect, "parameter": e.name,
                    "true": e.true, "said": e.said, "in_sigma": e.in_sigma, "covered": e.covered,
                }
                for e in found.errors
            ],
        },
        "closed_fraction": {
            "less_the_oracle_s_median": _median(found.closed_error),
            "less_the_oracle_s_median_size": _median(np.abs(found.closed_error)),
            "within_0.03": found.closed_near.to_json(),
        },
        "seconds": {
            "median": _median(found.seconds),
            "largest": float(np.max(found.seconds)) if len(found.seconds) else None,
        },
    }  # fmt: skip


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None
