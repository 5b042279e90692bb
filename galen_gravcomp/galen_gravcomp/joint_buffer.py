"""Recent roll and tilt angles, and their value at a stamp between two samples."""

import math
from bisect import bisect_left
from enum import Enum
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array


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


class Interpolated(NamedTuple):
    """`JointBuffer.angles_at` at many stamps at once.

    angles (n, 2): roll and tilt, rad; good (n,): whether they are what `angles_at` gives (else it
    refuses, or they aren't finite); oldest (n,): the oldest sample that they hang on.
    """

    angles: Array
    good: np.ndarray
    oldest: np.ndarray


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

    @property
    def capacity(self) -> int:
        """So many of the newest samples are surely kept."""
        return self._capacity

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
        # Trimming in runs keeps the cost of a push constant on average and the lists bisectable.
        if len(stamps) >= 2 * self._capacity:
            excess = len(stamps) - self._capacity
            del stamps[:excess], self._rolls[:excess], self._tilts[:excess]
        return JointPush.STORED

    def push_regular(self, stamp_ns: np.ndarray, angles: Array) -> None:
        """Store samples as `push` would one by one: stamps (n,) increasing and newer, (n, 2) rad.

        Trimming included: what is kept afterwards is the same.
        """
        count = len(self._stamps) + len(stamp_ns)
        if count >= 2 * self._capacity:
            count = self._capacity + count % self._capacity
        rows = slice(max(0, len(stamp_ns) - count), None)
        self._stamps += stamp_ns[rows].tolist()
        self._rolls += angles[rows, 0].tolist()
        self._tilts += angles[rows, 1].tolist()
        excess = len(self._stamps) - count
        del self._stamps[:excess], self._rolls[:excess], self._tilts[:excess]

    def since(self, stamp_ns: int) -> tuple[np.ndarray, Array]:
        """Stamps (n,) and angles (n, 2) from the last sample before `stamp_ns` on.

        The newest sample is always among them.
        """
        first = max(0, bisect_left(self._stamps, stamp_ns) - 1)
        angles = np.array([self._rolls[first:], self._tilts[first:]]).T
        return np.array(self._stamps[first:], dtype=np.int64), angles

    def interpolate(self, stamps: np.ndarray, angles: Array, at_ns: np.ndarray) -> Interpolated:
        """`angles_at` for stamps (n,) in samples (m,), (m, 2), none newer than the last sample.

        The samples need not be in the buffer; `since` and such as come after it make a series.
        """
        after = np.searchsorted(stamps, at_ns, side="left")
        exact = stamps[after] == at_ns
        before = np.maximum(after - 1, 0)
        span_ns = stamps[after] - stamps[before]
        weight = (at_ns - stamps[before]) / np.maximum(span_ns, 1)
        # A sample with exactly the stamp is taken as it is, whatever lies before it.
        start = np.where(exact[:, None], angles[after], angles[before])
        found = start + weight[:, None] * (angles[after] - start)
        good = exact | ((after > 0) & (span_ns <= self._max_gap_ns))
        good &= np.isfinite(found).all(axis=1)
        return Interpolated(found, good, np.where(exact, after, before))

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
