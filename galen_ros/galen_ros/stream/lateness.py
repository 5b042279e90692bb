"""Whether wrenches come late: after a stall, those that queued up come at once, and old. No ROS.

How late a wrench is can't be told from one alone, for the driver's clock may be another machine's.
But its arrival minus its stamp, less the smallest such difference of the last seconds, is the time
that it took longer than the fastest: whatever the clocks' offset, as long as both run at one rate.
"""

import math

LATE_S = 0.05
# The smallest difference is of one to two of these: clocks that drift apart by 500 ppm, more than
# quartzes do, do so by 5 ms meanwhile.
WINDOW_S = 5.0


class LateWatch:
    """Compares arrivals with stamps. A lateness that lasts is the normal one after 10 s at most."""

    def __init__(self, late_s: float = LATE_S) -> None:
        """`late_s`: so much longer than the fastest may a wrench take; 0: not watched."""
        self.on = late_s > 0.0
        self.count = 0
        """How many were late."""
        self.worst_s = 0.0
        """The largest lateness of these."""
        self._late_s = late_s
        self._last_s = -math.inf
        self._told = 0
        self._told_s = -math.inf
        self.forget()

    def forget(self) -> None:
        """Begin anew: the stamps are another clock's."""
        self._least_s = self._before_s = self._limit_s = math.inf
        self._turned_s: float | None = None

    def push(self, arrival_s: float, stamp_ns: int) -> None:
        """Take a wrench; `arrival_s` by a clock that is never set, such as the monotonic one."""
        if not self.on:
            return
        stamp_s = stamp_ns * 1e-9
        if stamp_s < self._last_s - self._late_s:
            self.forget()  # a clock was set back; else what follows would seem late
        self._last_s = stamp_s
        took_s = arrival_s - stamp_s
        if took_s < self._least_s:
            self._least_s = took_s
            self._limit_s = min(self._limit_s, took_s + self._late_s)
        if took_s > self._limit_s:
            self.count += 1
            self.worst_s = max(self.worst_s, took_s - self._limit_s + self._late_s)

    def tick(self, now_s: float) -> None:
        """Let go of what is too old; call it a few times a second."""
        if self.count > self._told:
            self._told, self._told_s = self.count, now_s
        if self._turned_s is None:
            self._turned_s = now_s
        elif now_s - self._turned_s >= WINDOW_S:
            self._turned_s = now_s
            self._before_s, self._least_s = self._least_s, math.inf
            self._limit_s = self._before_s + self._late_s

    def trouble(self, now_s: float, hold_s: float) -> str:
        """What was late, in words, for so long after the last one; else empty."""
        if now_s - self._told_s >= hold_s:
            return ""
        return (
            f"{self._told} so far came late, the worst by {self.worst_s:.2g} s: they go out,"
            " and whoever takes them has to look at their stamps"
        )
