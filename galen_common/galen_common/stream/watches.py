# SPDX-License-Identifier: Apache-2.0
"""Three watches over a node's inputs: a frozen reading, late wrenches, their publishers. No ROS.

Frozen: a live reading's noise and the weight that turns with the arm both change it. Looked at a
few times a second only: that six numbers with noise repeat bit for bit at several looks in a row
does not happen by chance (noise of four quanta: once in 10^7 looks).

Late: after a stall, wrenches that queued up come at once, and old. One wrench alone doesn't show
it, for the driver's clock may be another machine's. But its arrival minus its stamp, less the
smallest such difference of the last seconds, is the time that it took longer than the fastest:
whatever the clocks' offset, as long as both run at one rate.

Publishers: DDS reports a `kill -9` only by a time-out of some 20 s, and so long the driver that
came back is the second publisher listed. No message tells which publisher it is from. So one that
was silent when the next one came counts as quiet, and only what is not quiet can be one too many.
"""

import math
from collections import Counter
from collections.abc import Sequence

from galen_model.arrays import Array

# A pointer's weight of 0.6 N then changes by six quanta of the sensor.
TURN_RAD = 0.05
FROZEN_S = 1.0


class FrozenWatch:
    """Look at the newest wrench and the newest angles. Times are wall times, s."""

    def __init__(self, frozen_s: float = FROZEN_S) -> None:
        """Start before the first wrench.

        Args:
            frozen_s: so long must the reading stay the same, s of wall time; 0: not watched.

        """
        self._frozen_s = frozen_s
        self._wrench: tuple[float, ...] = ()
        self._since_s = 0.0
        self._received = 0
        self._angles: tuple[float, ...] = ()
        self._turned_rad = 0.0

    def look(
        self,
        now_s: float,
        received: int,
        wrench: Sequence[float] | Array | None,
        angles: Sequence[float] | None,
    ) -> str:
        """Return why the reading can't be a live one.

        Args:
            now_s: wall time, s.
            received: how many wrenches came so far.
            wrench: (6,), the newest, N and N.m; None: none came.
            angles: (k,), the newest of the turning joints, rad; None: none came.

        Returns:
            Words that follow the topic's name; empty while it may be a live one.

        """
        if self._frozen_s <= 0.0 or wrench is None or angles is None:
            return ""
        held = tuple(wrench)
        if held != self._wrench:
            self._wrench, self._angles = held, tuple(angles)
            self._since_s, self._turned_rad = now_s, 0.0
        elif received == self._received:
            return ""  # nothing new came: that is silence
        self._received = received
        pairs = zip(angles, self._angles, strict=True)
        self._turned_rad = max(self._turned_rad, *(abs(now - then) for now, then in pairs))
        held_s = now_s - self._since_s
        if held_s < self._frozen_s or self._turned_rad < TURN_RAD:
            return ""
        return (
            f"has been the same to the last bit for {held_s:.1f} s while the arm turned by"
            f" {self._turned_rad:.2f} rad: the sensor hangs"
        )


LATE_S = 0.05
# The smallest difference is of one to two of these: clocks that drift apart by 500 ppm, more than
# quartzes do, do so by 5 ms meanwhile.
WINDOW_S = 5.0


class LateWatch:
    """Compares arrivals with stamps. A lateness that lasts is the normal one after 10 s at most."""

    def __init__(self, late_s: float = LATE_S) -> None:
        """Start before the first wrench.

        Args:
            late_s: so much longer than the fastest may a wrench take, s; 0: not watched.

        """
        self.on = late_s > 0.0
        self.count = 0
        """How many were late."""
        self.worst_s = 0.0
        """The largest lateness of these."""
        self._late_s = late_s
        self._last_s = -math.inf
        self._reported = 0
        self._reported_s = -math.inf
        self.forget()

    def forget(self) -> None:
        """Begin anew: the stamps are another clock's."""
        self._least_s = self._before_s = self._limit_s = math.inf
        self._turned_s: float | None = None

    def push(self, arrival_s: float, stamp_ns: int) -> None:
        """Take a wrench.

        Args:
            arrival_s: when it came, s, by a clock that is never set, such as the monotonic one.
            stamp_ns: its stamp, ns, by the driver's clock.

        """
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
        """Let go of what is too old; call it a few times a second.

        Args:
            now_s: wall time, s, by the clock of `push`.

        """
        if self.count > self._reported:
            self._reported, self._reported_s = self.count, now_s
        if self._turned_s is None:
            self._turned_s = now_s
        elif now_s - self._turned_s >= WINDOW_S:
            self._turned_s = now_s
            self._before_s, self._least_s = self._least_s, math.inf
            self._limit_s = self._before_s + self._late_s

    def trouble(self, now_s: float, hold_s: float) -> str:
        """Return what was late.

        Args:
            now_s: wall time, s, by the clock of `push`.
            hold_s: how long after the last late one it is reported, s.

        Returns:
            Words; empty: nothing was late so recently.

        """
        if now_s - self._reported_s >= hold_s:
            return ""
        return (
            f"{self._reported} so far came late, the worst by {self.worst_s:.2g} s: they go out,"
            " and their users have to look at their stamps"
        )


class Publishers:
    """The publishers of one topic, as they come and go."""

    def __init__(self, topic: str) -> None:
        """Start with no publisher.

        Args:
            topic: as it is called in sentences.

        """
        self._topic = topic
        self._names: tuple[str, ...] = ()
        self.listed = 0
        """How many there are, by discovery."""
        self.quiet = 0
        """How many of them had been silent when another one came."""
        self.since_s = float("-inf")
        """When that last changed, s."""

    @property
    def sending(self) -> int:
        """How many of them may send."""
        return self.listed - self.quiet

    def changed(self, listed: int, came: int, silent: bool, now_s: float) -> str:
        """Take what discovery reports.

        A first publisher is no restart: its first samples may even have come before. Nor is it one
        when a quiet publisher goes: what came since is from another one.

        Args:
            listed: how many publishers there are now.
            came: how many of these are new.
            silent: whether those listed before had stopped sending.
            now_s: wall time, s.

        Returns:
            Why to start anew; empty: no need.

        """
        before = self.listed
        gone = before + came - listed
        quiet_gone = min(gone, self.quiet)
        self.quiet -= quiet_gone
        self.listed = listed
        self.since_s = now_s
        if came > 0 and silent:
            self.quiet = listed - came
        if gone > quiet_gone:
            return f"driver restarted: a publisher of {self._topic} is gone"
        if came > 0 and before > 0:
            return f"driver restarted: a publisher of {self._topic} is new"
        return ""

    def heard_again(self) -> None:
        """Say that those which had been quiet send as well."""
        self.quiet = 0

    def name(self, nodes: Sequence[str]) -> None:
        """Take the names of their nodes.

        Args:
            nodes: full names, one a publisher.

        """
        self._names = tuple(nodes)

    @property
    def several(self) -> str:
        """Which are too many, in words; empty with one."""
        if self.sending < 2:
            return ""
        text = f"{self._topic} has {self.sending} publishers"
        return f"{text} ({self.nodes})" if self._names else text

    @property
    def nodes(self) -> str:
        """The names of their nodes."""
        counts = Counter(self._names)
        return ", ".join(
            name if count == 1 else f"{name} {count} times" for name, count in counts.items()
        )
