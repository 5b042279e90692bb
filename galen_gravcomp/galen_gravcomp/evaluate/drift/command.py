"""`drift`: how a sensor that nobody touches drifts, and whether that can be predicted."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from galen_bags.arrays.arm_recording import ArmTopics
from galen_bags.formats.find import find_bags
from galen_model.arm.galen import JOINT_NAMES
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    check_folder,
    positive,
    run_command,
)
from rich.console import Console
from tqdm import tqdm

from galen_gravcomp.evaluate.drift.report import print_drift
from galen_gravcomp.evaluate.drift.result import judge_drift, to_json
from galen_gravcomp.evaluate.drift.series import CELL_S, TEXT_SUFFIXES, read_series
from galen_gravcomp.evaluate.residual_decomposition import Limits

_CELL_LIMITS_S = 1e-3, 3600.0
_EPILOG = f"""exit codes:
  {EXIT_OK}    done, whatever the answer
  {EXIT_FAILED}    a recording or the tool's file can't be used; a line says why
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="drift",
        description="A long recording in which nobody touches the tool, and normally nothing"
        " moves: its course, Allan deviation, how long a tare holds, and whether the drift can be"
        " predicted, on hours that no fit has seen.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="RECORDING",
        help="bags, in the order in which they were recorded, or tables (.csv, .txt) with the"
        " columns t (s), fx fy fz tx ty tz (N, N.m), which are read whole",
    )
    parser.add_argument(
        "--tool",
        metavar="FILE",
        type=Path,
        help="a tool's file, to take the weight off where the arm stands in several poses",
    )
    parser.add_argument(
        "--columns", metavar="NAMES", help="names of a table's columns, '-' for one to skip"
    )
    parser.add_argument(
        "--rate-hz", type=positive, metavar="HZ", help="rate of a table without the column t"
    )
    parser.add_argument(
        "--cell-s",
        type=positive,
        default=CELL_S,
        metavar="SECONDS",
        help="readings are averaged over so much first; less for a short recording (default:"
        " %(default)s)",
    )
    topics = ArmTopics()
    parser.add_argument("--wrench-raw", default=topics.wrench_raw, metavar="TOPIC")
    parser.add_argument("--joint-states", default=topics.joint_states, metavar="TOPIC")
    parser.add_argument(
        "--joint-names",
        default=",".join(JOINT_NAMES),
        metavar="NAMES",
        help="names of the five joints; only the last two must be there (default: %(default)s)",
    )
    parser.add_argument(
        "--limit-force-n",
        type=positive,
        default=Limits.force_n,
        metavar="N",
        help="how far a tare may be off (1 sigma; default: %(default)s)",
    )
    parser.add_argument(
        "--limit-torque-nm",
        type=positive,
        default=Limits.torque_nm,
        metavar="NM",
        help="the same for torques, N.m (default: %(default)s)",
    )
    parser.add_argument("--plots", metavar="DIR", type=Path, help="write a picture here")
    parser.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    return parser


def run(arguments: argparse.Namespace, console: Console) -> None:
    """Judge the recordings; raises GalenError."""
    check_folder(arguments.plots)
    tool = None if arguments.tool is None else read_calibration(arguments.tool)
    paths: list[Path] = []
    for given in arguments.recordings:
        paths += [given] if given.suffix in TEXT_SUFFIXES else find_bags([given])
    topics = ArmTopics(
        arguments.joint_states, arguments.wrench_raw, tuple(arguments.joint_names.split(","))
    )
    columns = arguments.columns.split(",") if arguments.columns else None
    quiet = arguments.json or not sys.stderr.isatty()
    with tqdm(unit="msg", unit_scale=True, disable=quiet) as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        series = read_series(
            paths, topics, tool, columns, arguments.rate_hz, arguments.cell_s, show
        )
    result = judge_drift(series, Limits(arguments.limit_force_n, arguments.limit_torque_nm))
    written = None
    if arguments.plots is not None:
        from galen_gravcomp.evaluate.drift.plots import (
            plot_drift,  # slow to import, so only when asked
        )

        try:
            written = plot_drift(result, arguments.plots, paths[0].resolve().stem)
        except OSError as error:
            raise GalenError(f"{arguments.plots}: can't be written: {error.strerror}") from error
    if arguments.json:
        print(json.dumps(to_json(result), indent=2))
        return
    print_drift(result, console)
    if written is not None:
        console.print(f"plot: {written}", soft_wrap=True)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    low, high = _CELL_LIMITS_S
    if not low <= arguments.cell_s <= high:
        parser.error(f"--cell-s is {arguments.cell_s:g}, but must be {low:g} to {high:g}")
    if len(arguments.joint_names.split(",")) != len(JOINT_NAMES):
        parser.error(f"--joint-names needs {len(JOINT_NAMES)} names, separated by commas")

    def work() -> int:
        run(arguments, Console(width=None if sys.stdout.isatty() else 120))
        return EXIT_OK

    return run_command("drift", work)


if __name__ == "__main__":
    sys.exit(main())
