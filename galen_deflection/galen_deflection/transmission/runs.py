"""Readings of one joint: two angles and a torque, from tables in text files.

The lag is what the joint gives and loses: the motor's angle, over its gear, less the link's, both
in the motor's sense.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from galen_bags.arrays.text_table import TableError, TextTable, read_text_table
from galen_model.arrays import Array

COLUMNS = ("t", "motor", "link", "torque")
MOST_READINGS_HZ = 20e3
"""No encoder of a joint is read faster: then the time column is in another unit."""

_LONGEST_GAP = 5.0
_FEWEST_READINGS = 50
_LARGEST = 1e9
"""Beyond any joint's angle (rad) and torque (N.m)."""
_MUCH_LOST = 0.1


@dataclass(frozen=True)
class ColumnMap:
    """Which columns of a file are which, and what takes them to the joint.

    motor, link: angles, rad; torque: N.m; t: time, or None with `rate_hz`. time_scale_s: seconds a
    unit of the column t; None if nobody said, then seconds unless that can't be. opposite: the two
    ends turn in opposite senses. angle_gear, torque_gear: motor turns a turn of the link, by which
    the motor's angle is divided, and by which the torque is multiplied (a negative one turns it
    round).
    """

    t: str | None = "t"
    motor: str = "motor"
    link: str = "link"
    torque: str = "torque"
    time_scale_s: float | None = None
    rate_hz: float | None = None
    opposite: bool = False
    angle_gear: float = 1.0
    torque_gear: float = 1.0


class Noise(NamedTuple):
    """What no model can predict of the lag, rad: steps of both encoders, and its noise in time."""

    motor_step: float
    link_step: float
    quantisation: float
    jitter: float

    @property
    def floor(self) -> float:
        """The larger of the two; each holds some of the other."""
        return max(self.quantisation, self.jitter)


@dataclass(frozen=True)
class Run:
    """A recording (n,): time_s, increasing in even steps; motor, link (rad), torque (N.m).

    All at the joint and in the motor's sense: gears are taken out.
    """

    name: str
    time_s: Array
    motor: Array
    link: Array
    torque: Array

    def __len__(self) -> int:
        """Number of readings."""
        return len(self.time_s)

    @property
    def lag(self) -> Array:
        """Motor's angle less the link's (n,), rad."""
        return self.motor - self.link

    @property
    def step_s(self) -> float:
        """Between two readings."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self) - 1)


def read_runs(files: Sequence[str | os.PathLike[str]], columns: ColumnMap) -> list[Run]:
    """Read one run a file; raises TableError that names file and line, or column."""
    runs = [read_run(file, columns) for file in files]
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise TableError(f"two runs have the name {name}: is a file given twice?")
    return runs


def read_run(file: str | os.PathLike[str], columns: ColumnMap) -> Run:
    """Read a run; raises TableError that names file and line, or column."""
    wanted = [columns.motor, columns.link, columns.torque]
    wanted += [columns.t] if columns.t is not None else []
    table = read_text_table(file, wanted)
    motor, link, torque = (table.require(name) for name in wanted[:3])
    if len(motor) < _FEWEST_READINGS:
        raise TableError(f"{table.path}: {len(motor)} readings; a run needs {_FEWEST_READINGS}")
    for name, values in zip(wanted[:2], (motor, link), strict=True):
        if np.ptp(values) == 0.0:
            raise TableError(f"{table.path}: column {name!r} never changes: that end stands still")
    for name, values in zip(wanted, (motor, link, torque), strict=False):
        if np.abs(values).max() > _LARGEST:
            at = int(np.argmax(np.abs(values)))
            raise TableError(
                f"{table.path}: line {table.lines[at]}, column {name!r}: {values[at]:g} is no"
                " measurement in rad or N.m"
            )
    run = Run(
        name=Path(file).stem,
        time_s=_time(table, columns, motor / columns.angle_gear),
        motor=motor / columns.angle_gear,
        link=-link if columns.opposite else link,
        torque=torque * columns.torque_gear,
    )
    if np.ptp(run.lag) == 0.0:
        raise TableError(
            f"{table.path}: columns {wanted[0]!r} and {wanted[1]!r} are the same but for an offset:"
            " nothing gives between them"
        )
    return run


def noise_of(runs: Sequence[Run]) -> Noise:
    """From all runs: steps of the encoders, if they are seen, and the lag's second differences.

    White noise s has second differences of sqrt(6) s; what the lag itself does from one reading to
    the next is small beside it. Steps s of an encoder leave s / sqrt(12).
    """
    motor = max(encoder_step(run.motor) for run in runs)
    link = max(encoder_step(run.link) for run in runs)
    differences = np.concatenate([np.diff(run.lag, 2) for run in runs])
    return Noise(
        motor,
        link,
        quantisation=float(np.hypot(motor, link) / np.sqrt(12.0)),
        jitter=float(np.sqrt(np.mean(differences**2) / 6.0)),
    )


def encoder_step(angle: Array) -> float:
    """The step (rad) of the encoder that angles (n,) come from; 0 if they don't show one."""
    distinct = np.unique(angle)
    if len(distinct) > 0.5 * len(angle):
        return 0.0
    apart = np.diff(distinct)
    step = float(np.median(apart))
    off = np.abs(apart / step - np.round(apart / step))
    return step if np.mean(off < 0.1) > 0.9 else 0.0


