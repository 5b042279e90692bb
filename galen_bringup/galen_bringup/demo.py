# SPDX-License-Identifier: Apache-2.0
"""`demo`: the whole way on the simulated arm, through the nodes that a lab would use.

Starts driver, calibration and compensation as processes of their own, calibrates both tools through
the action, visits poses that the calibration has not seen, and prints what is left of the tools'
weight beside the 2019 report's tables and the noise; then turns the arm in admittance mode
without contact, with the compensation off and on.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from galen_common.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_SIGNAL,
    add_json,
    make_parser,
    whole,
)
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.errors import GalenError
from galen_model.files.atomic_file import save_figure
from galen_model.load.model import ADAPTER, TOOLS, nominal_reading
from matplotlib.figure import Figure
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from galen_bringup.measurements import Drift, PoseReadings, measure_drift, random_poses, visit
from galen_bringup.processes import (
    AVERAGE_S,
    Processes,
    calibrate,
    connected_arm,
    ros_world,
    start_suite,
)

_BEFORE, _AFTER = "#c44e52", "#1f6f8b"
_UNITS = ("N", "N", "N", "mN·m", "mN·m", "mN·m")
_SCALE = (1.0, 1.0, 1.0, 1e3, 1e3, 1e3)

REPORT_RMSE = {
    "pointer": [0.0214, 0.0174, 0.0306, 0.2835e-3, 0.6009e-3, 0.3330e-3],
    "retractor": [0.0245, 0.0134, 0.0388, 0.6621e-3, 0.7079e-3, 0.3997e-3],
}
"""Tables 1 and 2 of the 2019 report, on the real arm: RMSE (6,), N and N.m."""

_END_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
PANEL = "http://127.0.0.1:8080/"
NEXT = (
    "ros2 run galen_gravcomp evaluate bags/free_motion --tool bags/tools/retractor.json",
    "python -m galen_diagnosis.simulated_recording tilt --output tilt && "
    "ros2 run galen_diagnosis diagnose tilt --output found",
    "ros2 run galen_bringup preflight --sensor-frame tool0   # with your arm's driver running",
)


def run_demo(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Do all of the demonstration.

    Args:
        options: those of `build_parser`.
        console: shows how it goes.

    Returns:
        The result as JSON has it, SI units: `tools` and `drift` by name, `wall_s`, and the paths of
        `figures`.

    Raises:
        GalenError: a process ended, the calibration failed, or the arm did not get somewhere.

    """
    started = time.monotonic()
    output = Path(options.output).resolve()
    figures = output / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    sweep = ["--iters-t", str(options.sweep[0]), "--iters-r", str(options.sweep[1])]
    tools: dict[str, Any] = {}
    with ros_world(), Processes(output / "logs") as processes:
        start_suite(processes, output / "tools", float(options.speed), options.seed)
        console.print(
            "driver, compensation and calibration run as processes of their own", style="dim"
        )
        if options.panel:
            show = ["--show"] if os.environ.get("DISPLAY") else []
            folders = ["--tools-dir", str(output / "tools"), "--output-dir", str(output / "panel")]
            processes.start("galen_panel", "panel", [*folders, *show])
            console.print(f"panel, until the demonstration ends: {PANEL}")
        for tool in TOOLS:
            print(f"calibrating the {tool} through the action:", file=sys.stderr)
            calibration = calibrate(processes, tool, sweep)
            with connected_arm(processes) as arm, _live(console, started) as (progress, on_pose):
                arm.set_tool(tool)
                poses = random_poses(options.poses, rng)
                label = f"{tool}: poses not seen before"
                readings = visit(arm, poses, AVERAGE_S, progress, label, on_pose)
                tools[tool] = _tool_result(tool, calibration, readings)
                plot_compensation(tool, readings, figures / f"{tool}_compensation.png")
                if tool == list(TOOLS)[-1]:
                    off, on = measure_drift(arm, TOOLS[tool].tip_m, progress)
    plot_drift(tool, off, on, figures / "drift.png")
    return {
        "tools": tools,
        "drift": {
            name: {
                "end_m": float(drift.distance[-1]),
                "largest_m": float(drift.distance.max()),
                "largest_rad": float(drift.angle.max()),
            }
            for name, drift in (("off", off), ("on", on))
        },
        "wall_s": time.monotonic() - started,
        "figures": [
            str(figures / f"{name}.png")
            for name in (*(f"{t}_compensation" for t in TOOLS), "drift")
        ],
    }


