"""The blind check's tables: for a terminal, and as Markdown for a README."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from galen_diagnosis.blind.scoring.rates import Calibration, Rate
from galen_diagnosis.blind.scoring.score import CLOSED_WITHIN, STRENGTHS, Score

PROGRAM = "galen_diagnosis"
_GOALS = {
    "top-1 by class": "≥ 95 %", "false alarms": "≤ 3 %", "unknown at 5 %": "≥ 85 %",
    "pairs": "≥ 0.90", "coverage": "90–99 %", "wrong and sure": "≤ 3 %", "wall": "≤ 30 s",
}  # fmt: skip


class Line(NamedTuple):
    """A row of the table: what, the goal (empty for none), and a cell for each method."""

    what: str
    goal: str
    cells: tuple[str, ...]


def lines(scores: Mapping[str, Score]) -> list[Line]:
    """The rows that are shown and printed for README; the first score is the program's."""
    found = list(scores.values())
    singles = "singles, clear and gross"

    def line(what: str, goal: str, cells: Sequence[str]) -> Line:
        return Line(what, _GOALS.get(goal, ""), tuple(cells))

    rows = [
        line(
            f"{singles}: top-1, mean over classes",
            "top-1 by class",
            [share(s.by_class) for s in found],
        ),
        line(
            f"{singles}: the same, twins of this recording as one",
            "top-1 by class",
            [share(s.by_class_accepted) for s in found],
        ),
    ]
    for strength in STRENGTHS:
        rows.append(
            line(f"singles, {strength}: top-1", "", [percent(s.top1[strength]) for s in found])
        )
    rows += [
        line("healthy: false alarms", "false alarms", [percent(s.false_alarms) for s in found]),
        line(
            "unknown found at 5 % false positives",
            "unknown at 5 %",
            [percent(s.unknown_at_5) for s in found],
        ),
        line("unknown found by the verdict", "", [percent(s.unknown_own) for s in found]),
        line("known called unknown", "", [percent(s.unknown_wrongly) for s in found]),
        line("faint: wrong and sure", "wrong and sure", [percent(s.wrong_and_sure) for s in found]),
        line("faint: called none", "", [percent(s.faint_missed) for s in found]),
        line("faint: left open", "", [percent(s.faint_open) for s in found]),
        line("pairs: F1", "pairs", [number(s.pair_f1) for s in found]),
        line("pairs: both and no other", "", [percent(s.pair_whole) for s in found]),
        line("ambiguous: the whole set named", "", [percent(s.ambiguous_held) for s in found]),
        line("ambiguous: sure of less", "", [percent(s.ambiguous_alone) for s in found]),
        line(
            "parameters: coverage of 95 % intervals",
            "coverage",
            [percent(s.covered) for s in found],
        ),
        line("parameters: RMS error, own σ", "", [number(s.error_rms_sigma) for s in found]),
        line("axis, joint, bag named right", "", [percent(s.words) for s in found]),
        line(
            f"closed fraction within {CLOSED_WITHIN} of the oracle's",
            "",
            [percent(s.closed_near) for s in found],
        ),
        line(
            "closed fraction less the oracle's, median",
            "",
            [number(_median(s.closed_error), 3) for s in found],
        ),
        line(
            "calibration error (ECE; by chance alone)",
            "",
            [_calibration_words(s.calibration) for s in found],
        ),
        line(
            "calibration error without faint ones",
            "",
            [_calibration_words(s.calibration_sure) for s in found],
        ),
        line(
            "Brier score; log score, nats",
            "",
            [
                "–"
                if s.calibration is None
                else f"{s.calibration.brier:.3f}; {s.calibration.log_score:.2f}"
                for s in found
            ],
        ),
        line(
            "wall time of a recording: median, longest",
            "wall",
            [
                f"{np.median(s.seconds):.1f} s, {np.max(s.seconds):.1f} s"
                if len(s.seconds)
                else "–"
                for s in found
            ],
        ),
        line("diagnoses that failed", "", [f"{s.failed} of {s.cases}" for s in found]),
    ]
    return rows