def lost_after_reversal(leading: Sequence[Array], trailing: Sequence[Array]) -> float:
    """How much less one end moves than the other in an eighth of the motion after that turned back.

    Of angles (n,) of each run. Near 0 if the trailing end follows at once, 1 if it stands. An end
    that drives has turned before the other one does: taken the wrong way round, it is near 0.
    """
    ratios = [
        (after[last] - after[first]) / (before[last] - before[first])
        for before, after in zip(leading, trailing, strict=True)
        for first, last in _after_reversals(before)
    ]
    return 1.0 - float(np.median(ratios)) if ratios else 0.0


def swapped(runs: Sequence[Run]) -> bool:
    """Whether motion is lost on the way from the link to the motor, and not the other way."""
    motors, links = [run.motor for run in runs], [run.link for run in runs]
    there, back = lost_after_reversal(motors, links), lost_after_reversal(links, motors)
    return back > _MUCH_LOST and back > 2.0 * there


def _after_reversals(motor: Array) -> list[tuple[int, int]]:
    """Where it turned back, and where it had then moved far enough to be sure of it."""
    reach = np.ptp(motor) / 8.0
    found, turned, sense = [], 0, 0.0
    for k in range(len(motor)):
        moved = motor[k] - motor[turned]
        if sense == 0.0:
            sense = float(np.sign(moved)) if abs(moved) > reach else 0.0
            turned = k if sense else turned
        elif moved * sense >= 0.0:
            turned = k
        elif abs(moved) > reach:
            found.append((turned, k))
            turned, sense = k, -sense
    return found


def _time(table: TextTable, columns: ColumnMap, motor: Array) -> Array:
    count = len(table.rows)
    if columns.t is None:
        assert columns.rate_hz is not None
        return np.arange(count) / columns.rate_hz
    time = table.require(columns.t)
    steps = np.diff(time)
    if np.any(steps <= 0.0):
        at = int(np.argmax(steps <= 0.0)) + 1
        raise TableError(
            f"{table.path}: line {table.lines[at]}: the time {time[at]:g} in column {columns.t!r} "
            f"does not come after {time[at - 1]:g}"
        )
    usual = float(np.median(steps))
    if np.any(steps > _LONGEST_GAP * usual):
        at = int(np.argmax(steps > _LONGEST_GAP * usual)) + 1
        raise TableError(
            f"{table.path}: line {table.lines[at]}: {steps[at - 1]:g} after the reading before it, "
            f"where {usual:g} is usual: a gap cuts what the joint remembers; split the file there"
        )
    if columns.time_scale_s is None and usual * MOST_READINGS_HZ < 1.0:
        fastest = np.abs(np.diff(motor)).sum() / (time[-1] - time[0])
        raise TableError(
            f"{table.path}: column {columns.t!r} steps by {usual:g}; in seconds that were "
            f"{1.0 / usual:.0f} readings a second, and {fastest:.3g} rad/s on average: give "
            "--time-scale, the seconds a unit of this column"
        )
    return time * (columns.time_scale_s or 1.0)