def _tool_result(tool: str, calibration: dict[str, Any], readings: PoseReadings) -> dict[str, Any]:
    # The noise that the averages had is known, because the arm is simulated.
    truth = nominal_reading(GALEN.angles(readings.joints), TOOLS[tool].load, ADAPTER, arm=GALEN)
    noise = readings.noise_at(truth)
    # Of one sample: mean square of averages and of scatter together.
    sample_rmse = np.sqrt(readings.rmse**2 + np.mean(readings.sample_std**2, axis=0))
    return {
        "calibration": calibration,
        "poses": len(readings.raw),
        "skipped": list(readings.skipped),
        "report_rmse": REPORT_RMSE[tool],
        "rmse": readings.rmse.tolist(),
        "noise": noise.tolist(),
        "noise_from_scatter": readings.noise.tolist(),
        "over_noise": (readings.rmse / noise).tolist(),
        "sample_rmse": sample_rmse.tolist(),
        "raw_rmse": np.sqrt(np.mean(readings.raw**2, axis=0)).tolist(),
    }


@contextmanager
def _live(
    console: Console, started_s: float
) -> Iterator[tuple[Progress, Callable[[np.ndarray, np.ndarray], None]]]:
    """Show progress and the last pose's wrenches in place; off a terminal, plain lines."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    progress = Progress(*columns, TimeElapsedColumn(), console=console)
    squares: list[np.ndarray] = []

    with Live(progress, console=console, refresh_per_second=4) as live:

        def on_pose(raw: np.ndarray, compensated: np.ndarray) -> None:
            if not squares:
                seconds = time.monotonic() - started_s
                console.print(f"first compensated wrench {seconds:.0f} s after the start")
            squares.append(compensated**2)
            if not console.is_terminal:
                return
            table = Table("axis", "unit", "raw", "compensated", "root mean square")
            rmse = np.sqrt(np.mean(squares, axis=0))
            for axis, unit, scale, *values in zip(
                WRENCH_AXES, _UNITS, _SCALE, raw, compensated, rmse, strict=True
            ):
                table.add_row(axis, unit, *(f"{scale * value:8.4f}" for value in values))
            live.update(Group(progress, table))

        yield progress, on_pose
    if not console.is_terminal:
        console.print()  # Live ends without one there


def print_report(result: dict[str, Any], console: Console) -> None:
    """Print the report's tables beside ours, and the drift.

    Args:
        result: as `run_demo` returns it.
        console: where to.

    """
    for number, (tool, found) in enumerate(result["tools"].items(), start=1):
        table = Table(
            title=f"{tool}: root mean square of the compensated reading at {found['poses']} "
            "poses that the calibration has not seen",
            title_justify="left",
        )
        columns = {
            f"report's table {number}\n(real arm)": ("report_rmse", 4),
            "averaged\nreading": ("rmse", 5),
            "noise\nin it": ("noise", 5),
            "over\nnoise": ("over_noise", 3),
            "one\nsample": ("sample_rmse", 4),
            "without com-\npensation": ("raw_rmse", 4),
        }
        for name in ("axis", "unit"):
            table.add_column(name)
        for name in columns:
            table.add_column(name, justify="right")
        for index, axis in enumerate(WRENCH_AXES):
            cells = [
                f"{found[key][index] * (1.0 if key == 'over_noise' else _SCALE[index]):.{digits}f}"
                for key, digits in columns.values()
            ]
            table.add_row(axis, _UNITS[index], *cells)
        console.print(table)
        calibration, truth = found["calibration"], TOOLS[tool].load
        console.print(
            f"  mass {calibration['mass_kg'] * 1e3:.3f} g (standard deviation "
            f"{calibration['mass_std_kg'] * 1e3:.3f} g; simulated: "
            f"{truth.mass_kg * 1e3:.1f} g), centre {_millimetres(calibration['com_m'])} mm "
            f"(simulated: {_millimetres(truth.com_m)} mm)"
        )
        for skipped in found["skipped"]:
            console.print(f"  [yellow]skipped {skipped}[/yellow]")
    table = Table(
        title=f"Drift of the {tool} in admittance mode, without contact", title_justify="left"
    )
    for name in ("", "at the end (mm)", "largest (mm)", "largest (°)"):
        table.add_column(name, justify="right" if name else "left")
    for name, drift in result["drift"].items():
        millimetres = (f"{drift[key] * 1e3:.3f}" for key in ("end_m", "largest_m"))
        degrees = f"{np.degrees(drift['largest_rad']):.4f}"
        table.add_row(f"compensation {name}", *millimetres, degrees)
    console.print(table)
    ratio = result["drift"]["on"]["largest_m"] / result["drift"]["off"]["largest_m"]
    console.print(f"  largest on over largest off: {100 * ratio:.3f} %")
    console.print("figures:")
    for figure in result["figures"]:
        console.print(f"  {figure}", soft_wrap=True)
    console.print(f"took {result['wall_s']:.0f} s; next, after `source scripts/env.sh`:")
    for command in NEXT:
        console.print(f"  {command}", soft_wrap=True)


def _millimetres(vector: Sequence[float] | np.ndarray) -> str:
    return "(" + ", ".join(f"{1e3 * value:.2f}" for value in vector) + ")"


def plot_compensation(tool: str, readings: PoseReadings, path: Path) -> None:
    """Plot the report's figures 8 and 9: each axis over the visited poses, before and after.

    The left axes hold both; the right ones hold the residual alone, against the noise.

    Args:
        tool: its name, for the title.
        readings: of the poses visited with it.
        path: picture file to write.

    """
    figure = Figure(figsize=(11, 12), layout="constrained")
    axes = figure.subplots(6, 2, sharex=True, width_ratios=(1.4, 1))
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
    save_figure(figure, path)


def plot_drift(tool: str, off: Drift, on: Drift, path: Path) -> None:
    """Plot the tip's drift in admittance mode without contact, on a logarithmic scale.

    Args:
        tool: its name, for the title.
        off: drift on the raw reading.
        on: drift on the compensated wrench.
        path: picture file to write.

    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for drift, color, name in ((off, _BEFORE, "off"), (on, _AFTER, "on")):
        axis.semilogy(drift.time, drift.distance * 1e3, color=color, label=f"compensation {name}")
    axis.set_ylim(bottom=1e-3)
    axis.set_xlabel("time (s)")
    axis.set_ylabel("distance of the tip (mm)")
    axis.legend(loc="upper left")
    figure.suptitle(f"{tool}: admittance mode, no contact with the tool")
    save_figure(figure, path)


