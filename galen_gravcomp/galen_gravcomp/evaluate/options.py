# SPDX-License-Identifier: Apache-2.0
"""Options of `evaluate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from galen_bags.archive import add_results, place
from galen_common.arm import add_arm
from galen_common.command import (
    add_arm_topics,
    add_json,
    add_plots,
    add_table_columns,
    add_tool_file,
    add_workers,
    make_parser,
    not_negative,
    positive,
)
from galen_common.parameters import add_options
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.load.verdict import Limits

from galen_gravcomp.evaluate.drift_series import CELL_S
from galen_gravcomp.parameters import GravcompParameters

_USAGE = """evaluate BAG... (--tool FILE | --tool-beside NAME) [options]
       evaluate TABLE [--tool FILE] [options]
       evaluate TABLE --run WRENCH IMU ORIENTATIONS [options]
       evaluate BAG|TABLE... --drift [--tool FILE] [options]"""
_NOTES = """BAG: rosbag2 directory, .mcap, .db3, or a folder that is searched for
them: does the calibration file still fit the recording, and where not?
TABLE: .csv, .txt, .tsv or .dat with fx fy fz tx ty tz (N, N.m; a push reads positive in
its direction) and one of gx gy gz | r11..r33 (R_base_sensor) | qx qy qz qw (sensor in
base) | roll tilt; optional: t (s), block (label): a load is fitted, and scored on
readings held out, beside the plain ten-parameter least squares."""
# The node's own parameters that decide what becomes of a wrench, with its defaults.
NODE_OPTIONS = ("max_joint_age_s", "motion", "motion_lag_s")


def build_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = make_parser(
        "evaluate",
        "Judge calibration files, loads and sensors on recordings and tables; the kind is found"
        " from the input.",
        usage=_USAGE,
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="an input can't be used; a line gives the reason. Of many bags, the others were"
        " evaluated",
    )
    parser.add_argument(
        "inputs",
        nargs="+",
        type=place,
        metavar="INPUT",
        help="bags or tables: paths, or URLs (s3://, gs://, az://, https://)",
    )
    add_tool_file(parser, "the calibration file; with a table optional, scored beside").type = place
    add_plots(parser)
    add_json(parser)
    for unit, metavar, default in (
        ("force-n", "N", Limits.force_n),
        ("torque-nm", "NM", Limits.torque_nm),
    ):
        parser.add_argument(
            f"--limit-{unit}",
            type=positive,
            default=default,
            metavar=metavar,
            help="a file fits if no axis has a larger RMSE over the rest segments; with --drift:"
            " how far a tare may be off (1 sigma; default: %(default)s)",
        )
    add_arm(parser)
    _add_bag_options(parser.add_argument_group("bags"))
    _add_table_options(parser.add_argument_group("tables"))
    _add_drift_options(parser.add_argument_group("long recordings without contact"))
    return parser


def _add_bag_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--tool-beside",
        metavar="NAME",
        help="instead of --tool: use the file of this name in each bag's directory or above it",
    )
    add_arm_topics(group)
    group.add_argument(
        "--start-offset",
        type=not_negative,
        default=0.0,
        metavar="SECONDS",
        help="leave out so much at the beginning (default: %(default)s)",
    )
    group.add_argument(
        "--duration", type=positive, metavar="SECONDS", help="look at so much only (default: all)"
    )
    add_options(group, GravcompParameters, NODE_OPTIONS)
    group.add_argument(
        "--write-bags",
        metavar="DIR",
        type=Path,
        help="write each bag with wrench_compensated in it as DIR/<name>_compensated",
    )
    add_results(group)
    add_workers(group)


def _add_table_options(group: argparse._ArgumentGroup) -> None:
    add_table_columns(group)
    group.add_argument(
        "--average-s",
        type=positive,
        metavar="SECONDS",
        help="the table is a recording: find its rest segments and average this long within them",
    )
    group.add_argument(
        "--estimate",
        metavar="GROUPS",
        default=(),
        type=lambda text: tuple(text.split(",")),
        help="score a model beside that has these together with the load, comma-separated; rejected"
        " where the orientations don't distinguish them: sensor_rotation, axis_gain, gain_ratio,"
        " base_inclination (not with gx gy gz alone) and their parts",
    )
    group.add_argument(
        "--write-tool",
        metavar="FILE",
        type=Path,
        help="write the load from all readings as the calibration file <tools_dir>/<tool>.json; one"
        " load doesn't distinguish the adapter from the tool, and the file notes it",
    )
    group.add_argument(
        "--run",
        nargs=3,
        type=Path,
        metavar=("WRENCH", "IMU", "ORIENTATIONS"),
        help="the table holds still poses with an IMU (ax ay az): calibrate load and IMU on them,"
        " subtract weight and inertial forces from this run (tables of t and fx .. tz; t, ax ay az;"
        " t and an orientation), and score the residual",
    )
    group.add_argument(
        "--time-unit-s",
        type=positive,
        default=1.0,
        metavar="SECONDS",
        help="a unit of the run's column t (default: %(default)s)",
    )
    group.add_argument(
        "--imu-unit-m-s2",
        type=positive,
        default=1.0,
        metavar="UNIT",
        help=f"a unit of ax ay az; {-GRAVITY_M_S2[2]} for g (default: %(default)s)",
    )


def _add_drift_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--drift",
        action="store_true",
        help="the inputs, in their order, are one recording without contact: its course, Allan"
        " deviation, and how long a tare holds. Tables are read whole; --tool: the arm was at rest"
        " in several poses",
    )
    group.add_argument(
        "--cell-s",
        type=positive,
        default=CELL_S,
        metavar="SECONDS",
        help="readings are averaged over so much first; less for a short recording (default:"
        " %(default)s)",
    )
