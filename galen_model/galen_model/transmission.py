# SPDX-License-Identifier: Apache-2.0
"""Readings of one joint, what its lag is made of, and which readings are held out.

The lag is the motor's angle, over its gear, less the link's, both in the motor's sense.

    lag = offset + gear error x motor + delay x velocity                         (rigid)
        + c x torque + sum_i w_i play_i(torque)                                  (it deflects)
        + f x direction + sum_j u_j (motor - play_j(motor)),   c, w_i, u_j >= 0  (it loses motion)

The plays of the torque are `galen_model.play`'s: a spring with dry friction.
What a play of the motor's motion leaves behind, motor - play(motor), is a gap of backlash if one
has the weight 1, and a gap that friction closes bit by bit if there are several (of Maxwell-slip
elements, in the motion, each gives that). The link's angle is in none of them.

Direction is tanh(v / v0), by default with v0 a twentieth of the fast motion's velocity: at
standstill nothing of it is left. The velocity is the slope at the end of a parabola through the
last `window_s` of the motor's angle: it looks at nothing that comes later, and does not lag in even
acceleration.

**Parts.** Which readings of a joint's runs are fitted to, and which are checked. Never by the
sample.

All readings belong to parts: a run is one, or, where runs are few, a block of time in it. What a
part is checked with has seen nothing of its lag; the torque and the motor's motion in it still
count for what the joint remembers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used

from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.play import PlayOperators

_MUCH_LOST = 0.1


class LagNoise(NamedTuple):
    """What no model can predict of the lag, rad: steps of both encoders, noise in time."""

    motor_step: float
    link_step: float
    quantisation: float
    jitter: float

    @property
    def floor(self) -> float:
        """The larger of the two; each holds some of the other."""
        return max(self.quantisation, self.jitter)


@dataclass(frozen=True)
class JointRun:
    """A recording (n,): time_s, increasing in even steps; motor, link (rad), torque (N.m).

    All at the joint and in the motor's sense: gears are taken out.
    """

    name: str
    time_s: Array
    motor: Array
    link: Array
    torque: Array

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.time_s)

    @property
    def lag(self) -> Array:
        """Motor's angle less the link's (n,), rad."""
        return self.motor - self.link

    @property
    def step_s(self) -> float:
        """Between two readings."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self) - 1)


def noise_of(runs: Sequence[JointRun]) -> LagNoise:
    """Estimate the noise from all runs: encoders' steps, if seen, and the lag's second differences.

    White noise s has second differences of sqrt(6) s; what the lag itself does from one reading to
    the next is small beside it. Steps s of an encoder leave s / sqrt(12).

    Args:
        runs: all recordings of one joint.

    Returns:
        Steps and standard deviations of the lag, rad.

    """
    motor = max(encoder_step(run.motor) for run in runs)
    link = max(encoder_step(run.link) for run in runs)
    differences = np.concatenate([np.diff(run.lag, 2) for run in runs])
    return LagNoise(
        motor,
        link,
        quantisation=float(np.hypot(motor, link) / np.sqrt(12.0)),
        jitter=float(np.sqrt(np.mean(differences**2) / 6.0)),
    )


def encoder_step(angle: Array) -> float:
    """Find the step of the encoder that angles come from.

    Args:
        angle: (n,), rad.

    Returns:
        The step, rad; 0 if the angles don't show one.

    """
    distinct = np.unique(angle)
    if not 1 < len(distinct) <= 0.5 * len(angle):
        return 0.0
    apart = np.diff(distinct)
    step = float(np.median(apart))
    off = np.abs(apart / step - np.round(apart / step))
    return step if np.mean(off < 0.1) > 0.9 else 0.0


def lost_after_reversal(leading: Sequence[Array], trailing: Sequence[Array]) -> float:
    """Compute the share of motion that the trailing end lacks after a reversal.

    Over an eighth of the motion after the leading end turned back. An end that drives has turned
    before the other one does: taken the wrong way round, the share is near 0.

    Args:
        leading: of each run, angles (n,) of the end that is taken to drive, rad.
        trailing: of each run, angles (n,) of the other end, rad.

    Returns:
        Median over the reversals: near 0 if the trailing end follows at once, 1 if it stands; 0 if
        there is no reversal.

    """
    ratios = [
        (after[last] - after[first]) / (before[last] - before[first])
        for before, after in zip(leading, trailing, strict=True)
        for first, last in _after_reversals(before)
    ]
    return 1.0 - float(np.median(ratios)) if ratios else 0.0


