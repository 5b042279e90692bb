# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis leaves: one HTML page, the terminal's tables, the output directory."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from galen_common.command import PageRow, check_parent, render_page, writing
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.atomic_file import sync_directory
from galen_sim_driver.effects.effect import ConfigError, Effect
from galen_sim_driver.effects.registry import EFFECTS
from galen_sim_driver.parameters import driver_file
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from galen_diagnosis.answer.answer import NONE, RESIDUAL, UNKNOWN, Answer
from galen_diagnosis.answer.localization import LEVEL
from galen_diagnosis.observation.specification import Specification
from galen_diagnosis.report.words import (
    RANKING_NOTE,
    VERDICTS,
    limit_of_parameter,
    limit_words,
    missed_words,
    next_steps,
    p_words,
    parameter_words,
    share_words,
    title,
)

DIAGNOSIS, REPORT, EFFECT, PICTURES = (
    "diagnosis.json",
    "report.html",
    "found_effect.yaml",
    "pictures",
)
RESULT_VERSION = 3
"""To be raised where answers change: kept ones of before are then not taken for today's."""
_SHOWN_PROBABILITY = 0.005
_RANKED = 6
_PLACES = 4
_CAPTIONS = {
    "budget": "What the whole gap between measured and nominal is made of, on blocks that no fit"
    " has seen: from all of it down to the noise. Right: each number over its limit.",
    "answer": "Measured less nominal, and what was found, in the channels that show it most"
    " clearly. Grey is noise alone; what the tolerances of a healthy arm add to it is no gap.",
    "gap": "RMS residual over the noise before, and after the cause was added to the simulator, on"
    " blocks that no fit has seen. 1 is noise alone; framed cells are beyond noise and the"
    " tolerances of a healthy arm.",
}


def report(answer: Answer, pictures: Mapping[str, Path]) -> str:
    """Return the page.

    Args:
        answer: What it shows.
        pictures: PNG files by name, as `write_pictures` gives them.

    Returns:
        HTML in one file.

    """
    return render_page(
        Path(__file__).parent / "template.html",
        {name: file.read_bytes() for name, file in pictures.items()},
        title=f"Diagnosis of {answer.recording}",
        sentence=answer.sentence,
        verdict=VERDICTS[answer.verdict],
        good=answer.verdict == NONE,
        answer=answer,
        captions=_CAPTIONS,
        steps=next_steps(answer),
        tested=[PageRow((title(one.label), missed_words(one))) for one in answer.tested],
        causes=[PageRow(cells) for cells in _causes(answer)],
        budget=[PageRow(cells) for cells in _budget(answer)],
        closed=share_words(answer.gap.get("closed_fraction")),
        gap=[PageRow(cells) for cells in _gap(answer.gap)],
        ranking_note=RANKING_NOTE,
        ranking=[
            PageRow((name, title(name), f"{probability:.1%}"), probability)
            for name, probability in answer.ranking
            if probability >= _SHOWN_PROBABILITY or name in (NONE, UNKNOWN)
        ],
        remaining=[
            PageRow((one["what"], _number(one["energy"]), _number(one["log_bayes"])))
            for one in answer.remaining
        ],
        where=list(_where(answer.where)),
        data=[PageRow(line) for line in answer.data],
    )


def _causes(answer: Answer) -> Iterator[tuple[str, ...]]:
    """Return a line a parameter; the cause with its first."""
    for cause in answer.causes:
        model = f" ({cause.model})" if cause.model else ""
        first = (title(cause.label) + model, f"{cause.probability:.1%}")
        last = (share_words(cause.gap_closed), ", ".join(cause.equivalent) or "-")
        for number, name in enumerate(list(cause.parameters) or [""]):
            words = parameter_words(name, cause.parameters) if name else "-"
            yield (*(first if not number else ("", "")), name, words,
                   *(last if not number else ("", "")))  # fmt: skip


def _budget(answer: Answer) -> Iterator[tuple[str, ...]]:
    """Return a line a parameter; the effect with its first."""
    for one in answer.budget:
        standing: str = one.standing or "-"
        if one.probability_beyond is not None and standing == "undecided":
            standing += f", {one.probability_beyond:.0%} beyond"
        name = RESIDUAL if one.label == RESIDUAL else title(one.label)
        first, last = (name, share_words(one.share), standing), ", ".join(one.equivalent) or "-"
        for number, key in enumerate(list(one.parameters) or [""]):
            words = parameter_words(key, one.parameters) if key else "-"
            limit = limit_of_parameter(key, one) if key in one.limits else "-"
            yield (*(first if not number else ("",) * 3), key or "-", words, limit,
                   last if not number else "")  # fmt: skip


