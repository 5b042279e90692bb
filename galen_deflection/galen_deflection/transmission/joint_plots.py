"""Pictures of a joint's lag: loops over the torque, and its course, measured and predicted."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array

from galen_deflection.transmission.comparison import OURS, Comparison
from galen_deflection.transmission.joint_report import MRAD

_MEASURED = "#8c8c8c"
_RARE = 0.005
_COLOURS = ("#c44e52", "#1f6f8b", "#55a868")


def plot_joint(comparison: Comparison, label: str, folder: Path) -> Path:
    """A run a row: lag over torque, over the motor's angle, and over time; returns the file.

    Predictions are of models that haven't seen what they predict: ours, the linear one, and the
    better of the networks, if there are any.
    """
    runs, scale = comparison.runs, MRAD
    names = ["linear", OURS]
    if comparison.against is not None:
        names.append(comparison.against[0])
    figure, panels = plt.subplots(
        len(runs), 3, figsize=(14, 1.2 + 2.9 * len(runs)), squeeze=False,
        gridspec_kw={"width_ratios": (1.0, 1.0, 1.8)},
    )  # fmt: skip
    for k, (run, row) in enumerate(zip(runs, panels, strict=True)):
        time_s = run.time_s - run.time_s[0]
        for panel, across in zip(row, (run.torque, run.motor, time_s), strict=True):
            panel.plot(across, scale * run.lag, color=_MEASURED, lw=2.2, label="measured")
            for name, colour in zip(names, _COLOURS, strict=False):
                lag = comparison.predictions[name][k]
                panel.plot(across, scale * lag, color=colour, lw=0.9, label=name)
            panel.grid(alpha=0.25)
            panel.set_ylim(*_limits(scale * run.lag))
        # a start's jerk would leave no room for the loops
        row[0].set_xlim(*_limits(np.quantile(run.torque, [_RARE, 1.0 - _RARE])))
        row[0].locator_params(axis="x", nbins=5)
        row[0].set_ylabel(f"{run.name}\nlag, mrad")
        row[2].margins(x=0.0)
    for panel, text in zip(
        panels[-1], ("torque, N.m", "motor's angle, rad", "time, s"), strict=True
    ):
        panel.set_xlabel(text)
    handles, labels = panels[0, 2].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncol=5, frameon=False, fontsize=10)
    figure.suptitle(f"{label}: lag of the link behind the motor; each prediction is by a model that"
                    " has not seen it", x=0.01, ha="left", fontsize=11)  # fmt: skip
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.25 / figure.get_figheight()))
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', label)}_lag.png"
    figure.savefig(file, dpi=100)
    plt.close(figure)
    return file


def _limits(values: Array) -> tuple[float, float]:
    """What is measured fills the panel; a prediction may leave it."""
    low, high = float(values.min()), float(values.max())
    margin = 0.2 * (high - low)
    return low - margin, high + margin
