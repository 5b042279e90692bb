"""The rules by which a sample is out of line, for one sample and for many.

Both forms of a rule stand side by side, so that pushing arrays can't decide otherwise than pushing
one sample at a time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

# A torque this many times beyond the sensor's range is no overload but another unit.
TORQUE_UNIT_FACTOR = 20.0
ANGLE_UNIT_LIMIT_RAD = 2.0 * math.pi
# No arm turns so fast: 0.4 rad between two samples at 500 Hz.
JOINT_JUMP_RAD_S = 200.0
# No wrench comes near it; six such numbers still have a finite sum.
_LARGEST = 1e300
# Of the range; a multiple of the sensor's quantum may come out below it by rounding.
_AT_RANGE = 1.0 - 1e-9


@dataclass(frozen=True)
class SampleLimits:
    """Limits in ns of the samples' stamps; range (6,) in N and N.m."""

    max_age_ns: int
    restart_gap_ns: int
    max_waiting: int
    sensor_range: tuple[float, ...]

    def restarted(self, topic: str, stamp_ns: int, newest_ns: int) -> str:
        """Text when the stamp after the newest one tells of a restart, else empty."""
        step_ns = stamp_ns - newest_ns
        if step_ns < -self.max_age_ns:
            return f"driver restarted: {topic} stamps jumped back by {-step_ns * 1e-9:.3f} s"
        if step_ns > self.restart_gap_ns:
            # Or a node between switched off and on, or one that stood still and lost the oldest.
            return (
                "driver restarted, or messages are lacking:"
                f" {topic} stamps jumped ahead by {step_ns * 1e-9:.3f} s"
            )
        return ""

    def regular_steps(self, stamp_ns: np.ndarray, newest_ns: int | None) -> np.ndarray:
        """Which stamps (n,) are later than the one before by no more than a restart's gap.

        The first one is compared with `newest_ns`; None: with nothing.
        """
        regular = np.ones(len(stamp_ns), dtype=bool)
        if len(stamp_ns):
            if newest_ns is not None:
                regular[0] = 0 < int(stamp_ns[0]) - newest_ns <= self.restart_gap_ns
            steps = np.diff(stamp_ns)
            regular[1:] = (steps > 0) & (steps <= self.restart_gap_ns)
        return regular

    def range_notices(self, wrench: Sequence[float]) -> tuple[bool, bool]:
        """Whether a wrench (6,) is at the sensor's range or beyond, and its torque of another unit.

        A sensor that clips reads its range itself.
        """
        limits = self.sensor_range
        worst_torque = max(
            abs(value) / limit for value, limit in zip(wrench[3:], limits[3:], strict=True)
        )
        beyond = worst_torque >= _AT_RANGE or any(
            abs(value) >= _AT_RANGE * limit
            for value, limit in zip(wrench[:3], limits[:3], strict=True)
        )
        return beyond, worst_torque > TORQUE_UNIT_FACTOR

    def count_range_notices(self, wrenches: Array) -> tuple[int, int]:
        """How many of the wrenches (n, 6) `range_notices` tells of."""
        sizes, limits = np.abs(wrenches), np.array(self.sensor_range)
        worst_torque = (sizes[:, 3:] / limits[3:]).max(axis=1, initial=0.0)
        beyond = worst_torque >= _AT_RANGE
        beyond |= (sizes[:, :3] >= _AT_RANGE * limits[:3]).any(axis=1)
        return int(beyond.sum()), int((worst_torque > TORQUE_UNIT_FACTOR).sum())


def joint_jump(step_ns: int, step_rad: float) -> bool:
    """Whether roll or tilt can't have turned by so much between two samples."""
    return step_rad > JOINT_JUMP_RAD_S * 1e-9 * step_ns


def joint_jumps(step_ns: np.ndarray, steps_rad: Array) -> np.ndarray:
    """Which of the steps `joint_jump` tells of: (n,) and (n, 2)."""
    return np.asarray(np.abs(steps_rad).max(axis=1) > JOINT_JUMP_RAD_S * 1e-9 * step_ns)


def angle_unit_notice(roll_rad: float, tilt_rad: float) -> bool:
    """Whether finite angles look like degrees."""
    return max(abs(roll_rad), abs(tilt_rad)) > ANGLE_UNIT_LIMIT_RAD


def count_angle_unit_notices(angles: Array) -> int:
    """How many of the angles (n, 2) `angle_unit_notice` tells of."""
    return int((np.abs(angles) > ANGLE_UNIT_LIMIT_RAD).any(axis=1).sum())


def surely_finite(wrenches: Array) -> np.ndarray:
    """Which of the wrenches (n, 6) have a finite sum for certain; absurdly large ones don't."""
    return np.asarray((np.abs(wrenches) <= _LARGEST).all(axis=1))
