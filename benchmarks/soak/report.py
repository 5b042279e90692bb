"""Tables and a picture of a soak."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from galen_model.files.atomic_file import save_figure
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from benchmarks.soak.__main__ import Soaked

_WARM_UP_SHARE = 0.1


def slope_per_hour(time_s: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Slope after the warm-up and its standard error, a hour; of least squares.

    The error takes neighbouring windows as independent; memory that steps isn't, so that it is too
    small for a process that grew once.
    """
    first = int(len(time_s) * _WARM_UP_SHARE)
    hours, y = np.array(time_s[first:]) / 3600.0, np.array(values[first:])
    if len(y) < 3:
        return float("nan"), float("nan")
    design = np.column_stack([hours - hours.mean(), np.ones_like(hours)])
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    rest = y - design @ solution
    spread = np.sqrt(rest @ rest / (len(y) - 2) / np.sum(design[:, 0] ** 2))
    return float(solution[0]), float(spread)


def print_report(one: Soaked, console: Console) -> None:
    """What a person wants to know."""
    real = one.kind == "real"
    title = f"{one.seconds / 60:.1f} min of wall time"
    if not real:
        title += f", {one.simulated_s / 3600:.2f} h of simulated time"
    console.rule(f"[bold]{one.kind}: {title}", align="left")
    streams = Table("stream", "in", "out", "lost", "doubled", "unknown", "out of order", box=None)
    for name, a in one.accounts.items():
        numbers = (a.went_in, a.came_out, a.lost, a.doubled, a.unknown, a.disordered)
        streams.add_row(name, *(str(number) for number in numbers))
    console.print(streams)
    memory = Table("process", "CPU %", "MB first", "MB last", "MB/h after warm-up", box=None)
    for name, values in one.memory_mb.items():
        slope, error = slope_per_hour(one.time_s, values)
        memory.add_row(
            name, f"{one.cpu_percent[name]:.0f}", f"{values[0]:.1f}", f"{values[-1]:.1f}",
            f"{slope:+.2f} +- {error:.2f}",
        )  # fmt: skip
    console.print(memory)
    if real:
        slope, error = slope_per_hour(one.time_s, one.delay_p50_ms)
        console.print(
            f"stamp to compensation, windows of 5 s: median {np.median(one.delay_p50_ms):.2f} ms, "
            f"99 % {np.median(one.delay_p99_ms):.1f} ms, largest {max(one.delay_max_ms):.1f} ms; "
            f"the median drifts by {slope:+.2f} +- {error:.2f} ms/h"
        )
    console.print(
        f"stamps over wall time: {one.pace[-1]:.6f}"
        + (f", off by {1e6 * (one.pace[-1] - 1):+.0f} ppm" if real else "")
    )
    for state, (count, text) in one.states.items():
        console.print(f"/diagnostics, {state}, {count} times, the last: {text}")


def save_plot(one: Soaked, path: Path) -> None:
    """Memory of each process and the delay over time."""
    from matplotlib.figure import Figure

    rows = 2 if one.delay_p99_ms else 1
    figure = Figure(figsize=(8, 2.6 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    minutes = np.array(one.time_s) / 60.0
    for name, values in one.memory_mb.items():
        axes[0].plot(minutes, values, label=name)
    axes[0].set_ylabel("resident set [MB]")
    axes[0].set_ylim(0, 1.25 * max(map(max, one.memory_mb.values())))
    axes[0].legend(loc="lower right", ncols=4)
    if one.delay_p99_ms:
        for name, values in (
            ("largest", one.delay_max_ms),
            ("99 %", one.delay_p99_ms),
            ("median", one.delay_p50_ms),
        ):
            axes[1].semilogy(minutes, values, label=name)
        axes[1].set_ylabel("stamp to compensation [ms]")
        axes[1].legend(loc="upper right", ncols=3)
    axes[-1].set_xlabel("wall time [min]")
    for axis in axes:
        axis.grid(alpha=0.3)
    save_figure(figure, path)
