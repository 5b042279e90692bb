# SPDX-License-Identifier: Apache-2.0
"""The still phases of a recording, found in its cells: arm at rest, wrench steady.

The arm is still in a cell in which no angle leaves a narrow band, and whose angles are those
of its neighbour. The wrench is steady from one cell to the next when their means differ by no more
than `steady_sigmas` of what such differences scatter by in this recording (their median absolute
deviation, at least the sensor's quantum): a hand that comes or goes ends a phase. A hand that
holds still looks like a file that does not fit, so a phase may be one of a steady push.
A long stand, and a slow turn, are cut into phases of `max_duration_s` and `max_turn_rad`: a phase
has one time and one pose.

A recording of hours is first reduced to cells of a tenth of a second: means, scatter, angles. All
that an evaluation finds in a recording's course is computed from these, so that it needs memory for
the hours and not for the samples: 150 bytes a cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array, runs
from galen_model.rest.segments import ENCODER_STEP, allowed_travel

CELL_S = 0.1


@dataclass(frozen=True)
class Cells:
    """Cells (n,) in the order of the samples.

    start_ns, end_ns (n,): first and last stamp; count (n,); mean (n, 6) of the compensated wrench
    and squares (n, 6), the sum of squares about that mean, N and N.m; angles (n, k) their
    mean, spans (n, k) largest less smallest, rad.
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
        """Return the number of cells."""
        return len(self.start_ns)

    def rows(self, rows: np.ndarray) -> Cells:
        """Select some of the cells.

        Args:
            rows: mask (n,) or indices.

        Returns:
            Those cells, in that order.

        """
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
        """Take the next block of samples.

        Args:
            stamp_ns: (n,), from where the last block ended.
            wrench: compensated (n, 6), N and N.m.
            angles: (n, k), rad.

        """
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
        """Collect all cells so far.

        Returns:
            The cells; the last one may be short.

        """
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


_MAD_TO_STD = 1.4826
# Cells further apart than so many lengths hold a gap between them.
_NEIGHBOURS = 2.5
_FEWEST_PAIRS = 30
_LARGEST_LAG1 = 0.9


# When a stretch counts as still; the rim is cut off at both ends.
_MAX_RATE_RAD_S = 0.01
_RIM_S = 0.2
_MIN_DURATION_S = 0.3
_MAX_DURATION_S = 10.0
_MAX_TURN_RAD = 0.02
_STEADY_SIGMAS = 6.0


@dataclass(frozen=True)
class StillPhases:
    """Still phases (n,) of a recording.

    start_ns, end_ns (n,); samples (n,); mean (n, 6) of the compensated wrench, N and N.m, and
    std_of_mean (n, 6), by the scatter of the phase's cells and how they hang together; angles
    (n, k), rad.
    arm_still (cells,): where the arm was at rest; noise (6,): standard deviation of one sample
    about its cell's mean, pooled over the phases.
    """

    start_ns: np.ndarray
    end_ns: np.ndarray
    samples: np.ndarray
    mean: Array
    std_of_mean: Array
    angles: Array
    arm_still: np.ndarray
    noise: Array

    def __len__(self) -> int:
        """Return the number of phases."""
        return len(self.start_ns)

    def part(self, rows: slice) -> StillPhases:
        """Select some of the phases; `arm_still` and `noise` stay those of all.

        Args:
            rows: which phases.

        Returns:
            Those phases.

        """
        columns = ("start_ns", "end_ns", "samples", "mean", "std_of_mean", "angles")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def find_still_phases(cells: Cells) -> StillPhases:
    """Find the phases in which the arm was still and the wrench steady.

    Args:
        cells: of a whole recording, in order.

    Returns:
        Phases, each within `_MAX_DURATION_S` and `_MAX_TURN_RAD`; none, with noise of NaN, if the
        arm never stood still.

    """
    arm_still, joined = _arm_still(cells)
    steady = joined & _steady(cells, joined)
    phases = []
    # A run of cells, each joined to the next; cut at its rims.
    for start, last_joint in runs(steady):
        stop = last_joint + 1
        rim_ns = _RIM_S * 1e9
        first, last = cells.start_ns[start] + rim_ns, cells.end_ns[stop - 1] - rim_ns
        rows = np.arange(start, stop)
        rows = rows[(cells.start_ns[rows] >= first) & (cells.end_ns[rows] <= last)]
        for piece in _pieces(cells, rows):
            length_ns = cells.end_ns[piece[-1]] - cells.start_ns[piece[0]]
            if len(piece) >= 2 and length_ns >= _MIN_DURATION_S * 1e9:
                phases.append(cells.rows(piece))
    return _summary(phases, arm_still)


