"""Whether a driver is silent: the one question that goes by the wall clock."""

from __future__ import annotations

# A tick of the wall clock counts at most this much towards a silence: a process that was itself
# held up for seconds has the samples still waiting in its queues.
_LONGEST_TICK_S = 0.25


class WallClock:
    """Time gone by from one look at a steady clock to the next."""

    def __init__(self) -> None:
        self._last_s: float | None = None

    def step(self, now_s: float) -> float:
        """Seconds since the last call, never so many that a stall of this process tells."""
        last_s, self._last_s = self._last_s, now_s
        return 0.0 if last_s is None else min(max(now_s - last_s, 0.0), _LONGEST_TICK_S)


class Silence:
    """How long a topic has brought nothing new, by the wall clock."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.silent_s = 0.0
        self._received = False
        self._moved_on = False
        self._ever = False
        self._standing_still = False
        self._stamp_ns: int | None = None

    def heard(self, stamp_ns: int) -> None:
        """Take the stamp of a sample."""
        self._received = self._ever = True
        if stamp_ns != self._stamp_ns:
            self._stamp_ns = stamp_ns
            self._moved_on = True

    def tick(self, dt_s: float) -> None:
        """Let wall time go by."""
        self.silent_s = 0.0 if self._moved_on else self.silent_s + dt_s
        self._standing_still = self._received and not self._moved_on
        self._received = self._moved_on = False

    def complaint(self) -> str:
        """Say what is wrong with the topic."""
        if self._standing_still:
            return f"the stamps of {self.topic} have stood still for {self.silent_s:.1f} s"
        if self._ever:
            return f"nothing on {self.topic} for {self.silent_s:.1f} s"
        return f"nothing has come on {self.topic}: is the driver running?"
