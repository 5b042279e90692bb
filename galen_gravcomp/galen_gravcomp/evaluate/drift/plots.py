"""The picture of a drift recording: its course, Allan deviation, how long a tare holds."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.files.figure_file import save_figure

from galen_gravcomp.evaluate.drift.result import GROUPS, DriftResult

_COLOURS = ("#1f6f8b", "#c44e52", "#55a868")
_MOST_POINTS = 2000
_TITLE_WIDTH = 150
_SLOW_PART = 1 / 20


def plot_drift(result: DriftResult, directory: Path, name: str) -> Path:
    """Write `<name>_drift.png` into `directory`; returns its path."""
    figure, grid = plt.subplots(2, 3, figsize=(14, 8), width_ratios=(1.6, 1.0, 1.0))
    series = result.series
    cell_s = max(1, len(series.reading) // _MOST_POINTS) * series.cell_s
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
            allan.loglog(one.tau_s, one.fitted(one.tau_s) * factor, color=colour, lw=0.8, ls=":")
            hold.loglog(result.delay_s, result.change[:, axis] * factor, color=colour, lw=1.4)
        for begin, end in series.touched_s:
            course.axvspan(begin / unit_s, end / unit_s, color="black", alpha=0.12, lw=0)
        course.axhline(0.0, color="black", lw=0.6)
        course.set_xlabel("time, h" if hours else "time, min")
        course.set_ylabel(f"change of {group}, {unit}")
        course.legend(loc="upper left", ncol=3, frameon=False)
        allan.set_xlabel("averaging time, s (dotted: fitted)")
        allan.set_ylabel(f"Allan deviation, {unit}")
        limit = result.limits.axes[axes.start] * factor
        hold.axhline(limit, color="grey", lw=0.8, ls="--")
        hold.set_xlabel("time since tare, s (dashed: the limit)")
        hold.set_ylabel(f"rms change, {unit}")
    title = "\n".join(fill(sentence, _TITLE_WIDTH) for sentence in result.sentence.values())
    figure.suptitle(title, fontsize=9)
    figure.tight_layout()
    return save_figure(figure, directory / f"{name}_drift.png")
