# SPDX-License-Identifier: Apache-2.0
"""What becomes of samples: rejections and notices, the rules behind them, recent joints.

The rules by which a sample is out of line stand here for one sample and for many, so that pushing
arrays can't decide otherwise than pushing one sample at a time.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
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


class Rejection(Enum):
    """Why a wrench was not used."""

    DISABLED = "disabled"
    NO_TOOL = "no_tool"
    WRONG_FRAME = "wrong_frame"
    SEVERAL_PUBLISHERS = "several_publishers"  # whose of them is it?
    FROZEN = "frozen_wrench"  # the sensor hangs
    UNREADABLE = "unreadable"  # not even a message
    UNSTAMPED = "unstamped"
    DUPLICATE = "duplicate_stamp"
    NONFINITE_WRENCH = "nonfinite_wrench"
    NO_JOINTS = "no_joints"
    STALE_JOINTS = "stale_joints"
    BAD_JOINTS = "bad_joints"  # only unusable joint messages came, e.g. with unknown names
    NONFINITE_JOINTS = "nonfinite_joints"
    JUMPING_JOINTS = "jumping_joints"  # faster than any arm turns
    QUEUE_FULL = "queue_full"
    UNITS = "implausible_units"  # of the wrench or the joints
    WRONG_SETUP = "wrong_setup"  # readings at rest contradict it
    NOT_VERIFIED = "setup_not_verified"  # and no reading at rest has fitted yet
    NO_MOTION = "no_motion"  # inertial forces are asked for and not known at the stamp
    RESTART = "restart"  # was waiting for joints when the driver restarted


class Notice(Enum):
    """What was noticed without a rejection of the wrench."""

    OUT_OF_ORDER_WRENCH = "out_of_order_wrench"
    OUT_OF_ORDER_JOINTS = "out_of_order_joints"
    DUPLICATE_JOINTS = "duplicate_joints"
    NONFINITE_JOINTS = "nonfinite_joint_samples"
    BAD_JOINTS = "bad_joint_messages"
    JOINT_JUMP = "joint_jumps"
    BEYOND_RANGE = "beyond_sensor_range"
    TORQUE_UNIT = "torque_looks_like_N_mm"
    ANGLE_UNIT = "angles_look_like_degrees"
    RESTART = "restarts"


class PairedWrench(NamedTuple):
    """A finite wrench (6,), N and N.m, with finite joints at its stamp, m and rad.

    tag: as it was pushed; number: of the wrench in the order of arrival, from 0.
    """

    stamp_ns: int
    wrench: Array
    joints: tuple[float, ...]
    tag: object
    number: int


class Rejected(NamedTuple):
    """A wrench that was not used, and why; `detail` is a sentence for a person.

    reason: a `Rejection`, or another enumeration's where another node adds reasons of its own.
    """

    stamp_ns: int
    reason: Enum
    detail: str
    number: int  # as above


Result = PairedWrench | Rejected


# Rules


@dataclass(frozen=True)
class SampleLimits:
    """Limits in ns of the samples' stamps; range (6,) in N and N.m."""

    max_age_ns: int
    restart_gap_ns: int
    max_waiting: int
    sensor_range: tuple[float, ...]

    def restarted(self, topic: str, stamp_ns: int, newest_ns: int) -> str:
        """Return why a stamp after the newest one means a restart.

        Args:
            topic: as it is called in the sentence.
            stamp_ns: the stamp, ns.
            newest_ns: the newest one before, ns.

        Returns:
            A sentence; empty: no restart.

        """
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
        """Return which stamps are later than the one before by no more than a restart's gap.

        Args:
            stamp_ns: (n,), ns.
            newest_ns: what the first one is compared with, ns; None: with nothing.

        Returns:
            Mask (n,).

        """
        regular = np.ones(len(stamp_ns), dtype=bool)
        if len(stamp_ns):
            if newest_ns is not None:
                regular[0] = 0 < int(stamp_ns[0]) - newest_ns <= self.restart_gap_ns
            steps = np.diff(stamp_ns)
            regular[1:] = (steps > 0) & (steps <= self.restart_gap_ns)
        return regular

    def range_notices(self, wrench: Sequence[float]) -> tuple[bool, bool]:
        """Return whether a wrench is at the sensor's range, and its torque of another unit.

        A sensor that clips reads its range itself.

        Args:
            wrench: (6,) as read, finite, N and N.m.

        Returns:
            Whether any axis is at its range or beyond; whether a torque is TORQUE_UNIT_FACTOR
            beyond it.

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
        """Count the wrenches for which each of `range_notices` holds.

        Args:
            wrenches: (n, 6) as read, finite, N and N.m.

        Returns:
            Number at the range or beyond; number whose torque looks like another unit.

        """
        sizes, limits = np.abs(wrenches), np.array(self.sensor_range)
        worst_torque = (sizes[:, 3:] / limits[3:]).max(axis=1, initial=0.0)
        beyond = worst_torque >= _AT_RANGE
        beyond |= (sizes[:, :3] >= _AT_RANGE * limits[:3]).any(axis=1)
        return int(beyond.sum()), int((worst_torque > TORQUE_UNIT_FACTOR).sum())


def joint_jump(step_ns: Any, step_rad: Any) -> Any:
    """Return whether no joint can have turned so far between two samples.

    Args:
        step_ns: from one stamp to the next, ns; a number or (n,).
        step_rad: largest step of a turning joint, rad; a number or (n,).

    Returns:
        A bool, or a mask (n,).

    """
    return step_rad > JOINT_JUMP_RAD_S * 1e-9 * step_ns


def angle_unit_notice(angles: Sequence[float], limited: Sequence[bool]) -> bool:
    """Return whether an angle looks like degrees.

    Args:
        angles: (k,) of the turning joints, finite, rad.
        limited: (k,) which of them have limits; others may be reported over many turns.

    Returns:
        True where one that is limited is beyond ANGLE_UNIT_LIMIT_RAD.

    """
    return any(
        abs(angle) > ANGLE_UNIT_LIMIT_RAD
        for angle, counts in zip(angles, limited, strict=True)
        if counts
    )


def count_angle_unit_notices(angles: Array, limited: Sequence[bool]) -> int:
    """Count the samples for which `angle_unit_notice` holds.

    Args:
        angles: (n, k) of the turning joints, rad.
        limited: (k,) which of them have limits.

    Returns:
        Number of rows.

    """
    return int((np.abs(angles[:, list(limited)]) > ANGLE_UNIT_LIMIT_RAD).any(axis=1).sum())


def surely_finite(wrenches: Array) -> np.ndarray:
    """Return which wrenches have a finite sum for certain; absurdly large ones don't.

    Args:
        wrenches: (n, 6), N and N.m.

    Returns:
        Mask (n,).

    """
    return np.asarray((np.abs(wrenches) <= _LARGEST).all(axis=1))


# Recent joints


NO_JOINTS_GAP = "the joint samples around this stamp lie too far apart"


class JointBuffer:
    """Ring of stamped positions of k joints (m, rad), stamps in ns, strictly increasing.

    A sample may hold NaN: it marks a moment at which the joints are known to be bad, and
    `joints_at` gives NaN next to it instead of reaching over it.
    """

    def __init__(self, max_gap_ns: int, capacity: int = 4096, arm: Arm | None = None) -> None:
        """Start empty.

        Args:
            max_gap_ns: longest distance of two samples to interpolate between, ns; above 0.
            capacity: number of the newest samples that are surely kept; 2 or more.
            arm: whose endless joints are interpolated the shorter way round; None: there are none.

        Raises:
            ValueError: a number is too small.

        """
        if max_gap_ns <= 0 or capacity < 2:
            raise ValueError(f"max_gap_ns = {max_gap_ns}, capacity = {capacity}: need > 0 and >= 2")
        self._max_gap_ns = max_gap_ns
        self._capacity = capacity
        self._arm = arm if arm is not None and arm.endless.any() else None
        self._stamps: list[int] = []
        self._positions: list[tuple[float, ...]] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample, ns; None when empty."""
        return self._stamps[-1] if self._stamps else None

    @property
    def capacity(self) -> int:
        """Number of the newest samples that are surely kept."""
        return self._capacity

    def nearest(self, positions: Array, to: Array) -> Array:
        """Return positions, endless joints by whole turns nearest to others.

        Args:
            positions: (n, k), m and rad.
            to: (n, k), m and rad.

        Returns:
            Positions (n, k), m and rad.

        """
        return positions if self._arm is None else self._arm.nearest(positions, to)

    def clear(self) -> None:
        """Forget every sample."""
        self._stamps.clear()
        self._positions.clear()

    def push(self, stamp_ns: int, positions: tuple[float, ...]) -> Notice | None:
        """Store a sample if it is newer than the newest one.

        Args:
            stamp_ns: its stamp, ns.
            positions: (k,), m and rad; NaN: known to be bad.

        Returns:
            What is wrong with a sample that is not stored; None: it is stored.

        """
        stamps = self._stamps
        if stamps and stamp_ns <= stamps[-1]:
            repeated = stamp_ns == stamps[-1]
            return Notice.DUPLICATE_JOINTS if repeated else Notice.OUT_OF_ORDER_JOINTS
        stamps.append(stamp_ns)
        self._positions.append(positions)
        # Trimming in runs keeps the cost of a push constant on average and the lists bisectable.
        if len(stamps) >= 2 * self._capacity:
            excess = len(stamps) - self._capacity
            del stamps[:excess], self._positions[:excess]
        return None

    def push_regular(self, stamp_ns: np.ndarray, positions: Array) -> None:
        """Store samples as `push` would one by one.

        Trimming included: what is kept afterwards is the same.

        Args:
            stamp_ns: (n,), ns, increasing and newer than those in the buffer.
            positions: (n, k), m and rad.

        """
        count = len(self._stamps) + len(stamp_ns)
        if count >= 2 * self._capacity:
            count = self._capacity + count % self._capacity
        rows = slice(max(0, len(stamp_ns) - count), None)
        self._stamps += stamp_ns[rows].tolist()
        self._positions += map(tuple, positions[rows].tolist())
        excess = len(self._stamps) - count
        del self._stamps[:excess], self._positions[:excess]

    def since(self, stamp_ns: int) -> tuple[np.ndarray, Array]:
        """Return the samples from the last one before a stamp on.

        Args:
            stamp_ns: the stamp, ns.

        Returns:
            Stamps (n,), ns, and positions (n, k), m and rad; the newest sample is always among
            them. An empty buffer has (0,) and (0, 0).

        """
        first = max(0, bisect_left(self._stamps, stamp_ns) - 1)
        positions = np.array(self._positions[first:], dtype=float)
        if not len(positions):
            positions = positions.reshape(0, 0)
        return np.array(self._stamps[first:], dtype=np.int64), positions

    def interpolate(
        self, stamps: np.ndarray, positions: Array, at_ns: np.ndarray
    ) -> tuple[Array, np.ndarray, np.ndarray]:
        """Do as `joints_at` for many stamps, in a series of samples.

        The samples need not be in the buffer; `since` and such as come after it make a series.

        Args:
            stamps: (m,) of the samples, ns, increasing.
            positions: (m, k) of the samples, m and rad.
            at_ns: (n,) where to interpolate, ns, none newer than the last sample.

        Returns:
            Joints (n, k), m and rad; mask (n,), whether they are what `joints_at` gives, else it
            rejects or they aren't finite; place (n,) of the oldest sample that each needs.

        """
        after = np.searchsorted(stamps, at_ns, side="left")
        exact = stamps[after] == at_ns
        before = np.maximum(after - 1, 0)
        span_ns = stamps[after] - stamps[before]
        weight = (at_ns - stamps[before]) / np.maximum(span_ns, 1)
        # A sample with exactly the stamp is taken as it is, whatever lies before it.
        start = np.where(exact[:, None], positions[after], positions[before])
        found = start + weight[:, None] * (self.nearest(positions[after], start) - start)
        good = exact | ((after > 0) & (span_ns <= self._max_gap_ns))
        good &= np.isfinite(found).all(axis=1)
        return found, good, np.where(exact, after, before)

    def joints_at(self, stamp_ns: int) -> tuple[float, ...] | str:
        """Interpolate positions at a stamp, linear between the two samples around it.

        A sample with exactly this stamp is returned as it is. Never extrapolates.

        Args:
            stamp_ns: the stamp, ns.

        Returns:
            Positions (k,), m and rad, all NaN next to a bad sample; or a text: why there are none.

        """
        stamps = self._stamps
        if not stamps:
            return "no joint sample was received"
        if stamp_ns == stamps[-1]:  # the usual case: driver stamps wrench and joints alike
            return self._positions[-1]
        if stamp_ns > stamps[-1]:
            return "no joint sample at or after this stamp was received yet"
        after = bisect_left(stamps, stamp_ns)
        if stamps[after] == stamp_ns:
            return self._positions[after]
        if after == 0:
            return "the stamp lies before the oldest joint sample kept"
        before = after - 1
        span_ns = stamps[after] - stamps[before]
        if span_ns > self._max_gap_ns:
            return NO_JOINTS_GAP
        w = (stamp_ns - stamps[before]) / span_ns
        start, end = self._positions[before], self._positions[after]
        if self._arm is not None:
            end = tuple(self._arm.nearest(end, start).tolist())
        between = tuple([low + w * (high - low) for low, high in zip(start, end, strict=True)])
        if not math.isfinite(sum(between)):
            return (math.nan,) * len(between)
        return between
