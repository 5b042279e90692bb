# SPDX-License-Identifier: Apache-2.0
"""`convert`: makes a bag of measured readings, so that nodes and commands can work on them.

The compensation needs no more of the joints than the direction of gravity in the sensor's frame,

    u = (cos roll cos tilt, -sin roll, cos roll sin tilt),

so any sensor's orientation can be given by a roll and a tilt:

    roll = atan2(-u_y, |(u_x, u_z)|) in -90 to 90 degrees,   tilt = atan2(u_z, u_x),

without steps, unless it would wind up over more than a turn.

Where gravity lies along y (roll at 90 degrees) tilt has no meaning, and the last one is kept.
Angles may lie beyond the Galen's limits; the platform stands at home. A turn about the direction of
gravity is lost, and so is where the sensor's frame stands on its robot. A table of another arm's
joint angles (`--urdf`) keeps them, for commands that are given the same description.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_common.arm import add_arm, chosen_arm
from galen_common.cdr import NS_PER_S, joint_state_bytes, wrench_bytes
from galen_common.command import (
    EXIT_OK,
    add_table_columns,
    check_parent,
    make_parser,
    positive,
    progress,
    run_command,
)
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.setup_check.check import SetupError, require_setup

from galen_bags.arrays.arm_recording import JOINT_STATE_TYPE, WRENCH_TYPE
from galen_bags.arrays.tables import (
    OrientationTable,
    read_orientations,
    read_table,
    read_wrenches,
    still_readings,
)
from galen_bags.formats.writer import BagWriter

_UNITS_NS = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}
_NO_TILT = 1e-6  # |(u_x, u_z)| below which tilt has no meaning
_LAST_STAMP_NS = 2**31 * NS_PER_S  # a message's seconds are an int32

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
    add_table_columns(parser)
    add_arm(parser)
    parser.add_argument(
        "--time-unit", choices=tuple(_UNITS_NS), default="s", help="unit of t (default: s)"
    )
    parser.add_argument(
        "--rate-hz",
        type=positive,
        metavar="HZ",
        help="of a table without t: stamp its readings at this rate, one after the other",
    )
    return parser


@dataclass(frozen=True)
class Measured:
    """Wrenches and orientations, each with its own stamps (ns) in the file's order.

    wrench (n, 6) N and N.m, gravity (m, 3) in the sensor's frame, any length. arm: whose joints are
    written; angles (m, k): its turning joints', rad, None: those that turn gravity so.
    """

    wrench_stamp_ns: np.ndarray
    wrench: Array
    gravity_stamp_ns: np.ndarray
    gravity: Array
    arm: Arm
    angles: Array | None = None


def read_measured(arguments: argparse.Namespace) -> Measured:
    """Read the tables that the command's options name.

    Args:
        arguments: the parsed options of `build_parser`.

    Returns:
        The readings, with stamps; in the sensor's frame.

    Raises:
        SetupError: a wrong set-up explains the readings, and the options don't allow it.
        GalenError: a table can't be read, or lacks times.

    """
    unit, file = arguments.time_unit, arguments.table or arguments.wrench
    arm = chosen_arm(arguments)
    if not arguments.table:
        wrench_time, wrench = read_wrenches(arguments.wrench)
        gravity_time, gravity = read_orientations(arguments.orientations, arm=arm)
        return _stamped(file, [wrench_time, gravity_time], unit, wrench, gravity, arm)
    columns = arguments.columns.split(",") if arguments.columns else None
    table = read_table(file, columns, arguments.wrench_frame, arm=arm)
    time = table.time
    if time is None and arguments.rate_hz is None:
        raise GalenError(f"{file}: no column 't'; give the readings' --rate-hz")
    if time is not None and arguments.rate_hz is not None:
        raise GalenError(f"{file}: has a column 't'; --rate-hz is for tables without")
    if not arguments.no_setup_check:
        _check_setup(file, table)
    if time is None:
        time, unit = np.arange(len(table)) / arguments.rate_hz, "s"
    measured = _stamped(file, [time, time], unit, table.wrench, table.gravity, arm)
    if table.angles is None or arm.joint_names == GALEN.joint_names:
        return measured
    return replace(measured, angles=table.angles)


def _check_setup(file: str, table: OrientationTable) -> None:
    """Raise SetupError where a wrong set-up explains the readings."""
    try:
        require_setup(still_readings(table))
    except SetupError as error:
        raise SetupError(f"{file}: {error}; --no-setup-check converts it") from error


def _stamped(
    file: str, times: Sequence[Array], unit: str, wrench: Array, gravity: Array, arm: Arm
) -> Measured:
    try:
        wrench_ns, gravity_ns = stamps_ns(times, unit)
    except ValueError as error:
        raise GalenError(f"{file}: {error}") from error
    return Measured(wrench_ns, wrench, gravity_ns, gravity, arm)


def stamps_ns(times: Sequence[Array], unit: str = "s") -> list[np.ndarray]:
    """Return stamps of several columns of times that share one clock.

    Args:
        times: columns of times, each of any length, in `unit`.
        unit: "s", "ms", "us" or "ns".

    Returns:
        Stamps, ns, int64, in the order of `times`. A stamp is above 0: where the earliest is not,
        it becomes 1 s.

    Raises:
        ValueError: no stamp can hold the times.

    """
    unit_ns = _UNITS_NS[unit]
    latest_ns = max(float(np.abs(time).max()) for time in times) * unit_ns
    if not latest_ns < _LAST_STAMP_NS:
        raise ValueError(
            f"times go up to {latest_ns / NS_PER_S:g} s, beyond any stamp: are they in {unit}?"
            " (--time-unit)"
        )
    result = []
    for time in times:
        whole = np.floor(time)
        part_ns = np.rint((time - whole) * unit_ns)
        result.append(whole.astype(np.int64) * unit_ns + part_ns.astype(np.int64))
    first = min(int(stamps.min()) for stamps in result)
    return result if first > 0 else [stamps - first + NS_PER_S for stamps in result]


def angles_of(gravity: Array) -> tuple[Array, np.ndarray]:
    """Find the roll and tilt that turn gravity so, by the module's equations.

    Args:
        gravity: (m, 3) in the sensor's frame, any length but 0.

    Returns:
        Roll and tilt (m, 2), rad; and whether tilt has no meaning, (m,) bool: gravity lies along y,
        and the last tilt known is kept.

    """
    unit = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    level = np.hypot(unit[:, 0], unit[:, 2])
    angles = np.column_stack((np.arctan2(-unit[:, 1], level), np.arctan2(unit[:, 2], unit[:, 0])))
    lost = level < _NO_TILT
    if lost.all():
        angles[:, 1] = 0.0
        return angles, lost
    known = np.flatnonzero(~lost)
    # The last one known; before the first of them, the first.
    last = known[np.maximum(np.searchsorted(known, np.arange(len(unit)), side="right") - 1, 0)]
    tilt = np.unwrap(angles[known, 1])[np.searchsorted(known, last)]
    turns = np.round(np.median(tilt) / (2.0 * np.pi))  # keep it near zero, as an arm's angles are
    tilt = tilt - 2.0 * np.pi * turns
    # Readings one by one, which don't follow each other, would wind up over several turns.
    wound = np.max(np.abs(tilt)) > 2.0 * np.pi
    angles[:, 1] = np.arctan2(np.sin(tilt), np.cos(tilt)) if wound else tilt
    return angles, lost


def write_measured(path: str, measured: Measured) -> tuple[Array, int]:
    """Write `wrench_raw` and `joint_states` into a new bag.

    Every message keeps its stamp and its place in its file. The log time is the stamp; where
    stamps step back, that of the message before.

    Args:
        path: the bag's directory, which must not be there.
        measured: the readings; velocities are differences of the joints.

    Returns:
        The joints (m, n), m and rad, and how many orientations have no tilt of their own.

    Raises:
        BagError: the bag can't be written.

    """
    arm, angles, lost = measured.arm, measured.angles, np.zeros(0, dtype=bool)
    if angles is None:
        angles, lost = angles_of(measured.gravity)
    joints = arm.with_angles(angles)
    velocities = _velocities(measured.gravity_stamp_ns, joints)
    states, forces = joint_state_bytes(arm.joint_names), wrench_bytes(arm.sensor_frame)
    stamps = (measured.gravity_stamp_ns, measured.wrench_stamp_ns)
    log_ns = np.concatenate([np.maximum.accumulate(one) for one in stamps])
    stamp_ns = np.concatenate(stamps)
    # Stable: of one time the joints come first, as the driver publishes them.
    order = np.argsort(log_ns, kind="stable").tolist()
    with BagWriter(path) as bag, progress(len(order), "message", path) as bar:
        joint_states = bag.add_topic("joint_states", JOINT_STATE_TYPE)
        wrench_raw = bag.add_topic("wrench_raw", WRENCH_TYPE)
        for k in order:
            stamp, row = int(stamp_ns[k]), k - len(joints)
            if row < 0:
                data = states.fill(stamp, joints[k].tolist(), velocities[k].tolist())
                bag.write(joint_states, int(log_ns[k]), data)
            else:
                data = forces.fill(stamp, measured.wrench[row].tolist())
                bag.write(wrench_raw, int(log_ns[k]), data)
            bar.update()
    return joints, int(lost.sum())


def _velocities(stamp_ns: np.ndarray, positions: Array) -> Array:
    """Differences of the neighbours on both sides, per s; zero where time does not go on."""
    after = np.minimum(np.arange(len(stamp_ns)) + 1, len(stamp_ns) - 1)
    before = np.maximum(np.arange(len(stamp_ns)) - 1, 0)
    span_s = (stamp_ns[after] - stamp_ns[before])[:, None] / NS_PER_S
    change = positions[after] - positions[before]
    return np.divide(change, span_s, out=np.zeros_like(change), where=span_s > 0.0)


def convert(arguments: argparse.Namespace) -> list[str]:
    """Read the tables and write the bag.

    Args:
        arguments: the parsed options of `build_parser`.

    Returns:
        What was written, line by line, for a person.

    Raises:
        GalenError: a table can't be read, or the bag can't be written.

    """
    check_parent(Path(arguments.output))
    measured = read_measured(arguments)
    joints, lost = write_measured(arguments.output, measured)
    lines = []
    for name, stamps in (
        ("joint_states", measured.gravity_stamp_ns),
        ("wrench_raw", measured.wrench_stamp_ns),
    ):
        duration_s = int(stamps[-1] - stamps[0]) / NS_PER_S
        rate = f", {(len(stamps) - 1) / duration_s:.1f} Hz" if duration_s > 0.0 else ""
        lines.append(f"{name}: {len(stamps)} messages over {duration_s:.3f} s{rate}")
        if back := int(np.sum(np.diff(stamps) <= 0)):
            lines.append(f"{name}: {back} stamps are not after the one before them")
    arm = measured.arm
    for name, angles in zip(arm.turning_names, arm.angles(joints).T, strict=True):
        lines.append(f"{name}: {angles.min():.4f} to {angles.max():.4f} rad")
    if lost:
        lines.append(
            f"gravity lies along y in {lost} orientations: their tilt is the last one known"
        )
    return [*lines, f"bag: {arguments.output}"]


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: its arguments; None: those of the process.

    Returns:
        The exit code.

    """
    parser = build_parser()
    arguments = parser.parse_args(args)
    two = (arguments.wrench is not None, arguments.orientations is not None)
    if (arguments.table is not None) == any(two) or any(two) != all(two):
        parser.error("give a table, or --wrench and --orientations")
    if any(two) and (
        arguments.wrench_frame != "sensor" or arguments.rate_hz is not None or arguments.columns
    ):
        parser.error("--columns, --wrench-frame base and --rate-hz are for a table that has both")

    def work() -> int:
        print("\n".join(convert(arguments)))
        return EXIT_OK

    return run_command("convert", work, "; no bag is written")


if __name__ == "__main__":
    sys.exit(main())
