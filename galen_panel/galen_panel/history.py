"""The newest samples of the streams, for plots and files; written and read in two threads. No ROS.

A stamp that goes back by more than `RESTART_S` is another run (a simulation begun anew, a bag
played again): what was before it is dropped.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

SECONDS = 120.0
_ROWS = 120_000
"""120 s at 1000 Hz."""
RESTART_S = 1.0
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class Samples:
    """stamps_ns (n,) int64, rising; values (n, width)."""

    stamps_ns: np.ndarray
    values: Array


class Series:
    """A ring of stamped rows."""

    def __init__(self, width: int, rows: int = _ROWS, seconds: float = SECONDS) -> None:
        self._stamps = np.zeros(rows, dtype=np.int64)
        self._values = np.zeros((rows, width))
        self._count = 0
        self._span_ns = int(seconds * NS_PER_S)
        self._lock = threading.Lock()

    def append(self, stamps_ns: np.ndarray, values: Array) -> None:
        """Add rows, stamps (n,) and values (n, width); rows out of order are left out."""
        with self._lock:
            rows = len(self._stamps)
            for stamp, value in zip(stamps_ns.tolist(), values, strict=True):
                newest = int(self._stamps[(self._count - 1) % rows]) if self._count else stamp - 1
                if stamp < newest - int(RESTART_S * NS_PER_S):
                    self._count = 0
                elif stamp <= newest:
                    continue
                self._stamps[self._count % rows] = stamp
                self._values[self._count % rows] = value
                self._count += 1

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._count = 0

    def last(self, seconds: float | None = None) -> Samples:
        """A copy of the newest rows, as far back as `seconds` before the newest one."""
        with self._lock:
            rows = len(self._stamps)
            have = min(self._count, rows)
            order = np.arange(self._count - have, self._count) % rows
            stamps, values = self._stamps[order], self._values[order]
        if not have:
            return Samples(stamps, values)
        span_ns = self._span_ns if seconds is None else int(seconds * NS_PER_S)
        first = int(np.searchsorted(stamps, stamps[-1] - span_ns))
        return Samples(stamps[first:], values[first:])


class History:
    """What the plots show: raw and compensated wrench (6), deflection (6), joints (5); SI."""

    def __init__(self) -> None:
        self.raw = Series(6)
        self.compensated = Series(6)
        self.deflection = Series(6)
        """(translation, rotation vector) at the tip, in base_link; m, rad."""
        self.joints = Series(5)
        """delta_x, delta_y, delta_z, roll, tilt; m, rad."""

    def clear(self) -> None:
        """Forget all."""
        for series in (self.raw, self.compensated, self.deflection, self.joints):
            series.clear()
