"""Readings of one joint: two angles and a torque; steps and noise of its encoders.

The lag is the motor's angle, over its gear, less the link's, both in the motor's sense.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from galen_model.arrays import Array

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


def noise_of(runs: Sequence[JointRun]) -> LagNoise:
    """From all runs: steps of the encoders, if they are seen, and the lag's second differences.

    White noise s has second differences of sqrt(6) s; what the lag itself does from one reading to
    the next is small beside it. Steps s of an encoder leave s / sqrt(12).
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
    """The step (rad) of the encoder that angles (n,) come from; 0 if they don't show one."""
    distinct = np.unique(angle)
    if len(distinct) > 0.5 * len(angle):
        return 0.0
    apart = np.diff(distinct)
    step = float(np.median(apart))
    off = np.abs(apart / step - np.round(apart / step))
    return step if np.mean(off < 0.1) > 0.9 else 0.0


def lost_after_reversal(leading: Sequence[Array], trailing: Sequence[Array]) -> float:
    """Return the share of motion that the trailing end lacks after a reversal.

    Over an eighth of the motion after the leading end turned back; angles (n,) of each run. Near 0
    if the trailing end follows at once, 1 if it stands. An end that drives has turned before the
    other one does: taken the wrong way round, it is near 0.
    """
    ratios = [
        (after[last] - after[first]) / (before[last] - before[first])
        for before, after in zip(leading, trailing, strict=True)
        for first, last in _after_reversals(before)
    ]
    return 1.0 - float(np.median(ratios)) if ratios else 0.0


def swapped(runs: Sequence[JointRun]) -> bool:
    """Whether motion is lost from the link to the motor, and not the other way."""
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
