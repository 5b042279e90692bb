# SPDX-License-Identifier: Apache-2.0
"""The blind check's tables in Markdown, and the pages that hold them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from galen_common.command import writing
from galen_model.errors import GalenError

from galen_validation.blind.score import Answered, Rate, Score, score, sure_rate

LINES = (
    ("clear and gross causes: detected (another verdict than none)", "", "detected"),
    ("single causes, clear and gross: top-1, mean over classes", "≥ 95 %", "top1_by_class"),
    ("the same, twins of the recording as one", "≥ 95 %", "top1_by_class_accepted"),
    *((f"single causes, {one}: top-1", "", f"top1_{one}") for one in ("faint", "clear", "gross")),
    ("pairs: both named", "≥ 85 %", "pairs_named"),
    ("pairs: both and no other", "", "pairs_whole"),
    ("three to five at once: all named", "", "several_named"),
    ("three to five at once: all and no other", "", "several_whole"),
    ("changes since a reference, from a fifth of the limit: named", "≥ 90 %", "changed_named"),
    ("changes since a reference: named and no other", "", "changed_whole"),
    ("nothing changed since a reference: false alarms", "≤ 3 %", "unchanged_alarms"),
    ("measured tables with a reference, from 10 σ on: named", "≥ 85 %", "tables_named"),
    ("measured tables, nothing put in: false alarms", "≤ 3 %", "tables_alarms"),
    ("twins: the whole set named", "", "twins_named"),
    ("unlisted causes: found by the verdict", "≥ 85 %", "unlisted"),
    ("listed or none, but called unknown", "", "known_called_unknown"),
    ("healthy: false alarms", "≤ 3 %", "false_alarms"),
    ("wrong and sure", "≤ 2 %", "wrong_and_sure"),
    ("parameters: 95 % intervals that hold", "90–98 %", "coverage"),
    ("parameters of found causes told with an interval", "", "told"),
    ("parameters: error over the true value, median", "", "relative_error"),
    ("axis, joint, bag named right", "", "words"),
    ("calibration error (ECE) without faint causes", "≤ 0.05", "calibration_error"),
    ("that error by chance alone", "", "calibration_error_by_chance"),
    ("Brier score without faint causes", "", "brier"),
    ("wall time of a recording, median, s", "≤ 12", "seconds_median"),
    ("wall time of a recording, longest, s", "≤ 30", "seconds_largest"),
    ("no valid answer", "", "failed"),
)
_SHARES = ("top1_by_class", "top1_by_class_accepted", "relative_error")
_NOTHING = "–"
_MOST = 12
"""Confusions and bad answers that are named."""


def tables(cases: Mapping[str, Sequence[Answered]], made: str) -> dict[str, str]:
    """Return the tables of a set's scores.

    Args:
        cases: Labels with answers by tool, of the same recordings; the first tool is compared with
            the others.
        made: A sentence on how the set was made.

    Returns:
        Markdown by name: `made`, `score`, `classes`, `members`, `arms`, `notes`; empty where there
        is nothing to show.

    """
    scores = {tool: score(found) for tool, found in cases.items()}
    first, *others = scores
    own = scores[first]
    arms = sorted({one.label.arm for one in cases[first]})
    by_arm = {arm: score([c for c in cases[first] if c.label.arm == arm]) for arm in arms}
    classes = [
        [
            f"`{name}`",
            *(_counts(by_strength.get(strength)) for strength in ("faint", "clear", "gross", "")),
            *(_counts(sure_rate(scores[other].classes[name])) for other in others),
        ]
        for name, by_strength in own.classes.items()
    ]
    members = [
        [f"`{effect}`", member, *map(_counts, rates)]
        for (effect, member), rates in own.members.items()
    ]
    notes = [
        f"{truth} taken for {said}: {count}"
        for (truth, said), count in list(own.confusions.items())[:_MOST]
    ]
    for tool, one in scores.items():
        notes += [f"{tool}, {name}: {why}" for name, why in list(one.failed.items())[:_MOST]]
    right = f"right, of {first}:"
    beside = [f"{other}, clear and gross" for other in others]
    return {
        "made": made,
        "score": _main(scores),
        "classes": _table([right, "faint", "clear", "gross", "all", *beside], classes),
        "members": _table(["", "model", "right", "unknown", "wrong and sure"], members),
        "arms": _main(by_arm) if len(arms) > 1 else "",
        "notes": "\n".join(f"- {_line(note)}" for note in notes),
    }


def _line(text: str) -> str:
    """Return one line of a text that may be another tool's."""
    return " ".join(text.split())[:200]


def _main(scores: Mapping[str, Score]) -> str:
    rows = [
        [what, goal, *(_cell(one.values[key], key in _SHARES) for one in scores.values())]
        for what, goal, key in LINES
    ]
    shown = [row for row in rows if set(row[2:]) != {_NOTHING}]
    return _table(["", "goal", *scores], shown)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; empty without rows."""
    if not rows:
        return ""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: Rate | float | None, share: bool) -> str:
    if value is None or (isinstance(value, Rate) and not value.of):
        return _NOTHING
    if not isinstance(value, Rate):
        return f"{100 * value:.1f} %" if share else f"{value:.3f}"
    assert value.value is not None and value.interval is not None
    low, high = value.interval
    return (
        f"{100 * value.value:.0f} % ({100 * low:.0f}–{100 * high:.0f}), {value.hits} of {value.of}"
    )


def _counts(found: Rate | None) -> str:
    """`3/4`; empty of nothing."""
    return "" if found is None or not found.of else f"{found.hits}/{found.of}"


def fill(page: Path, found: Mapping[str, str]) -> None:
    """Put tables into a Markdown page, each between `<!-- NAME -->` and `<!-- end -->`.

    Args:
        page: File to change; places whose names are not in `found` stay as they are.
        found: Markdown by name.

    Raises:
        GalenError: The page can't be read or written, or has no place for a table.

    """

    def filled(place: re.Match[str]) -> str:
        name = place.group(1)
        return f"<!-- {name} -->\n{found.get(name, place.group(2))}\n<!-- end -->"

    try:
        before = page.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise GalenError(f"{page}: can't be read: {error}") from error
    after, places = re.subn(r"<!-- (\w+) -->\n(.*?)\n?<!-- end -->", filled, before, flags=re.S)
    if not places:
        raise GalenError(f"{page}: has no place for a table, <!-- score --> and <!-- end -->")
    with writing(page):
        page.write_text(after, encoding="utf-8")
