"""The blind check's tables in Markdown, which a terminal shows as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from galen_diagnosis.blind.rates import Rate
from galen_diagnosis.blind.score import STRENGTHS, Score, sure_rate

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
