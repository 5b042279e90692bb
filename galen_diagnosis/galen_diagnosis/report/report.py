"""What a diagnosis leaves: one HTML page, the terminal's tables, the output directory.

Text on the page is escaped by jinja2. Its Content-Security-Policy lets in nothing but pictures in
the page itself and the one style sheet whose hash it names; a name that smuggled in a tag could
still not run or load anything.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from galen_model.errors import GalenError
from galen_model.files.atomic_file import sync_directory
from galen_ros.command import check_parent, writing
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.parameters import driver_file
from jinja2 import Environment, FileSystemLoader
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from galen_diagnosis.answer.answer import NONE, UNKNOWN, Answer
from galen_diagnosis.answer.localization import LEVEL
from galen_diagnosis.report.words import (
    RANKING_NOTE,
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
_SHOWN_PROBABILITY = 0.005
_RANKED = 6
_PLACES = 4
_CAPTIONS = {
    "gap": "RMS residual over the noise before, and after the cause was added to the simulator, on"
    " blocks that no fit has seen. 1 is noise alone; framed cells are beyond noise and the"
    " tolerances of a healthy arm.",
    "time": "The residual in time, before (left) and after (right) on the same scale.",
}
_HOW = (
    "The nominal simulator was driven along the recorded joint states. What was measured less what"
    " it predicts is the residual, whitened by the noise that the recording itself shows.",
    "The unknowns of a recording that are no gap (the sensor's zero, the tracker's place) were"
    " fitted in every comparison.",
    "Every effect was tried singly, in pairs and more; each fitted on the simulator itself. Before,"
    " after and the closed fraction are of blocks of time that the fit has not seen.",
    "Closed fraction: (before - after) / (before - floor) of the mean squared residual in units of"
    " the noise; 1 means down to the noise.",
    "p-values of where the gap lies are how often noise and the tolerances of a healthy arm give"
    " as much, corrected for all cells of their table: in 5 % of healthy recordings any cell of it"
    " is marked.",
)


@dataclass(frozen=True)
class Row:
    """A table's row; share: of a bar beside it, None without one."""

    cells: Sequence[str]
    share: float | None = None
    marked: bool = False


def report(answer: Answer, pictures: Mapping[str, Path]) -> str:
    """Return the page; pictures: PNG files by name, as `write_pictures` gives them."""
    loader = FileSystemLoader(Path(__file__).parent)
    page = Environment(autoescape=True, trim_blocks=True, loader=loader).get_template(
        "template.html"
    )
    style = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    experiment = answer.next_experiment or {}
    return page.render(
        answer=answer,
        style=style,
        digest=digest,
        captions=_CAPTIONS,
        pictures={
            name: base64.b64encode(file.read_bytes()).decode() for name, file in pictures.items()
        },
        causes=[Row(cells) for cells in _causes(answer, _named)],
        closed=f"Closed fraction: {share_words(answer.gap.get('closed_fraction'))}",
        gap=[Row(cells) for cells in _gap(answer.gap)],
        ranking_note=RANKING_NOTE,
        ranking=[
            Row((name, title(name), f"{probability:.1%}"), probability)
            for name, probability in answer.ranking
            if probability >= _SHOWN_PROBABILITY or name in (NONE, UNKNOWN)
        ],
        remaining=[
            Row((one["what"], _number(one["energy"]), _number(one["log_bayes"])))
            for one in answer.remaining
        ],
        where=list(_where(answer.where)),
        lists=(
            ("Not identifiable in this recording", answer.cannot_tell),
            ("What to do next", [str(experiment["do"])] if experiment.get("do") else []),
            ("Problems of the recording", answer.problems),
            ("How it was done", answer.notes or _HOW),
        ),
    )


def _named(label: str) -> str:
    return f"{label}: {title(label)}"


def _causes(answer: Answer, name_of: Callable[[str], str]) -> Iterator[tuple[str, ...]]:
    """Return a line a parameter; the cause with its first."""
    for cause in answer.causes:
        first = (name_of(cause.label), f"{cause.probability:.1%}")
        last = (share_words(cause.gap_closed), ", ".join(cause.equivalent) or "-")
        for number, name in enumerate(list(cause.parameters) or [""]):
            words = parameter_words(cause.effect, name, cause.parameters) if name else "-"
            yield (*(first if not number else ("", "")), name, words,
                   *(last if not number else ("", "")))  # fmt: skip


