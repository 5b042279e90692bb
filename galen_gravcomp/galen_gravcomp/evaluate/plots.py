# SPDX-License-Identifier: Apache-2.0
"""Pictures of evaluations: a bag, a long recording without contact."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.axes import Axes

from galen_gravcomp.evaluate.bag import BagEvaluation
from galen_gravcomp.evaluate.drift import GROUPS, DriftResult

_COLOURS = ("#1f6f8b", "#c44e52", "#55a868")
_MOST_POINTS = 3000
_SLOW_PART = 1 / 20


def plot_evaluation(result: BagEvaluation, directory: Path, name: str) -> Path:
    """Write the picture of a bag's evaluation.

    Args:
        result: the bag's evaluation.
        directory: where the picture goes; made if need be.
        name: of the bag; begins the picture's name and title.

    Returns:
        The picture, `<name>_evaluation.png`.

    Raises:
        OSError: it can't be written.

    """
    figure = plt.figure(figsize=(12, 10))
    grid = figure.add_gridspec(3, 2, height_ratios=(1.0, 1.0, 1.15))
    force = figure.add_subplot(grid[0, :])
    torque = figure.add_subplot(grid[1, :], sharex=force)
    _course(force, result, slice(0, 3), 1.0, "N")
    _course(torque, result, slice(3, 6), 1e3, "mN.m")
    torque.set_xlabel("time, s (shaded: rest segments)")
    _poses(figure.add_subplot(grid[2, 0]), result, slice(0, 3), 1.0, "force, N")
    _poses(figure.add_subplot(grid[2, 1]), result, slice(3, 6), 1e3, "torque, mN.m")
    figure.suptitle(f"{name}, {result.tool.tool}: {fill(result.verdict.text, 90)}")
    figure.tight_layout()
    return save_figure(figure, directory / f"{name}_evaluation.png")


def _course(axes: Axes, result: BagEvaluation, which: slice, factor: float, unit: str) -> None:
    cells = result.cells
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set_ylabel(f"residual, {unit}")
    if not len(cells):
        return
    time = (cells.start_ns - cells.start_ns[0]) * 1e-9
    group = max(1, len(cells) // _MOST_POINTS)
    starts = np.arange(0, len(cells), group)
    # A line over a gap would show what was not measured.
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


def _places(result: BagEvaluation) -> tuple[Array, tuple[str, str]]:
    """Where the rest segments lie (n, 2), and what that is: two angles, or where gravity points."""
    arm = result.tool.arm
    angles = result.phases.angles.reshape(-1, len(arm.turning))
    if len(arm.turning) == 2:
        first, second = arm.turning_names
        return angles, (f"{first}, rad", f"{second}, rad")
    x, y, z = np.moveaxis(arm.gravity_in_sensor(angles), -1, 0)
    places = np.column_stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    names = ("azimuth", "elevation over its x-y plane")
    return places, (f"gravity in {arm.sensor_frame}: {names[0]}, rad", f"{names[1]}, rad")


def _poses(axes: Axes, result: BagEvaluation, which: slice, factor: float, label: str) -> None:
    places, names = _places(result)
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.set_title(f"rest segments: {label}", fontsize=10)
    if not len(result.phases):
        axes.text(0.5, 0.5, "no rest segment", ha="center", transform=axes.transAxes)
        return
    size: Array = factor * np.linalg.norm(result.phases.mean[:, which], axis=1)
    order = np.argsort(size)  # so that the largest lies on top
    size, places = size[order], places[order]
    top = max(float(size.max()), factor * float(result.limits.axes[which.start]))
    points = axes.scatter(
        places[:, 0], places[:, 1], c=size, cmap="viridis", vmin=0.0, vmax=top, s=40,
        edgecolors="black", linewidths=0.4,
    )  # fmt: skip
    axes.figure.colorbar(points, ax=axes)


def plot_drift(result: DriftResult, directory: Path, name: str) -> Path:
    """Write the picture of a long recording.

    Args:
        result: the judged recording.
        directory: where the picture goes; made if need be.
        name: of the recording; begins the picture's name.

    Returns:
        The picture, `<name>_drift.png`.

    Raises:
        OSError: it can't be written.

    """
    figure, grid = plt.subplots(2, 3, figsize=(14, 8), width_ratios=(1.6, 1.0, 1.0))
    series = result.series
    cell_s = max(1, len(series.reading) // 2000) * series.cell_s
    shown = series.every(cell_s)
    slow_s = max(cell_s, series.duration_s * _SLOW_PART)
    slow = series.every(slow_s)
    hours = series.duration_s > 7200.0
    unit_s = 3600.0 if hours else 60.0
    for row, (group, axes) in enumerate(GROUPS.items()):
        factor, unit = (1.0, "N") if group == "force" else (1e3, "mN.m")
        course, allan, hold = grid[row]
        start = np.nanmean(slow[:1, axes], axis=0)
        for colour, axis in zip(_COLOURS, range(6)[axes], strict=True):
            zero = start[axis - axes.start]
            time = (np.arange(len(shown)) + 0.5) * cell_s / unit_s
            course.plot(time, (shown[:, axis] - zero) * factor, color=colour, lw=0.5, alpha=0.5)
            time = (np.arange(len(slow)) + 0.5) * slow_s / unit_s
            course.plot(
                time, (slow[:, axis] - zero) * factor, color=colour, lw=1.8, label=WRENCH_AXES[axis]
            )
            one = result.allan[axis]
            allan.loglog(one.tau_s, one.deviation * factor, color=colour, lw=1.4)
            allan.fill_between(
                one.tau_s, one.low * factor, one.high * factor, color=colour, alpha=0.2, lw=0
            )
            hold.loglog(result.delay_s, result.change[:, axis] * factor, color=colour, lw=1.4)
        for begin, end in series.contact_s:
            course.axvspan(begin / unit_s, end / unit_s, color="black", alpha=0.12, lw=0)
        course.axhline(0.0, color="black", lw=0.6)
        course.set_xlabel("time, h" if hours else "time, min")
        course.set_ylabel(f"change of {group}, {unit}")
        course.legend(loc="upper left", ncol=3, frameon=False)
        allan.set_xlabel("averaging time, s")
        allan.set_ylabel(f"Allan deviation, {unit}")
        limit = result.limits.axes[axes.start] * factor
        hold.axhline(limit, color="grey", lw=0.8, ls="--")
        hold.set_xlabel("time since tare, s (dashed: the limit)")
        hold.set_ylabel(f"rms change, {unit}")
    title = "\n".join(fill(sentence, 150) for sentence in result.sentence.values())
    figure.suptitle(title, fontsize=9)
    figure.tight_layout()
    return save_figure(figure, directory / f"{name}_drift.png")
