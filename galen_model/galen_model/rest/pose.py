"""Judge whether the arm, and the wrench, were still while a pose was averaged.

A touch, a swinging cable or a stepping joint shows in one of three ways: the joints move inside
the window, the wrench scatters more than in the sweep's other poses, or its first and second half
have different means. A steady push looks still here; the estimator's outlier test is for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, SENSOR, WRENCH_AXES
from galen_model.arrays import Array

# Median of |x| of a normal deviate with standard deviation 1.
_MEDIAN_OF_ABS_NORMAL = 0.67449


@dataclass(frozen=True)
class StillnessSettings:
    """Limits for one averaged pose."""

    joint_motion: Array  # (n,) largest span of each joint inside the window, m and rad
    scatter_ratio: float  # largest std, in units of the sweep's median std
    trend_sigmas: float  # largest difference of the halves' means, in its standard deviations;
    # also of the scatter's own statistical error
    min_samples: int  # of wrenches, and of joint states a tenth of it


@dataclass(frozen=True)
class PoseRecord:
    """Joints and wrench of one pose, averaged over a window."""

    joints: Array  # (n,) mean, m and rad
    joint_span: Array  # (n,) largest less smallest
    wrench: Array  # (6,) mean in ft_sensor, N and N.m
    wrench_std: Array  # (6,) of one sample, at least the quantum's
    half_difference: Array  # (6,) mean of the second half less that of the first
    samples: int

    @property
    def std_of_mean(self) -> Array:
        """Standard deviation of `wrench` (6,) for independent samples."""
        std: Array = self.wrench_std / np.sqrt(self.samples)
        return std


def average_pose(joints: Array, wrenches: Array) -> PoseRecord:
    """Average joint states (m, n) and wrenches (n, 6); n >= 4.

    The std is never less than that of rounding to the sensor's quantum (quantum / sqrt 12), so
    that a reading that sits on one step isn't taken for one without error.
    """
    half = len(wrenches) // 2
    rounding = SENSOR.quantum / np.sqrt(12.0)
    return PoseRecord(
        joints=joints.mean(axis=0),
        joint_span=np.ptp(joints, axis=0),
        wrench=wrenches.mean(axis=0),
        wrench_std=np.maximum(wrenches.std(axis=0, ddof=1), rounding),
        half_difference=wrenches[-half:].mean(axis=0) - wrenches[:half].mean(axis=0),
        samples=len(wrenches),
    )


def joint_motion_fault(record: PoseRecord, settings: StillnessSettings, arm: Arm = GALEN) -> str:
    """Name the joints that moved inside the window; empty when none did."""
    moved = np.flatnonzero(record.joint_span > settings.joint_motion)
    return "; ".join(
        f"{arm.joint_names[k]} moved by {record.joint_span[k]:.2g} {arm.units[k]} while averaging"
        for k in moved
    )


def wrench_fault(
    record: PoseRecord, sweep: Sequence[PoseRecord], settings: StillnessSettings
) -> str:
    """Say in which axis the wrench was less still than in the sweep's poses; empty when in none.

    `sweep` holds the records to compare with, `record` among them: their medians forgive up to
    half of them being touched. The noise of the halves' difference is the larger of
    2 std / sqrt(n), true for white noise, and of what the sweep's own differences show, true for
    a filtered or drifting sensor. The limit of the scatter is never so low that the std of few
    samples, whose own relative error is 1 / sqrt(2 (n - 1)), would cross it by chance.
    """
    std = np.median([r.wrench_std for r in sweep], axis=0)
    white = 2.0 * std / np.sqrt(record.samples)
    seen = np.median(np.abs([r.half_difference for r in sweep]), axis=0) / _MEDIAN_OF_ABS_NORMAL
    scatter = record.wrench_std / std
    trend = np.abs(record.half_difference) / np.maximum(white, seen)
    k = int(np.argmax(scatter))
    chance = 1.0 + settings.trend_sigmas / np.sqrt(2.0 * (record.samples - 1))
    if scatter[k] > max(settings.scatter_ratio, chance):
        return f"{WRENCH_AXES[k]} scattered {scatter[k]:.1f} times as much as in the other poses"
    k = int(np.argmax(trend))
    if trend[k] > settings.trend_sigmas:
        change, unit = record.half_difference[k], "N" if k < 3 else "N.m"
        return f"{WRENCH_AXES[k]} changed by {change:+.2g} {unit} while averaging"
    return ""
