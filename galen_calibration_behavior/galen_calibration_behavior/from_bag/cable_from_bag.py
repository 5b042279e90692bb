"""`cable_from_bag`: what a cable at the tool pulls, out of a recorded sweep with it on. No ROS."""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Iterable, Sized
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from galen_bags.arrays.arm_recording import read_arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.errors import GalenError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.load.cable.learning import HeldOut
from galen_ros.command import check_folder
from galen_ros.parameters.param import from_options
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from galen_calibration_behavior.calibration.estimate import check_writable
from galen_calibration_behavior.from_bag.cable_estimation import CableResult, estimate_cable
from galen_calibration_behavior.from_bag.options import (
    EXIT_CANCELED,
    EXIT_FAILED,
    EXIT_OK,
    EXIT_USAGE,
    POSE_PARAMETERS,
    add_output_options,
    add_pose_options,
    add_topic_options,
    arm_topics,
    check_not_newer,
    parse_with_tool,
    reported,
    sample_time,
)
from galen_calibration_behavior.parameters import CalibrationParameters

_EPILOG = f"""exit codes:
  {EXIT_OK}    learned (or, with --remove, removed); the file is written, but for --dry-run
  {EXIT_FAILED}    failed, as when no pull rises above the noise or the sweep is too sparse; the
       reason is printed, nothing is written
  {EXIT_USAGE}    wrong arguments
  {EXIT_CANCELED}  interrupted (Ctrl-C); nothing is written"""

T = TypeVar("T")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="cable_from_bag",
        usage="%(prog)s TOOL BAG [options]\n       %(prog)s TOOL --remove [options]",
        description="Add the pull of a cable to the file of a tool that was calibrated without it,"
        " from a recorded sweep of still poses with the cable on. Nobody touches the tool.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tool", help="name of the tool, whose file there is")
    parser.add_argument("bag", nargs="?", help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    parser.add_argument("--remove", action="store_true", help="take the cable out of the file")
    add_output_options(parser)
    parser.add_argument("--plots", metavar="DIR", help="write a picture of the pull into DIR")
    where = parser.add_argument_group("where things are in the recording")
    add_topic_options(where)
    add_pose_options(parser)
    options = parse_with_tool(parser, arguments)
    if options.remove == (options.bag is not None):
        parser.error("either a BAG, or --remove")
    return options


def remove(options: argparse.Namespace) -> dict[str, Any]:
    """Take the cable out of the tool's file; raises GalenError where there is none."""
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path)
    if tool.cable is None:
        raise GalenError(f"{path}: holds no cable")
    if not options.dry_run:
        write_calibration(path, replace(tool, cable=None))
    done = not options.dry_run
    return {"tool": options.tool, "file": str(path) if done else "", "removed": done}


