"""From rows to an answer, on the terminal, as JSON and as pictures, for tables and joints."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.errors import GalenError
from galen_model.evidence.held_out import BlockEvidence
from galen_model.evidence.search import SearchSettings, search
from galen_model.files.atomic_file import save_figure, write_whole
from galen_ros.command import check_folder, progress, terminal, writing
from rich.console import Console
from rich.table import Table

from galen_diagnosis.answer.answer import Cause, Interval
from galen_diagnosis.tables.conclusion import BlockDiagnosis, conclude
from galen_diagnosis.tables.table_rows import Prepared

_TABLE_WIDTH = 170
_SHOWN = 0.01
_SMALL = {"N": (1e3, "mN"), "N.m": (1e3, "mN.m"), "rad": (1e3, "mrad")}
_BEFORE, _AFTER = "#c44e52", "#1f6f8b"


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """How an answer is given."""
    parser.add_argument("--json", action="store_true", help="print diagnosis.json's content")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="write <name>_diagnosis.json here"
    )
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write a picture here")
    parser.add_argument("--label", metavar="TEXT", help="what it is called (default: the file's)")


def check_outputs(arguments: argparse.Namespace) -> None:
    """Raise GalenError before the work if what was asked for can't be written."""
    check_folder(arguments.plots)
    check_folder(arguments.output)


def diagnose_rows(
    name: str,
    prepared: Prepared,
    settings: SearchSettings | None = None,
    quiet: bool = True,
) -> BlockDiagnosis:
    """Search, and conclude from it."""
    evidence = BlockEvidence(prepared.rows, prepared.effects.nominal)
    with progress(0, "hypothesis", quiet=quiet) as bar:

        def show(text: str) -> None:
            bar.set_description(f"{name}: {text}", refresh=False)
            bar.update()

        found = search(evidence, prepared.effects, settings, show)
    return conclude(name, evidence, found, prepared.effects, prepared.words)


def give(found: list[BlockDiagnosis], arguments: argparse.Namespace) -> None:
    """Write and print what was found; raises GalenError where a file can't be written."""
    answers = [one.answer.to_json() for one in found]
    pictures: list[Path] = []
    if arguments.plots is not None:
        folder: Path = arguments.plots
        with writing(folder):
            pictures = [plot_diagnosis(one, folder) for one in found]
    if arguments.output is not None:
        for one, answer in zip(found, answers, strict=True):
            _write(arguments.output, one.answer.recording, answer)
    if arguments.json:
        print(json.dumps(answers[0] if len(answers) == 1 else answers, indent=2))
        return
    to = terminal(_TABLE_WIDTH)
    for one in found:
        print_diagnosis(one, to)
    for picture in pictures:
        to.print(f"plot: {picture}", soft_wrap=True)


def name_of(path: Path, label: str | None) -> str:
    """The label, or the file's name; neither is ever a path."""
    name = label or path.stem
    if not name.strip() or any(letter in name for letter in "/\\\0"):
        raise GalenError(f"--label {name!r}: a name, not a path")
    return name


def _write(folder: Path, name: str, answer: dict[str, object]) -> None:
    path = folder / f"{name}_diagnosis.json"
    try:
        write_whole(path, json.dumps(answer, indent=2) + "\n")
    except OSError as error:
        raise GalenError(f"{path}: can't be written: {error.strerror}") from error
    print(f"wrote {path}", file=sys.stderr)


def print_diagnosis(found: BlockDiagnosis, to: Console) -> None:
    """The sentence first, then what is behind it."""
    answer = found.answer
    to.print(f"[bold]{answer.recording}: {answer.verdict}[/bold]", soft_wrap=True, highlight=False)
    to.print(answer.sentence, soft_wrap=True, highlight=False)
    for text in found.words:
        to.print(f"  {text}", soft_wrap=True, highlight=False)
    causes = Table(title="Causes")
    for name in ("effect", "probability", "parameters, with 95 % interval", "alone closes", "or"):
        causes.add_column(name)
    for cause in answer.causes:
        closed = "" if cause.gap_closed is None else interval(cause.gap_closed)
        causes.add_row(
            cause.effect,
            f"{cause.probability:.2f}",
            "\n".join(parameter_lines(cause)),
            closed,
            ", ".join(cause.equivalent),
        )
    if answer.causes:
        to.print(causes)
    ranking = [f"{name} {share:.2f}" for name, share in answer.ranking if share >= _SHOWN]
    to.print(
        f"probabilities, of each cause being there, alone or with others: {', '.join(ranking)}",
        soft_wrap=True,
        highlight=False,
    )
    to.print(_gap_table(found))
    worst = sorted(answer.where["poses"], key=lambda pose: -pose["share"])[:4]
    shares = ", ".join(f"{pose['pose']} {100 * pose['share']:.0f} %" for pose in worst)
    to.print(f"most of the gap: {shares}", soft_wrap=True, highlight=False)
    for text in (*answer.problems, *answer.cannot_tell):
        to.print(f"[yellow]{text}[/yellow]", soft_wrap=True, highlight=False)


