"""The demonstration's results: tables beside the 2019 report's, JSON, and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # the machine in the lab may have no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.load.nominal_tools import TOOLS
from rich.console import Console
from rich.table import Table

from galen_bringup.drift import Drift
from galen_bringup.verification import PoseReadings

_BEFORE, _AFTER = "#c44e52", "#1f6f8b"
_UNITS = ("N", "N", "N", "mN·m", "mN·m", "mN·m")
_SCALE = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])

REPORT_RMSE = {
    "pointer": np.array([0.0214, 0.0174, 0.0306, 0.2835e-3, 0.6009e-3, 0.3330e-3]),
    "retractor": np.array([0.0245, 0.0134, 0.0388, 0.6621e-3, 0.7079e-3, 0.3997e-3]),
}
"""Tables 1 and 2 of the 2019 report, on the real arm: RMSE (6,), N and N.m."""


@dataclass(frozen=True)
class ToolResult:
    """One tool: what the calibration answered, and what is left at unseen poses."""

    calibration: dict[str, Any]
    readings: PoseReadings
    noise: Array
    """Noise (6,) that the averaged readings had, known because the arm is simulated."""
    sample_rmse: Array

    @property
    def over_noise(self) -> Array:
        """Ratio (6,): 1 if the compensation added nothing to the noise."""
        return self.readings.rmse / self.noise


@dataclass(frozen=True)
class DemoResult:
    """All that the demonstration measured."""

    tools: dict[str, ToolResult]
    drift_tool: str
    drift_off: Drift
    drift_on: Drift
    wall_s: float
    figures: list[str]


def print_report(result: DemoResult, console: Console) -> None:
    """The report's tables beside ours, and the drift."""
    for number, (tool, found) in enumerate(result.tools.items(), start=1):
        readings = found.readings
        table = Table(
            title=f"{tool}: root mean square of the compensated reading at {len(readings.raw)} "
            "poses that the calibration has not seen",
            title_justify="left",
        )
        table.add_column("axis")
        table.add_column("unit")
        for name in (
            f"report's table {number}\n(real arm)",
            "averaged\nreading",
            "noise\nin it",
            "over\nnoise",
            "one\nsample",
            "without com-\npensation",
        ):
            table.add_column(name, justify="right")
        raw = np.sqrt(np.mean(readings.raw**2, axis=0))
        for index, axis in enumerate(WRENCH_AXES):
            scale, unit = (1.0, "N") if index < 3 else (1e3, "mN·m")
            table.add_row(
                axis,
                unit,
                f"{REPORT_RMSE[tool][index] * scale:.4f}",
                f"{readings.rmse[index] * scale:.5f}",
                f"{found.noise[index] * scale:.5f}",
                f"{found.over_noise[index]:.3f}",
                f"{found.sample_rmse[index] * scale:.4f}",
                f"{raw[index] * scale:.4f}",
            )
        console.print(table)
        calibration = found.calibration
        truth = TOOLS[tool]
        console.print(
            f"  mass {calibration['mass_kg'] * 1e3:.3f} g (standard deviation "
            f"{calibration['mass_std_kg'] * 1e3:.3f} g; simulated: "
            f"{truth.load.mass_kg * 1e3:.1f} g), centre {_millimetres(calibration['com_m'])} mm "
            f"(simulated: {_millimetres(truth.load.com_m)} mm)"
        )
        for skipped in readings.skipped:
            console.print(f"  [yellow]skipped {skipped}[/yellow]")
    off, on = result.drift_off, result.drift_on
    table = Table(
        title=f"Drift of the {result.drift_tool} in admittance mode, without contact",
        title_justify="left",
    )
    for name in ("", "at the end (mm)", "largest (mm)", "largest (°)"):
        table.add_column(name, justify="right" if name else "left")
    for name, drift in (("compensation off", off), ("compensation on", on)):
        table.add_row(
            name,
            f"{drift.end_m * 1e3:.3f}",
            f"{drift.largest_m * 1e3:.3f}",
            f"{np.degrees(drift.angle.max()):.4f}",
        )
    console.print(table)
    console.print(f"  largest on over largest off: {100 * on.largest_m / off.largest_m:.3f} %")
    console.print("figures:")
    for figure in result.figures:
        console.print(f"  {figure}", soft_wrap=True)
    console.print(f"took {result.wall_s:.0f} s")


def _millimetres(vector: Sequence[float] | Array) -> str:
    return "(" + ", ".join(f"{1e3 * value:.2f}" for value in vector) + ")"


def to_json(result: DemoResult) -> dict[str, Any]:
    """The result for a program; SI units."""
    return {
        "tools": {
            tool: {
                "calibration": found.calibration,
                "poses": len(found.readings.raw),
                "skipped": list(found.readings.skipped),
                "report_rmse": REPORT_RMSE[tool].tolist(),
                "rmse": found.readings.rmse.tolist(),
                "noise": found.noise.tolist(),
                "noise_from_scatter": found.readings.noise.tolist(),
                "over_noise": found.over_noise.tolist(),
                "sample_rmse": found.sample_rmse.tolist(),
                "raw_rmse": np.sqrt(np.mean(found.readings.raw**2, axis=0)).tolist(),
            }
            for tool, found in result.tools.items()
        },
        "drift": {
            name: {
                "end_m": drift.end_m,
                "largest_m": drift.largest_m,
                "largest_rad": float(drift.angle.max()),
            }
            for name, drift in (("off", result.drift_off), ("on", result.drift_on))
        },
        "wall_s": result.wall_s,
        "figures": result.figures,
    }


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
