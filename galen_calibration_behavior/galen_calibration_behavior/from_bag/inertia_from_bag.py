"""`inertia_from_bag`: the inertia of tool and adapter out of a recording of free motion. No ROS."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import numpy as np
from galen_bags.arrays.arm_recording import read_arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.errors import GalenError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.load.inertia.inertial import INERTIA_NAMES, point_mass_inertia
from rich.console import Console
from rich.table import Table

from galen_calibration_behavior.calibration.estimate import check_writable
from galen_calibration_behavior.from_bag.inertia_estimation import InertiaResult, estimate_inertia
from galen_calibration_behavior.from_bag.options import (
    EXIT_CANCELED,
    EXIT_FAILED,
    EXIT_OK,
    EXIT_USAGE,
    add_output_options,
    add_topic_options,
    arm_topics,
    check_not_newer,
    parse_with_tool,
    reported,
    sample_time,
)

_EPILOG = f"""exit codes:
  {EXIT_OK}    estimated; the file is written, but for --dry-run
  {EXIT_FAILED}    failed, as when the motion does not tell the inertia; the reason is printed,
       nothing is written
  {EXIT_USAGE}    wrong arguments
  {EXIT_CANCELED}  interrupted (Ctrl-C); nothing is written"""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="inertia_from_bag",
        description="Add the inertia of tool and adapter to a calibrated tool's file, from a"
        " recording of at least 12 s in which the arm swings roll and tilt, smoothly and fast, and"
        " nobody touches the tool.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tool", help="name of the tool, whose file there is")
    parser.add_argument("bag", help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    add_output_options(parser)
    add_topic_options(parser)
    return parse_with_tool(parser, arguments)


def run(options: argparse.Namespace) -> InertiaResult:
    """Estimate as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    path = calibration_path(options.tools_dir, options.tool)
    tool = read_calibration(path)
    if not options.dry_run:
        check_writable(path)
    recording = read_arm(options.bag, arm_topics(options))
    recorded = sample_time(int(recording.joint_stamp_ns[-1]), int(recording.joint_log_ns[-1]))
    check_not_newer(options, path, recorded)
    if not np.isfinite(recording.joints).any(axis=0).all():
        raise GalenError(
            f"{options.bag}: {options.joint_states} lacks the platform's position: of"
            f" {' '.join(options.joint_names)} all five are needed (--joint-names)"
        )
    try:
        result = estimate_inertia(tool, recording)
    except GalenError as error:
        raise GalenError(f"{options.bag}: {error}") from error
    if not options.dry_run:
        write_calibration(path, result.tool)
    return result


def result_fields(options: argparse.Namespace, result: InertiaResult) -> dict[str, Any]:
    """The result as plain numbers and texts, SI units."""
    fit, held = result.fit, result.held_out
    scores = None
    if held is not None:
        scores = {
            name: dict(zip(WRENCH_AXES, getattr(held, name).tolist(), strict=True))
            for name in ("static", "points", "inertia")
        }
    return {
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration_path(options.tools_dir, options.tool)),
        "inertia": fit.inertia.to_json(),
        "std_kg_m2": fit.inertia.std_kg_m2.tolist(),
        "point_masses_kg_m2": _points(result).tolist(),
        "mass_kg": float(fit.moments[0]),
        "agrees_with_file": not fit.disagrees,
        "lag_s": fit.lag_s,
        "lag_std_s": fit.lag_std_s,
        "blocks": fit.blocks,
        "blocks_left_out": fit.touched,
        "held_out_rms": scores,
        "warnings": list(result.warnings),
    }


def _points(result: InertiaResult) -> np.ndarray:
    return point_mass_inertia(result.tool.load.load, result.tool.adapter.load)


def print_result(options: argparse.Namespace, result: InertiaResult, console: Console) -> None:
    """Tables for a person."""
    fit = result.fit
    table = Table(title=f"Inertia of {options.tool} and adapter about ft_sensor, 1e-6 kg m^2")
    table.add_column("")
    for name in INERTIA_NAMES:
        table.add_column(name, justify="right")
    for label, values in (
        ("estimated", fit.inertia.about_sensor_kg_m2),
        ("one standard deviation", fit.inertia.std_kg_m2),
        ("points at the centres", _points(result)),
    ):
        table.add_row(label, *(f"{1e6 * value:.1f}" for value in values))
    console.print(table)
    if result.held_out is None:
        console.print("Half of the recording alone does not tell the inertia: nothing is held out")
    else:
        table = Table(title="Left over below 10 Hz, each half by a fit to the other, mN and mN.m")
        table.add_column("")
        for axis in WRENCH_AXES:
            table.add_column(axis, justify="right")
        for label, rms in (
            ("weight only", result.held_out.static),
            ("points at the centres", result.held_out.points),
            ("inertia", result.held_out.inertia),
        ):
            table.add_row(label, *(f"{1e3 * value:.2f}" for value in rms))
        console.print(table)
    for warning in result.warnings:
        console.print(f"[yellow]{warning}[/yellow]", soft_wrap=True, highlight=False)
    written = "not written (--dry-run)" if options.dry_run else "written"
    console.print(f"{calibration_path(options.tools_dir, options.tool)}: {written}", soft_wrap=True)


def main(arguments: list[str] | None = None) -> None:
    """Run the command; see `inertia_from_bag --help`."""
    options = parse(arguments)
    with reported("inertia_from_bag"):
        result = run(options)
        if options.json:
            print(json.dumps(result_fields(options, result)))
        else:
            print_result(options, result, Console(width=None if sys.stdout.isatty() else 100))


if __name__ == "__main__":
    main()
