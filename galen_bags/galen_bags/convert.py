"""`convert`: makes a bag of measured readings, so that nodes and commands can work on them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.galen import SENSOR_FRAME
from galen_model.errors import GalenError
from galen_ros.cdr import NS_PER_S
from galen_ros.command import (
    EXIT_OK,
    add_json,
    check_parent,
    make_parser,
    positive,
    print_json,
    run_command,
)

from galen_bags.arrays.measured import UNITS_NS, Measured, Written, stamps_ns, write_measured
from galen_bags.arrays.orientation_table import read_orientations, read_table, read_wrenches
from galen_bags.arrays.text_table import TableError

_NOTES = """columns, named in a file's first line or by --columns:
  fx fy fz tx ty tz                 wrench, N and N.m; a push reads positive in its direction
  gx gy gz | r11 ... r33 | qx qy qz qw | roll tilt
                                    gravity in the sensor's frame (m/s^2 or g); R_base_sensor;
                                    the sensor in the base; the Galen's joints (rad)
  t                                 time, in --time-unit
Others are skipped."""


def build_parser() -> argparse.ArgumentParser:
    """Return the command's options."""
    parser = make_parser(
        "convert",
        "Make a bag with wrench_raw and joint_states of measured wrenches and "
        "orientations in text files. Roll and tilt in it are those that turn gravity as the "
        "orientations do; the other joints stand at home.",
        notes=_NOTES,
        ok="the bag is written",
        failed="a file can't be read, or the bag not written; no bag is left",
    )
    parser.add_argument("table", nargs="?", help="text table of wrenches with orientations")
    parser.add_argument("--wrench", metavar="FILE", help="instead: a table of wrenches with t, and")
    parser.add_argument(
        "--orientations", metavar="FILE", help="one of orientations with t, at its own rate"
    )
    parser.add_argument("-o", "--output", required=True, metavar="BAG", help="the new bag")
    for option, what in (
        ("--columns", "the table"),
        ("--wrench-columns", "--wrench"),
        ("--orientation-columns", "--orientations"),
    ):
        parser.add_argument(
            option,
            metavar="NAMES",
            help=f"comma-separated column names of {what}, when it has no first line of names;"
            " '-' skips a column",
        )
    parser.add_argument(
        "--wrench-frame",
        choices=("sensor", "base"),
        default="sensor",
        help="axes that the table's wrenches are written in (default: sensor)",
    )
    parser.add_argument(
        "--time-unit", choices=tuple(UNITS_NS), default="s", help="unit of t (default: s)"
    )
    parser.add_argument(
        "--start-s",
        type=positive,
        metavar="SECONDS",
        help="stamp of the earliest sample (default: t as it is)",
    )
    parser.add_argument(
        "--rate-hz",
        type=positive,
        metavar="HZ",
        help="of a table without t: stamp its readings at this rate, one after the other",
    )
    parser.add_argument(
        "--sensor-frame",
        default=SENSOR_FRAME,
        metavar="NAME",
        help="frame_id of the wrenches (default: %(default)s)",
    )
    add_json(parser)
    return parser


def convert(arguments: argparse.Namespace) -> dict[str, Any]:
    """Read, write, and return what was written; raises GalenError."""
    check_parent(Path(arguments.output))
    measured = _read_one(arguments) if arguments.table else _read_two(arguments)
    written = write_measured(
        arguments.output, measured, sensor_frame=arguments.sensor_frame, quiet=arguments.json
    )
    return _summary(arguments.output, measured, written)


def _read_one(arguments: argparse.Namespace) -> Measured:
    table = read_table(arguments.table, _names(arguments.columns), arguments.wrench_frame)
    time, unit, start_s = table.time, arguments.time_unit, arguments.start_s
    if time is None and arguments.rate_hz is None:
        raise TableError(f"{arguments.table}: no column 't'; give the readings' --rate-hz")
    if time is not None and arguments.rate_hz is not None:
        raise TableError(f"{arguments.table}: has a column 't'; --rate-hz is for tables without")
    if time is None:
        time, unit = np.arange(len(table)) / arguments.rate_hz, "s"
        start_s = start_s or 1.0
    (stamp_ns,) = _stamps(arguments.table, [time], unit, start_s)
    return Measured(stamp_ns, table.wrench, stamp_ns, table.gravity)


def _read_two(arguments: argparse.Namespace) -> Measured:
    wrench_time, wrench = read_wrenches(arguments.wrench, _names(arguments.wrench_columns))
    time, gravity = read_orientations(arguments.orientations, _names(arguments.orientation_columns))
    wrench_stamp_ns, stamp_ns = _stamps(
        arguments.wrench, [wrench_time, time], arguments.time_unit, arguments.start_s
    )
    return Measured(wrench_stamp_ns, wrench, stamp_ns, gravity)


def _stamps(
    file: str, times: list[np.ndarray], unit: str, start_s: float | None
) -> list[np.ndarray]:
    try:
        return stamps_ns(times, unit, start_s)
    except GalenError as error:
        raise TableError(f"{file}: {error}") from error


def _names(option: str | None) -> list[str] | None:
    return option.split(",") if option else None


def _summary(path: str, measured: Measured, written: Written) -> dict[str, Any]:
    topics = {
        "joint_states": measured.gravity_stamp_ns,
        "wrench_raw": measured.wrench_stamp_ns,
    }
    return {
        "bag": path,
        "topics": {
            name: {
                "messages": len(stamps),
                "first_stamp_s": int(stamps[0]) / NS_PER_S,
                "duration_s": int(stamps[-1] - stamps[0]) / NS_PER_S,
                "stamps_not_after_the_one_before": int(np.sum(np.diff(stamps) <= 0)),
            }
            for name, stamps in topics.items()
        },
        "roll_rad": [float(written.roll_rad.min()), float(written.roll_rad.max())],
        "tilt_rad": [float(written.tilt_rad.min()), float(written.tilt_rad.max())],
        "orientations_without_tilt": written.without_tilt,
    }


def _print(summary: dict[str, Any]) -> None:
    for name, topic in summary["topics"].items():
        rate = ""
        if topic["duration_s"] > 0.0:
            rate = f", {(topic['messages'] - 1) / topic['duration_s']:.1f} Hz"
        print(f"{name}: {topic['messages']} messages over {topic['duration_s']:.3f} s{rate}")
        if back := topic["stamps_not_after_the_one_before"]:
            print(f"{name}: {back} stamps are not after the one before them")
    for name in ("roll", "tilt"):
        low, high = summary[f"{name}_rad"]
        print(f"{name}: {low:.4f} to {high:.4f} rad")
    if lost := summary["orientations_without_tilt"]:
        print(f"gravity lies along y in {lost} orientations: their tilt is the last one known")
    print(f"bag: {summary['bag']}")


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    two = (arguments.wrench is not None, arguments.orientations is not None)
    if (arguments.table is not None) == any(two) or any(two) != all(two):
        parser.error("give a table, or --wrench and --orientations")
    if any(two) and (arguments.wrench_frame != "sensor" or arguments.rate_hz is not None):
        parser.error("--wrench-frame base and --rate-hz are for a table that has both")

    def work() -> int:
        summary = convert(arguments)
        print_json(summary) if arguments.json else _print(summary)
        return EXIT_OK

    return run_command("convert", work, "; no bag is written")


if __name__ == "__main__":
    sys.exit(main())
