# SPDX-License-Identifier: Apache-2.0
"""Does the sensor itself look sound? Channels that are stuck, saturated or not finite.

A driver may send each of the sensor's readings several times: all six channels are then equal for
about the same number of messages, over and over. That number is found first, and a reading that
comes again counts once. A run of all six that is far longer is a frozen reading.

A channel with noise above its quantum changes with most readings. If a fraction p of them differs
from the one before, a run of L equal ones turns up in N readings about N (1 - p)^L times by
chance. A run for which that is below one in a million is no chance: the channel is saturated when
the run stands at the channel's own largest or smallest value, or at the range's end, else stuck.
Where the noise is below the quantum (a coarse or strongly filtered sensor), a channel stands still
by nature: there, only one that never changes, while another does all the time, is called stuck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

_CHANCE = 1e-6
_SHORTEST_RUN = 10
_KEPT_RUNS = 2000
# Below this part of readings that differ from the one before, the noise is below the quantum.
_NOISY = 0.5
# The same of a sound sensor's six channels together.
_NOISY_ROWS = 0.8
# How often a channel changes depends a little on where between two quanta it stands.
_LEAST_NOISY = 0.8
_LONGEST_HOLD = 256
# A stand of so many usual ones is a frozen reading.
_FROZEN_HOLDS = 10


RUNS = ("frozen", "stuck", "saturated")
"""Kinds of runs in a `ChannelReport`."""


@dataclass(frozen=True)
class EqualReadings:
    """Equal readings: from `start_ns` on, `count` of them over `duration_s`.

    `axis` is None where all six are equal; `value` is then that of fx.
    """

    axis: int | None
    start_ns: int
    duration_s: float
    count: int
    value: float


@dataclass(frozen=True)
class ChannelReport:
    """Faults of the channels.

    beyond_range, not_finite (6,): how many readings; `stuck` and `saturated`: runs of one channel
    that are no chance, `frozen`: of all six at once; longest first. `held`: how often each reading
    usually comes.
    """

    beyond_range: np.ndarray
    not_finite: np.ndarray
    stuck: tuple[EqualReadings, ...]
    saturated: tuple[EqualReadings, ...]
    frozen: tuple[EqualReadings, ...]
    held: int


class ChannelCheck:
    """Takes raw wrenches in the order of arrival; `sensor_range` (6,) in N and N.m."""

    def __init__(self, sensor_range: Array) -> None:
        self._range = np.asarray(sensor_range, dtype=float)
        self._count = 0
        self._beyond = np.zeros(6, dtype=np.int64)
        self._not_finite = np.zeros(6, dtype=np.int64)
        self._smallest = np.full(6, np.inf)
        self._largest = np.full(6, -np.inf)
        self._last: Array | None = None
        # of all messages; of each channel, in the messages in which any channel changes
        self._rows = _Runs()
        self._channels = [_Runs() for _ in range(6)]

    def add(self, stamp_ns: np.ndarray, wrenches: Array) -> None:
        """Take raw wrenches, in the order of arrival.

        Args:
            stamp_ns: (n,) their stamps.
            wrenches: (n, 6) in the sensor's frame, N and N.m; not finite ones are counted.

        """
        if not len(stamp_ns):
            return
        self._count += len(stamp_ns)
        finite = np.isfinite(wrenches)
        self._not_finite += np.count_nonzero(~finite, axis=0)
        self._beyond += np.count_nonzero(finite & (np.abs(wrenches) >= self._range), axis=0)
        self._smallest = np.fmin(self._smallest, np.fmin.reduce(wrenches, axis=0))
        self._largest = np.fmax(self._largest, np.fmax.reduce(wrenches, axis=0))
        differs = np.empty(wrenches.shape, dtype=bool)
        np.not_equal(wrenches[1:], wrenches[:-1], out=differs[1:])
        differs[0] = True if self._last is None else wrenches[0] != self._last
        self._last = wrenches[-1].copy()
        new = np.asarray(differs.any(axis=1))
        self._rows.add(stamp_ns, new, wrenches[:, 0])
        if not new.all():
            stamp_ns, wrenches, differs = stamp_ns[new], wrenches[new], differs[new]
        for axis, runs in enumerate(self._channels):
            runs.add(stamp_ns, differs[:, axis], wrenches[:, axis])

    def report(self) -> ChannelReport:
        """Judge the readings so far."""
        held = self._rows.usual_length()
        frozen = self._rows.no_chance(None, held)
        readings = (self._count - sum(run.count for run in frozen)) / held
        # Of a coarse sensor only some readings differ from the one before in any channel.
        share = min(1.0, self._rows.changes / readings) if readings else 0.0
        any_noisy = any(share * runs.changing() >= _NOISY for runs in self._channels)
        stuck: list[EqualReadings] = []
        saturated: list[EqualReadings] = []
        for axis, runs in enumerate(self._channels):
            ends = (self._smallest[axis], self._largest[axis])
            for run in runs.no_chance(axis, share=share, never_changes=any_noisy):
                at_end = run.value in ends and ends[0] != ends[1]
                beyond = abs(run.value) >= self._range[axis]
                (saturated if at_end or beyond else stuck).append(run)
        return ChannelReport(
            self._beyond,
            self._not_finite,
            _longest_first(stuck),
            _longest_first(saturated),
            _longest_first(frozen),
            held,
        )


class _Runs:
    """The runs of equal values in a sequence that comes in blocks; `changes`: how many began."""

    def __init__(self) -> None:
        self._count = 0
        self.changes = 0
        # start, length and value of the run that the next block may go on with
        self._open: tuple[int, int, float] | None = None
        self._last_ns = 0
        self._long: list[EqualReadings] = []
        self._lengths = np.zeros(_LONGEST_HOLD + 1, dtype=np.int64)

    def add(self, stamp_ns: np.ndarray, new: np.ndarray, values: Array) -> None:
        """Take stamps (n,), whether each value differs from the one before, and values (n,)."""
        if not len(stamp_ns):
            return
        self._count += len(stamp_ns)
        starts = np.flatnonzero(new)
        self.changes += len(starts)
        first = int(starts[0]) if len(starts) else len(stamp_ns)
        if self._open is not None:
            start_ns, length, value = self._open
            self._open = (start_ns, length + first, value)
            if len(starts):
                end_ns = int(stamp_ns[first - 1]) if first else self._last_ns
                self._keep(self._open, end_ns)
        if len(starts):
            lengths = np.diff(starts)
            self._lengths += np.bincount(
                np.minimum(lengths, _LONGEST_HOLD), minlength=_LONGEST_HOLD + 1
            )
            for k in np.flatnonzero(lengths >= _SHORTEST_RUN):
                start = int(starts[k])
                run = (int(stamp_ns[start]), int(lengths[k]), float(values[start]))
                self._append(run, int(stamp_ns[starts[k + 1] - 1]))
            last = int(starts[-1])
            self._open = (int(stamp_ns[last]), len(stamp_ns) - last, float(values[last]))
        self._last_ns = int(stamp_ns[-1])

    def usual_length(self) -> int:
        """Length of the usual run where hardly any are of length 1; else 1."""
        total = np.cumsum(self._lengths)
        # The median, and nine in ten at least half as long: all of one kind, not a wide mixture.
        middle = int(np.searchsorted(total, 0.5 * total[-1])) if total[-1] else 1
        low = int(np.searchsorted(total, 0.1 * total[-1])) if total[-1] else 1
        return middle if low >= 2 and 2 * low >= middle else 1

    def no_chance(
        self, axis: int | None, held: int = 1, *, share: float = 1.0, never_changes: bool = False
    ) -> list[EqualReadings]:
        """Return the runs that chance does not explain, of a sequence of runs usually `held` long.

        `share`: part of the readings that are in the sequence at all; `never_changes`: a run over
        all of it counts as well.
        """
        runs = [replace(run, axis=axis) for run in self._all_long()]
        if held > 1:
            return [run for run in runs if run.count >= _FROZEN_HOLDS * held]
        if self.changes <= 1:
            return runs if never_changes else []
        changing = self.changing()
        if share * changing < (_NOISY_ROWS if axis is None else _NOISY):
            return []
        limit = self._limit(changing)
        return [run for run in runs if run.count >= limit]

    def changing(self) -> float:
        """Part of the values that differ from the one before, outside of runs beyond chance."""
        if not self._count or self.changes <= 1:
            return 0.0
        outside, runs = self._count, self._all_long()
        while True:
            changing = self.changes / outside
            limit = self._limit(changing)
            rest = self._count - sum(run.count - 1 for run in runs if run.count >= limit)
            if rest >= outside:
                return changing
            outside = rest

    def _limit(self, changing: float) -> float:
        """Length from which on a run is no chance."""
        changing = min(_LEAST_NOISY * changing, 1.0 - 1e-12)
        return max(float(_SHORTEST_RUN), np.log(_CHANCE / self._count) / np.log1p(-changing))

    def _all_long(self) -> list[EqualReadings]:
        runs = list(self._long)
        if self._open is not None and self._open[1] >= _SHORTEST_RUN:
            runs.append(_run(self._open, self._last_ns))
        return runs

    def _keep(self, run: tuple[int, int, float], end_ns: int) -> None:
        self._lengths[min(run[1], _LONGEST_HOLD)] += 1
        if run[1] >= _SHORTEST_RUN:
            self._append(run, end_ns)

    def _append(self, run: tuple[int, int, float], end_ns: int) -> None:
        self._long.append(_run(run, end_ns))
        if len(self._long) > 2 * _KEPT_RUNS:
            self._long = list(_longest_first(self._long)[:_KEPT_RUNS])


def _run(run: tuple[int, int, float], end_ns: int) -> EqualReadings:
    return EqualReadings(None, run[0], (end_ns - run[0]) * 1e-9, run[1], run[2])


def _longest_first(runs: Sequence[EqualReadings]) -> tuple[EqualReadings, ...]:
    return tuple(sorted(runs, key=lambda run: -run.count))


def describe_run(run: EqualReadings, first_ns: int, verb: str) -> str:
    """Describe a run: "fx stuck at 0.5 N for 2.10 s (1050 readings), from 12.30 s on".

    Args:
        run: equal readings of one channel, or of all.
        first_ns: stamp that the text counts time from.
        verb: one of `RUNS`.

    Returns:
        The text, without a full stop.

    """
    since_s = (run.start_ns - first_ns) * 1e-9
    span = f"for {run.duration_s:.2f} s ({run.count} readings), from {since_s:.2f} s on"
    if run.axis is None:
        return f"all six channels {verb} {span}"
    unit = "N" if run.axis < 3 else "N.m"
    return f"{WRENCH_AXES[run.axis]} {verb} at {run.value:g} {unit} {span}"