def _gap_table(found: BlockDiagnosis) -> Table:
    rows, gap = found.rows, found.answer.gap
    table = Table(title="RMS on readings that no fit has seen")
    table.add_column("")
    for name, unit in zip(rows.channels, rows.units, strict=True):
        table.add_column(f"{name}, {_SMALL[unit][1]}", justify="right")
    table.add_column("mean square, noise = 1", justify="right")
    for name in ("before", "after", "floor"):
        known = name != "floor" or rows.floor_known
        values = [
            f"{_SMALL[unit][0] * gap[name]['rms'][channel]:.3g}" if known else "?"
            for channel, unit in zip(rows.channels, rows.units, strict=True)
        ]
        square = f"{gap[name]['mean_square']:.4g}" if rows.floor_known else "?"
        table.add_row(name, *values, square)
    return table


def parameter_lines(cause: Cause) -> list[str]:
    """A line a parameter."""
    lines = []
    for name, value in {**cause.parameters, **cause.extra}.items():
        lines.append(f"{name} {_value(value)}")
    return lines


def _value(value: Any) -> str:
    if isinstance(value, Interval):
        return interval(value)
    if isinstance(value, dict):
        return interval(Interval(value["value"], *(value["ci95"] or (None, None))))
    if isinstance(value, list):
        return "; ".join(_value(part) for part in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def interval(value: Interval) -> str:
    """As `0.76 (0.60 to 0.92)`."""
    if value.low is None or value.high is None:
        return f"{value.value:.3g}"
    return f"{value.value:.3g} ({value.low:.3g} to {value.high:.3g})"


def plot_diagnosis(found: BlockDiagnosis, folder: Path) -> Path:
    """Write `<name>_diagnosis.png`: the residual before and after, channel by channel."""
    import matplotlib

    matplotlib.use("Agg")  # a lab's machine over ssh has no display
    import matplotlib.pyplot as plt

    rows = found.rows
    across = np.arange(len(rows))
    count = len(rows.channels)
    columns = min(3, count)
    lines = -(-count // columns)
    figure, panels = plt.subplots(
        lines, columns, figsize=(4.2 * columns if count > 1 else 10, 0.8 + 2.5 * lines),
        squeeze=False, sharex=True,
    )  # fmt: skip
    order = np.argsort(rows.block, kind="stable")
    edges = np.flatnonzero(np.diff(rows.block[order])) + 0.5
    for channel, panel in zip(range(count), panels.flat, strict=False):
        scale, unit = _SMALL[rows.units[channel]]
        size = scale * rows.floor[channel]
        if rows.floor_known:
            panel.axhspan(-2 * size, 2 * size, color="#dddddd", lw=0, label="noise, 2 sigma")
        for values, colour, name in (
            (found.before, _BEFORE, "before"),
            (found.after, _AFTER, "after"),
        ):
            rms = np.sqrt(np.mean(values[:, channel] ** 2)) * size
            panel.plot(
                across, size * values[order, channel], ".-", ms=3, lw=0.7, color=colour,
                label=f"{name}: {rms:.3g} {unit}",
            )  # fmt: skip
        for edge in edges:
            panel.axvline(edge, color="#bbbbbb", lw=0.5)
        panel.set_title(f"{rows.channels[channel]}, {unit}", fontsize=10, loc="left")
        panel.legend(fontsize=7, frameon=False, loc="upper right")
        panel.margins(x=0.01)
    for panel in panels[-1]:
        panel.set_xlabel("row; lines part the blocks")
    figure.suptitle(
        f"{found.answer.recording}: {found.answer.verdict}. What is left on unseen readings",
        x=0.01, ha="left", fontsize=11,
    )  # fmt: skip
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.98))
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", found.answer.recording)
    return save_figure(figure, folder / f"{name}_diagnosis.png")
