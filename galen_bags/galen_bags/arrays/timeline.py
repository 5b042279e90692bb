"""When the samples of several topics were taken, where stamps may jump.

A bag has two clocks (`galen_bags.arrays.stamp_check`). Where a topic's stamps jump against its log
times, a section ends. Sections whose stamps stand off by more than the limit from most of the
topic's are put back in their place by their median delay, good for ordering and for knowing what
came together; what is measured is taken only from where all topics agree (`Timeline.shift_ns`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array

from galen_bags.arrays.stamp_check import GAP_PERIODS, StampCheck, StampReport

_NS = 1e9


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
        """Only some of the samples (n,)."""
        return Timeline(
            self.row[mask],
            self.stamp_ns[mask],
            self.time_ns[mask],
            self.shift_ns[mask],
            self.delay_ns,
            self.jumps,
            self.report,
        )


def lay_out(stamp_ns: np.ndarray, log_ns: np.ndarray, jump_s: float) -> Timeline:
    """Put a topic's samples, in the order of arrival, on a line of time; all in ns.

    Samples without a stamp, and those not later than one before them, are left out.
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
    """Values (m, k) between a topic's samples at times (m,), whether known (m,), shift_ns (m,).

    values (n, k) belong to the line's samples. Not known outside of them, between two further
    apart than `max_gap_s`, where one of the two isn't finite, and where the stamps jump.
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
    """Return what is wrong with a topic's stamps, as sentences; times in s after `start_ns`.

    beside_ns (m,), increasing: another topic's stamps. Where that has a gap, too, the recorder
    paused, as between two positions, and no sample is missing.
    """
    report, said = line.report, []
    if beside_ns is not None:
        report = _without_pauses(line, beside_ns)
    if report.unstamped:
        said.append(f"{topic}: {_count(report.unstamped, 'sample')} without a stamp; left out")
    if report.gaps:
        said.append(
            f"{topic}: {_count(report.gaps, 'gap')}, {_count(report.missing, 'sample')} missing, "
            f"longest {report.longest_step_s:.3g} s"
        )
    for before_ns, size_ns in line.jumps[:_SAID_JUMPS]:
        after_s = (before_ns - start_ns) / _NS
        said.append(
            f"{topic}: stamps jump by {size_ns / _NS:+.3f} s after {after_s:.3f} s; cut there"
        )
    if len(line.jumps) > _SAID_JUMPS:
        said.append(f"{topic}: stamps jump {len(line.jumps) - _SAID_JUMPS} times more")
    for kinds, number in (
        (("repeats a stamp", "repeat a stamp"), report.duplicates),
        (("is older than one before", "are older than one before"), report.out_of_order),
    ):
        if number:
            said.append(f"{topic}: {_count(number, 'sample')} {kinds[number > 1]}; left out")
    return said


def _without_pauses(line: Timeline, beside_ns: np.ndarray) -> StampReport:
    """Return the line's report without the gaps that `beside_ns` has as well."""
    report = line.report
    if len(line) < 2 or len(beside_ns) < 2:
        return report
    step, beside_step = np.diff(line.time_ns), np.diff(beside_ns)
    period_ns = report.period_s * _NS
    pause = np.flatnonzero(beside_step > GAP_PERIODS * np.median(beside_step))
    wide = np.flatnonzero(step > GAP_PERIODS * period_ns)
    overlap = np.minimum(line.time_ns[wide + 1, None], beside_ns[pause + 1]) - np.maximum(
        line.time_ns[wide, None], beside_ns[pause]
    )
    left = step[wide] - np.maximum(overlap, 0).sum(axis=1)
    paused = wide[left <= GAP_PERIODS * period_ns]
    return replace(
        report,
        gaps=max(report.gaps - len(paused), 0),
        missing=max(report.missing - int(np.sum(np.rint(step[paused] / period_ns) - 1)), 0),
        longest_step_s=float(np.delete(step, paused).max(initial=0)) / _NS,
    )


_SAID_JUMPS = 5


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")
