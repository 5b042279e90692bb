"""How long a behaviour still takes, from the pace of its poses. No ROS, no NiceGUI."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

_LAST = 16
_ENOUGH = 3


class Pace:
    """Follows one goal's count, by the median of its last steps: a person's pause is none."""

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=_LAST)
        self._done: int | None = None
        self._at_s = 0.0

    def left_s(self, done: int, total: int, now_s: float) -> float:
        """Seconds that are left, or NaN while too little is known. now_s: of a monotonic clock."""
        if self._done is None or done < self._done:
            self._steps.clear()
            self._done, self._at_s = done, now_s
        elif done > self._done:
            step = (now_s - self._at_s) / (done - self._done)
            self._steps.extend([step] * (done - self._done))
            self._done, self._at_s = done, now_s
        if len(self._steps) < _ENOUGH:
            return math.nan
        return max(0.0, (total - done) * median(self._steps) - (now_s - self._at_s))
