# SPDX-License-Identifier: Apache-2.0
"""Answers against labels: every number of the blind check.

One recording is one unit of every rate. A missing or malformed answer is wrong, and named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_model.arrays import Array
from galen_model.json_fields import FieldError
from scipy.optimize import linear_sum_assignment
from scipy.stats import binomtest

from galen_validation.blind.answers import Estimate, ParsedAnswer, flat, read_answer
from galen_validation.blind.labels import Label

_BINS = 10


class Rate(NamedTuple):
    """`hits` of `of`."""

    hits: int
    of: int

    @property
    def value(self) -> float | None:
        """The share; None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
        if not self.of:
            return None
        found = binomtest(self.hits, self.of).proportion_ci(0.95, method="wilson")
        return float(found.low), float(found.high)


def rate(hits: Iterable[bool]) -> Rate:
    """Count hits.

    Args:
        hits: Whether each recording is one.

    Returns:
        Number of hits and of recordings.

    """
    found = [bool(hit) for hit in hits]
    return Rate(sum(found), len(found))


@dataclass(frozen=True)
class Answered:
    """A label and the answer to it, None where there is no valid one, for the reason `why`."""

    label: Label
    said: ParsedAnswer | None
    why: str = ""

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
    def all_named(self) -> bool:
        """Whether every effect, or what can't be separated from it, is named."""
        wanted = self.label.wanted
        return self.said is not None and matched(wanted, self.said.named) == len(wanted)

    @property
    def whole(self) -> bool:
        """Whether every effect is named, and as many causes as there are effects."""
        return (
            self.said is not None
            and self.all_named
            and len(self.said.causes) == len(self.label.names)
        )

    @property
    def solved(self) -> bool:
        """Whether verdict and causes are right; with twins `ambiguous` is, too."""
        if self.label.answer in (NONE, UNKNOWN):
            return self.verdict == self.label.answer
        alone = all(len(names) == 1 for names in self.label.wanted)
        return self.verdict in ("identified", "" if alone else "ambiguous") and self.all_named

    @property
    def wrong_and_sure(self) -> bool:
        """Whether a user would be misled.

        `identified` with a cause that isn't there, by none of the names that can't be separated
        from it, or `none` with a clear or gross cause.
        """
        if self.said is None or self.said.verdict != "identified":
            return self.verdict == NONE and self.label.sure
        there = frozenset().union(*self.label.wanted)
        causes = self.said.causes.values()
        return not causes or any(there.isdisjoint(cause.same) for cause in causes)


def read_answers(labels: Sequence[Label], tool: Path) -> list[Answered]:
    """Return labels with a tool's answers.

    Args:
        labels: Labels of the set.
        tool: The tool's folder of answers.

    Returns:
        One for each label, in their order; missing and malformed answers are None, with the reason.

    """
    found = []
    for label in labels:
        try:
            found.append(Answered(label, read_answer(tool, label.recording)))
        except FieldError as error:
            found.append(Answered(label, None, f"{error}"))
    return found


@dataclass(frozen=True)
class ParameterError:
    """One number of one cause, SI: the truth, what was told, and the largest of its vector."""

    recording: str
    effect: str
    name: str
    true: float
    scale: float
    told: Estimate | None

    @property
    def relative(self) -> float | None:
        """|told - true| over the scale; None where nothing was told."""
        return None if self.told is None else abs(self.told.value - self.true) / self.scale

    @property
    def covered(self) -> bool | None:
        """Whether the 95 % interval holds the truth; None without one."""
        if self.told is None or self.told.low is None or self.told.high is None:
            return None
        return self.told.low <= self.true <= self.told.high


@dataclass(frozen=True)
class Score:
    """The whole of it.

    values: rates and numbers by name, as in `table.LINES`. classes: what was right by class and
    strength (the empty word where it has none): singles of each effect by the ranking's first,
    healthy and unlisted ones by the verdict. members: of clear and gross singles by effect and
    member: right, called unknown, wrong and sure. confusions: truth and the ranking's first where
    they differ. failed: recordings without a valid answer, and why.
    """

    cases: int
    values: Mapping[str, Rate | float | None]
    classes: Mapping[str, Mapping[str, Rate]]
    members: Mapping[tuple[str, str], tuple[Rate, Rate, Rate]]
    confusions: Mapping[tuple[str, str], int]
    errors: tuple[ParameterError, ...]
    failed: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """All numbers; a rate has its value, interval and counts."""
        return {
            "cases": self.cases,
            "values": {name: _plain(value) for name, value in self.values.items()},
            "classes": {
                name: {strength or "all": _plain(one) for strength, one in own.items()}
                for name, own in self.classes.items()
            },
            "members": [
                {"effect": effect, "member": member}
                | {k: _plain(v) for k, v in zip(MEMBER_COLUMNS, rates, strict=True)}
                for (effect, member), rates in self.members.items()
            ],
            "confusions": [[*pair, count] for pair, count in self.confusions.items()],
            "errors": [asdict(one) for one in self.errors],
            "failed": dict(self.failed),
        }