def _pieces(cells: Cells, rows: np.ndarray) -> Iterator[np.ndarray]:
    """Return a run's cells cut where it becomes too long or has turned too far."""
    if not len(rows):
        return
    cell_ns = cells.cell_s * 1e9
    length_ns = cells.start_ns[rows[-1]] - cells.start_ns[rows[0]] + cell_ns
    # Pieces of one length, since all phases count alike.
    longest_ns = length_ns / np.ceil(length_ns / (_MAX_DURATION_S * 1e9))
    first = 0
    while first < len(rows):
        rest = rows[first:]
        turned = np.abs(cells.angles[rest] - cells.angles[rest[0]]).max(axis=1)
        late = cells.start_ns[rest] - cells.start_ns[rest[0]] > longest_ns - cell_ns / 2
        over = np.flatnonzero((turned > _MAX_TURN_RAD) | late)
        count = max(int(over[0]), 1) if len(over) else len(rest)
        yield rest[:count]
        first += count


def _arm_still(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Cells (n,) in which the arm is at rest, and whether (n - 1,) each goes on in the next."""
    band = allowed_travel(_MAX_RATE_RAD_S, cells.cell_s, ENCODER_STEP[1], steps=2.0)
    still = np.all(cells.spans <= band, axis=1)
    near = np.all(np.abs(np.diff(cells.angles, axis=0)) <= band, axis=1)
    gap = cells.start_ns[1:] - cells.end_ns[:-1]
    neighbours = np.abs(gap) <= _NEIGHBOURS * cells.cell_s * 1e9
    return still, still[1:] & still[:-1] & near & neighbours


def _steady(cells: Cells, joined: np.ndarray) -> np.ndarray:
    """Whether (n - 1,) the wrench of each cell goes on in the next."""
    step = np.abs(np.diff(cells.mean, axis=0))
    if not joined.any():
        return np.zeros(len(step), dtype=bool)
    scatter = _MAD_TO_STD * np.median(step[joined], axis=0)
    return np.all(step <= _STEADY_SIGMAS * np.maximum(scatter, SENSOR.quantum), axis=1)


def _lag1(phases: list[Cells]) -> Array:
    """Autocorrelation (6,) of neighbouring cells' means within the phases, 0 if too few to tell.

    Of all phases together, without the bias of short series (Kendall, *Biometrika* 41, 1954).
    """
    pairs = sum(len(cells) - 1 for cells in phases)
    if pairs < _FEWEST_PAIRS:
        return np.zeros(6)
    squares, products = np.zeros(6), np.zeros(6)
    for cells in phases:
        offset = cells.mean - cells.mean.mean(axis=0)
        squares += np.sum(offset**2, axis=0) * (len(cells) - 1) / len(cells)
        products += np.sum(offset[1:] * offset[:-1], axis=0)
    length = max(1.0 + pairs / len(phases), 4.0)
    lag1 = products / np.where(squares > 0.0, squares, 1.0)
    return np.clip((lag1 + 1.0 / length) / (1.0 - 3.0 / length), 0.0, _LARGEST_LAG1)


def _inflation(lag1: Array, count: int) -> Array:
    """How many times more than white noise's the mean of `count` cells varies, as AR(1)."""
    rest = 2.0 * lag1 * (1.0 - lag1**count) / (count * (1.0 - lag1) ** 2)
    return np.asarray((1.0 + lag1) / (1.0 - lag1) - rest)


def _summary(phases: list[Cells], arm_still: np.ndarray) -> StillPhases:
    rows = []
    lag1 = _lag1(phases)
    squares, freedom = np.zeros(6), 0
    for cells in phases:
        total = int(cells.count.sum())
        weight = cells.count[:, None] / total
        mean = np.sum(weight * cells.mean, axis=0)
        between = np.sum(weight * (cells.mean - mean) ** 2, axis=0) / (len(cells) - 1)
        # Cells that hang together make a worse mean, and scatter less about it.
        inflation = _inflation(lag1, len(cells))
        between *= inflation * (len(cells) - 1) / np.maximum(len(cells) - inflation, 1.0)
        within = cells.squares.sum(axis=0)
        squares, freedom = squares + within, freedom + total - len(cells)
        # White noise gives the second; a filtered or drifting sensor more, and then the first.
        white = within / max(total - len(cells), 1) / total
        rows.append(
            (
                cells.start_ns[0],
                cells.end_ns[-1],
                total,
                mean,
                np.sqrt(np.maximum(between, white)),
                np.sum(weight * cells.angles, axis=0),
            )
        )
    if not rows:
        none, six = np.zeros(0, dtype=np.int64), np.zeros((0, 6))
        nothing = np.full(6, np.nan)
        return StillPhases(none, none, none, six, six, np.zeros((0, 2)), arm_still, nothing)
    start_ns, end_ns, samples, mean, std, angles = map(np.array, zip(*rows, strict=True))
    noise = np.sqrt(squares / max(freedom, 1))
    return StillPhases(start_ns, end_ns, samples, mean, std, angles, arm_still, noise)