def swapped(runs: Sequence[JointRun]) -> bool:
    """Check whether motion is lost from the link to the motor, and not the other way.

    Args:
        runs: all recordings of one joint.

    Returns:
        Whether the columns of motor and link look exchanged.

    """
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


Used = list[np.ndarray]
"""Of each run, which readings (n,) bool."""


@dataclass(frozen=True)
class Parts:
    """The parts (p,) of some runs.

    label: of each run, the part (n,) of its readings. apart (p, p) bool: [k, j] says that a model
    that is checked on part k may be fitted to part j.
    """

    names: tuple[str, ...]
    label: tuple[np.ndarray, ...]
    apart: np.ndarray
    whole_runs: bool

    def rows(self, parts: Sequence[int]) -> Used:
        """Find the readings of some parts.

        Args:
            parts: numbers of parts.

        Returns:
            Of each run, the mask (n,) of its readings that belong to them.

        """
        return [np.isin(label, parts) for label in self.label]

    def trained_on(self, part: int) -> list[int]:
        """List the parts that a model may be fitted to that is checked on a given one.

        Args:
            part: number of the part that is held out.

        Returns:
            Numbers of the other parts.

        """
        return np.flatnonzero(self.apart[part]).tolist()


def whole_runs(runs: Sequence[JointRun], unlike: str | None = None) -> Parts:
    """Make each run a part.

    Args:
        runs: recordings of one joint.
        unlike: regular expression with groups for the runs' names; one run may train for another
            only where all their groups differ. None: all runs train for each other.

    Returns:
        As many parts as runs, with the runs' names.

    Raises:
        GalenError: there are fewer than three runs, a run has fewer than two others to train on, or
            `unlike` is no regular expression or finds no groups in a name.

    """
    if len(runs) < 3:
        raise GalenError(f"{len(runs)} runs: to hold out whole ones takes three; hold out blocks")
    groups = [_groups(run.name, unlike) for run in runs]
    apart = np.array([[all(a != b for a, b in zip(x, y, strict=True)) for y in groups]
                      for x in groups])  # fmt: skip
    np.fill_diagonal(apart, False)
    for run, others in zip(runs, apart, strict=True):
        if others.sum() < 2:
            raise GalenError(
                f"run {run.name}: {int(others.sum())} runs differ from it in every group of "
                f"{unlike!r}; two are needed to fit a model that it checks"
            )
    label = tuple(np.full(len(run), k) for k, run in enumerate(runs))
    return Parts(tuple(run.name for run in runs), label, apart, whole_runs=True)


def time_blocks(runs: Sequence[JointRun], count: int) -> Parts:
    """Cut each run into equal blocks of time; the same block of all runs is a part.

    Args:
        runs: recordings of one joint.
        count: blocks of each, at least 3.

    Returns:
        `count` parts, each checked with all others as training.

    Raises:
        GalenError: fewer than three blocks are asked for.

    """
    if count < 3:
        raise GalenError(f"{count} blocks: at least three are needed")
    label = tuple(np.arange(len(run)) * count // len(run) for run in runs)
    names = tuple(f"block {k + 1} of {count}" for k in range(count))
    return Parts(names, label, ~np.eye(count, dtype=bool), whole_runs=False)


def _groups(name: str, unlike: str | None) -> tuple[str, ...]:
    if unlike is None:
        return (name,)
    try:
        pattern = re.compile(unlike)
    except re.error as error:
        raise GalenError(f"{unlike!r} is no regular expression: {error}") from error
    found = pattern.search(name)
    if found is None or not pattern.groups or None in found.groups():
        raise GalenError(f"run {name}: {unlike!r} finds no groups in its name")
    return found.groups()


FREE = ("offset", "gear", "delay", "direction")
"""Terms of any sign; all others are none below zero."""

COMMON = ("gear", "delay")
"""Terms that the caller may give to all models."""

TORQUE_GRID = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8)
"""Thresholds of plays over half of the torque's range."""
MOTION_GRID = (0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.2)
"""Thresholds of plays of the motion over half of the lag's range."""

DIRECTION_SHARE = 0.05


