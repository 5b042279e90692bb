# SPDX-License-Identifier: Apache-2.0
"""The rule of rest, and how it is applied.

The arm is at rest while no joint goes further in a window than its limit of speed allows, beside
steps of its encoder: one step of 5e-5 rad between two samples, 2 ms apart, would be 0.025 rad/s.
The wrench is steady while it changes from window to window by no more than its noise makes it.

The forms differ in what they see and in what they must say, and so in windows and limits:

- `segments`: rows of a recording, by joints or by gravity's direction alone. No wrench: a recording
  of a calibration holds contacts that the estimator has to see.
- `binned`: time bins of hours of a compensated wrench, the noise known from the whole recording.
- `windows`: a live stream, sample by sample, the noise learned from what came before. A segment
  can't be looked back into, so that windows are of one length and begin where the arm came to rest.
- `PoseRecord`, also here: one averaged pose, compared with the other poses of its sweep. A contact,
  a swinging cable or a stepping joint shows in one of three ways: the joints move in the window,
  the wrench scatters more than in the other poses, or its halves have different means. A steady
  push looks still here; the estimator's outlier test is for that.

By joints: a joint's range is taken over blocks of half a window, and the arm is at rest where, over
each two blocks that follow one another, no joint goes further than `allowed_travel`. Blocks
lie on multiples of half a window of the stamps, so that segments don't depend on where a recording
begins, and one read in parts has the same blocks as one read as a whole.

By gravity's direction in the sensor, of a table that has no joints: the arm is at rest while that
turns slower than a limit, but for a rim at both ends, where the arm still rings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arm.galen import SENSOR, WRENCH_AXES
from galen_model.arrays import Array, runs


def allowed_travel(max_speed: Any, window_s: float, quantum: Any, steps: float = 1.0) -> Any:
    """Compute how far a joint at rest may go in a window.

    A range over many samples holds a step of the encoder at both of its ends: steps = 2.

    Args:
        max_speed: of one joint or of each (n,), m/s or rad/s.
        window_s: length of the window.
        quantum: step of the encoder, one or of each joint (n,), m or rad.
        steps: how many of the encoder's steps are allowed beside the speed.

    Returns:
        Travel, m or rad, in the shape of `max_speed` and `quantum`.

    """
    return max_speed * window_s + steps * quantum


_NS = 1_000_000_000
_SPEED = (5e-4, 2e-3)  # m/s, rad/s
ENCODER_STEP = (5e-6, 5e-5)
"""Of prismatic joints, m, and of revolute ones, rad."""


@dataclass(frozen=True)
class JointRest:
    """When the arm is at rest. Joints in the arm's order, m and rad.

    max_speed (n,): m/s and rad/s, over `window_s`; quantum (n,): of the encoders; None: what is
    usual of prismatic and revolute joints. A segment shorter than `min_duration_s` is none;
    a step of the stamps backward or longer than `max_stamp_step_s` ends a segment.
    """

    max_speed: Array | None = None
    quantum: Array | None = None
    window_s: float = 0.1
    min_duration_s: float = 0.5
    max_stamp_step_s: float = 0.25


@dataclass(frozen=True)
class DirectionRest:
    """When gravity's direction is at rest; `rim_s` is cut off at both ends."""

    max_rate_rad_s: float = 0.01
    rim_s: float = 0.5
    min_duration_s: float = 2.0


