"""The picture of a bag's evaluation: course, poses, and what the left over is made of."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.figure_file import save_figure
from matplotlib.axes import Axes

from galen_gravcomp.evaluate.bag_evaluation import BagEvaluation

_COLOURS = ("#1f6f8b", "#c44e52", "#55a868")
_PART_COLOURS = {"load": "#c44e52", "offset": "#dd8452", "drift": "#8172b3", "rest": "#8c8c8c"}
_MOST_POINTS = 3000


def plot_evaluation(result: BagEvaluation, directory: Path, name: str) -> Path:
    """Write `<name>_evaluation.png` into `directory`; returns its path."""
    figure = plt.figure(figsize=(12, 10))
    grid = figure.add_gridspec(3, 3, height_ratios=(1.0, 1.0, 1.15))
    force = figure.add_subplot(grid[0, :])
    torque = figure.add_subplot(grid[1, :], sharex=force)
    _course(force, result, slice(0, 3), 1.0, "N")
    _course(torque, result, slice(3, 6), 1e3, "mN.m")
    torque.set_xlabel("time, s (shaded: still phases)")
    _poses(figure.add_subplot(grid[2, 0]), result, slice(0, 3), 1.0, "force, N")
    _poses(figure.add_subplot(grid[2, 1]), result, slice(3, 6), 1e3, "torque, mN.m")
    _parts(figure.add_subplot(grid[2, 2]), result)
    figure.suptitle(f"{name}, {result.tool.tool}: {_wrapped(result.sentence)}")
    figure.tight_layout()
    return save_figure(figure, directory / f"{name}_evaluation.png")


def _course(axes: Axes, result: BagEvaluation, which: slice, factor: float, unit: str) -> None:
    """The compensated wrench over time: means, and the band that the single readings fill."""
    cells = result.cells
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set_ylabel(f"left over, {unit}")
    if not len(cells):
        return
    time = (cells.start_ns - cells.start_ns[0]) * 1e-9
    group = max(1, len(cells) // _MOST_POINTS)
    starts = np.arange(0, len(cells), group)
    # A line over a gap would show what nobody measured.
    broken = np.concatenate([[False], np.diff(time[starts]) > 3.0 * group * cells.cell_s])
    weight = cells.count[:, None]
    total = np.add.reduceat(weight, starts, axis=0)
    mean = np.add.reduceat(weight * cells.mean, starts, axis=0) / total
    mean_square = np.add.reduceat(cells.sum_of_squares, starts, axis=0) / total
    spread = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
    for colour, axis in zip(_COLOURS, range(6)[which], strict=True):
        value, width = factor * mean[:, axis], factor * spread[:, axis]
        value = np.where(broken, np.nan, value)
        axes.plot(time[starts], value, color=colour, lw=1.0, label=WRENCH_AXES[axis])
        axes.fill_between(
            time[starts], value - width, value + width, color=colour, alpha=0.15, lw=0
        )
    limit = factor * result.limits.axes[which.start]
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit, color="grey", lw=0.8, ls="--")
    for start, end in zip(result.phases.start_ns, result.phases.end_ns, strict=True):
        axes.axvspan(
            (start - cells.start_ns[0]) * 1e-9, (end - cells.start_ns[0]) * 1e-9,
            color="black", alpha=0.06, lw=0,
        )  # fmt: skip
    if result.change is not None:
        time_s = (result.change.time_ns - cells.start_ns[0]) * 1e-9
        axes.axvline(time_s, color="black", lw=1.2, ls=":")
    axes.margins(x=0.0)
    # Above the axes: a push would go through it.
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=3, frameon=False)


def _poses(axes: Axes, result: BagEvaluation, which: slice, factor: float, label: str) -> None:
    """Where in roll and tilt something is left over."""
    axes.set_xlabel("roll, rad")
    axes.set_ylabel("tilt, rad")
    axes.set_title(f"still phases: {label}", fontsize=10)
    if not len(result.phases):
        axes.text(0.5, 0.5, "no still phase", ha="center", transform=axes.transAxes)
        return
    size: Array = factor * np.linalg.norm(result.phases.mean[:, which], axis=1)
    order = np.argsort(size)  # so that the largest lies on top
    size, angles = size[order], result.phases.angles[order]
    top = max(float(size.max()), factor * float(result.limits.axes[which.start]))
    points = axes.scatter(
        angles[:, 0], angles[:, 1], c=size, cmap="viridis", vmin=0.0, vmax=top, s=40,
        edgecolors="black", linewidths=0.4,
    )  # fmt: skip
    axes.figure.colorbar(points, ax=axes)


def _parts(axes: Axes, result: BagEvaluation) -> None:
    """Root mean square of each part, in units of the limit of a fit."""
    axes.set_title("made of (1: the limit of a fit)", fontsize=10)
    misfit = result.misfit
    if misfit is None:
        why = "too few still phases" if result.change is None else "see the parts on their own"
        axes.text(0.5, 0.5, why, ha="center", transform=axes.transAxes)
        return
    parts = {
        name: part
        for name in _PART_COLOURS
        if (part := getattr(misfit, name)) is not None
    }  # fmt: skip
    width = 0.8 / len(parts)
    for k, (name, part) in enumerate(parts.items()):
        axes.bar(
            np.arange(6) + (k - (len(parts) - 1) / 2) * width, part / result.limits.axes, width,
            color=_PART_COLOURS[name], label=name,
        )  # fmt: skip
    axes.axhline(1.0, color="grey", lw=0.8, ls="--")
    axes.set_xticks(range(6), WRENCH_AXES)
    axes.legend(frameon=False, fontsize=8)


def _wrapped(sentence: str) -> str:
    words, lines = sentence.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) > 90:
            lines.append("")
        lines[-1] += f"{word} "
    return "\n".join(line.strip() for line in lines)
