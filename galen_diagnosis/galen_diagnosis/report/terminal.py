"""A diagnosis on the terminal: the sentence, the causes, how far the gap shrinks, where it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from galen_diagnosis.answer.answer import Answer
from galen_diagnosis.answer.localization import p_words
from galen_diagnosis.report.words import RANKING_NOTE, parameter_words

_RANKED = 6
_PLACES = 4


def print_answer(answer: Answer, console: Console) -> None:
    """Print one diagnosis."""
    console.print(f"[bold]{escape(answer.recording)}: {answer.verdict}[/bold]")
    console.print(escape(answer.sentence))
    if answer.causes:
        console.print(_causes(answer))
    console.print(_ranking(answer))
    console.print(RANKING_NOTE)
    places = _places(answer.where)
    if len(places.rows):
        console.print(places)
    for title, texts in (("can't tell", answer.cannot_tell), ("problem", answer.problems)):
        for text in texts:
            console.print(f"{title}: {escape(text)}")
    if answer.next_experiment is not None:
        console.print(f"next: {escape(str(answer.next_experiment.get('do', '')))}")


def print_overview(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """Print a line for each of many recordings: diagnosis.json's content, or its error."""
    table = Table("recording", "verdict", "causes", "probability", "gap closed", box=None)
    for row in rows:
        if "error" in row:
            continue
        causes = row["causes"]
        table.add_row(
            escape(row["recording"]),
            row["verdict"],
            ", ".join(cause["effect"] for cause in causes) or "-",
            ", ".join(f"{cause['probability']:.0%}" for cause in causes) or "-",
            _closed(row["gap"].get("closed_fraction")),
        )
    console.print(table)
    for row in rows:
        if "error" in row:
            console.print(f"failed: {escape(str(row['error']))}", soft_wrap=True)


def _causes(answer: Answer) -> Table:
    table = Table("cause", "probability", "parameter", "value (95 % interval)", "not told from",
                  box=None)  # fmt: skip
    for cause in answer.causes:
        names = list(cause.parameters) or [""]
        for number, name in enumerate(names):
            words = parameter_words(cause.effect, name, cause.parameters) if name else ""
            first = (cause.label, f"{cause.probability:.1%}") if number == 0 else ("", "")
            last = _few(cause.equivalent) if number == 0 else ""
            table.add_row(*first, name, escape(words), last)
    return table


def _few(effects: Sequence[str]) -> str:
    return ", ".join(effects) if len(effects) <= _PLACES else f"{len(effects)} other effects"


def _ranking(answer: Answer) -> Table:
    table = Table("cause alone or with others", "probability that it is there", box=None)
    for name, probability in answer.ranking[:_RANKED]:
        table.add_row(name, f"{probability:.1%}")
    return table


def _places(where: dict[str, Any]) -> Table:
    table = Table("where", "share of the gap", "p", box=None)
    for name in ("bags", "regimes", "channels"):
        shares = sorted(where.get(name, {}).items(), key=lambda one: -one[1])[:_PLACES]
        for label, share in shares:
            p = where.get("p", {}).get(name, {}).get(label)
            if share > 0.0 and p is not None and p < 0.05:
                table.add_row(label, f"{share:.1%}", p_words(p))
    return table


def _closed(closed: dict[str, Any] | None) -> str:
    if not closed or closed.get("value") is None:
        return "-"
    text = f"{closed['value']:.0%}"
    interval = closed.get("ci95")
    return text + (f" ({interval[0]:.0%} to {interval[1]:.0%})" if interval else "")
