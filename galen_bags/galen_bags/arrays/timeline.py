# SPDX-License-Identifier: Apache-2.0
"""Whether a topic's time stamps are sound, and when the samples of several topics were taken.

The authors of the 2019 report lost weeks to stamps that jumped. A bag has two clocks: the stamp,
taken where the sample was, and the log time, taken where it was received. Where both advance
alike by more than a sample's period, samples are missing (a gap); where the stamp advances
otherwise than the log time, the stamp jumped, and a section ends. Sections whose stamps stand off
by more than the limit from most of the topic's are put back in their place by their median delay,
good for ordering and for knowing what came together; what is measured is taken only from where all
topics agree (`Timeline.shift_ns`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from galen_model.arrays import Array

_NS = 1e9
# Steps of this many periods are gaps; schedulers make steps of two.
_GAP_PERIODS = 2.5
_KEPT_EVENTS = 100
_KEPT_GAPS = 100
_KINDS = ("gap", "jump", "duplicate", "out_of_order", "unstamped")
_MOST_JUMPS = 5


@dataclass(frozen=True)
class StampReport:
    """What the stamps of a topic are like; times in s. NaN where there is too little to say it.

    rate_hz: without the gaps; `gap` counts steps of over 2.5 periods in which samples are missing,
    `missing` how many; `jump` where stamp and log time advance differently; `out_of_order` smaller
    steps back; `delay_s` is log time less stamp: smallest, mean, largest. `events` holds the first
    of them: what, when after the topic's first stamp, and the size (signed) of the step.
    """

    count: int
    rate_hz: float
    period_s: float
    longest_step_s: float
    gaps: int
    missing: int
    jumps: int
    duplicates: int
    out_of_order: int
    unstamped: int
    delay_s: tuple[float, float, float]
    events: tuple[tuple[str, float, float], ...]


@dataclass
class StampCheck:
    """Takes one topic's stamps and log times, in the order of arrival."""

    jump_s: float = 0.1
    _first: int | None = None
    _last: tuple[int, int] | None = None
    _period_ns: float = float("nan")
    _periods: list[float] = field(default_factory=list)
    _counts: dict[str, int] = field(default_factory=dict)
    _count: int = 0
    _missing: int = 0
    _advance_ns: int = 0
    _steps: int = 0
    _longest_ns: int = 0
    _delay: list[float] = field(default_factory=lambda: [np.inf, 0.0, -np.inf])
    _events: list[tuple[str, float, float]] = field(default_factory=list)
    # Begin and end, ns, and how many samples are missing: one that comes late may be of them.
    _gaps: list[list[int]] = field(default_factory=list)

    def add(self, stamp_ns: np.ndarray, log_time_ns: np.ndarray) -> None:
        """Take samples, in the order of arrival.

        Args:
            stamp_ns: stamps (n,), ns; 0 or less: the sample has none.
            log_time_ns: log times (n,), ns.

        """
        self._count += len(stamp_ns)
        stamped = stamp_ns > 0
        self._note("unstamped", int(np.count_nonzero(~stamped)))
        stamp_ns, log_time_ns = stamp_ns[stamped], log_time_ns[stamped]
        if not len(stamp_ns):
            return
        delay = (log_time_ns - stamp_ns) / _NS
        self._delay[0] = min(self._delay[0], float(delay.min()))
        self._delay[1] += float(delay.sum())
        self._delay[2] = max(self._delay[2], float(delay.max()))
        if self._first is None:
            self._first = int(stamp_ns[0])
        if self._last is not None:
            stamp_ns = np.concatenate([[self._last[0]], stamp_ns])
            log_time_ns = np.concatenate([[self._last[1]], log_time_ns])
        late = self._late(stamp_ns, log_time_ns)
        filling = stamp_ns[late]
        stamp_ns, log_time_ns = np.delete(stamp_ns, late), np.delete(log_time_ns, late)
        self._last = (int(stamp_ns[-1]), int(log_time_ns[-1]))
        if len(stamp_ns) > 1:
            self._judge(stamp_ns, np.diff(stamp_ns), np.diff(log_time_ns))
        for stamp in filling:
            self._fill(int(stamp))

    def _late(self, stamp_ns: np.ndarray, log_time_ns: np.ndarray) -> list[int]:
        """Return the rows of samples that are older than one before them, and no jump."""
        if not np.any(np.diff(stamp_ns) < 0):
            return []
        late, last = [], 0
        for row in range(1, len(stamp_ns)):
            step = int(stamp_ns[row] - stamp_ns[last])
            far = step < -self.jump_s / 2 * _NS
            jump = far and abs(step - int(log_time_ns[row] - log_time_ns[last])) > self.jump_s * _NS
            if step < 0 and not jump:
                late.append(row)
            else:
                last = row
        return late

    def _fill(self, stamp_ns: int) -> None:
        """Count a sample that came late, and take it from the gap that it left."""
        self._note("out_of_order", 1)
        if len(self._events) < _KEPT_EVENTS:
            assert self._first is not None
            late_s = (stamp_ns - self._last[0]) / _NS if self._last else 0.0
            self._events.append(("out_of_order", (stamp_ns - self._first) / _NS, late_s))
        for gap in self._gaps:
            if gap[0] < stamp_ns < gap[1] and gap[2] > 0:
                gap[2] -= 1
                self._missing -= 1
                if gap[2] == 0:
                    assert self._first is not None
                    self._note("gap", -1)
                    at_s = (gap[0] - self._first) / _NS
                    self._events = [e for e in self._events if e[:2] != ("gap", at_s)]
                return

    def report(self) -> StampReport:
        """Return what was found so far."""
        counts = {kind: self._counts.get(kind, 0) for kind in _KINDS}
        stamped = self._count - counts["unstamped"]
        good = self._steps > 0 and self._advance_ns > 0
        return StampReport(
            count=self._count,
            rate_hz=self._steps / (self._advance_ns / _NS) if good else float("nan"),
            period_s=self._period_ns / _NS,
            longest_step_s=self._longest_ns / _NS,
            gaps=counts["gap"],
            missing=self._missing,
            jumps=counts["jump"],
            duplicates=counts["duplicate"],
            out_of_order=counts["out_of_order"],
            unstamped=counts["unstamped"],
            delay_s=(self._delay[0], self._delay[1] / stamped, self._delay[2])
            if stamped
            else (float("nan"),) * 3,
            events=tuple(self._events),
        )

    def _judge(self, stamp_ns: np.ndarray, step: np.ndarray, log_step: np.ndarray) -> None:
        forward = step[step > 0]
        if len(forward):
            # The median of the blocks' medians: one block may be all trouble.
            self._periods.append(float(np.median(forward)))
            del self._periods[1000:]
            self._period_ns = float(np.median(self._periods))
        wide = step > _GAP_PERIODS * self._period_ns
        # A log time that stood still, as while a disk was busy, makes no jump of a regular stamp.
        far = (step < -self.jump_s / 2 * _NS) | (wide & (step > self.jump_s / 2 * _NS))
        jump = far & (np.abs(step - log_step) > self.jump_s * _NS)
        duplicate = step == 0
        gap = wide & ~jump
        regular = ~(jump | duplicate | gap)
        self._advance_ns += int(step[regular].sum())
        self._steps += int(np.count_nonzero(regular))
        if np.any(regular | gap):
            self._longest_ns = max(self._longest_ns, int(step[regular | gap].max()))
        for row in np.flatnonzero(gap):
            missing = int(np.rint(step[row] / self._period_ns)) - 1
            self._missing += missing
            self._gaps.append([int(stamp_ns[row]), int(stamp_ns[row + 1]), missing])
        del self._gaps[:-_KEPT_GAPS]
        for kind, rows in (("jump", jump), ("gap", gap), ("duplicate", duplicate)):
            found = np.flatnonzero(rows)
            self._note(kind, len(found))
            for row in found[: max(0, _KEPT_EVENTS - len(self._events))]:
                assert self._first is not None
                time_s = (int(stamp_ns[row]) - self._first) / _NS
                self._events.append((kind, time_s, float(step[row]) / _NS))

    def _note(self, kind: str, count: int) -> None:
        self._counts[kind] = self._counts.get(kind, 0) + count


