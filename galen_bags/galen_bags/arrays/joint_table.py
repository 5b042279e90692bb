# SPDX-License-Identifier: Apache-2.0
"""Readings of one joint from tables in text files, and the command options that map columns."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_common.command import positive
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.transmission import JointRun

from galen_bags.arrays.tables import TextTable, read_text_table

COLUMNS = ("t", "motor", "link", "torque")
MOST_READINGS_HZ = 20e3
"""No encoder of a joint is read faster: then the time column is in another unit."""

_LONGEST_GAP = 5.0
_FEWEST_READINGS = 50
_LARGEST = 1e9
"""Beyond any joint's angle (rad) and torque (N.m)."""


@dataclass(frozen=True)
class JointColumns:
    """The names of a table's columns, and their units and gears.

    motor, link: angles, rad; torque: N.m; t: time. time_scale_s: seconds a unit of the column t;
    None: not given, then seconds unless that can't be. opposite: the two ends turn in opposite
    senses. torque_gear: motor turns a turn of the link, by which the torque is multiplied (a
    negative one turns it round).
    """

    t: str = "t"
    motor: str = "motor"
    link: str = "link"
    torque: str = "torque"
    time_scale_s: float | None = None
    opposite: bool = False
    torque_gear: float = 1.0


def read_joint_runs(
    files: Sequence[str | os.PathLike[str]], columns: JointColumns
) -> list[JointRun]:
    """Read one run a file.

    Args:
        files: text tables; a run is named after its file.
        columns: names, units and gears of their columns, the same for all.

    Returns:
        The runs, in the order of `files`.

    Raises:
        GalenError: two files have the same name, or a file is wrong as of `read_joint_run`.

    """
    runs = [read_joint_run(file, columns) for file in files]
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise GalenError(f"two runs have the name {name}: is a file given twice?")
    return runs


def read_joint_run(file: str | os.PathLike[str], columns: JointColumns) -> JointRun:
    """Read a run of one joint out of a text table.

    Args:
        file: the table; the run is named by its stem.
        columns: names, units and gears of its columns.

    Returns:
        Time, s, angles of motor and link, rad, torque, N.m, each (n,); where they are opposite, the
        link turned into the sense of the motor, the torque multiplied by the gear.

    Raises:
        GalenError: an end stands still, readings are too few, too large or lack time, or nothing
            deflects; it names file and line, or column.

    """
    wanted = [columns.motor, columns.link, columns.torque, columns.t]
    table = read_text_table(file, wanted, units_as={columns.t: "t", columns.torque: "tx"})
    motor, link, torque = (table.require(name) for name in wanted[:3])
    if len(motor) < _FEWEST_READINGS:
        raise GalenError(f"{table.path}: {len(motor)} readings; a run needs {_FEWEST_READINGS}")
    for name, values in zip(wanted[:2], (motor, link), strict=True):
        if np.ptp(values) == 0.0:
            raise GalenError(f"{table.path}: column {name!r} never changes: that end stands still")
    for name, values in zip(wanted, (motor, link, torque), strict=False):
        if np.abs(values).max() > _LARGEST:
            at = int(np.argmax(np.abs(values)))
            raise GalenError(
                f"{table.path}: line {table.lines[at]}, column {name!r}: {values[at]:g} is no"
                " measurement in rad or N.m"
            )
    run = JointRun(
        name=Path(file).stem,
        time_s=_time(table, columns, motor),
        motor=motor,
        link=-link if columns.opposite else link,
        torque=torque * columns.torque_gear,
    )
    if np.ptp(run.lag) == 0.0:
        raise GalenError(
            f"{table.path}: columns {wanted[0]!r} and {wanted[1]!r} are the same but for an offset:"
            " nothing deflects between them"
        )
    return run


def _time(table: TextTable, columns: JointColumns, motor: Array) -> Array:
    time = table.require(columns.t)
    steps = np.diff(time)
    if np.any(steps <= 0.0):
        at = int(np.argmax(steps <= 0.0)) + 1
        raise GalenError(
            f"{table.path}: line {table.lines[at]}: the time {time[at]:g} in column {columns.t!r} "
            f"does not come after {time[at - 1]:g}"
        )
    usual = float(np.median(steps))
    if np.any(steps > _LONGEST_GAP * usual):
        at = int(np.argmax(steps > _LONGEST_GAP * usual)) + 1
        raise GalenError(
            f"{table.path}: line {table.lines[at]}: {steps[at - 1]:g} after the reading before it, "
            f"where {usual:g} is usual: a gap cuts what the joint remembers; split the file there"
        )
    if columns.time_scale_s is None and usual * MOST_READINGS_HZ < 1.0:
        fastest = np.abs(np.diff(motor)).sum() / (time[-1] - time[0])
        raise GalenError(
            f"{table.path}: column {columns.t!r} steps by {usual:g}; in seconds that were "
            f"{1.0 / usual:.0f} readings a second, and {fastest:.3g} rad/s on average: give "
            "--time-scale, the seconds a unit of this column"
        )
    return time * (columns.time_scale_s or 1.0)


# Command options


def add_column_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that name a table's columns, units and gears.

    Args:
        group: a command's group of options; `joint_columns` reads them.

    """
    group.add_argument(
        "--columns",
        type=_columns,
        default={},
        metavar="MAP",
        help="names of the columns: t (time), motor, link (angles, rad), torque (N.m), as in"
        " motor=q_motor_rad,torque=tau (default: those four names)",
    )
    group.add_argument(
        "--time-scale",
        type=positive,
        metavar="S",
        help="seconds a unit of the column t (default: 1, where that can be)",
    )
    group.add_argument(
        "--opposite", action="store_true", help="motor and link turn in opposite senses"
    )
    group.add_argument(
        "--torque-gear",
        type=_not_zero,
        default=1.0,
        metavar="G",
        help="the torque is of the motor's shaft: multiply it by G; a negative G turns it round"
        " (default: %(default)s)",
    )


def joint_columns(arguments: argparse.Namespace) -> JointColumns:
    """Make the columns from the options of `add_column_options`.

    Args:
        arguments: a command's parsed options.

    Returns:
        Names, unit of time and gears; columns that the options don't name keep their default names.

    """
    return JointColumns(
        **arguments.columns,
        time_scale_s=arguments.time_scale,
        opposite=arguments.opposite,
        torque_gear=arguments.torque_gear,
    )


def _columns(text: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for item in text.split(","):
        name, equals, column = (part.strip() for part in item.partition("="))
        if not equals or not column or name not in COLUMNS:
            raise argparse.ArgumentTypeError(
                f"{item!r}: expected {', '.join(f'{known}=NAME' for known in COLUMNS)}"
            )
        if name in found:
            raise argparse.ArgumentTypeError(f"{name} is given twice")
        found[name] = column
    return found


def _not_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not math.isfinite(value) or value == 0.0:
        raise argparse.ArgumentTypeError(f"{text} is zero or not finite")
    return value
