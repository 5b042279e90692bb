"""Are a topic's time stamps sound? Gaps, jumps, duplicates, order, block by block.

The authors of the 2019 report lost weeks to stamps that jumped. A bag has two clocks: the stamp,
taken where the sample was, and the log time, taken where it was received. Where both advance
alike by more than a sample's period, samples are missing (a gap); where the stamp advances
otherwise than the log time, the stamp jumped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_NS = 1e9
# Steps of this many periods are gaps; schedulers make steps of two.
GAP_PERIODS = 2.5
_KEPT_EVENTS = 100


@dataclass(frozen=True)
class StampEvent:
    """Something odd: at `time_s` after the topic's first stamp, `size_s` (signed) of the step."""

    kind: str
    time_s: float
    size_s: float


@dataclass(frozen=True)
class StampReport:
    """What the stamps of a topic are like; times in s. NaN where there is too little to say it.

    rate_hz: without the gaps; `gap` counts steps of over 2.5 periods in which samples are missing,
    `missing` how many; `jump` where stamp and log time advance differently; `out_of_order` smaller
    steps back; `delay_s` is log time less stamp: smallest, mean, largest. `events` holds the first
    of them.
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
    events: tuple[StampEvent, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not (
            self.gaps or self.jumps or self.duplicates or self.out_of_order or self.unstamped
        )


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
    _events: list[StampEvent] = field(default_factory=list)

    def add(self, stamp_ns: np.ndarray, log_time_ns: np.ndarray) -> None:
        """Take stamps (n,) and log times (n,), ns."""
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
        self._last = (int(stamp_ns[-1]), int(log_time_ns[-1]))
        if len(stamp_ns) > 1:
            self._judge(stamp_ns, np.diff(stamp_ns), np.diff(log_time_ns))

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
        wide = step > GAP_PERIODS * self._period_ns
        # A log time that stood still, as while a disk was busy, makes no jump of a regular stamp.
        far = (step < -self.jump_s / 2 * _NS) | (wide & (step > self.jump_s / 2 * _NS))
        jump = far & (np.abs(step - log_step) > self.jump_s * _NS)
        duplicate = step == 0
        late = (step < 0) & ~jump
        gap = wide & ~jump
        regular = ~(jump | duplicate | late | gap)
        self._advance_ns += int(step[regular].sum())
        self._steps += int(np.count_nonzero(regular))
        if np.any(regular | gap):
            self._longest_ns = max(self._longest_ns, int(step[regular | gap].max()))
        if np.any(gap):
            self._missing += int(np.sum(np.rint(step[gap] / self._period_ns) - 1))
        for kind, rows in (
            ("jump", jump), ("gap", gap), ("duplicate", duplicate), ("out_of_order", late)
        ):  # fmt: skip
            found = np.flatnonzero(rows)
            self._note(kind, len(found))
            for row in found[: max(0, _KEPT_EVENTS - len(self._events))]:
                assert self._first is not None
                time_s = (int(stamp_ns[row]) - self._first) / _NS
                self._events.append(StampEvent(kind, time_s, float(step[row]) / _NS))

    def _note(self, kind: str, count: int) -> None:
        self._counts[kind] = self._counts.get(kind, 0) + count


_KINDS = ("gap", "jump", "duplicate", "out_of_order", "unstamped")
