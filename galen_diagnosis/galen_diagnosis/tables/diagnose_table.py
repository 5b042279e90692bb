"""`diagnose` of a text table: what differs between readings and the weight of their load."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from galen_bags.arrays.motion_table import read_motion, read_specific
from galen_bags.arrays.orientation_table import (
    ORIENTATIONS,
    OrientationTable,
    read_rotations,
    read_table,
)
from galen_bags.arrays.text_table import read_text_table
from galen_model.arm.galen import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import read_calibration
from galen_model.rest.segments import DirectionRest
from galen_ros.command import (
    EXIT_OK,
    make_parser,
    positive,
    run_command,
)

from galen_diagnosis.tables.conclusion import BlockDiagnosis
from galen_diagnosis.tables.output import (
    add_output_options,
    check_outputs,
    diagnose_rows,
    give,
    name_of,
)
from galen_diagnosis.tables.table_rows import prepare_table
from galen_diagnosis.tables.table_run import prepare_run

_RUN_WINDOW_S, _STOP_WINDOW_S = 0.01, 1.0
_WAYS = "; ".join(" ".join(columns) for columns in ORIENTATIONS.values())
_NOTES = f"""TABLE: fx .. tz and an orientation ({_WAYS}),
perhaps t and block. With t it is cut into its stops. With --wrench and --orientations the tables
are still poses that tell the load, and the run is diagnosed."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = make_parser(
        "diagnose",
        "From readings of a force/torque sensor with its orientations: whether weight"
        " and constants explain them, which effect does beyond that, how sure it is, and how much"
        " it closes on blocks (stops, poses, stretches of a run) that no fit has seen.",
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="a table can't be used; one line gives the reason",
    )
    parser.add_argument("tables", nargs="+", type=Path, metavar="TABLE", help="each by itself")
    parser.add_argument(
        "--columns", metavar="NAMES", help="of a table without a first line of names; - skips one"
    )
    parser.add_argument(
        "--wrench-frame",
        choices=("sensor", "base"),
        default="sensor",
        help="the axes that wrenches are told along (default: %(default)s)",
    )
    parser.add_argument(
        "--tool", type=Path, metavar="FILE", help="diagnose against this tool's file, don't fit"
    )
    parser.add_argument(
        "--noise",
        type=Path,
        metavar="TABLE",
        help="readings of the sensor, still and untouched (fx .. tz): the floor of a table without"
        " time",
    )
    parser.add_argument(
        "--average-s",
        type=positive,
        metavar="S",
        help=f"rows are means over this (default: {_STOP_WINDOW_S:g} in stops,"
        f" {_RUN_WINDOW_S:g} in a run)",
    )
    parser.add_argument(
        "--still-rate-rad-s",
        type=positive,
        default=DirectionRest.max_rate_rad_s,
        metavar="RATE",
        help="slower than this counts as still (default: %(default)s)",
    )
    run = parser.add_argument_group("a run in motion")
    run.add_argument("--wrench", type=Path, metavar="FILE", help="its wrench: t, fx .. tz")
    run.add_argument(
        "--orientations", type=Path, metavar="FILE", help="its orientation: t, r11 .. or another"
    )
    run.add_argument(
        "--imu",
        type=Path,
        metavar="FILE",
        help="its IMU: t, ax ay az; the table of still poses then has ax ay az as well",
    )
    run.add_argument(
        "--time-unit-s",
        type=positive,
        default=1.0,
        metavar="S",
        help="a unit of the run's t (default: %(default)s)",
    )
    run.add_argument(
        "--imu-unit-m-s2",
        type=positive,
        default=1.0,
        metavar="UNIT",
        help=f"a unit of ax ay az; {-GRAVITY_M_S2[2]} for g (default: %(default)s)",
    )
    add_output_options(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    in_motion = arguments.wrench is not None
    if in_motion != (arguments.orientations is not None):
        parser.error("--wrench and --orientations belong together")
    if arguments.imu is not None and not in_motion:
        parser.error("--imu is a run's: give --wrench and --orientations")
    if in_motion and (arguments.tool is not None or arguments.noise is not None):
        parser.error("--tool and --noise are for still tables; a run has its own rest")
    if len(arguments.tables) > 1 and (in_motion or arguments.label is not None):
        parser.error("a run and --label take one table")
    return run_command("diagnose", lambda: _diagnose(arguments))


def _diagnose(arguments: argparse.Namespace) -> int:
    check_outputs(arguments)
    found = [_one(path, arguments) for path in arguments.tables]
    give(found, arguments)
    return EXIT_OK


def _one(path: Path, arguments: argparse.Namespace) -> BlockDiagnosis:
    columns = arguments.columns.split(",") if arguments.columns else None
    table = read_table(path, columns, arguments.wrench_frame)
    if arguments.wrench is not None:
        return _run(table, path, arguments)
    prepared = prepare_table(
        table,
        noise=None if arguments.noise is None else _noise(arguments.noise),
        tool=None if arguments.tool is None else read_calibration(arguments.tool),
        window_s=arguments.average_s or _STOP_WINDOW_S,
        settings=DirectionRest(max_rate_rad_s=arguments.still_rate_rad_s),
    )
    return diagnose_rows(name_of(path, arguments.label), prepared, quiet=arguments.json)


def _run(still: OrientationTable, path: Path, arguments: argparse.Namespace) -> BlockDiagnosis:
    run = read_motion(
        arguments.wrench,
        arguments.imu,
        arguments.orientations,
        arguments.time_unit_s,
        arguments.imu_unit_m_s2,
    )
    prepared = prepare_run(
        still,
        None if arguments.imu is None else read_specific(path, arguments.imu_unit_m_s2),
        run,
        read_rotations(arguments.orientations),
        arguments.average_s or _RUN_WINDOW_S,
    )
    return diagnose_rows(name_of(arguments.wrench, arguments.label), prepared, quiet=arguments.json)


def _noise(path: Path) -> Array:
    text = read_text_table(path, set(WRENCH_AXES))
    return np.column_stack([text.require(axis) for axis in WRENCH_AXES])
