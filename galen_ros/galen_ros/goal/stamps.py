"""Clocks of a goal on the arm: the samples' own stamps and their jumps; silence by the wall clock.

The authors of the 2019 report lost weeks to jumps in the time stamps of their recordings.
Here a jump never counts as time gone by, and never hides inside an average.
"""

from __future__ import annotations

from galen_model.errors import GalenError

NS = 1_000_000_000
# So many jumps, and more jumps than steps: then it is not a jump but how the topic is.
_MANY_JUMPS = 10
# A tick of the wall clock counts at most this much towards a silence: a process that was itself
# held up for seconds has the samples still waiting in its queues.
_LONGEST_TICK_S = 0.25


class StampsError(GalenError):
    """A topic whose stamps jump with nearly every sample; the message names it and the step."""


class StampClock:
    """Time gone by on a topic's stamps; a step back, or a long one, is a jump and adds nothing."""

    def __init__(self, topic: str, max_step_s: float) -> None:
        self._topic = topic
        self._max_step_ns = round(max_step_s * NS)
        self._elapsed_ns = 0
        self._steps = 0
        self.stamp_ns: int | None = None
        self.jumps = 0
        self.last_jump = ""

    @property
    def elapsed_ns(self) -> int:
        """Time gone by since the first sample, jumps left out."""
        return self._elapsed_ns

    def advance(self, stamp_ns: int) -> bool:
        """Take a sample's stamp (ns); False for a repeated one, whose sample tells nothing.

        Raises StampsError for a topic that is slower than the longest step allowed.
        """
        last, self.stamp_ns = self.stamp_ns, stamp_ns
        if last is None:
            return True
        step = stamp_ns - last
        if step == 0:
            return False
        if 0 < step <= self._max_step_ns:
            self._elapsed_ns += step
            self._steps += 1
        else:
            self.jumps += 1
            self.last_jump = f"the stamps of {self._topic} jumped by {step / NS:+.3f} s"
            if self.jumps >= _MANY_JUMPS and self.jumps > self._steps:
                raise StampsError(
                    f"{self.last_jump}, and so do most of its samples;"
                    f" max_stamp_step_s is {self._max_step_ns / NS:g}"
                )
        return True


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
