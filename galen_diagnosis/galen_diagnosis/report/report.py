"""The report that a person reads: one HTML file that opens without a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from galen_diagnosis.answer.answer import NONE, UNKNOWN, Answer, Cause, Diagnosis
from galen_diagnosis.answer.localization import hertz, p_words
from galen_diagnosis.report.report_html import (
    Table,
    bar,
    details,
    heading,
    items,
    page,
    paragraph,
    picture,
)
from galen_diagnosis.report.words import RANKING_NOTE, parameter_words, title

_SHOWN_PROBABILITY = 0.005
_LEVEL = 0.05
_CAPTIONS = {
    "gap": "RMS residual over the noise, by channel and by what the arm was doing: before, and"
    " after the cause was added to the simulator, on blocks that no fit has seen. 1 is noise alone;"
    " framed cells are beyond noise and the tolerances of a healthy arm.",
    "sweep": "RMS residual over the noise at each still pose of the sweep, before and after.",
    "time": "The residual in time, before (left) and after (right) on the same scale.",
    "spectra": "Power of the residual over the noise's by frequency, before and after.",
}
_HOW = (
    "The nominal simulator was driven along the recorded joint states. What was measured less what"
    " it predicts is the residual, whitened by the noise that the recording itself shows.",
    "What isn't known of a recording and is no gap (the sensor's zero, where the tracker stands)"
    " was fitted in every comparison.",
    "Every effect was tried singly, in pairs and more; each fitted on the simulator itself. Before,"
    " after and the closed fraction are of blocks of time that the fit has not seen.",
    "Closed fraction: (before - after) / (before - floor) of the mean squared residual in units of"
    " the noise; 1 means down to the noise.",
    "Before is the same arm without the cause: what a healthy arm may be off stays as it was fitted"
    " beside the cause, so that it neither closes the gap nor hides that it is closed.",
    "What the best fit leaves is looked through for smooth functions that stand for no effect"
    " in particular, of gravity's direction, joints, rates, time, load, and for oscillations.",
    "p-values of where the gap lies say how often noise and the tolerances of a healthy arm give"
    " as much, and are corrected for all cells of their table: in 5 % of healthy recordings any"
    " cell of it is marked.",
)


def report(diagnosis: Diagnosis, pictures: Mapping[str, Path]) -> str:
    """The page; pictures: PNG files by name, as `write_pictures` gives them."""
    answer = diagnosis.answer
    return page(f"Diagnosis of {answer.recording}", _body(diagnosis, answer, pictures))


def _body(diagnosis: Diagnosis, answer: Answer, pictures: Mapping[str, Path]) -> Iterator[str]:
    yield f"<header>{_tag('h1', f'Diagnosis of {answer.recording}')}"
    yield paragraph(answer.sentence, "sentence")
    yield _verdict(answer)
    yield "</header><main>"
    if "gap" in pictures:
        yield picture(pictures["gap"], _CAPTIONS["gap"])
    if answer.causes:
        yield heading("Causes")
        yield _causes(answer.causes)
    yield heading("How far the gap shrinks")
    yield _gap(answer.gap)
    yield heading("Which effect")
    yield paragraph(RANKING_NOTE, "note")
    yield _ranking(answer)
    if answer.left_over:
        yield heading("What the best fit leaves")
        yield _left_over(answer.left_over)
    yield from _where(answer.where)
    for name, words in (
        ("sweep", "Over the sweep's poses"),
        ("time", "In time"),
        ("spectra", "By frequency"),
    ):
        if name in pictures:
            yield heading(words)
            yield picture(pictures[name], _CAPTIONS[name])
    if answer.cannot_tell:
        yield heading("What this recording can't tell")
        yield items(answer.cannot_tell)
    if answer.next_experiment is not None:
        yield heading("What to do next")
        yield from _next(answer.next_experiment)
    if answer.problems:
        yield heading("Problems of the recording")
        yield items(answer.problems)
    yield heading("How it was done")
    yield items(_HOW)
    took = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in diagnosis.seconds.items())
    yield paragraph(f"Time taken: {took}." if took else "", "note")
    yield "</main>"


def _tag(tag: str, text: str) -> str:
    return paragraph(text).replace("<p>", f"<{tag}>", 1).removesuffix("</p>") + f"</{tag}>"


def _verdict(answer: Answer) -> str:
    kind = "verdict none" if answer.verdict == "none" else "verdict"
    return paragraph(answer.verdict, kind)


def _causes(causes: tuple[Cause, ...]) -> str:
    table = Table(
        "cause", "probability", "parameter", "value (95 % interval)", "gap closed by it alone",
        "can't be told from", numbers=(1,),
    )  # fmt: skip
    for cause in causes:
        closed = cause.gap_closed
        part = "-" if closed is None else f"{closed.value:.0%}"
        if closed is not None and closed.low is not None and closed.high is not None:
            part += f" ({closed.low:.0%} to {closed.high:.0%})"
        first = (
            f"{cause.label}: {title(cause.label)}",
            f"{cause.probability:.1%}",
        )
        last = (part, ", ".join(cause.equivalent) or "-")
        names = list(cause.parameters) or [""]
        for number, name in enumerate(names):
            words = parameter_words(cause.effect, name, cause.parameters) if name else "-"
            if number == 0:
                table.add(*first, name or "-", words, *last)
            else:
                table.add("", "", name, words, "", "")
    return table.html()


def _gap(gap: dict[str, Any]) -> str:
    parts = {name: gap.get(name) or {} for name in ("before", "after", "floor")}
    keys = list(dict.fromkeys(key for part in parts.values() for key in part))
    table = Table("mean squared residual over noise", *parts, numbers=(1, 2, 3))
    for key in keys:
        values = [part.get(key) for part in parts.values()]
        if any(isinstance(value, int | float) for value in values):
            table.add(str(key), *(_number(value) for value in values))
    closed = gap.get("closed_fraction")
    if closed and closed.get("value") is not None:
        text = f"Closed fraction: {closed['value']:.3f}"
        if closed.get("ci95"):
            text += f" ({closed['ci95'][0]:.3f} to {closed['ci95'][1]:.3f})"
        text += ", on data that no fit has seen."
    else:
        text = "No closed fraction: the gap is not above the floor, or nothing was found to add."
    return paragraph(text) + (table.html() if len(table) else "")


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "-"


def _ranking(answer: Answer) -> str:
    shown, rest = Table("effect", "", "probability", "", numbers=(2,)), []
    for name, probability in answer.ranking:
        if probability >= _SHOWN_PROBABILITY or name in (NONE, UNKNOWN):
            shown.add(name, title(name), f"{probability:.1%}", bar(probability), bars=(3,))
        else:
            rest.append(f"{name}: {probability:.2%}")
    more = details(f"{len(rest)} more, each below 0.5 %", items(rest)) if rest else ""
    return shown.html() + more


def _left_over(left: tuple[dict[str, Any], ...]) -> str:
    table = Table(
        "is a function of", "energy over noise's", "log of the odds against noise", numbers=(1, 2)
    )
    for one in left:
        table.add(one["what"], _number(one["energy"]), _number(one["log_bayes"]))
    return table.html()


def _where(where: dict[str, Any]) -> Iterator[str]:
    if not where:
        return
    yield heading("Where the gap lies")
    if not any(any(where.get(name, {}).values()) for name in ("channels", "bags", "regimes")):
        yield paragraph(
            "Nowhere: no channel, bag or regime is beyond noise and a healthy arm's tolerances."
        )
    ratios, p_values = where.get("ratio", {}), where.get("p", {})
    for name, word in (("bags", "bag"), ("regimes", "regime"), ("channels", "channel")):
        table = Table(word, "share", "", "RMS over noise", "p", numbers=(1, 3, 4))
        for label, share in where.get(name, {}).items():
            ratio, p = ratios.get(name, {}).get(label), p_values.get(name, {}).get(label)
            table.add(
                label, f"{share:.1%}", bar(share), _rms(ratio), p_words(p),
                bars=(2,), marked=p is not None and p < _LEVEL,
            )  # fmt: skip
        yield table.html()
    joints = where.get("joints", {})
    yield _follows(joints.get("follows", []))
    both = "noise and tolerances"
    for name, beyond, cells in (
        ("Joints: ranges and directions of motion", both, joints.get("cells", [])),
        ("Times", both, where.get("times", [])),
        ("Poses", both, where.get("poses", [])),
        ("Frequencies", "noise, tolerances not counted", where.get("bands", [])),
    ):
        marked = [cell for cell in cells if cell["p"] < _LEVEL]
        summary = f"{name}: {len(marked)} of {len(cells)} cells are beyond {beyond}"
        if marked:
            yield details(summary, _cells(marked))
        elif cells:
            yield paragraph(f"{summary}.", "note")


def _follows(follows: list[dict[str, Any]]) -> str:
    if not follows:
        return ""
    table = Table("joint", "part of the sweep's gap that is a function of it", "", "p",
                  numbers=(1, 3))  # fmt: skip
    for one in follows:
        table.add(
            one["joint"], f"{one['part']:.0%}", bar(one["part"]), p_words(one["p"]),
            bars=(2,), marked=one["p"] < _LEVEL,
        )  # fmt: skip
    return table.html()


def _cells(cells: list[dict[str, Any]]) -> str:
    table = Table("cell", "share", "", "RMS over noise", "p", numbers=(1, 3, 4))
    for cell in sorted(cells, key=lambda one: -one["share"]):
        table.add(
            cell_words(cell), f"{cell['share']:.1%}", bar(cell["share"]), _rms(cell["ratio"]),
            p_words(cell["p"]), bars=(2,),
        )  # fmt: skip
    return table.html()


def cell_words(cell: dict[str, Any]) -> str:
    """A cell of diagnosis.json's lists in words."""
    if "group" in cell:
        return f"{cell['bag']}, {cell['group']}, {hertz(cell['from_hz'], cell['to_hz'])}"
    if "from_s" in cell:
        return f"{cell['bag']}, {cell['from_s']:.1f} to {cell['to_s']:.1f} s"
    if "direction" in cell:
        return f"{cell['joint']} moving {cell['direction']}"
    if "from" in cell:
        return f"{cell['joint']} from {cell['from']:.3f} to {cell['to']:.3f}"
    joints = cell["joints"]
    at = f"roll {joints['roll']:.2f} rad, tilt {joints['tilt']:.2f} rad"
    return f"{cell['bag']} {cell['pose']}: {at}"


def _rms(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio**0.5:.2f}"


def _next(experiment: dict[str, Any]) -> Iterator[str]:
    yield paragraph(str(experiment.get("do", "")))
    lines = []
    separates = experiment.get("separates") or []
    if separates:
        lines.append(f"It tells apart: {', '.join(map(str, separates))}.")
    if experiment.get("expected_probability") is not None:
        lines.append(
            "Expected probability of the right answer afterwards:"
            f" {experiment['expected_probability']:.0%}."
        )
    if lines:
        yield items(lines)
