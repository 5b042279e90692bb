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
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, WRENCH_AXES
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
    """stamps_ns (n,) int64, rising; values (n, width). run: another one after each restart."""

    stamps_ns: np.ndarray
    values: Array
    run: int = 0

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
        self._run = 0
        self._span_ns = int(seconds * NS_PER_S)
        self._lock = threading.Lock()

    def append(self, stamps_ns: np.ndarray, values: Array) -> None:
        """Add rows, stamps (n,) and values (n, width); rows out of order are left out."""
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
                self._restart()
                stamps, rows = stamps[back[0] :], rows[back[0] :]

    @property
    def newest_ns(self) -> int | None:
        """The last stamp; None without rows."""
        with self._lock:
            return self._newest() if self._count else None

    def last(self, seconds: float | None = None) -> StreamSamples:
        """Copy the newest rows, as far back as `seconds` before the newest one."""
        with self._lock:
            span_ns = self._span_ns if seconds is None else int(seconds * NS_PER_S)
            return self._from(self._newest() - span_ns if self._count else 0)

    def since(self, stamp_ns: int) -> StreamSamples:
        """Copy the rows from this stamp on; it costs only as much as there are of them."""
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

    def _restart(self) -> None:
        self._count = 0
        self._run += 1

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
        return StreamSamples(np.concatenate(stamps), np.concatenate(values), self._run)


class History:
    """What the plots show: raw and compensated wrench (6), deflection (6), joints (n); SI."""

    def __init__(self, arm: Arm = GALEN) -> None:
        self.raw = StreamSeries(6)
        self.compensated = StreamSeries(6)
        self.deflection = StreamSeries(6)
        """(translation, rotation vector) at the tip, in base_link; m, rad."""
        self.joints = StreamSeries(len(arm.joints))
        """In the arm's order; m, rad."""


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
    """Write a row a stamp, joined by equal stamps; a cell is empty where a stream has none."""
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


@dataclass(frozen=True)
class PlotRows:
    """What is drawn: stamps_ns (n,) int64, rising, and values (n, width); NaN ends a line."""

    stamps_ns: np.ndarray
    values: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)


def decimate(stamps_ns: np.ndarray, values: Array, width_ns: int) -> PlotRows:
    """Reduce to two rows or one a bucket; stamps (n,) rising, values (n, columns). O(n)."""
    if not len(stamps_ns):
        return PlotRows(stamps_ns, values)
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
    return PlotRows(times[kept], pairs[kept])


def with_gaps(rows: PlotRows, width_ns: int, before_ns: int | None = None) -> PlotRows:
    """Add a row of NaN at the end of each gap; before_ns: the stamp before the rows."""
    if not len(rows):
        return rows
    # A bucket's own two rows are up to its width apart.
    gap_ns = max(int(GAP_S * NS_PER_S), 3 * width_ns // 2)
    earlier = rows.stamps_ns[0] if before_ns is None else before_ns
    steps = np.diff(rows.stamps_ns, prepend=earlier)
    at = np.flatnonzero(steps > gap_ns)
    # Not in the midst of the gap: a row before `Patch.from_ns` would be sent twice.
    stamps = np.insert(rows.stamps_ns, at, rows.stamps_ns[at])
    return PlotRows(stamps, np.insert(rows.values, at, np.nan, axis=0))


def bucket_ns(span_s: float) -> int:
    """Return a bucket's width for a window of this length."""
    return max(1, int(span_s * NS_PER_S) // BUCKETS)


@dataclass(frozen=True)
class Patch:
    """What a browser has to change: drop its rows from `from_ns` on, append `rows`.

    whole: it has to begin anew. newest_ns: the series' newest stamp, None without samples.
    """

    from_ns: int
    rows: PlotRows
    whole: bool
    newest_ns: int | None


class Follower:
    """One browser's place in one series: what is new since the last patch that arrived."""

    def __init__(self, series: StreamSeries, curves: Callable[[Array], Array] = np.asarray) -> None:
        """`curves`: what is drawn (n, columns) of the series' values (n, width)."""
        self._series = series
        self._curves = curves
        self._width_ns = 1
        self._span_ns = 0
        self.forget()

    def look_at(self, span_s: float, width_ns: int) -> None:
        """Follow the last `span_s` seconds in buckets of this width from now on."""
        self._span_ns, self._width_ns = int(span_s * NS_PER_S), width_ns
        self.forget()

    def forget(self) -> None:
        """Make the next patch whole: the browser has nothing."""
        self._run: int | None = None
        self._newest_ns: int | None = None
        self._from_ns = 0
        self._before_ns: int | None = None

    def patch(self) -> Patch:
        """Return what is new; call `forget` where it did not arrive."""
        samples = self._series.since(self._from_ns)
        whole = samples.run != self._run
        if whole:
            samples = self._series.last(self._span_ns / NS_PER_S)
            self._from_ns, self._before_ns, self._newest_ns = 0, None, None
        self._run = samples.run
        from_ns, newest = self._from_ns, samples.newest_ns
        if newest == self._newest_ns and not whole:
            nothing = PlotRows(samples.stamps_ns[:0], samples.values[:0])
            return Patch(0 if newest is None else newest + 1, nothing, whole, newest)
        self._newest_ns = newest
        rows = decimate(samples.stamps_ns, self._curves(samples.values), self._width_ns)
        rows = with_gaps(rows, self._width_ns, self._before_ns)
        if newest is not None:
            # The newest bucket may still grow: it is sent again.
            self._from_ns = newest // self._width_ns * self._width_ns
            earlier = int(np.searchsorted(samples.stamps_ns, self._from_ns))
            if earlier:
                self._before_ns = int(samples.stamps_ns[earlier - 1])
        return Patch(from_ns, rows, whole, newest)
