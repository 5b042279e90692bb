# SPDX-License-Identifier: Apache-2.0
"""The newest samples of the streams, for plots and files; written and read in two threads. No ROS.

Plots draw few points that look like many: the smallest and the largest of each bucket. Buckets
begin at whole multiples of their width since the epoch, so that a bucket that is full never
changes, however the window moves on: no peak is lost and nothing flickers. A bucket gives two rows,
at the times of its first and of its last sample, smallest first where the curve rises. Where a
bucket holds one sample, that is the row.

A stamp that goes back by more than `RESTART_S` is another run (a simulation begun anew, a bag
played again): what was before it is dropped.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

SECONDS = 120.0
_ROWS = 120_000
"""120 s at 1000 Hz."""
GAP_S = 0.25
"""Samples further apart aren't joined by a line; the streams have hundreds a second."""
BUCKETS = 300
"""In a window: 600 rows, about as many as a plot has pixels."""
RESTART_S = 1.0
NS_PER_S = 1_000_000_000
_RESTART_NS = int(RESTART_S * NS_PER_S)


@dataclass(frozen=True)
class StreamSamples:
    """stamps_ns (n,) int64, rising; values (n, width)."""

    stamps_ns: np.ndarray
    values: Array

    @property
    def newest_ns(self) -> int | None:
        """The last stamp; None without samples."""
        return int(self.stamps_ns[-1]) if len(self.stamps_ns) else None


class StreamSeries:
    """A ring of stamped rows."""

    def __init__(self, width: int, rows: int = _ROWS, seconds: float = SECONDS) -> None:
        self._stamps = np.zeros(rows, dtype=np.int64)
        self._values = np.zeros((rows, width))
        self._count = 0
        self._span_ns = int(seconds * NS_PER_S)
        self._lock = threading.Lock()

    def append(self, stamps_ns: np.ndarray, values: Array) -> None:
        """Add rows; those out of order are left out.

        Args:
            stamps_ns: (n,), ns.
            values: (n, width).

        Raises:
            ValueError: the numbers of stamps and rows differ.

        """
        if len(stamps_ns) != len(values):
            raise ValueError(f"{len(stamps_ns)} stamps for {len(values)} rows")
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        rows = np.asarray(values)
        with self._lock:
            while len(stamps):
                if self._rises(stamps):
                    self._write(stamps, rows)
                    return
                highest = np.maximum.accumulate(stamps)
                before = np.empty_like(highest)
                before[0] = self._newest() if self._count else stamps[0] - 1
                np.maximum(highest[:-1], before[0], out=before[1:])
                back = np.flatnonzero(stamps < before - _RESTART_NS)
                if not len(back):
                    taken = stamps > before
                    self._write(stamps[taken], rows[taken])
                    return
                # What came before a restart is dropped with all that was there.
                self._count = 0
                stamps, rows = stamps[back[0] :], rows[back[0] :]

    @property
    def newest_ns(self) -> int | None:
        """The last stamp; None without rows."""
        with self._lock:
            return self._newest() if self._count else None

    def last(self, seconds: float | None = None) -> StreamSamples:
        """Copy the newest rows.

        Args:
            seconds: as far back before the newest one, s; None: the series' own length.

        Returns:
            The rows, the oldest first.

        """
        with self._lock:
            span_ns = self._span_ns if seconds is None else int(seconds * NS_PER_S)
            return self._from(self._newest() - span_ns if self._count else 0)

    def since(self, stamp_ns: int) -> StreamSamples:
        """Copy the rows from a stamp on; it costs only as much as there are of them.

        Args:
            stamp_ns: the stamp, ns.

        Returns:
            The rows, the oldest first, none beyond the series' own length.

        """
        with self._lock:
            oldest = self._newest() - self._span_ns if self._count else 0
            return self._from(max(stamp_ns, oldest))

    def frozen(self) -> StreamSeries:
        """Return a copy of the rows that gets no more of them."""
        samples = self.last()
        copy = StreamSeries(self._values.shape[1], max(1, len(samples.stamps_ns)))
        copy.append(samples.stamps_ns, samples.values)
        return copy

    def _newest(self) -> int:
        return int(self._stamps[(self._count - 1) % len(self._stamps)])

    def _rises(self, stamps: np.ndarray) -> bool:
        """Whether nothing is to be left out, as nearly always."""
        if self._count and int(stamps[0]) <= self._newest():
            return False
        return bool((stamps[1:] > stamps[:-1]).all())

    def _write(self, stamps: np.ndarray, rows: Array) -> None:
        size = len(self._stamps)
        if len(stamps) > size:
            self._count += len(stamps) - size
            stamps, rows = stamps[-size:], rows[-size:]
        start = self._count % size
        head = min(len(stamps), size - start)
        self._stamps[start : start + head] = stamps[:head]
        self._values[start : start + head] = rows[:head]
        if head < len(stamps):
            self._stamps[: len(stamps) - head] = stamps[head:]
            self._values[: len(stamps) - head] = rows[head:]
        self._count += len(stamps)

    def _from(self, stamp_ns: int) -> StreamSamples:
        size = len(self._stamps)
        end = self._count % size
        # Older rows lie behind the place where the next one goes, once the ring is full.
        parts = [slice(end, size), slice(0, end)] if self._count >= size else [slice(0, end)]
        stamps, values = [], []
        for part in parts:
            first = int(np.searchsorted(self._stamps[part], stamp_ns))
            stamps.append(self._stamps[part][first:])
            values.append(self._values[part][first:])
        return StreamSamples(np.concatenate(stamps), np.concatenate(values))