def rest_by_joints(
    stamp_ns: np.ndarray,
    joints: Array,
    settings: JointRest | None = None,
    *,
    arm: Arm,
) -> list[slice]:
    """Find the rest segments of a recording by its joints.

    A row that is not finite counts as motion; a joint of which no row is finite does not count.
    Inside a segment the stamps never go back, and where they repeat, the rows belong to it all the
    same.

    Args:
        stamp_ns: (n,) in the order received.
        joints: (n, d) of the arm, m and rad.
        settings: limits; None: the defaults.
        arm: whose joints they are, for the limits that the settings leave open.

    Returns:
        Rows of each segment, in order.

    """
    settings = settings or JointRest()
    known = np.isfinite(joints).any(axis=0)
    if len(stamp_ns) < 2 or not known.any():
        return []
    max_speed = arm.by_unit(*_SPEED) if settings.max_speed is None else settings.max_speed
    quantum = arm.by_unit(*ENCODER_STEP) if settings.quantum is None else settings.quantum
    block_ns = max(1, round(settings.window_s * _NS / 2))
    step_ns = np.diff(stamp_ns)
    jumps = (step_ns < 0) | (step_ns > round(settings.max_stamp_step_s * _NS))
    starts = np.flatnonzero(np.concatenate([[True], jumps | (np.diff(stamp_ns // block_ns) != 0)]))
    joined = ~jumps[starts[1:] - 1]  # whether a block goes on from the one before it
    low = np.minimum.reduceat(joints[:, known], starts, axis=0)
    high = np.maximum.reduceat(joints[:, known], starts, axis=0)
    span = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1])
    allowed = allowed_travel(max_speed, settings.window_s, quantum)
    at_rest = joined & np.all(span <= allowed[known], axis=1)  # of a block and its next one

    ends = np.concatenate([starts[1:], [len(stamp_ns)]])
    least_ns = round(settings.min_duration_s * _NS)
    segments = [slice(int(starts[first]), int(ends[last])) for first, last in runs(at_rest)]
    return [s for s in segments if stamp_ns[s.stop - 1] - stamp_ns[s.start] >= least_ns]


def rest_by_direction(
    time: Array, gravity_sensor: Array, settings: DirectionRest | None = None
) -> list[slice]:
    """Find the rest segments of a table by gravity's direction alone.

    Args:
        time: (n,), s, increasing.
        gravity_sensor: (n, 3) along the sensor's axes, of any length but zero.
        settings: limits; None: the defaults.

    Returns:
        Rows of each segment, in order, without the rims.

    """
    settings = settings or DirectionRest()
    if len(time) < 2:
        return []
    direction = gravity_sensor / np.linalg.norm(gravity_sensor, axis=1, keepdims=True)
    # A chord is shorter than the arc, by nothing that matters at such angles.
    rate = np.linalg.norm(np.diff(direction, axis=0), axis=1) / np.diff(time)
    segments = []
    for start, stop in runs(np.concatenate([[True], rate <= settings.max_rate_rad_s])):
        inside = (time[start:stop] >= time[start] + settings.rim_s) & (
            time[start:stop] <= time[stop - 1] - settings.rim_s
        )
        rows = start + np.flatnonzero(inside)
        if len(rows) and time[rows[-1]] - time[rows[0]] >= settings.min_duration_s:
            segments.append(slice(int(rows[0]), int(rows[-1]) + 1))
    return segments


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
    stamp_ns: int = 0  # middle of the window
    temperature_c: float = math.nan  # of the sensor, where it is known

    @property
    def std_of_mean(self) -> Array:
        """Standard deviation of `wrench` (6,) for independent samples."""
        std: Array = self.wrench_std / np.sqrt(self.samples)
        return std


def average_pose(joints: Array, wrenches: Array, stamp_ns: int = 0) -> PoseRecord:
    """Average joint states and wrenches of one pose.

    The std is never less than that of rounding to the sensor's quantum (quantum / sqrt 12), so
    that a reading that sits on one step isn't taken for one without error.

    Args:
        joints: joint states (m, d), m and rad.
        wrenches: (n, 6) in ft_sensor, N and N.m, n >= 4.
        stamp_ns: middle of the window.

    Returns:
        Means, spans and scatter.

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
        stamp_ns=stamp_ns,
    )


def joint_motion_fault(record: PoseRecord, settings: StillnessSettings, arm: Arm) -> str:
    """Name the joints that moved inside the window.

    Args:
        record: the pose.
        settings: largest span of each joint.
        arm: whose joint names and units go into the text.

    Returns:
        A clause for each joint that moved; empty when none did.

    """
    moved = np.flatnonzero(record.joint_span > settings.joint_motion)
    return "; ".join(
        f"{arm.joint_names[k]} moved by {record.joint_span[k]:.2g} {arm.units[k]} while averaging"
        for k in moved
    )


def wrench_fault(
    record: PoseRecord, sweep: Sequence[PoseRecord], settings: StillnessSettings
) -> str:
    """Name the axis in which the wrench was less still than in the sweep's poses.

    The medians over the sweep forgive up to half of its poses being touched. The noise of the
    halves' difference is the larger of 2 std / sqrt(n), true for white noise, and of what the
    sweep's own differences show, true for a filtered or drifting sensor. The limit of the scatter
    is never so low that the std of few samples, whose own relative error is 1 / sqrt(2 (n - 1)),
    would cross it by chance.

    Args:
        record: the pose to judge.
        sweep: records to compare with, `record` among them.
        settings: limits of scatter and trend.

    Returns:
        A clause on the worst axis; empty when none is beyond its limit.

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
