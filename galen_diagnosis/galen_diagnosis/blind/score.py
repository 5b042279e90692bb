"""Answers against labels: every number of the blind check's tables, and these in Markdown.

One recording is one unit of every rate. A diagnosis that failed counts as wrong, and as failed
beside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.blind.labels import Label, ParsedAnswer
from galen_diagnosis.blind.rates import ParameterError, Rate, calibration, compare, rate

STRENGTHS = ("faint", "clear", "gross")
SURE = ("clear", "gross")
"""Strengths that a diagnosis must get right; a faint one it may leave open."""
FALSE_POSITIVES = 0.05


@dataclass(frozen=True)
class Answered:
    """A label and the answer to it, None where the diagnosis failed."""

    label: Label
    said: ParsedAnswer | None

    @property
    def verdict(self) -> str:
        """Of a failed diagnosis one that is never right."""
        return "" if self.said is None else self.said.verdict

    @property
    def right(self) -> bool:
        """Whether the ranking's first is the truth."""
        return self.said is not None and self.said.first == self.label.answer

    @property
    def accepted(self) -> bool:
        """Whether it is the truth or can't be separated from it by this recording."""
        return self.said is not None and self.said.first in self.label.accepted

    @property
    def named(self) -> bool:
        """Whether the answer names the truth, or what can't be separated from it."""
        return self.said is not None and bool(self.label.accepted & self.said.named)

    @property
    def whole_set(self) -> bool:
        """Whether all names that can't be separated are named."""
        return self.said is not None and self.label.accepted - {NONE} <= self.said.named

    @property
    def unknown(self) -> float:
        """Probability of `unknown`."""
        return 0.0 if self.said is None else self.said.probability(UNKNOWN)


@dataclass(frozen=True)
class Score:
    """The whole of it; `_LINES` has one for each rate and number.

    rates: of recordings, by what is counted. numbers: all that aren't rates. classes: top-1 of
    none, every effect's singles and unknown, by strength (the empty word where a class has none).
    by_unknown: unknown ones found by the verdict, by kind. confusion (k, k): counts, row the truth,
    column the ranking's first, in the order of `names`.
    """

    cases: int
    failed: int
    rates: Mapping[str, Rate]
    numbers: Mapping[str, float | None]
    classes: Mapping[str, Mapping[str, Rate]]
    by_unknown: Mapping[str, Rate]
    names: tuple[str, ...]
    confusion: np.ndarray
    errors: tuple[ParameterError, ...]

    def to_json(self) -> dict[str, Any]:
        """All numbers, for `blind_check.json`."""
        return {
            "cases": self.cases,
            "failed": self.failed,
            "rates": {name: one.to_json() for name, one in self.rates.items()},
            "numbers": dict(self.numbers),
            "classes": {
                name: {strength or "all": one.to_json() for strength, one in own.items()}
                for name, own in self.classes.items()
            },
            "unknown_by_kind": {kind: one.to_json() for kind, one in self.by_unknown.items()},
            "confusion": {"names": list(self.names), "first": self.confusion.tolist()},
            "errors": [
                {**asdict(one), "in_sigma": one.in_sigma, "covered": one.covered}
                for one in self.errors
            ],
        }


def score(cases: Sequence[Answered], effects: Sequence[str]) -> Score:
    """Score all; effects: the names of the list, in its order."""
    names = (NONE, *effects, UNKNOWN)
    singles = [c for c in cases if c.label.kind == "single"]
    pairs = [c for c in cases if c.label.kind == "pair"]
    unknown = [c for c in cases if c.label.kind == UNKNOWN]
    plain = [c for c in cases if c.label.kind in (NONE, "single", UNKNOWN)]
    errors, words = _parameters([*singles, *pairs])
    threshold = _threshold([c.unknown for c in cases if c.label.kind != UNKNOWN])
    of_pairs, pair_f1 = _pairs(pairs)
    classes = {name: _by_strength(name, plain, lambda c: c.right) for name in names}
    twins_as_one = [_by_strength(name, plain, lambda c: c.accepted) for name in effects]
    return Score(
        cases=len(cases),
        failed=sum(c.said is None for c in cases),
        rates={
            **_rates(cases),
            **of_pairs,
            "unknown_at_5_percent": rate(
                threshold is not None and c.unknown > threshold for c in unknown
            ),
            "coverage": rate(e.covered for e in errors if e.covered is not None),
            "words": words,
        },
        numbers={
            "top1_by_class": _mean_of_classes([classes[name] for name in effects]),
            "top1_by_class_accepted": _mean_of_classes(twins_as_one),
            "unknown_threshold": threshold,
            "pairs_f1": pair_f1,
            "rms_error_sigma": _rms([e.in_sigma for e in errors if e.in_sigma is not None]),
            **calibration(
                [c.said.ranking for c in plain if c.said is not None],
                [c.label.answer for c in plain if c.said is not None],
            ),
            **_seconds(cases),
        },
        classes={name: own for name, own in classes.items() if own},
        by_unknown={
            kind: rate(c.verdict == UNKNOWN for c in unknown if c.label.unknown == kind)
            for kind in sorted({c.label.unknown for c in unknown})
        },
        names=names,
        confusion=_confusion(plain, names),
        errors=errors,
    )