@dataclass(frozen=True)
class Timeline:
    """Samples (n,) of one topic that have a place in time.

    row (n,): where they were in the arrays given. stamp_ns (n,); time_ns (n,): the stamps, put
    back in their place where they jumped, increasing; shift_ns (n,): how far ahead of it they
    stood, 0 where they didn't jump. delay_ns: log time over stamp, for most of the topic. jumps:
    the stamp before each, and how far ahead it went, ns.
    """

    row: np.ndarray
    stamp_ns: np.ndarray
    time_ns: np.ndarray
    shift_ns: np.ndarray
    delay_ns: int
    jumps: tuple[tuple[int, int], ...]
    report: StampReport

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.row)

    def kept(self, mask: np.ndarray) -> Timeline:
        """Return only some of the samples.

        Args:
            mask: (n,) bool, or indices, of the samples to keep.

        Returns:
            The line of those; delay, jumps and report stay those of the whole topic.

        """
        return replace(
            self,
            row=self.row[mask],
            stamp_ns=self.stamp_ns[mask],
            time_ns=self.time_ns[mask],
            shift_ns=self.shift_ns[mask],
        )


def lay_out(stamp_ns: np.ndarray, log_ns: np.ndarray, jump_s: float) -> Timeline:
    """Put a topic's samples on a line of time.

    Args:
        stamp_ns: stamps (n,), ns, in the order of arrival; 0 or less: the sample has none.
        log_ns: log times (n,), ns.
        jump_s: change, s, of the delay from stamp to log time from which on the stamps jumped.

    Returns:
        The samples, increasing in time; without those that have no stamp, or aren't later than one
        before them.

    """
    check = StampCheck(jump_s)
    check.add(stamp_ns, log_ns)
    row = np.flatnonzero(stamp_ns > 0)
    stamp, log = stamp_ns[row], log_ns[row]
    if not len(row):
        return Timeline(row, stamp, stamp, stamp, 0, (), check.report())
    jump_ns = jump_s * _NS
    delay = log - stamp
    edges = np.flatnonzero(np.abs(np.diff(delay)) > jump_ns) + 1
    # Where the delay soon is what it was, the recorder held up, and the stamps are sound.
    edges = edges[np.abs(np.diff(_medians(delay, edges))) > jump_ns]
    medians = _medians(delay, edges)
    jumps = tuple(
        (int(stamp[edge - 1]), int(size))
        for edge, size in zip(edges, -np.diff(medians), strict=True)
    )
    delay = np.repeat(medians, np.diff([0, *edges, len(row)]))
    most = int(np.percentile(delay, 50, method="nearest"))
    shift = most - delay
    shift[np.abs(shift) <= jump_ns] = 0
    time = stamp - shift
    later = np.concatenate([[True], time[1:] > np.maximum.accumulate(time)[:-1]])
    return Timeline(
        row[later], stamp[later], time[later], shift[later], most, jumps, check.report()
    )