def build_parser() -> argparse.ArgumentParser:
    """Build the command's options."""
    codes = {EXIT_SIGNAL + one: f"ended by {one.name}" for one in _END_SIGNALS}
    parser = make_parser("demo", __doc__ or "", codes=codes)
    parser.add_argument(
        "--output", default="output/demo", metavar="DIR", help="tools, figures and logs go here"
    )
    parser.add_argument(
        "--poses", type=whole(10), default=40, help="poses to visit with each tool (default 40)"
    )
    parser.add_argument(
        "--sweep",
        type=whole(3),
        nargs=2,
        default=(4, 6),
        metavar=("TILTS", "ROLLS"),
        help="poses of a sweep; fewer are quicker and tell less (default 4 6)",
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
    parser.add_argument(
        "--panel", action="store_true", help=f"serve the operator's page meanwhile, at {PANEL}"
    )
    add_json(parser)
    return parser


def _on_terminate(number: int, _: Any) -> None:
    """End as an interrupt does: the nodes are processes of their own and would go on."""
    raise SystemExit(EXIT_SIGNAL + number)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: the command line without the command's name; None: that of the process.

    Returns:
        The exit code.

    """
    options = build_parser().parse_args(args)
    for number in _END_SIGNALS:
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
        print(json.dumps(result, indent=2))
    else:
        print_report(result, console)
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
