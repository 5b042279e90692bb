"""A recording of hours reduced to cells of a tenth of a second or so: means, scatter, angles.

Everything that an evaluation says of a recording's course is computed from these cells, so that it
needs memory for the hours and not for the samples: 150 bytes a cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array

CELL_S = 0.1


@dataclass(frozen=True)
class Cells:
    """Cells (n,) in the order of the samples.

    start_ns, end_ns (n,): first and last stamp; count (n,); mean (n, 6) of the compensated wrench
    and squares (n, 6), the sum of squares about that mean, N and N.m; angles (n, 2) mean roll and
    tilt, spans (n, 2) largest less smallest, rad.
    """

    start_ns: np.ndarray
    end_ns: np.ndarray
    count: np.ndarray
    mean: Array
    squares: Array
    angles: Array
    spans: Array
    cell_s: float = CELL_S

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.start_ns)

    def rows(self, rows: np.ndarray) -> Cells:
        """Some of the cells."""
        columns = {name: getattr(self, name)[rows] for name in _FIELDS}
        return Cells(**columns, cell_s=self.cell_s)

    @property
    def sum_of_squares(self) -> Array:
        """Sum of the squared samples in each cell (n, 6)."""
        return self.squares + self.count[:, None] * self.mean**2


_FIELDS = ("start_ns", "end_ns", "count", "mean", "squares", "angles", "spans")


class CellReducer:
    """Takes samples in blocks; a cell that a block's border cuts is put together again."""

    def __init__(self, cell_s: float = CELL_S) -> None:
        self._cell_s = cell_s
        self._cell_ns = round(cell_s * 1e9)
        self._parts: list[Cells] = []
        self._open: tuple[np.ndarray, Array, Array] | None = None

    def add(self, stamp_ns: np.ndarray, wrench: Array, angles: Array) -> None:
        """Take stamps (n,), compensated wrenches (n, 6) and roll, tilt (n, 2) in rad."""
        if self._open is not None:
            stamp_ns = np.concatenate([self._open[0], stamp_ns])
            wrench = np.concatenate([self._open[1], wrench])
            angles = np.concatenate([self._open[2], angles])
        if not len(stamp_ns):
            return
        number = stamp_ns // self._cell_ns
        starts = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1])
        last = int(starts[-1])
        self._open = (stamp_ns[last:], wrench[last:], angles[last:])
        if last:
            self._parts.append(_reduce(stamp_ns[:last], wrench[:last], angles[:last], starts[:-1]))

    def finish(self) -> Cells:
        """All cells so far; the last one may be short."""
        parts = list(self._parts)
        if self._open is not None:
            parts.append(_reduce(*self._open, np.zeros(1, dtype=np.intp)))
        if not parts:
            none = np.zeros(0, dtype=np.int64)
            six, two = np.zeros((0, 6)), np.zeros((0, 2))
            return Cells(none, none, none, six, six, two, two, self._cell_s)
        columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _FIELDS}
        return Cells(**columns, cell_s=self._cell_s)


def _reduce(stamp_ns: np.ndarray, wrench: Array, angles: Array, starts: np.ndarray) -> Cells:
    ends = np.append(starts[1:], len(stamp_ns))
    count = ends - starts
    mean = np.add.reduceat(wrench, starts, axis=0) / count[:, None]
    # About the cell's own mean, since a difference of large sums would lose the scatter.
    offset = wrench - np.repeat(mean, count, axis=0)
    return Cells(
        stamp_ns[starts],
        stamp_ns[ends - 1],
        count,
        mean,
        np.add.reduceat(offset**2, starts, axis=0),
        np.add.reduceat(angles, starts, axis=0) / count[:, None],
        np.maximum.reduceat(angles, starts, axis=0) - np.minimum.reduceat(angles, starts, axis=0),
    )