def _medians(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Median of each part between the edges, as whole numbers."""
    parts = np.split(values, edges)
    return np.rint([np.median(part) for part in parts]).astype(np.int64)


def interpolated(
    line: Timeline, values: Array, at_ns: np.ndarray, max_gap_s: float
) -> tuple[Array, np.ndarray, np.ndarray]:
    """Interpolate a topic's values between its samples.

    Args:
        line: the topic's n samples.
        values: (n, k), of the line's samples.
        at_ns: times (m,), ns, on the same clock as the line's.
        max_gap_s: samples further apart, s, have nothing known between them.

    Returns:
        Values (m, k), NaN where not known; whether known, (m,) bool: False outside of the samples,
        in a gap, where one of the two isn't finite, and where the stamps jump; and the line's shift
        (m,), ns, at the sample before.

    """
    if not len(line):
        return (
            np.full((len(at_ns), values.shape[1]), np.nan),
            np.zeros(len(at_ns), dtype=bool),
            np.zeros(len(at_ns), dtype=np.int64),
        )
    right = np.searchsorted(line.time_ns, at_ns, side="left")
    inside = right < len(line)
    right = np.minimum(right, len(line) - 1)
    exact = line.time_ns[right] == at_ns
    left = np.where(exact, right, np.maximum(right - 1, 0))
    inside &= exact | (line.time_ns[left] < at_ns)
    gap = line.time_ns[right] - line.time_ns[left]
    part = (at_ns - line.time_ns[left]) / np.maximum(gap, 1)
    between = values[left] + part[:, None] * (values[right] - values[left])
    known = (
        inside
        & (gap <= max_gap_s * _NS)
        & (line.shift_ns[left] == line.shift_ns[right])
        & np.isfinite(between).all(axis=1)
    )
    return np.where(known[:, None], between, np.nan), known, line.shift_ns[left]


def stamp_sentences(
    topic: str, line: Timeline, start_ns: int, beside_ns: np.ndarray | None = None
) -> list[str]:
    """Return what is wrong with a topic's stamps, as sentences.

    Args:
        topic: its name, with which each sentence begins.
        line: its samples.
        start_ns: time, ns, from which the times in the sentences count, in s.
        beside_ns: another topic's stamps (m,), ns, increasing. Where that has a gap, too, the
            recorder paused, as between two positions, and no sample is missing. None: every gap
            counts.

    Returns:
        The sentences; none where the stamps are sound.

    """
    report, sentences = line.report, []
    if beside_ns is not None:
        report = _without_pauses(line, beside_ns)
    if report.unstamped:
        sentences.append(f"{topic}: {_count(report.unstamped, 'sample')} without a stamp; left out")
    if report.gaps:
        sentences.append(
            f"{topic}: {_count(report.gaps, 'gap')}, {_count(report.missing, 'sample')} missing, "
            f"longest {report.longest_step_s:.3g} s"
        )
    for before_ns, size_ns in line.jumps[:_MOST_JUMPS]:
        after_s = (before_ns - start_ns) / _NS
        sentences.append(
            f"{topic}: stamps jump by {size_ns / _NS:+.3f} s after {after_s:.3f} s; cut there"
        )
    if len(line.jumps) > _MOST_JUMPS:
        sentences.append(f"{topic}: stamps jump {len(line.jumps) - _MOST_JUMPS} times more")
    for kinds, number in (
        (("repeats a stamp", "repeat a stamp"), report.duplicates),
        (("is older than one before", "are older than one before"), report.out_of_order),
    ):
        if number:
            sentences.append(f"{topic}: {_count(number, 'sample')} {kinds[number > 1]}; left out")
    return sentences


def _without_pauses(line: Timeline, beside_ns: np.ndarray) -> StampReport:
    """Return the line's report without the gaps that `beside_ns` has as well."""
    report = line.report
    if len(line) < 2 or len(beside_ns) < 2:
        return report
    step, beside_step = np.diff(line.time_ns), np.diff(beside_ns)
    period_ns = report.period_s * _NS
    pause = np.flatnonzero(beside_step > _GAP_PERIODS * np.median(beside_step))
    wide = np.flatnonzero(step > _GAP_PERIODS * period_ns)
    overlap = np.minimum(line.time_ns[wide + 1, None], beside_ns[pause + 1]) - np.maximum(
        line.time_ns[wide, None], beside_ns[pause]
    )
    left = step[wide] - np.maximum(overlap, 0).sum(axis=1)
    paused = wide[left <= _GAP_PERIODS * period_ns]
    return replace(
        report,
        gaps=max(report.gaps - len(paused), 0),
        missing=max(report.missing - int(np.sum(np.rint(step[paused] / period_ns) - 1)), 0),
        longest_step_s=float(np.delete(step, paused).max(initial=0)) / _NS,
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")