class History:
    """What the plots show: raw and compensated wrench (6), deflection (6), joints (n); SI."""

    def __init__(self, arm: Arm) -> None:
        self.raw = StreamSeries(6)
        self.compensated = StreamSeries(6)
        self.deflection = StreamSeries(6)
        """(translation, rotation vector) at the tip, in base_link; m, rad."""
        self.joints = StreamSeries(len(arm.joints))
        """In the arm's order; m, rad."""

    def follow(self, arm: Arm) -> None:
        """Begin the joints anew, as another arm has them.

        Args:
            arm: whose n joints the series has from now on.

        """
        self.joints = StreamSeries(len(arm.joints))


_UNITS = ("n",) * 3 + ("nm",) * 3
_DEFLECTION = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
_BLOCK = 2000

HEADER = ",".join(
    [
        "stamp_s",
        *(f"raw_{axis}_{unit}" for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True)),
        *(f"compensated_{axis}_{unit}" for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True)),
        *(f"deflection_{axis}" for axis in _DEFLECTION),
    ]
)
"""SI units; wrenches in ft_sensor, the deflection of the tip in base_link."""


def csv(raw: StreamSamples, compensated: StreamSamples, deflection: StreamSamples) -> bytes:
    """Write a row a stamp, joined by equal stamps; a cell is empty where a stream has none.

    Args:
        raw: wrenches (n, 6) in the sensor's frame, N and N.m.
        compensated: wrenches (n, 6) in the sensor's frame, N and N.m.
        deflection: translation and rotation vector (n, 6) of the tip in the base's frame, m and
            rad.

    Returns:
        The file's content, with `HEADER`.

    """
    return "".join(_lines(raw, compensated, deflection)).encode()


def _lines(*streams: StreamSamples) -> Iterator[str]:
    yield HEADER + "\n"
    stamps = np.unique(np.concatenate([samples.stamps_ns for samples in streams]))
    table: Array = np.full((len(stamps), 6 * len(streams)), np.nan)
    for index, samples in enumerate(streams):
        rows = np.searchsorted(stamps, samples.stamps_ns)
        table[rows, 6 * index : 6 * index + 6] = samples.values
    line = "%d.%09d" + ",%.7g" * table.shape[1] + "\n"
    for start in range(0, len(stamps), _BLOCK):
        block = zip(
            stamps[start : start + _BLOCK].tolist(),
            table[start : start + _BLOCK].tolist(),
            strict=True,
        )
        text = "".join(line % (*divmod(stamp, NS_PER_S), *row) for stamp, row in block)
        yield text.replace("nan", "")


def bucket_ns(span_s: float) -> int:
    """Return a bucket's width for a window.

    Args:
        span_s: the window's length, s.

    Returns:
        The width, ns.

    """
    return max(1, int(span_s * NS_PER_S) // BUCKETS)


def plot_rows(stamps_ns: np.ndarray, values: Array, width_ns: int) -> tuple[np.ndarray, Array]:
    """Reduce to two rows or one a bucket, with a row of NaN at the end of each gap. O(n).

    Args:
        stamps_ns: (n,), ns, rising.
        values: (n, columns).
        width_ns: the buckets' width, ns.

    Returns:
        Stamps (m,), ns, and values (m, columns) of what is drawn.

    """
    if not len(stamps_ns):
        return stamps_ns, values
    number = stamps_ns // width_ns
    first = np.flatnonzero(np.r_[True, number[1:] != number[:-1]])
    last = np.r_[first[1:], len(number)] - 1
    low = np.minimum.reduceat(values, first, axis=0)
    high = np.maximum.reduceat(values, first, axis=0)
    rising = values[last] >= values[first]
    pairs = np.stack([np.where(rising, low, high), np.where(rising, high, low)], axis=1)
    times = np.stack([stamps_ns[first], stamps_ns[last]], axis=1)
    kept = np.ones(times.shape, dtype=bool)
    kept[:, 1] = last > first
    stamps, rows = times[kept], pairs[kept]
    # A bucket's own two rows are up to its width apart.
    gap_ns = max(int(GAP_S * NS_PER_S), 3 * width_ns // 2)
    at = np.flatnonzero(np.diff(stamps, prepend=stamps[0]) > gap_ns)
    return np.insert(stamps, at, stamps[at]), np.insert(rows, at, np.nan, axis=0)
