"""The time base of a calibration: the samples' own stamps, and where they jump.

The authors of the 2019 report lost weeks to jumps in the time stamps of their recordings.
Here a jump never counts as time gone by, and never hides inside an average.
"""

from __future__ import annotations

from galen_model.errors import GalenError

NS = 1_000_000_000
# So many jumps, and more jumps than steps: then it is not a jump but how the topic is.
_MANY_JUMPS = 10


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
