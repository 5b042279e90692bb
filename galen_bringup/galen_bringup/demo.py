"""`demo`: the whole way on the simulated arm, through the nodes that a lab would use.

Starts driver, calibration and compensation as processes of their own, calibrates both tools through
the action, visits poses that the calibration has not seen, and prints what is left of the tools'
weight beside the 2019 report's tables and the noise; then turns the arm in admittance mode
without contact, with the compensation off and on.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.model import nominal_reading
from galen_model.load.nominal_tools import ADAPTER, TOOLS
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_SIGNAL,
    add_json,
    make_parser,
    whole,
)
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from galen_bringup.measurements import Drift, PoseReadings, measure_drift, random_poses, visit
from galen_bringup.processes import (
    AVERAGE_S,
    Processes,
    calibrate,
    connected_arm,
    ros_world,
    start_suite,
)

matplotlib.use("Agg")  # the machine in the lab may have no display
import matplotlib.pyplot as plt
from galen_model.arm.galen import GALEN, WRENCH_AXES
from rich.table import Table

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
    """Print the report's tables beside ours, and the drift."""
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
    """Return the result for a program; SI units."""
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
    """Plot the report's figures 8 and 9: each axis over the visited poses, before and after.

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


def run_demo(options: argparse.Namespace, console: Console) -> DemoResult:
    """Do it all; raises GalenError."""
    started = time.monotonic()
    output = Path(options.output).resolve()
    tools_dir, figures_dir = output / "tools", output / "figures"
    figures_dir.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    with ros_world(), Processes(output / "logs") as processes:
        start_suite(processes, tools_dir, float(options.speed), options.seed)
        console.print(
            "driver, compensation and calibration run as processes of their own", style="dim"
        )
        found: dict[str, ToolResult] = {}
        drift = None
        for tool in TOOLS:
            print(f"calibrating the {tool} through the action:", file=sys.stderr)
            calibration = calibrate(processes, tool, _sweep_arguments(options.sweep))
            with connected_arm(processes) as arm, _progress(console) as progress:
                arm.set_tool(tool)
                readings = visit(
                    arm,
                    random_poses(options.poses, rng),
                    AVERAGE_S,
                    progress,
                    f"{tool}: poses not seen before",
                )
                angles = GALEN.angles(readings.joints)
                truth = nominal_reading(angles, TOOLS[tool].load, ADAPTER)
                found[tool] = ToolResult(
                    calibration, readings, readings.noise_at(truth), _sample_rmse(readings)
                )
                if tool == list(TOOLS)[-1]:
                    drift = measure_drift(arm, TOOLS[tool].tip_m, progress)
    assert drift is not None
    figures = []
    for tool, result in found.items():
        path = figures_dir / f"{tool}_compensation.png"
        plot_compensation(tool, result.readings, path)
        figures.append(str(path))
    path = figures_dir / "drift.png"
    plot_drift(list(TOOLS)[-1], *drift, path)
    figures.append(str(path))
    wall_s = time.monotonic() - started
    return DemoResult(found, list(TOOLS)[-1], drift[0], drift[1], wall_s, figures)


def _sweep_arguments(sweep: Sequence[int] | None) -> list[str]:
    return [] if sweep is None else ["--iters-t", str(sweep[0]), "--iters-r", str(sweep[1])]


def _sample_rmse(readings: PoseReadings) -> Array:
    """RMSE (6,) of single compensated samples: mean square of averages and of scatter together."""
    return np.asarray(np.sqrt(readings.rmse**2 + np.mean(readings.sample_std**2, axis=0)))


def _progress(console: Console) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=console)


def build_parser() -> argparse.ArgumentParser:
    """Build the command's options."""
    parser = make_parser("demo", __doc__ or "", codes={EXIT_SIGNAL + 15: "ended by SIGTERM"})
    parser.add_argument(
        "--output", default="output/demo", metavar="DIR", help="tools, figures and logs go here"
    )
    parser.add_argument(
        "--poses", type=whole(10), default=200, help="poses to visit with each tool (default 200)"
    )
    parser.add_argument(
        "--sweep",
        type=whole(3),
        nargs=2,
        metavar=("TILTS", "ROLLS"),
        help="poses of a sweep; fewer are quicker and tell less (default 7 8)",
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=5.0,
        help="simulated over wall time; a machine that can't keep up runs slower, with the same "
        "result (default 5)",
    )
    parser.add_argument(
        "--seed", type=whole(0), default=2019, help="of noise and poses (default 2019)"
    )
    add_json(parser)
    return parser


def _on_terminate(number: int, _: Any) -> None:
    """End as an interrupt does: the nodes are processes of their own and would go on."""
    raise SystemExit(EXIT_SIGNAL + number)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = build_parser().parse_args(args)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _on_terminate)
    console = Console(
        stderr=options.json, width=None if sys.stdout.isatty() else 110, highlight=False
    )
    interrupted = []

    def on_interrupt(number: int, _frame: object) -> None:
        interrupted.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        result = run_demo(options, console)
    except (Exception, KeyboardInterrupt) as error:
        if interrupted:  # inside a library's C++ it may come out as another exception
            print("demo: interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        if not isinstance(error, GalenError | OSError):
            raise
        # OSError: what it writes to is full or not writable
        print(f"demo: {error}", file=sys.stderr)
        return EXIT_FAILED
    if options.json:
        print(json.dumps(to_json(result), indent=2))
    else:
        print_report(result, console)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
