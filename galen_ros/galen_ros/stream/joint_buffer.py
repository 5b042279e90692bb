"""Recent joint positions, and their value at a stamp between two samples."""

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


class NoJoints(Enum):
    """Why there are no joints at a stamp."""

    EMPTY = "no joint sample was received"
    NOT_YET = "no joint sample at or after this stamp was received yet"
    TOO_OLD = "the stamp lies before the oldest joint sample kept"
    GAP = "the joint samples around this stamp lie too far apart"


class Interpolated(NamedTuple):
    """`JointBuffer.joints_at` at many stamps at once.

    joints (n, k); good (n,): whether they are what `joints_at` gives (else it rejects, or they
    aren't finite); oldest (n,): the oldest sample that they hang on.
    """

    joints: Array
    good: np.ndarray
    oldest: np.ndarray


class JointBuffer:
    """Ring of stamped positions of k joints (m, rad), stamps in ns, strictly increasing.

    A sample may hold NaN: it marks a moment at which the joints are known to be bad, and
    `joints_at` gives NaN next to it instead of reaching over it.
    """

    def __init__(self, max_gap_ns: int, capacity: int = 4096) -> None:
        """Keep at least `capacity` samples; never interpolate over more than `max_gap_ns`."""
        if max_gap_ns <= 0 or capacity < 2:
            raise ValueError(f"max_gap_ns = {max_gap_ns}, capacity = {capacity}: need > 0 and >= 2")
        self._max_gap_ns = max_gap_ns
        self._capacity = capacity
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
        """So many of the newest samples are surely kept."""
        return self._capacity

    def clear(self) -> None:
        """Forget every sample."""
        self._stamps.clear()
        self._positions.clear()

    def push(self, stamp_ns: int, positions: tuple[float, ...]) -> JointPush:
        """Store a sample if it is newer than the newest one."""
        stamps = self._stamps
        if stamps and stamp_ns <= stamps[-1]:
            return JointPush.DUPLICATE if stamp_ns == stamps[-1] else JointPush.OUT_OF_ORDER
        stamps.append(stamp_ns)
        self._positions.append(positions)
        # Trimming in runs keeps the cost of a push constant on average and the lists bisectable.
        if len(stamps) >= 2 * self._capacity:
            excess = len(stamps) - self._capacity
            del stamps[:excess], self._positions[:excess]
        return JointPush.STORED

    def push_regular(self, stamp_ns: np.ndarray, positions: Array) -> None:
        """Store samples as `push` would one by one: stamps (n,) increasing and newer, (n, k).

        Trimming included: what is kept afterwards is the same.
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
        """Stamps (n,) and positions (n, k) from the last sample before `stamp_ns` on.

        The newest sample is always among them. An empty buffer has (0,) and (0, 0).
        """
        first = max(0, bisect_left(self._stamps, stamp_ns) - 1)
        positions = np.array(self._positions[first:], dtype=float)
        if not len(positions):
            positions = positions.reshape(0, 0)
        return np.array(self._stamps[first:], dtype=np.int64), positions

    def interpolate(self, stamps: np.ndarray, positions: Array, at_ns: np.ndarray) -> Interpolated:
        """`joints_at` for stamps (n,) in samples (m,), (m, k), none newer than the last sample.

        The samples need not be in the buffer; `since` and such as come after it make a series.
        """
        after = np.searchsorted(stamps, at_ns, side="left")
        exact = stamps[after] == at_ns
        before = np.maximum(after - 1, 0)
        span_ns = stamps[after] - stamps[before]
        weight = (at_ns - stamps[before]) / np.maximum(span_ns, 1)
        # A sample with exactly the stamp is taken as it is, whatever lies before it.
        start = np.where(exact[:, None], positions[after], positions[before])
        found = start + weight[:, None] * (positions[after] - start)
        good = exact | ((after > 0) & (span_ns <= self._max_gap_ns))
        good &= np.isfinite(found).all(axis=1)
        return Interpolated(found, good, np.where(exact, after, before))

    def joints_at(self, stamp_ns: int) -> tuple[float, ...] | NoJoints:
        """Positions (k,) at a stamp, linear between the two samples around it.

        A sample with exactly this stamp is returned as it is. Never extrapolates.
        """
        stamps = self._stamps
        if not stamps:
            return NoJoints.EMPTY
        if stamp_ns == stamps[-1]:  # the usual case: driver stamps wrench and joints alike
            return self._positions[-1]
        if stamp_ns > stamps[-1]:
            return NoJoints.NOT_YET
        after = bisect_left(stamps, stamp_ns)
        if stamps[after] == stamp_ns:
            return self._positions[after]
        if after == 0:
            return NoJoints.TOO_OLD
        before = after - 1
        span_ns = stamps[after] - stamps[before]
        if span_ns > self._max_gap_ns:
            return NoJoints.GAP
        w = (stamp_ns - stamps[before]) / span_ns
        sides = zip(self._positions[before], self._positions[after], strict=True)
        between = tuple([low + w * (high - low) for low, high in sides])
        if not math.isfinite(sum(between)):
            return (math.nan,) * len(between)
        return between
