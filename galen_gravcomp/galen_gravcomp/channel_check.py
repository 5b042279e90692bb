"""Does the sensor itself look sound? Channels that are stuck, saturated or not finite.

A channel with noise changes with nearly every sample. If a fraction p of its samples differ from
the one before, a run of L equal ones turns up in N samples about N (1 - p)^L times by chance. A
run for which that is below one in a million is no chance: the channel is saturated when the run
stands at the channel's own largest or smallest value, or at the range's end, else stuck.
A sensor whose noise is below its quantum stands still by nature, on most channels at once; a run
counts only if most other channels go on meanwhile, or if such runs are rare in the channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm import WRENCH_AXES
from galen_model.arrays import Array

_CHANCE = 1e-6
_SHORTEST_RUN = 10
_KEPT_RUNS = 2000
# A channel that spends less than this part of its time in long runs has noise above its quantum.
_RARE = 0.2


@dataclass(frozen=True)
class Run:
    """A channel's equal readings: from `start_ns` on, `count` of them over `duration_s`."""

    axis: int
    start_ns: int
    duration_s: float
    count: int
    value: float


@dataclass(frozen=True)
class ChannelReport:
    """What was found; by axis (6,) where it says so.

    beyond_range (6,): readings at or beyond the sensor's range; not_finite (6,); smallest and
    largest (6,); `stuck` and `saturated`: runs that are no chance, longest first.
    """

    count: int
    beyond_range: np.ndarray
    not_finite: np.ndarray
    smallest: Array
    largest: Array
    stuck: tuple[Run, ...]
    saturated: tuple[Run, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not (
            self.stuck or self.saturated or self.beyond_range.any() or self.not_finite.any()
        )


class ChannelCheck:
    """Takes raw wrenches in the order of arrival; `sensor_range` (6,) in N and N.m."""

    def __init__(self, sensor_range: Array) -> None:
        self._range = np.asarray(sensor_range, dtype=float)
        self._count = 0
        self._beyond = np.zeros(6, dtype=np.int64)
        self._not_finite = np.zeros(6, dtype=np.int64)
        self._smallest = np.full(6, np.inf)
        self._largest = np.full(6, -np.inf)
        self._changes = np.zeros(6, dtype=np.int64)
        # of each channel: the run that the next block may go on with
        self._open: list[tuple[int, int, float] | None] = [None] * 6
        self._runs: list[list[Run]] = [[] for _ in range(6)]
        self._last_ns = 0

    def add(self, stamp_ns: np.ndarray, wrenches: Array) -> None:
        """Take stamps (n,) and raw wrenches (n, 6)."""
        if not len(stamp_ns):
            return
        self._count += len(stamp_ns)
        finite = np.isfinite(wrenches)
        self._not_finite += np.count_nonzero(~finite, axis=0)
        self._beyond += np.count_nonzero(finite & (np.abs(wrenches) >= self._range), axis=0)
        self._smallest = np.fmin(self._smallest, np.fmin.reduce(wrenches, axis=0))
        self._largest = np.fmax(self._largest, np.fmax.reduce(wrenches, axis=0))
        for axis in range(6):
            self._follow(axis, stamp_ns, wrenches[:, axis])
        self._last_ns = int(stamp_ns[-1])

    def report(self) -> ChannelReport:
        """What was found so far."""
        runs = [self._long_runs(axis) for axis in range(6)]
        stuck, saturated = [], []
        for axis in range(6):
            rare = sum(run.count for run in runs[axis]) < _RARE * self._count
            ends = (self._smallest[axis], self._largest[axis])
            for run in self._no_chance(axis, runs[axis]):
                at_end = run.value in ends and ends[0] != ends[1]
                if at_end or abs(run.value) >= self._range[axis]:
                    saturated.append(run)
                elif rare or _alone(run, runs):
                    stuck.append(run)
        order = lambda run: -run.count  # noqa: E731
        return ChannelReport(
            self._count,
            self._beyond,
            self._not_finite,
            self._smallest,
            self._largest,
            tuple(sorted(stuck, key=order)),
            tuple(sorted(saturated, key=order)),
        )

    def _follow(self, axis: int, stamp_ns: np.ndarray, values: Array) -> None:
        """Go on with the channel's runs; the last one stays open."""
        borders = np.flatnonzero(values[1:] != values[:-1]) + 1
        starts = np.concatenate([[0], borders])
        lengths = np.diff(np.append(starts, len(values)))
        before = self._open[axis]
        first_ns, first_count = int(stamp_ns[0]), int(lengths[0])
        if before is not None and before[2] == values[0]:
            first_ns, first_count = before[0], before[1] + first_count
        elif before is not None:
            self._keep(axis, before, self._last_ns)
            self._changes[axis] += 1
        self._changes[axis] += len(borders)
        if not len(borders):
            self._open[axis] = (first_ns, first_count, float(values[0]))
            return
        end_ns = int(stamp_ns[starts[1] - 1])
        self._keep(axis, (first_ns, first_count, float(values[0])), end_ns)
        for k in np.flatnonzero(lengths[1:-1] >= _SHORTEST_RUN) + 1:
            run = (int(stamp_ns[starts[k]]), int(lengths[k]), float(values[starts[k]]))
            self._keep(axis, run, int(stamp_ns[starts[k + 1] - 1]))
        last = int(starts[-1])
        self._open[axis] = (int(stamp_ns[last]), int(lengths[-1]), float(values[last]))

    def _keep(self, axis: int, run: tuple[int, int, float], end_ns: int) -> None:
        if run[1] < _SHORTEST_RUN:
            return
        runs = self._runs[axis]
        runs.append(self._run(axis, run, end_ns))
        if len(runs) > 2 * _KEPT_RUNS:
            runs.sort(key=lambda kept: -kept.count)
            del runs[_KEPT_RUNS:]

    def _run(self, axis: int, run: tuple[int, int, float], end_ns: int) -> Run:
        return Run(axis, run[0], (end_ns - run[0]) * 1e-9, run[1], run[2])

    def _long_runs(self, axis: int) -> list[Run]:
        runs = list(self._runs[axis])
        open_run = self._open[axis]
        if open_run is not None and open_run[1] >= _SHORTEST_RUN:
            runs.append(self._run(axis, open_run, self._last_ns))
        return runs

    def _no_chance(self, axis: int, long: list[Run]) -> list[Run]:
        """The runs that chance does not explain, given how the channel changes outside of them."""
        outside = self._count - sum(run.count for run in long)
        if outside <= 0 or not self._changes[axis]:
            # It never changes. If none of the six does, it is a recording without noise.
            return long if self._changes.any() else []
        changing = min(self._changes[axis] / outside, 1.0 - 1e-12)
        limit = np.log(_CHANCE / self._count) / np.log1p(-changing)
        return [run for run in long if run.count >= limit]


def _alone(run: Run, runs: list[list[Run]]) -> bool:
    """Whether most other channels change while this one does not."""
    end_ns = run.start_ns + round(run.duration_s * 1e9)
    standing = 0
    for axis, others in enumerate(runs):
        if axis == run.axis:
            continue
        overlap = sum(
            max(
                0,
                min(end_ns, other.start_ns + round(other.duration_s * 1e9))
                - max(run.start_ns, other.start_ns),
            )
            for other in others
        )
        standing += overlap > 0.5 * (end_ns - run.start_ns)
    return standing <= 2


def describe_run(run: Run, first_ns: int, verb: str) -> str:
    """A sentence on a run: "fx stuck at 0.5 N for 2.1 s, from 12.3 s on"."""
    unit = "N" if run.axis < 3 else "N.m"
    return (
        f"{WRENCH_AXES[run.axis]} {verb} at {run.value:g} {unit} for {run.duration_s:.2f} s"
        f" ({run.count} readings), from {(run.start_ns - first_ns) * 1e-9:.2f} s on"
    )
