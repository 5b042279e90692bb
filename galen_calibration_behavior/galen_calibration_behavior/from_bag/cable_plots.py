"""The picture of a cable's pull: over roll and tilt, and how held-out poses were predicted."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.axes import Axes

from galen_calibration_behavior.from_bag.cable import CableResult

_STEPS = 80
_MARGIN_RAD = 0.4
_COLOURS = ("#1f6f8b", "#c44e52", "#55a868")


def plot_cable(result: CableResult, directory: Path, name: str) -> Path:
    """Write `<name>_cable.png` into `directory`; returns its path. Raises OSError."""
    figure, axes = plt.subplots(2, 4, figsize=(16, 7.5), layout="constrained")
    joints = result.sweep.joints
    roll, tilt = (_span(joints[:, column]) for column in (3, 4))
    grid = np.tile(np.median(joints, axis=0), (_STEPS * _STEPS, 1))
    grid[:, 3], grid[:, 4] = np.repeat(roll, _STEPS), np.tile(tilt, _STEPS)
    posterior = result.learned.drag.posterior
    means, weights = posterior.means(grid), posterior.weights(grid).reshape(_STEPS, _STEPS)
    for kind, (factor, unit) in enumerate(((1.0, "N"), (1e3, "mN.m"))):
        which = slice(3 * kind, 3 * kind + 3)
        largest = factor * float(np.abs(result.sweep.wrench[:, which]).max())
        for axis in range(3):
            column = 3 * kind + axis
            shown = axes[kind, axis]
            image = shown.pcolormesh(
                tilt,
                roll,
                factor * (means[:, column].reshape(_STEPS, _STEPS) * weights),
                cmap="RdBu_r",
                vmin=-largest,
                vmax=largest,
            )
            shown.contour(
                tilt, roll, weights, levels=[0.01, 0.99], colors="black", linestyles=[":", "-"]
            )
            shown.plot(joints[:, 4], joints[:, 3], ".", color="black", markersize=3)
            shown.set_title(f"{WRENCH_AXES[column]}, {unit}")
            shown.set_xlabel("tilt, rad")
            shown.set_ylabel("roll, rad")
            figure.colorbar(image, ax=shown)
        _held_out(axes[kind, 3], result, which, factor, unit)
    figure.suptitle(
        f"{name}: pull of the cable as '{result.learned.drag.form}'; dots: the sweep's poses;"
        " subtracted whole within the line, not at all beyond the dotted one"
    )
    return save_figure(figure, directory / f"{name}_cable.png")


def _span(values: Array) -> Array:
    return np.linspace(values.min() - _MARGIN_RAD, values.max() + _MARGIN_RAD, _STEPS)


def _held_out(axes: Axes, result: CableResult, which: slice, factor: float, unit: str) -> None:
    measured = factor * result.sweep.wrench[:, which]
    error = factor * result.learned.held_out.error[:, which]
    for axis in range(3):
        axes.plot(
            measured[:, axis],
            measured[:, axis] + error[:, axis],
            ".",
            color=_COLOURS[axis],
            label=WRENCH_AXES[which][axis],
        )
    ends = [measured.min(), measured.max()]
    axes.plot(ends, ends, color="black", lw=0.6)
    axes.set_title("poses held out")
    axes.set_xlabel(f"measured, {unit}")
    axes.set_ylabel(f"predicted, {unit}")
    axes.legend()
