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
from pathlib import Path
from typing import Any

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

from galen_bringup.drift import measure_drift
from galen_bringup.processes import (
    AVERAGE_S,
    Processes,
    calibrate,
    connected_arm,
    ros_world,
    start_suite,
)
from galen_bringup.report import (
    DemoResult,
    ToolResult,
    plot_compensation,
    plot_drift,
    plot_residual_map,
    print_report,
    to_json,
)
from galen_bringup.verification import PoseReadings, random_poses, visit


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
                roll, tilt = readings.joints[:, 3:].T
                truth = nominal_reading(roll, tilt, TOOLS[tool].load, ADAPTER)
                found[tool] = ToolResult(
                    calibration, readings, readings.noise_at(truth), _sample_rmse(readings)
                )
                if tool == list(TOOLS)[-1]:
                    drift = measure_drift(arm, TOOLS[tool].tip_m, progress)
    assert drift is not None
    figures = []
    for tool, result in found.items():
        for kind, plot in (
            ("compensation", plot_compensation),
            ("residual_map", plot_residual_map),
        ):
            path = figures_dir / f"{tool}_{kind}.png"
            plot(tool, result.readings, path)
            figures.append(str(path))
    path = figures_dir / "drift.png"
    plot_drift(list(TOOLS)[-1], *drift, path)
    figures.append(str(path))
    wall_s = time.monotonic() - started
    return DemoResult(found, list(TOOLS)[-1], drift[0], drift[1], wall_s, figures)


def _sweep_arguments(sweep: Sequence[int] | None) -> list[str]:
    """The client's options for so many tilts and rolls; its node knows how many without."""
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
    """The command's options."""
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