def _rates(cases: Sequence[Answered]) -> dict[str, Rate]:
    """Rates that are counts of one property of some of the recordings."""
    singles = [c for c in cases if c.label.kind == "single"]
    faint = [c for c in singles if c.label.strength == "faint"]
    unknown = [c for c in cases if c.label.kind == UNKNOWN]
    twins = [
        c
        for c in cases
        if c.label.kind in ("single", "ambiguous")
        and c.label.strength != "faint"
        and len(c.label.accepted) > 1
    ]
    top1 = {
        f"top1_{strength}": rate(c.right for c in singles if c.label.strength == strength)
        for strength in STRENGTHS
    }
    return {
        **top1,
        "false_alarms": rate(c.verdict != NONE for c in cases if c.label.kind == NONE),
        "unknown_by_verdict": rate(c.verdict == UNKNOWN for c in unknown),
        "known_called_unknown": rate(
            c.verdict == UNKNOWN for c in cases if c.label.kind != UNKNOWN
        ),
        "faint_wrong_and_sure": rate(c.verdict == "identified" and not c.named for c in faint),
        "faint_called_none": rate(c.verdict == NONE for c in faint),
        "faint_open": rate(c.verdict in ("ambiguous", UNKNOWN) for c in faint),
        "ambiguous_whole": rate(c.whole_set for c in twins),
        "ambiguous_sure_of_less": rate(
            c.verdict == "identified" and not c.whole_set for c in twins
        ),
    }


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
        return answer.verdict != "identified" or case.named
    wanted = _wanted(label)
    alone = all(len(names) == 1 for names in wanted)
    verdicts = ("identified",) if alone else ("identified", "ambiguous")
    return answer.verdict in verdicts and _matched(wanted, answer.named) == len(wanted)


def _by_strength(
    name: str, plain: Sequence[Answered], hit: Callable[[Answered], bool]
) -> dict[str, Rate]:
    own: dict[str, list[bool]] = {}
    for case in plain:
        if case.label.answer == name:
            strength = case.label.strength if case.label.kind == "single" else ""
            own.setdefault(strength, []).append(hit(case))
    return {strength: rate(hits) for strength, hits in own.items()}


def sure_rate(by_strength: Mapping[str, Rate]) -> Rate:
    """Add up clear and gross ones; all where a class has no strengths."""
    found = [by_strength[s] for s in (*SURE, "") if s in by_strength]
    return Rate(sum(r.hits for r in found), sum(r.of for r in found))


def _mean_of_classes(classes: Iterable[Mapping[str, Rate]]) -> float | None:
    shares = [share for one in classes if (share := sure_rate(one).value) is not None]
    return float(np.mean(shares)) if shares else None


def _confusion(plain: Sequence[Answered], names: Sequence[str]) -> np.ndarray:
    place = {name: number for number, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), dtype=int)
    for case in plain:
        if case.said is not None and case.said.first in place:
            counts[place[case.label.answer], place[case.said.first]] += 1
    return counts


def _threshold(of_known: Sequence[float]) -> float | None:
    """Return the smallest value among theirs that at most 5 % of the known ones exceed."""
    if not of_known:
        return None
    return sorted(of_known, reverse=True)[int(FALSE_POSITIVES * len(of_known))]


def _pairs(pairs: Sequence[Answered]) -> tuple[dict[str, Rate], float | None]:
    """Precision, recall, both and no other; F1.

    A cause counts for an effect that this recording can't separate from it, each once.
    """
    hits = named = true = whole = 0
    for case in pairs:
        wanted = _wanted(case.label)
        causes = frozenset() if case.said is None else frozenset(case.said.causes)
        found = _matched(wanted, causes)
        hits += found
        named += len(causes)
        true += len(wanted)
        whole += found == len(causes) == len(wanted)
    rates = {
        "pairs_precision": Rate(hits, named),
        "pairs_recall": Rate(hits, true),
        "pairs_whole": Rate(whole, len(pairs)),
    }
    return rates, 2.0 * hits / (named + true) if true else None


def _wanted(label: Label) -> list[set[str]]:
    same = label.acceptable or tuple((name,) for name in label.names)
    return [set(names) | {own} for own, names in zip(label.names, same, strict=True)]


def _matched(wanted: Sequence[set[str]], causes: frozenset[str]) -> int:
    """Count the most causes that can each be given to another one of the wanted sets."""
    if not wanted or not causes:
        return 0
    fits = np.array([[float(cause in names) for cause in sorted(causes)] for names in wanted])
    rows, columns = linear_sum_assignment(-fits)
    return int(fits[rows, columns].sum())