def _gap(gap: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """RMS over the noise and, where there are any, RMS by channel in its own unit."""
    parts = [gap.get(name) or {} for name in ("before", "after", "floor")]
    squares = [part.get("mean_square") for part in parts]
    if any(square is not None for square in squares):
        roots = (None if square is None else square**0.5 for square in squares)
        yield ("RMS over the noise", *map(_number, roots))
    for channel in parts[0].get("rms", {}):
        yield (f"RMS of {channel}", *(_number(part.get("rms", {}).get(channel)) for part in parts))


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "-"


def _where(where: Mapping[str, Any]) -> Iterator[tuple[str, list[PageRow]]]:
    """Tables by their titles; of poses those that are marked."""
    for name, word in (("bags", "bag"), ("regimes", "regime"), ("channels", "channel")):
        ratios, p_values = (where.get(of, {}).get(name, {}) for of in ("ratio", "p"))
        shares = where.get(name, {})
        if shares:
            yield word, [_place(at, shares[at], ratios.get(at), p_values.get(at)) for at in shares]
    poses = sorted(where.get("poses", []), key=lambda pose: -pose["share"])
    if poses:
        marked = [one for one in poses if one["share"] > 0.0 and one.get("p", 0.0) < LEVEL]
        yield (
            "pose",
            [_place(_pose_words(p), p["share"], p.get("ratio"), p.get("p")) for p in marked],
        )


def _place(label: str, share: float, ratio: float | None, p: float | None) -> PageRow:
    rms = "-" if ratio is None else f"{ratio**0.5:.2f}"
    return PageRow((label, f"{share:.1%}", rms, p_words(p)), share, p is not None and p < LEVEL)


def _pose_words(pose: Mapping[str, Any]) -> str:
    at = ", ".join(f"{name} {value:.2f}" for name, value in pose.get("joints", {}).items())
    return f"{pose.get('bag', '')} {pose['pose']} {at}".strip()


# Terminal


def print_answer(answer: Answer, console: Console) -> None:
    """Print one diagnosis.

    Args:
        answer: What is printed, without the poses of a recording.
        console: Where.

    """
    verdict = f"{answer.verdict} ({VERDICTS[answer.verdict].lower()})"
    console.print(f"[bold]{escape(answer.recording)}: {verdict}[/bold]")
    console.print(escape(answer.sentence))
    for step in next_steps(answer):
        console.print(f"next: {escape(step)}")
    for note in answer.notes:
        console.print(f"  {escape(note)}")
    _print_table(console, ("cause", "probability", "parameter", "value (95 % interval)",
                           "alone closes", "not distinguishable from"),
                 [(*cells[:5], _few(cells[5])) for cells in _causes(answer)])  # fmt: skip
    _print_table(console, ("of the whole gap", "share", "by the specification", "parameter",
                           "value (95 % interval)", "limit"),
                 [cells[:6] for cells in _budget(answer)])  # fmt: skip
    ranked = [(name, f"{p:.1%}") for name, p in answer.ranking[:_RANKED]]
    _print_table(console, ("cause alone or with others", "probability that it is there"), ranked)
    console.print(RANKING_NOTE)
    if "rms" in answer.gap.get("before", {}):
        gap = list(_gap(answer.gap))
        _print_table(console, ("on readings that no fit has seen", "before", "after", "floor"), gap)
    whole = bool(answer.where.get("bags"))  # a recording's 60 poses are for the page
    places = [
        row.cells
        for kind, rows in _where(answer.where)
        for row in sorted(rows, key=lambda one: -(one.share or 0.0))[:_PLACES]
        if row.share and (row.marked or row.cells[3] == "-") and not (whole and kind == "pose")
    ]
    _print_table(console, ("where", "share of the gap", "RMS over noise", "p"), places)
    seen = [one for one in answer.tested if one.missed_below]
    if seen:
        console.print(f"tested and excluded: {len(seen)} effects, each up to the size in {REPORT}")
    for what, texts in (("not identifiable", answer.cannot_tell), ("problem", answer.problems)):
        for text in texts:
            console.print(f"{what}: {escape(text)}")


def print_specification(given: Specification, console: Console) -> None:
    """Print limits, each with its source.

    Args:
        given: The limits.
        console: Where.

    """
    console.print(f"[bold]{escape(given.name)}[/bold]  {escape(given.source)}")
    rows = [
        (effect, limit_words(effect, by_part), given.sources.get(effect, "-"))
        for effect, by_part in given.limits.items()
    ]
    _print_table(console, ("effect", "limit", "source"), rows)


def _print_table(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if rows:
        table = Table(*columns, box=None)
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)


def _few(names: str) -> str:
    count = names.count(",") + 1
    return names if count <= _PLACES else f"{count} other effects"


COLUMNS = {
    **dict.fromkeys(("verdict", "sentence", "causes"), "string"),
    **dict.fromkeys(
        (
            "probability", "gap_before", "gap_after", "gap_floor", "closed_fraction",
            "closed_fraction_low", "closed_fraction_high",
        ),
        "float64",
    ),
    "problems": "int64",
}  # fmt: skip
"""The table of an archive: a row a recording, null where unknown; types as pyarrow's.

causes: with their joints, comma-separated; probability: of the first. gap_...: mean squared
residual over the noise's. problems: how many.
"""


def to_row(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of `COLUMNS`.

    Args:
        content: What diagnosis.json holds.

    Returns:
        Values by column; None where unknown.

    """
    causes, gap = content["causes"], content["gap"]
    closed = gap.get("closed_fraction") or {}
    low, high = closed.get("ci95") or (None, None)
    return {
        "verdict": content["verdict"],
        "sentence": content["sentence"],
        "causes": ", ".join(":".join(filter(None, (c["effect"], c.get("joint")))) for c in causes),
        "probability": causes[0]["probability"] if causes else None,
        **{
            f"gap_{part}": (gap.get(part) or {}).get("mean_square")
            for part in ("before", "after", "floor")
        },
        "closed_fraction": closed.get("value"),
        "closed_fraction_low": low,
        "closed_fraction_high": high,
        "problems": len(content["problems"]),
    }


def print_overview(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """Print a line for each of many recordings.

    Args:
        rows: What diagnosis.json holds or, with the key `error`, why there is none.
        console: Where.

    """
    good = [
        (
            row["recording"],
            row["verdict"],
            ", ".join(cause["effect"] for cause in row["causes"]) or "-",
            ", ".join(f"{cause['probability']:.0%}" for cause in row["causes"]) or "-",
            share_words(row["gap"].get("closed_fraction")),
        )
        for row in rows
        if "error" not in row
    ]
    columns = ("recording", "verdict", "causes", "probability", "gap closed")
    _print_table(console, columns, good)
    for row in rows:
        if "error" in row:
            console.print(f"failed: {escape(str(row['error']))}", soft_wrap=True)


# The output directory


def check_output(folder: Path, *, overwrite: bool) -> None:
    """Check that `write_output` can write a folder.

    Args:
        folder: The diagnosis' directory.
        overwrite: Whether an old diagnosis may be replaced.

    Raises:
        GalenError: The folder is there and may not be replaced, holds no diagnosis, or can't be
            written.

    """
    check_parent(folder)
    if not os.path.lexists(folder):
        return
    if not overwrite:
        raise GalenError(f"{folder}: is there already; --overwrite replaces an old diagnosis")
    if folder.is_symlink() or not (folder / DIAGNOSIS).is_file():
        raise GalenError(f"{folder}: not overwritten: it holds no {DIAGNOSIS}")


def write_output(
    answer: Answer,
    folder: Path,
    *,
    files: Mapping[str, str],
    draw: Callable[[Path], Mapping[str, Path]] | None = None,
    overwrite: bool = False,
) -> None:
    """Write diagnosis.json and, where given, report.html with its pictures.

    They are made in a directory beside, which is renamed once all are there.

    Args:
        answer: What is written.
        folder: The directory to make.
        files: Texts of other files by name.
        draw: Writes the pictures into a directory, and returns them by name; None for no report.
        overwrite: Whether an old diagnosis is replaced.

    Raises:
        GalenError: The folder can't be written or replaced; an old directory is then untouched.

    """
    check_output(folder, overwrite=overwrite)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            content = json.dumps(answer.to_json(), indent=2, allow_nan=False)
            (made / DIAGNOSIS).write_text(content + "\n", encoding="utf-8")
            for name, text in files.items():
                (made / name).write_text(text, encoding="utf-8")
            if draw is not None:
                page = report(answer, draw(made / PICTURES))
                (made / REPORT).write_text(page, encoding="utf-8")
            made.chmod(0o755)  # mkdtemp's 0700 would hide it from the lab's others
            _put(made, folder, overwrite=overwrite)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        sync_directory(folder.parent)


def _put(made: Path, folder: Path, *, overwrite: bool) -> None:
    """Give the new directory its name; an old one is moved aside first and then removed."""
    if not (overwrite and folder.exists()):
        made.rename(folder)  # fails where a directory with files came there meanwhile
        return
    aside = made.with_name(made.name + ".old")
    folder.rename(aside)
    try:
        made.rename(folder)
    except OSError:
        aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)


_HEAD = """\
# What the diagnosis of {recording} found, for the simulated driver:
# {causes}
#
#   ros2 run galen_sim_driver sim_driver_node --ros-args --params-file THIS_FILE{arm}
"""


def effect_file(recording: str, effects: Sequence[Effect], arm: Arm) -> str | None:
    """Return an arm's found effects as the driver's parameters.

    Args:
        recording: Name of the recording, for a comment.
        effects: As `in_driver` returns them.
        arm: The Galen needs no description, of another arm the comment names one.

    Returns:
        YAML; None where there are no effects.

    Raises:
        ConfigError: Two effects of a kind, of which the driver has one each, or one of
            `effects/general_shapes.py`, of which it has none.

    """
    if not effects:
        return None
    for effect in effects:
        if effect.name not in EFFECTS:
            words = effect.name.replace("_", " ")
            raise ConfigError(f"the simulated driver has no {words} as it was fitted here")
    # A recording's name is whatever its directory is called: no line may end in it.
    name = "".join(letter if letter.isprintable() else "?" for letter in recording)
    causes = ", ".join(effect.identity for effect in effects)
    urdf = "" if arm.joint_names == GALEN.joint_names else " -p urdf_file:=ARM.urdf"
    head = _HEAD.format(recording=name, causes=causes, arm=urdf)
    content = {f"/**/{node}": below for node, below in driver_file(effects).items()}
    return head + yaml.safe_dump(content, sort_keys=False)