MEMBER_COLUMNS = ("right", "unknown", "wrong_and_sure")


def _plain(value: Rate | float | None) -> Any:
    if not isinstance(value, Rate):
        return value
    return {"value": value.value, "wilson95": value.interval, **value._asdict()}


def score(cases: Sequence[Answered]) -> Score:
    """Score one tool's answers to all recordings of a set, or to some.

    Args:
        cases: Labels with their answers.

    Returns:
        All rates and numbers; those of no recording are empty rates or None.

    """
    singles = [c for c in cases if c.label.kind == "single"]
    plain = [c for c in cases if c.label.kind in (NONE, "single", UNKNOWN)]
    sure = [c for c in plain if c.label.sure or c.label.kind == NONE]
    classes = _by_strength(plain, _class_right)
    effects = {c.label.effect for c in singles}
    accepted = _by_strength(singles, lambda c: c.accepted)
    seconds = [c.said.seconds for c in cases if c.said is not None and c.said.seconds is not None]
    errors, words = _parameters(cases)
    confusions = Counter(
        ((*c.label.names, NONE)[0], c.said.first)
        for c in plain
        if c.said is not None and not c.right
    )
    return Score(
        cases=len(cases),
        values={
            **_rates(cases),
            **_of_parameters(errors),
            "words": words,
            "top1_by_class": _mean_of_classes(classes[effect] for effect in effects),
            "top1_by_class_accepted": _mean_of_classes(accepted.values()),
            **calibration(
                [(c.said.ranking, c.label.answer) for c in sure if c.said is not None],
            ),
            "seconds_median": float(np.median(seconds)) if seconds else None,
            "seconds_largest": max(seconds, default=None),
            "failed": rate(c.said is None for c in cases),
        },
        classes=dict(sorted(classes.items())),
        members=_members([c for c in singles if c.label.sure and c.label.member]),
        confusions=dict(confusions.most_common()),
        errors=errors,
        failed={c.label.recording: c.why for c in cases if c.said is None},
    )


def _rates(cases: Sequence[Answered]) -> dict[str, Rate]:
    """Rates that are counts of one property of some of the recordings."""
    of = {
        kind: [c for c in cases if c.label.kind == kind]
        for kind in ("single", "pair", "several", "changed", "unchanged", "table", UNKNOWN)
    }
    twins = [c for c in cases if c.label.kind in ("single", "ambiguous")]
    twins = [c for c in twins if c.label.sure and len(c.label.accepted - {NONE}) > 1]
    return {
        "detected": rate(c.verdict not in ("", NONE) for c in cases if c.label.sure),
        **{
            f"top1_{strength}": rate(c.right for c in of["single"] if c.label.strength == strength)
            for strength in ("faint", "clear", "gross")
        },
        "pairs_named": rate(c.all_named for c in of["pair"]),
        "pairs_whole": rate(c.whole for c in of["pair"]),
        "several_named": rate(c.all_named for c in of["several"]),
        "several_whole": rate(c.whole for c in of["several"]),
        "changed_named": rate(c.all_named for c in of["changed"]),
        "changed_whole": rate(c.whole for c in of["changed"]),
        "unchanged_alarms": rate(c.verdict != NONE for c in of["unchanged"]),
        "tables_named": rate(c.all_named for c in of["table"] if c.label.sure),
        "tables_alarms": rate(c.verdict != NONE for c in of["table"] if not c.label.effects),
        "twins_named": rate(
            c.said is not None and c.label.accepted - {NONE} <= c.said.named for c in twins
        ),
        "unlisted": rate(c.verdict == UNKNOWN for c in of[UNKNOWN]),
        "known_called_unknown": rate(
            c.verdict == UNKNOWN for c in cases if c.label.kind != UNKNOWN
        ),
        "false_alarms": rate(c.verdict != NONE for c in cases if c.label.kind == NONE),
        "wrong_and_sure": rate(c.wrong_and_sure for c in cases),
    }


def _class_right(case: Answered) -> bool:
    return case.right if case.label.kind == "single" else case.verdict == case.label.kind


def _by_strength(
    cases: Sequence[Answered], hit: Callable[[Answered], bool]
) -> dict[str, dict[str, Rate]]:
    hits: dict[str, dict[str, list[bool]]] = {}
    for case in cases:
        strength = "" if case.label.kind == NONE else case.label.strength
        hits.setdefault(case.label.effect, {}).setdefault(strength, []).append(hit(case))
    return {
        name: {strength: rate(found) for strength, found in own.items()}
        for name, own in hits.items()
    }


def sure_rate(by_strength: Mapping[str, Rate]) -> Rate:
    """Add up all but faint ones.

    Args:
        by_strength: Rates of a class by strength, the empty word for those without one.

    Returns:
        Rate of all clear, gross and strengthless ones.

    """
    found = [one for strength, one in by_strength.items() if strength != "faint"]
    return Rate(sum(one.hits for one in found), sum(one.of for one in found))