def run(options: argparse.Namespace) -> CableResult:
    """Learn as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    check_folder(None if options.plots is None else Path(options.plots))
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path)
    if not options.dry_run:
        check_writable(path)
    recording = read_arm(options.bag, arm_topics(options))
    recorded = sample_time(int(recording.joint_stamp_ns[-1]), int(recording.joint_log_ns[-1]))
    check_not_newer(options, path, recorded)
    try:
        result = estimate_cable(
            tool,
            recording,
            from_options(options, CalibrationParameters, POSE_PARAMETERS),
            whole_phases=options.whole_phases,
            phase_progress=functools.partial(_progress, "averaging", "phase"),
            fit_progress=functools.partial(_progress, "learning", "fit"),
        )
    except GalenError as error:
        prefix = "" if str(error).startswith(f"{options.bag}: ") else f"{options.bag}: "
        raise GalenError(f"{prefix}{error}") from error
    if options.plots is not None:
        from galen_calibration_behavior.from_bag.cable_plots import plot_cable  # slow to import

        try:
            plot_cable(result, Path(options.plots), options.tool)
        except OSError as error:
            raise GalenError(f"{options.plots}: can't be written: {error.strerror}") from error
    if not options.dry_run:
        write_calibration(path, result.tool)
    return result


def _progress(what: str, unit: str, work: list[T]) -> Iterable[T]:
    # Nothing where standard error is no terminal, and never left behind an error message.
    assert isinstance(work, Sized)
    return tqdm(work, desc=what, unit=unit, file=sys.stderr, disable=None, leave=False)


def _scores(result: CableResult) -> dict[str, HeldOut]:
    learned = result.learned
    return {
        "the tool's file": learned.file,
        "ten-parameter least squares": learned.least_squares,
        **learned.forms,
        **result.others,
    }


def result_fields(options: argparse.Namespace, result: CableResult) -> dict[str, Any]:
    """The result as plain numbers and texts, SI units."""
    learned, drag = result.learned, result.learned.drag
    return {
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration_path(options.tools_dir, options.tool)),
        "form": drag.form,
        "poses": len(result.sweep),
        "blocks": int(learned.block.max()) + 1,
        "pull_rms": dict(zip(WRENCH_AXES, _rms(result.sweep.wrench).tolist(), strict=True)),
        "attachment_m": None if drag.form == "free" else drag.attachment_m.tolist(),
        "length_rad": drag.length_rad.tolist(),
        "scatter": learned.scatter,
        "inflation": drag.inflation,
        "held_out": {
            name: {
                "rmse": dict(zip(WRENCH_AXES, score.rmse.tolist(), strict=True)),
                "times_noise": score.chi,
                "coverage95": None if np.isnan(score.coverage) else score.coverage,
            }
            for name, score in _scores(result).items()
        },
        "warnings": list(result.warnings),
    }


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def print_result(options: argparse.Namespace, result: CableResult, console: Console) -> None:
    """Tables for a person."""
    learned, drag = result.learned, result.learned.drag
    blocks = int(learned.block.max()) + 1
    table = Table(
        title=f"{options.tool}: left over at poses held out, {blocks} blocks of {len(result.sweep)}"
        " poses, mN and mN.m"
    )
    table.add_column("")
    for axis in WRENCH_AXES:
        table.add_column(axis, justify="right")
    table.add_column("within 95 %", justify="right")
    for name, score in _scores(result).items():
        mark = " *" if name == drag.form else ""
        share = "" if np.isnan(score.coverage) else f"{100.0 * score.coverage:.0f} %"
        table.add_row(name + mark, *(f"{1e3 * value:.2f}" for value in score.rmse), share)
    console.print(table)
    pull = _rms(result.sweep.wrench)
    console.print(
        f"The cable pulls {np.linalg.norm(pull[:3]):.2g} N and {1e3 * np.linalg.norm(pull[3:]):.2g}"
        f" mN.m (rms over the poses); learned as '{drag.form}' (*)",
        soft_wrap=True,
        highlight=False,
    )
    if drag.form != "free":
        at = " ".join(f"{1e3 * value:.0f}" for value in drag.attachment_m)
        console.print(f"It pulls at ({at}) mm in ft_sensor", highlight=False)
    for warning in result.warnings:
        console.print(f"[yellow]{warning}[/yellow]", soft_wrap=True, highlight=False)
    written = "not written (--dry-run)" if options.dry_run else "written"
    console.print(f"{calibration_path(options.tools_dir, options.tool)}: {written}", soft_wrap=True)


def main(arguments: list[str] | None = None) -> None:
    """Run the command; see `cable_from_bag --help`."""
    options = parse(arguments)
    with reported("cable_from_bag"):
        if options.remove:
            fields = remove(options)
            written = "not written (--dry-run)" if options.dry_run else "the cable is removed"
            path = calibration_path(options.tools_dir, options.tool)
            print(json.dumps(fields) if options.json else f"{path}: {written}")
            return
        result = run(options)
        if options.json:
            print(json.dumps(result_fields(options, result)))
        else:
            print_result(options, result, Console(width=None if sys.stdout.isatty() else 100))


if __name__ == "__main__":
    main()
