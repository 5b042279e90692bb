"""What a lag is made of: columns of a joint's torque and of its motor's motion up to now.

    lag = offset + gear error x motor + delay x velocity                         (rigid)
        + c x torque + sum_i w_i play_i(torque)                                  (it deflects)
        + f x direction + sum_j u_j (motor - play_j(motor)),   c, w_i, u_j >= 0  (it loses motion)

The plays of the torque are `galen_model.transmission.play`'s: a spring with dry friction.
What a play of the motor's motion leaves behind, motor - play(motor), is a gap of backlash if one
has the weight 1, and a gap that friction closes bit by bit if there are several (of Maxwell-slip
elements, in the motion, each gives that). The link's angle is in none of them.

Direction is tanh(v / v0), by default with v0 a twentieth of the fast motion's velocity: at
standstill nothing of it is left. The velocity is the slope at the end of a parabola through the
last `window_s` of the motor's angle: it looks at nothing that comes later, and does not lag in even
acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from galen_model.arrays import Array
from galen_model.transmission.joint_run import JointRun
from galen_model.transmission.play import PlayOperators

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
        """From the used readings, booleans (n,) of each run; `direction_rad_s`: v0, if given."""
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
    """All terms (n, len(TERMS)) of a run, from a start that is unloaded and amid the gap.

    A lag in rad is what their weights give: the offset's, rad; gear's, direction's and plays' of
    the motion, rad or 1; the delay's, s; spring's and plays' of the torque, rad/N.m.
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
    """The motor's velocity (n,), rad/s, from readings up to each and none after it."""
    count = max(4, round(window_s / run.step_s) + 1)
    back = -run.step_s * np.arange(count)  # newest first
    slope = np.linalg.pinv(np.stack([np.ones(count), back, back**2], axis=1))[1]
    found = np.asarray(lfilter(slope, [1.0], run.motor))
    # too few readings for a parabola yet: a line from the first one
    first = np.arange(min(count - 1, len(run)))
    found[first] = (run.motor[first] - run.motor[0]) / (run.step_s * np.maximum(first, 1))
    return found


def _spread(values: Array) -> float:
    """The range of all but the outermost hundredths: a start's jerk is no measure of a run."""
    low, high = np.percentile(values, [1.0, 99.0])
    return float(high - low) or 1.0