def _gap(gap: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Mean squares over the noise and, where there are any, RMS by channel in its own unit."""
    parts = [gap.get(name) or {} for name in ("before", "after", "floor")]
    if any("mean_square" in part for part in parts):
        squares = [_number(part.get("mean_square")) for part in parts]
        yield ("mean squared residual over noise", *squares)
    for channel in parts[0].get("rms", {}):
        yield (f"RMS of {channel}", *(_number(part.get("rms", {}).get(channel)) for part in parts))


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "-"


def _where(where: Mapping[str, Any]) -> Iterator[tuple[str, list[Row]]]:
    """Tables by their titles; of poses those that are marked."""
    for name, word in (("bags", "bag"), ("regimes", "regime"), ("channels", "channel")):
        ratios, p_values = (where.get(of, {}).get(name, {}) for of in ("ratio", "p"))
        shares = where.get(name, {})
        if shares:
            yield (
                word,
                [
                    _place(label, share, ratios.get(label), p_values.get(label))
                    for label, share in shares.items()
                ],
            )
    poses = sorted(where.get("poses", []), key=lambda pose: -pose["share"])
    if poses:
        yield (
            "pose",
            [
                _place(_pose_words(pose), pose["share"], pose.get("ratio"), pose.get("p"))
                for pose in poses
                if pose["share"] > 0.0 and pose.get("p", 0.0) < LEVEL
            ],
        )


def _place(label: str, share: float, ratio: float | None, p: float | None) -> Row:
    rms = "-" if ratio is None else f"{ratio**0.5:.2f}"
    return Row((label, f"{share:.1%}", rms, p_words(p)), share, p is not None and p < LEVEL)


def _pose_words(pose: Mapping[str, Any]) -> str:
    at = ", ".join(f"{name} {value:.2f}" for name, value in pose.get("joints", {}).items())
    return f"{pose.get('bag', '')} {pose['pose']} {at}".strip()


# Terminal


def print_answer(answer: Answer, console: Console) -> None:
    """Print one diagnosis."""
    console.print(f"[bold]{escape(answer.recording)}: {answer.verdict}[/bold]")
    console.print(escape(answer.sentence))
    for note in answer.notes:
        console.print(f"  {escape(note)}")
    _print_table(console, ("cause", "probability", "parameter", "value (95 % interval)",
                           "alone closes", "not distinguishable from"),
                 [(*cells[:5], _few(cells[5])) for cells in _causes(answer, str)])  # fmt: skip
    ranked = [(name, f"{p:.1%}") for name, p in answer.ranking[:_RANKED]]
    _print_table(console, ("cause alone or with others", "probability that it is there"), ranked)
    console.print(RANKING_NOTE)
    if "rms" in answer.gap.get("before", {}):
        gap = list(_gap(answer.gap))
        _print_table(console, ("on readings that no fit has seen", "before", "after", "floor"), gap)
    of_recording = bool(answer.where.get("bags"))
    places = [
        row.cells
        for kind, rows in _where(answer.where)
        if not (of_recording and kind == "pose")  # 60 of them are for the page
        for row in sorted(rows, key=lambda one: -(one.share or 0.0))[:_PLACES]
        if row.share and (row.marked or row.cells[3] == "-")
    ]
    _print_table(console, ("where", "share of the gap", "RMS over noise", "p"), places)
    for what, texts in (("not identifiable", answer.cannot_tell), ("problem", answer.problems)):
        for text in texts:
            console.print(f"{what}: {escape(text)}")
    if answer.next_experiment is not None:
        console.print(f"next: {escape(str(answer.next_experiment.get('do', '')))}")


def _print_table(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if rows:
        table = Table(*columns, box=None)
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)


def _few(names: str) -> str:
    count = names.count(",") + 1
    return names if count <= _PLACES else f"{count} other effects"


def print_overview(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """Print a line for each of many recordings: diagnosis.json's content, or its error."""
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
    """Raise GalenError where `write_output` would reject the folder, or can't write it."""
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
    driver: str | None = None,
    draw: Callable[[Path], Mapping[str, Path]] | None = None,
    overwrite: bool = False,
) -> None:
    """Write diagnosis.json and, where given, found_effect.yaml, report.html with its pictures.

    They are made in a directory beside, which is renamed once all are there.

    Args:
        answer: the answer.
        folder: the directory.
        driver: `effect_file`'s text.
        draw: writes the pictures into a directory, by name; None for no report.
        overwrite: whether an old diagnosis is replaced.

    Raises:
        GalenError: an old directory is then untouched.

    """
    check_output(folder, overwrite=overwrite)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            content = json.dumps(answer.to_json(), indent=2, allow_nan=False)
            (made / DIAGNOSIS).write_text(content + "\n", encoding="utf-8")
            if driver is not None:
                (made / EFFECT).write_text(driver, encoding="utf-8")
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
#   ros2 run galen_sim_driver sim_driver_node --ros-args --params-file THIS_FILE
"""


def effect_file(recording: str, effects: Sequence[Effect]) -> str | None:
    """Return the found effects as the driver's parameters, YAML; None where there are none.

    Raises ConfigError: the driver has one of each effect, so that two of a kind are rejected.
    """
    if not effects:
        return None
    # A recording's name is whatever its directory is called: no line may end in it.
    name = "".join(letter if letter.isprintable() else "?" for letter in recording)
    head = _HEAD.format(recording=name, causes=", ".join(effect.identity for effect in effects))
    content = {f"/**/{node}": below for node, below in driver_file(effects).items()}
    return head + yaml.safe_dump(content, sort_keys=False)
