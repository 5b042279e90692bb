"""Pictures of chosen poses: where they lie and in which order, and how good any number is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure

from galen_calibration_behavior.pose_choice.report import Efficiency

_GRID, _CHOSEN = "#c44e52", "#1f6f8b"


def plot_poses(poses: Array, grid: Array, free: Array, blocked: Array, path: Path) -> Path:
    """Roll over tilt: all candidates (k, 2), the grid's poses and the chosen ones; rad."""
    figure, axis = plt.subplots(figsize=(9, 5.5))
    for points, options in (
        (free, {"marker": ".", "color": "0.75", "ms": 4, "label": "candidates"}),
        (blocked, {"marker": "x", "color": "0.6", "ms": 5, "label": "a box is in the way"}),
        (grid, {"marker": "s", "color": _GRID, "ms": 4, "mfc": "none", "label": "the grid"}),
    ):
        if len(points):
            axis.plot(*np.degrees(points).T, linestyle="none", **options)
    axis.plot(*np.degrees(poses).T, "o-", color=_CHOSEN, lw=0.7, ms=7, label="chosen, in order")
    for index, (roll, tilt) in enumerate(np.degrees(poses)):
        axis.annotate(str(index), (roll, tilt), (4, 5), textcoords="offset points", fontsize=8)
    axis.set_xlabel("roll (°)")
    axis.set_ylabel("tilt (°)")
    axis.set_title(f"{len(poses)} chosen poses")
    figure.legend(*axis.get_legend_handles_labels(), loc="lower center", ncol=4, frameon=False)
    return _save(figure, path)


def plot_curve(curve: Sequence[Efficiency], path: Path) -> Path:
    """How near to the best possible, and the std over the grid's, over the number of poses."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5))
    counts = [row.poses for row in curve]
    left.plot(counts, [100 * row.efficiency for row in curve], "o-", color=_CHOSEN, ms=4)
    left.axhline(100.0, color="black", lw=0.6)
    left.set_ylabel("of the best possible (%)")
    right.plot(counts, [row.grid_ratio for row in curve], "o-", color=_CHOSEN, ms=4)
    right.axhline(1.0, color=_GRID, lw=0.8)
    right.set_ylabel("standard deviation over the grid's")
    right.set_title("averages equally long", fontsize=10)
    for axis in (left, right):
        axis.set_xlabel("chosen poses")
    return _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> Path:
    figure.tight_layout(rect=(0.0, 0.05, 1.0, 1.0))
    return save_figure(figure, path)