def _seconds(cases: Sequence[Answered]) -> dict[str, float | None]:
    found = [c.said.seconds for c in cases if c.said is not None and c.said.seconds is not None]
    return {
        "seconds_median": float(np.median(found)) if found else None,
        "seconds_largest": max(found, default=None),
    }


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _parameters(cases: Sequence[Answered]) -> tuple[tuple[ParameterError, ...], Rate]:
    """Of causes that were found: numbers against their truth, words (axis, joint, bag) or not."""
    errors: list[ParameterError] = []
    words: list[bool] = []
    for case in cases:
        if case.said is None:
            continue
        for name, effect in zip(case.label.names, case.label.effects, strict=True):
            if name in case.said.causes:
                numbers, right = compare(
                    case.label.recording, name, effect["parameters"], case.said.causes[name]
                )
                errors += numbers
                words += [] if right is None else [right]
    return tuple(errors), rate(words)


# Tables

PROGRAM = "galen_diagnosis"
_SINGLES = "singles, clear and gross: top-1, mean over classes"
_LINES = (
    (_SINGLES, "≥ 95 %", "top1_by_class"),
    (f"{_SINGLES}, twins of this recording as one", "≥ 95 %", "top1_by_class_accepted"),
    *((f"singles, {strength}: top-1", "", f"top1_{strength}") for strength in STRENGTHS),
    ("healthy: false alarms", "≤ 3 %", "false_alarms"),
    ("unknown found at 5 % false positives", "≥ 85 %", "unknown_at_5_percent"),
    ("unknown found by the verdict", "", "unknown_by_verdict"),
    ("known called unknown", "", "known_called_unknown"),
    ("faint: wrong and sure", "≤ 3 %", "faint_wrong_and_sure"),
    ("faint: called none", "", "faint_called_none"),
    ("faint: left open", "", "faint_open"),
    ("pairs: F1", "≥ 0.90", "pairs_f1"),
    ("pairs: both and no other", "", "pairs_whole"),
    ("ambiguous: the whole set named", "", "ambiguous_whole"),
    ("ambiguous: sure of less", "", "ambiguous_sure_of_less"),
    ("parameters: coverage of 95 % intervals", "90–99 %", "coverage"),
    ("parameters: RMS error, own σ", "", "rms_error_sigma"),
    ("axis, joint, bag named right", "", "words"),
    ("calibration error (ECE)", "", "calibration_error"),
    ("calibration error by chance alone", "", "calibration_error_by_chance"),
    ("Brier score", "", "brier"),
    ("log score, nats", "", "log_score"),
    ("wall time of a recording, median, s", "≤ 30", "seconds_median"),
    ("wall time of a recording, longest, s", "", "seconds_largest"),
)


def markdown(scores: Mapping[str, Score]) -> str:
    """Return the tables; the first score is the program's."""
    names = list(scores)
    own = scores[names[0]]
    rows = [[what, goal, *(_cell(s, key) for s in scores.values())] for what, goal, key in _LINES]
    rows.append(
        ["diagnoses that failed", "", *(f"{s.failed} of {s.cases}" for s in scores.values())]
    )
    text = _table(["", "goal", *names], rows)
    classes = [
        [
            f"`{name}`",
            *(_counts(by_strength.get(strength)) for strength in (*STRENGTHS, "")),
            *(_counts(sure_rate(scores[other].classes.get(name, {}))) for other in names[1:]),
        ]
        for name, by_strength in own.classes.items()
    ]
    others = [f"{name}, clear and gross" for name in names[1:]]
    text += ["", *_table(["class: top-1", *STRENGTHS, "all", *others], classes)]
    if own.by_unknown:
        kinds = [[f"`{kind}`", percent(found)] for kind, found in own.by_unknown.items()]
        text += ["", *_table(["outside the list", "found by the verdict"], kinds)]
    return "\n".join([*text, "", *(f"- {sentence}" for sentence in confusions(own))])


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [headings, ["---"] * len(headings), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


def _cell(found: Score, key: str) -> str:
    if key in found.rates:
        return percent(found.rates[key])
    value = found.numbers[key]
    return "–" if value is None else f"{value:.3f}"


def confusions(found: Score, most: int = 12) -> list[str]:
    """Say what was most often taken for what, a sentence each."""
    wrong = found.confusion - np.diag(np.diag(found.confusion))
    pairs = np.argwhere(wrong)
    pairs = pairs[np.argsort(-wrong[tuple(pairs.T)], kind="stable")][:most]
    return [
        f"{found.names[row]} taken for {found.names[column]}: {wrong[row, column]} of"
        f" {found.confusion[row].sum()}"
        for row, column in pairs
    ]


def percent(found: Rate) -> str:
    """Return `97 % (93–99), 66 of 68`; a dash of nothing."""
    if found.value is None or found.interval is None:
        return "–"
    low, high = found.interval
    return (
        f"{100 * found.value:.0f} % ({100 * low:.0f}–{100 * high:.0f}), {found.hits} of {found.of}"
    )


def _counts(found: Rate | None) -> str:
    """`3/4`; empty of nothing."""
    return "" if found is None or not found.of else f"{found.hits}/{found.of}"
