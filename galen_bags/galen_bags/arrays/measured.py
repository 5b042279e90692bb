"""Measured readings with orientations, written as the arm's own recording.

The compensation needs no more of the joints than the direction of gravity in the sensor's frame,

    u = (cos roll cos tilt, -sin roll, cos roll sin tilt),

so any sensor's orientation can be told by a roll and a tilt:

    roll = atan2(-u_y, |(u_x, u_z)|) in -90 to 90 degrees,   tilt = atan2(u_z, u_x), without steps.

Where gravity lies along y (roll at 90 degrees) tilt has no meaning, and the last one is kept.
Angles may lie beyond the Galen's limits; the platform stands at home. A turn about the direction of
gravity is lost, and so is where the sensor's frame stands on its robot.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import HOME, JOINT_NAMES, SENSOR_FRAME
from galen_model.arrays import Array
from galen_ros.cdr import NS_PER_S, joint_state_bytes, wrench_bytes
from tqdm import tqdm

from galen_bags.arrays.messages import JOINT_STATE_TYPE, WRENCH_TYPE
from galen_bags.errors import BagError
from galen_bags.formats.writer import BagWriter

UNITS_NS = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Units of time by their names on the command line, in ns."""

_NO_TILT = 1e-6  # |(u_x, u_z)| below which tilt has no meaning
_LAST_STAMP_NS = 2**31 * NS_PER_S  # a message's seconds are an int32


@dataclass(frozen=True)
class Measured:
    """Wrenches and orientations, each with its own stamps (ns) in the file's order.

    wrench (n, 6) N and N.m, gravity (m, 3) in the sensor's frame, any length.
    """

    wrench_stamp_ns: np.ndarray
    wrench: Array
    gravity_stamp_ns: np.ndarray
    gravity: Array


@dataclass(frozen=True)
class Written:
    """What was written: angles (m,), rad; how many orientations have no tilt of their own."""

    roll_rad: Array
    tilt_rad: Array
    without_tilt: int


def roll_and_tilt(gravity: Array) -> tuple[Array, Array, np.ndarray]:
    """Roll and tilt (m,), rad, and where tilt has no meaning, of gravity (m, 3) in the sensor."""
    unit = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    level = np.hypot(unit[:, 0], unit[:, 2])
    roll = np.arctan2(-unit[:, 1], level)
    tilt = np.arctan2(unit[:, 2], unit[:, 0])
    lost = level < _NO_TILT
    if lost.all():
        return roll, np.zeros(len(unit)), lost
    told = np.flatnonzero(~lost)
    # The last one told; before the first of them, the first.
    last = told[np.maximum(np.searchsorted(told, np.arange(len(unit)), side="right") - 1, 0)]
    tilt = np.unwrap(tilt[told])[np.searchsorted(told, last)]
    turns = np.round(np.median(tilt) / (2.0 * np.pi))  # keep it near zero, as an arm's angles are
    return roll, tilt - 2.0 * np.pi * turns, lost


def stamps_ns(
    times: Iterable[Array], unit: str = "s", start_s: float | None = None
) -> list[np.ndarray]:
    """Stamps (ns) of several columns of times in `unit`, which share one clock.

    `start_s` becomes the stamp of the earliest. Raises BagError for times that no stamp can hold.
    """
    unit_ns = UNITS_NS[unit]
    columns = list(times)
    _check_last(max(float(np.abs(time).max()) for time in columns) * unit_ns, unit)
    result = []
    for time in columns:
        whole = np.floor(time)
        part_ns = np.rint((time - whole) * unit_ns)
        result.append(whole.astype(np.int64) * unit_ns + part_ns.astype(np.int64))
    first = min(int(stamps.min()) for stamps in result)
    if start_s is not None:
        shift = round(start_s * NS_PER_S) - first
        result = [stamps + shift for stamps in result]
        first += shift
        _check_last(max(int(stamps.max()) for stamps in result), unit)
    if first <= 0:
        raise BagError(
            f"times start at {first / NS_PER_S:g} s, but a stamp must be above 0: say where to"
            " start (--start-s)"
        )
    return result


def _check_last(stamp_ns: float, unit: str) -> None:
    if not stamp_ns < _LAST_STAMP_NS:
        raise BagError(
            f"times go up to {stamp_ns / NS_PER_S:g} s, beyond any stamp: are they in {unit}?"
            " (--time-unit)"
        )


def write_measured(
    path: str | os.PathLike[str],
    measured: Measured,
    *,
    sensor_frame: str = SENSOR_FRAME,
    quiet: bool = False,
) -> Written:
    """Write `wrench_raw` and `joint_states` into a new bag; raises BagError.

    Every message keeps its stamp and its place in its file. The log time is the stamp; where
    stamps step back, that of the message before.
    """
    roll, tilt, lost = roll_and_tilt(measured.gravity)
    joints = np.tile(HOME, (len(roll), 1))
    joints[:, 3], joints[:, 4] = roll, tilt
    velocities = _velocities(measured.gravity_stamp_ns, joints)
    states, forces = joint_state_bytes(JOINT_NAMES), wrench_bytes(sensor_frame)
    log_ns = [
        np.maximum.accumulate(stamps)
        for stamps in (measured.gravity_stamp_ns, measured.wrench_stamp_ns)
    ]
    # Stable: of one time the joints come first, as the driver publishes them.
    order = np.argsort(np.concatenate(log_ns), kind="stable").tolist()
    with BagWriter(path) as bag:
        joint_states = bag.add_topic("joint_states", JOINT_STATE_TYPE)
        wrench_raw = bag.add_topic("wrench_raw", WRENCH_TYPE)
        for k in tqdm(order, desc=os.fspath(path), unit="message", disable=quiet or None):
            if k < len(joints):
                stamp = int(measured.gravity_stamp_ns[k])
                data = states.fill(stamp, joints[k].tolist(), velocities[k].tolist())
                bag.write(joint_states, int(log_ns[0][k]), data)
            else:
                k -= len(joints)
                data = forces.fill(int(measured.wrench_stamp_ns[k]), measured.wrench[k].tolist())
                bag.write(wrench_raw, int(log_ns[1][k]), data)
    return Written(roll, tilt, int(lost.sum()))


def _velocities(stamp_ns: np.ndarray, positions: Array) -> Array:
    """Differences (n, 5) of the neighbours on both sides, per s; zero where time does not go on."""
    after = np.minimum(np.arange(len(stamp_ns)) + 1, len(stamp_ns) - 1)
    before = np.maximum(np.arange(len(stamp_ns)) - 1, 0)
    span_s = (stamp_ns[after] - stamp_ns[before])[:, None] / NS_PER_S
    change = positions[after] - positions[before]
    return np.divide(change, span_s, out=np.zeros_like(change), where=span_s > 0.0)