def _mean_of_classes(classes: Iterable[Mapping[str, Rate]]) -> float | None:
    shares = [share for one in classes if (share := sure_rate(one).value) is not None]
    return float(np.mean(shares)) if shares else None


def _members(cases: Sequence[Answered]) -> dict[tuple[str, str], tuple[Rate, Rate, Rate]]:
    own: dict[tuple[str, str], list[Answered]] = {}
    for case in cases:
        own.setdefault((case.label.effect, case.label.member), []).append(case)
    return {
        which: (
            rate(c.accepted for c in found),
            rate(c.verdict == UNKNOWN for c in found),
            rate(c.wrong_and_sure for c in found),
        )
        for which, found in sorted(own.items())
    }


def matched(wanted: Sequence[frozenset[str]], named: frozenset[str]) -> int:
    """Count the most names that can each be given to another one of the wanted sets.

    Args:
        wanted: Of each cause the names that stand for it.
        named: Names of an answer.

    Returns:
        Number of causes that are named.

    """
    if not wanted or not named:
        return 0
    fits = np.array([[float(name in names) for name in sorted(named)] for names in wanted])
    rows, columns = linear_sum_assignment(-fits)
    return int(fits[rows, columns].sum())


def _parameters(cases: Sequence[Answered]) -> tuple[tuple[ParameterError, ...], Rate]:
    """Return numbers of causes that were found, and whether words (axis, joint, bag) are right.

    Of a cause at another axis or joint numbers aren't compared.
    """
    errors: list[ParameterError] = []
    words: list[bool] = []
    for case in cases:
        label = case.label
        if case.said is None or label.kind == UNKNOWN:
            continue
        for name, effect in zip(label.names, label.effects, strict=True):
            if name not in case.said.causes:
                continue
            told, true = case.said.causes[name].parameters, dict(flat(effect["parameters"]))
            said = [told.get(key) == one for key, one in true.items() if isinstance(one, str)]
            words += [all(said)] if said else []
            if all(said):
                errors += _numbers(label.recording, name, true, told)
    return tuple(errors), rate(words)


def _numbers(
    recording: str,
    effect: str,
    true: Mapping[str, Estimate | str],
    told: Mapping[str, Estimate | str],
) -> list[ParameterError]:
    numbers = {key: one.value for key, one in true.items() if not isinstance(one, str)}
    scales: dict[str, float] = {}
    for key, value in numbers.items():
        vector = key.partition("[")[0]
        scales[vector] = max(scales.get(vector, 1e-12), abs(value))
    found = []
    for key, value in numbers.items():
        other = told.get(key)
        estimate = None if isinstance(other, str) else other
        scale = scales[key.partition("[")[0]]
        found.append(ParameterError(recording, effect, key, value, scale, estimate))
    return found


def _of_parameters(errors: Sequence[ParameterError]) -> dict[str, Rate | float | None]:
    relative = [one.relative for one in errors if one.relative is not None]
    return {
        "coverage": rate(one.covered for one in errors if one.covered is not None),
        "told": rate(one.covered is not None for one in errors),
        "relative_error": float(np.median(relative)) if relative else None,
    }


def calibration(answers: Sequence[tuple[Mapping[str, float], str]]) -> dict[str, float | None]:
    """Return how well probabilities hold, of rankings with their truths.

    calibration_error: mean |share of right ones - mean probability| over ten bins of the first's
    probability, weighted by their numbers (M. P. Naeini et al., AAAI 2015); by_chance: the same of
    probabilities that hold exactly, at this number. brier: mean sum over the names of (probability
    - truth)^2, 0 ... 2 (G. W. Brier, 1950).

    Args:
        answers: Probabilities by name, and the true name, of each recording.

    Returns:
        `calibration_error`, `calibration_error_by_chance` and `brier`; None each where there are no
        answers.

    """
    if not answers:
        return dict.fromkeys(("calibration_error", "calibration_error_by_chance", "brier"))
    first = [max(ranking, key=lambda name: ranking[name]) for ranking, _ in answers]
    sure = np.array([one[0][name] for one, name in zip(answers, first, strict=True)])
    right = np.array([one[1] == name for one, name in zip(answers, first, strict=True)], float)
    chance = np.random.default_rng(0)
    drawn = [
        _binned_error(sure, (chance.random(len(sure)) < sure).astype(float)) for _ in range(200)
    ]
    brier = [
        sum((p - (name == truth)) ** 2 for name, p in ranking.items()) + (truth not in ranking)
        for ranking, truth in answers
    ]
    return {
        "calibration_error": _binned_error(sure, right),
        "calibration_error_by_chance": float(np.mean(drawn)),
        "brier": float(np.mean(brier)),
    }


def _binned_error(sure: Array, right: Array) -> float:
    index = np.minimum((sure * _BINS).astype(int), _BINS - 1)
    excess = np.bincount(index, right - sure, _BINS)
    return float(np.sum(np.abs(excess)) / len(sure))