@dataclass(frozen=True)
class Scales:
    """What the terms need to know of the runs that a model is fitted to; rad, N.m, rad/s."""

    motor_middle: float
    torque_half_range: float
    lag_half_range: float
    direction_rad_s: float
    window_s: float

    @classmethod
    def of(
        cls,
        runs: Sequence[JointRun],
        used: Sequence[np.ndarray],
        window_s: float,
        direction_rad_s: float | None = None,
    ) -> Scales:
        """Compute the scales from the used readings.

        Args:
            runs: recordings of one joint.
            used: of each run, the mask (n,) of its readings that count.
            window_s: length of the velocity's window.
            direction_rad_s: v0; None: DIRECTION_SHARE of the 95th percentile of the used speeds.

        Returns:
            Scales at the joint, in the motor's sense.

        """
        motor = np.concatenate([run.motor[some] for run, some in zip(runs, used, strict=True)])
        torque = np.concatenate([run.torque[some] for run, some in zip(runs, used, strict=True)])
        lag = np.concatenate([run.lag[some] for run, some in zip(runs, used, strict=True)])
        speed = np.concatenate(
            [np.abs(velocity(run, window_s)[some]) for run, some in zip(runs, used, strict=True)]
        )
        return cls(
            motor_middle=float(motor.mean()),
            torque_half_range=0.5 * _spread(torque),
            lag_half_range=0.5 * _spread(lag),
            direction_rad_s=DIRECTION_SHARE * float(np.percentile(speed, 95.0))
            if direction_rad_s is None
            else direction_rad_s,
            window_s=window_s,
        )

    @property
    def torque_thresholds(self) -> Array:
        """Of TORQUE_GRID, N.m."""
        return np.array(TORQUE_GRID) * self.torque_half_range

    @property
    def motion_thresholds(self) -> Array:
        """Of MOTION_GRID, rad."""
        return np.array(MOTION_GRID) * self.lag_half_range


TORQUE_PLAYS = tuple(f"torque_play_{k}" for k in range(len(TORQUE_GRID)))
MOTION_PLAYS = tuple(f"motion_play_{k}" for k in range(len(MOTION_GRID)))
TERMS = (*FREE, "spring", *TORQUE_PLAYS, *MOTION_PLAYS)
"""Names of all terms, in the order of `design`'s columns."""


def design(run: JointRun, scales: Scales) -> Array:
    """Compute all terms of a run, from a start that is unloaded and amid the gap.

    Args:
        run: recording of one joint.
        scales: of the runs that the model is fitted to.

    Returns:
        Columns (n, len(TERMS)). A lag in rad is what their weights give: the offset's, rad; gear's,
        direction's and plays' of the motion, rad or 1; the delay's, s; spring's and plays' of the
        torque, rad/N.m.

    """
    speed = velocity(run, scales.window_s)
    torque = np.repeat(run.torque[:, None], len(TORQUE_GRID), axis=1)
    motion = np.repeat((run.motor - run.motor[0])[:, None], len(MOTION_GRID), axis=1)
    thresholds = np.concatenate([scales.torque_thresholds, scales.motion_thresholds])
    played = PlayOperators(thresholds).run(np.hstack([torque, motion])).output
    return np.column_stack(
        [
            np.ones(len(run)),
            run.motor - scales.motor_middle,
            speed,
            np.tanh(speed / scales.direction_rad_s),
            run.torque,
            played[:, : len(TORQUE_GRID)],
            motion - played[:, len(TORQUE_GRID) :],
        ]
    )


def velocity(run: JointRun, window_s: float) -> Array:
    """Estimate the motor's velocity from readings up to each and none after it.

    Args:
        run: recording of one joint.
        window_s: length of the parabola, at least four readings.

    Returns:
        Velocity (n,), rad/s, at the joint.

    """
    count = max(4, round(window_s / run.step_s) + 1)
    back = -run.step_s * np.arange(count)  # newest first
    slope = np.linalg.pinv(np.stack([np.ones(count), back, back**2], axis=1))[1]
    found = np.asarray(scipy.signal.lfilter(slope, [1.0], run.motor))
    # too few readings for a parabola yet: a line from the first one
    first = np.arange(min(count - 1, len(run)))
    found[first] = (run.motor[first] - run.motor[0]) / (run.step_s * np.maximum(first, 1))
    return found


def _spread(values: Array) -> float:
    """Return the range of all but the outermost hundredths."""
    low, high = np.percentile(values, [1.0, 99.0])
    return float(high - low) or 1.0
