"""Few points that look like many: the smallest and the largest of each bucket. No ROS, no page.

Buckets begin at whole multiples of their width since the epoch, so that a bucket that is full
never changes, however the window moves on: no peak is lost and nothing flickers. A bucket gives two
rows, at the times of its first and of its last sample, smallest first where the curve rises.
Where a bucket holds one sample, that is the row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

from galen_panel.history import NS_PER_S, StreamSeries

GAP_S = 0.25
"""Samples further apart aren't joined by a line; the streams have hundreds a second."""
BUCKETS = 300
"""In a window: 600 rows, about as many as a plot has pixels."""


@dataclass(frozen=True)
class PlotRows:
    """What is drawn: stamps_ns (n,) int64, rising, and values (n, width); NaN ends a line."""

    stamps_ns: np.ndarray
    values: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)


def decimate(stamps_ns: np.ndarray, values: Array, width_ns: int) -> PlotRows:
    """Two rows or one for each bucket; stamps (n,) rising, values (n, columns). O(n)."""
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
    """The rows with one of NaN at the end of each gap; before_ns: stamp of what was before them."""
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
    """A bucket's width for a window of this length."""
    return max(1, int(span_s * NS_PER_S) // BUCKETS)


def zoomed(
    stamps_ns: np.ndarray, values: Array, start_ns: int, end_ns: int, span_s: float
) -> PlotRows:
    """All of `span_s` coarsely, with what is from start to end in as much detail as can be seen."""
    coarse, fine = bucket_ns(span_s), bucket_ns((end_ns - start_ns) / NS_PER_S)
    edges = [0, *np.searchsorted(stamps_ns, [start_ns, end_ns]).tolist(), len(stamps_ns)]
    pieces = [
        decimate(stamps_ns[begin:end], values[begin:end], width)
        for begin, end, width in zip(edges, edges[1:], (coarse, fine, coarse), strict=False)
    ]
    rows = PlotRows(
        np.concatenate([piece.stamps_ns for piece in pieces]),
        np.concatenate([piece.values for piece in pieces]),
    )
    return with_gaps(rows, coarse)


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
        """The browser has nothing: the next patch is whole."""
        self._run: int | None = None
        self._newest_ns: int | None = None
        self._from_ns = 0
        self._before_ns: int | None = None

    def patch(self) -> Patch:
        """What is new; taken as arrived, call `forget` where it did not."""
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
