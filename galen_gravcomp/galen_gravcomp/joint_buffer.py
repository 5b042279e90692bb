"""Recent roll and tilt angles, and their value at a stamp between two samples."""

import math
from bisect import bisect_left
from enum import Enum


class JointPush(Enum):
    """What became of a joint sample."""

    STORED = "stored"
    DUPLICATE = "duplicate"  # same stamp as the newest sample; the first one is kept
    OUT_OF_ORDER = "out of order"  # older than the newest sample; dropped


class NoAngles(Enum):
    """Why there are no angles at a stamp."""

    EMPTY = "no joint sample was received"
    NOT_YET = "no joint sample at or after this stamp was received yet"
    TOO_OLD = "the stamp lies before the oldest joint sample kept"
    GAP = "the joint samples around this stamp lie too far apart"


class JointBuffer:
    """Ring of stamped roll and tilt angles (rad), stamps in ns, strictly increasing.

    A sample may hold NaN: it marks a moment at which the angles are known to be bad, and
    `angles_at` gives NaN next to it instead of reaching over it.
    """

    def __init__(self, max_gap_ns: int, capacity: int = 4096) -> None:
        """Keep at least `capacity` samples; never interpolate over more than `max_gap_ns`."""
        if max_gap_ns <= 0 or capacity < 2:
            raise ValueError(f"max_gap_ns = {max_gap_ns}, capacity = {capacity}: need > 0 and >= 2")
        self._max_gap_ns = max_gap_ns
        self._capacity = capacity
        self._stamps: list[int] = []
        self._rolls: list[float] = []
        self._tilts: list[float] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample, ns; None when empty."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget every sample."""
        self._stamps.clear()
        self._rolls.clear()
        self._tilts.clear()

    def push(self, stamp_ns: int, roll: float, tilt: float) -> JointPush:
        """Store a sample if it is newer than the newest one."""
        stamps = self._stamps
        if stamps and stamp_ns <= stamps[-1]:
            return JointPush.DUPLICATE if stamp_ns == stamps[-1] else JointPush.OUT_OF_ORDER
        stamps.append(stamp_ns)
        self._rolls.append(roll)
        self._tilts.append(tilt)
        # Trimming in blocks keeps the cost of a push constant on average and the lists bisectable.
        if len(stamps) >= 2 * self._capacity:
            excess = len(stamps) - self._capacity
            del stamps[:excess], self._rolls[:excess], self._tilts[:excess]
        return JointPush.STORED

    def angles_at(self, stamp_ns: int) -> tuple[float, float] | NoAngles:
        """Roll and tilt (rad) at a stamp, linear between the two samples around it.

        A sample with exactly this stamp is returned as it is. Never extrapolates.
        """
        stamps = self._stamps
        if not stamps:
            return NoAngles.EMPTY
        if stamp_ns == stamps[-1]:  # the usual case: driver stamps wrench and joints alike
            return self._rolls[-1], self._tilts[-1]
        if stamp_ns > stamps[-1]:
            return NoAngles.NOT_YET
        after = bisect_left(stamps, stamp_ns)
        if stamps[after] == stamp_ns:
            return self._rolls[after], self._tilts[after]
        if after == 0:
            return NoAngles.TOO_OLD
        before = after - 1
        span_ns = stamps[after] - stamps[before]
        if span_ns > self._max_gap_ns:
            return NoAngles.GAP
        w = (stamp_ns - stamps[before]) / span_ns
        roll = self._rolls[before] + w * (self._rolls[after] - self._rolls[before])
        tilt = self._tilts[before] + w * (self._tilts[after] - self._tilts[before])
        if not (math.isfinite(roll) and math.isfinite(tilt)):
            return math.nan, math.nan
        return roll, tilt