def _calibration_words(of: Calibration | None) -> str:
    return "–" if of is None else f"{of.error:.3f} ({of.by_chance:.3f})"


def print_scores(scores: Mapping[str, Score], console: Console) -> None:
    """All tables for a person."""
    table = Table(title="Blind check (95 % intervals by Wilson)")
    for heading in ("", "goal", *scores):
        table.add_column(heading)
    for row in lines(scores):
        table.add_row(row.what, row.goal, *row.cells)
    console.print(table)
    console.print(_class_table(scores))
    first = next(iter(scores.values()))
    if first.by_unknown:
        kinds = Table(title="Causes outside the list: found by the verdict")
        kinds.add_column("kind")
        kinds.add_column("found")
        for kind, found in first.by_unknown.items():
            kinds.add_row(kind, percent(found))
        console.print(kinds)
    for sentence in confusions(first):
        console.print(sentence, soft_wrap=True, highlight=False)


def _class_table(scores: Mapping[str, Score]) -> Table:
    name, first = next(iter(scores.items()))
    table = Table(title=f"Top-1 of {name} by class", caption="others: clear and gross")
    for heading in ("class", *STRENGTHS, "all", *list(scores)[1:]):
        table.add_column(heading)
    others = list(scores.values())[1:]
    for number_, one in enumerate(first.classes):
        if not one.top1:
            continue
        cells = [short(one.top1.get(strength)) for strength in (*STRENGTHS, "")]
        from_others = [short(_sure(other, number_)) for other in others]
        table.add_row(one.name, *cells, *from_others)
    return table


def _sure(score: Score, number_: int) -> Rate | None:
    found = [r for s, r in score.classes[number_].top1.items() if s != "faint"]
    return Rate(sum(r.hits for r in found), sum(r.of for r in found)) if found else None


def confusions(score: Score, most: int = 12) -> list[str]:
    """What was most often taken for what, a sentence each."""
    wrong = score.confusion - np.diag(np.diag(score.confusion))
    order = np.argsort(wrong, axis=None)[::-1][:most]
    found = []
    for flat in order:
        row, column = np.unravel_index(flat, wrong.shape)
        if wrong[row, column]:
            found.append(
                f"{score.names[row]} taken for {score.names[column]}: {wrong[row, column]} of"
                f" {score.confusion[row].sum()}; probability given to it on average"
                f" {score.predicted[row, column] / max(score.confusion[row].sum(), 1):.2f}"
            )
    return found


def markdown(scores: Mapping[str, Score]) -> str:
    """The tables as README has them."""
    names = list(scores)
    text = [_row(["", "goal", *names]), _row(["---"] * (2 + len(names)))]
    text += [_row([row.what, row.goal, *row.cells]) for row in lines(scores)]
    first = scores[names[0]]
    text += ["", _row(["class", *STRENGTHS, "all"]), _row(["---"] * (2 + len(STRENGTHS)))]
    for one in first.classes:
        if one.top1:
            cells = [short(one.top1.get(strength)) for strength in (*STRENGTHS, "")]
            text.append(_row([f"`{one.name}`", *cells]))
    if found := confusions(first):
        text += ["", *(f"- {sentence}" for sentence in found)]
    return "\n".join(text)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def percent(found: Rate) -> str:
    """`97 % (93–99), 66 of 68`; a dash of nothing."""
    if found.value is None or found.interval is None:
        return "–"
    low, high = found.interval
    return (
        f"{100 * found.value:.0f} % ({100 * low:.0f}–{100 * high:.0f}), {found.hits} of {found.of}"
    )


def short(found: Rate | None) -> str:
    """`3/4`; empty of nothing."""
    return "" if found is None or not found.of else f"{found.hits}/{found.of}"


def share(value: float | None) -> str:
    """In percent."""
    return "–" if value is None else f"{100 * value:.0f} %"


def number(value: float | None, digits: int = 2) -> str:
    """With so many decimals."""
    return "–" if value is None else f"{value:.{digits}f}"


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None
