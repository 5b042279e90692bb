"""A diagnosis of measured tables for a person: tables on the terminal, pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.files.atomic_file import save_figure
from rich.console import Console
from rich.table import Table

from galen_diagnosis.answer.answer import Cause, Interval
from galen_diagnosis.tables.block_answer import BlockDiagnosis

_SHOWN = 0.01
_SMALL = {"N": (1e3, "mN"), "N.m": (1e3, "mN.m"), "rad": (1e3, "mrad")}
_BEFORE, _AFTER = "#c44e52", "#1f6f8b"


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
