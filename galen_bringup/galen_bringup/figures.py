"""The demonstration's figures."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # the machine in the lab may have no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES

from galen_bringup.drift import Drift
from galen_bringup.verification import PoseReadings

_BEFORE, _AFTER = "#c44e52", "#1f6f8b"
_UNITS = ("N", "N", "N", "mN·m", "mN·m", "mN·m")
_SCALE = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])


def plot_compensation(tool: str, readings: PoseReadings, path: Path) -> None:
    """The report's figures 8 and 9: each axis over the visited poses, before and after.

    The left axes hold both; the right ones hold what is left alone, against the noise.
    """
    figure, axes = plt.subplots(6, 2, figsize=(11, 12), sharex=True, width_ratios=(1.4, 1))
    for index, (left, right) in enumerate(axes):
        scale, unit = _SCALE[index], _UNITS[index]
        left.plot(readings.raw[:, index] * scale, ".-", color=_BEFORE, ms=3, lw=0.6)
        left.plot(readings.compensated[:, index] * scale, ".-", color=_AFTER, ms=3, lw=0.6)
        left.set_ylabel(f"{WRENCH_AXES[index]} ({unit})")
        noise = readings.noise[index] * scale * 1e3
        right.axhspan(-2 * noise, 2 * noise, color="0.88", lw=0)
        right.plot(readings.compensated[:, index] * scale * 1e3, ".", color=_AFTER, ms=3)
        right.set_ylabel("mN" if index < 3 else "µN·m")
        for axis in (left, right):
            axis.axhline(0.0, color="black", lw=0.5)
    axes[0, 0].set_title("uncompensated (red), compensated (blue)", fontsize=9)
    axes[0, 1].set_title("compensated; grey: ± 2 σ of the average", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("pose, not seen by the calibration")
    figure.suptitle(f"{tool}: averaged readings at {len(readings.raw)} poses")
    _save(figure, path)


def plot_residual_map(tool: str, readings: PoseReadings, path: Path) -> None:
    """Plot the residual over roll and tilt, in units of the averaged reading's noise."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 7), sharex=True, sharey=True)
    roll, tilt = np.degrees(readings.joints[:, 3:]).T
    shown = None
    for index, axis in enumerate(axes.flat):
        values = readings.compensated[:, index] / readings.noise[index]
        shown = axis.scatter(roll, tilt, c=values, cmap="coolwarm", vmin=-4, vmax=4, s=22)
        ratio = readings.rmse[index] / readings.noise[index]
        axis.set_title(f"{WRENCH_AXES[index]}: RMS {ratio:.2f} σ", fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("roll (°)")
    for axis in axes[:, 0]:
        axis.set_ylabel("tilt (°)")
    figure.suptitle(f"{tool}: compensated reading over the poses, in σ of the averaged reading")
    figure.tight_layout(rect=(0.0, 0.0, 0.92, 1.0))
    figure.colorbar(shown, cax=figure.add_axes((0.935, 0.12, 0.015, 0.74)), label="σ")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plot_drift(tool: str, off: Drift, on: Drift, path: Path) -> None:
    """Plot the tip's drift in admittance mode without contact."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4))
    for axis, log in zip(axes, (False, True), strict=True):
        axis.plot(off.time, off.distance * 1e3, color=_BEFORE, label="compensation off")
        axis.plot(on.time, on.distance * 1e3, color=_AFTER, label="compensation on")
        axis.set_xlabel("time (s)")
        axis.set_ylabel("distance of the tip (mm)")
        if log:
            axis.set_yscale("log")
            axis.set_ylim(bottom=1e-3)
            axis.set_title("the same, logarithmic", fontsize=10)
        else:
            axis.set_title("drift of the tool while the arm turns", fontsize=10)
            axis.legend(loc="upper left")
    figure.suptitle(f"{tool}: admittance mode, no contact with the tool")
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
