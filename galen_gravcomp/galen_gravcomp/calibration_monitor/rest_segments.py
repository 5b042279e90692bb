"""Stops of a live stream: one pose, one steady wrench, put together from still windows.

A window that is not steady, or that steps away from its stop's mean, ends the stop. A stop at a
place replaces the older one there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.rest.windows import StillWindow

from galen_gravcomp.calibration_monitor.evidence import Stops

REMEMBERED = 16
_OLDEST_NS = 1_800_000_000_000
_SAME_PLACE = 0.1
"""Chord between gravity's unit vectors, rad: stops nearer than that are at one place."""
_SAME_POSE = 0.005
_STEP_SIGMAS = 6.0
_STEP_FLOOR = np.repeat([0.02, 5e-4], 3)
_SOON_NS = 2_000_000_000


@dataclass(eq=False)
class Stop:
    """A pose with one steady wrench.

    stepped: it began by a step of the wrench where the arm stood, as a push does;
    fits: by chi-square; fitted: it did once; log_touched: log odds of a touch against a fit.
    """

    gravity: Array
    angles: tuple[float, float]
    mean: Array
    std: Array
    start_ns: int
    end_ns: int
    windows: int = 1
    stepped: bool = False
    fits: bool = False
    fitted: bool = False
    log_touched: float = 0.0
    recent: deque[Array] = field(default_factory=lambda: deque(maxlen=4))

    @property
    def lasts_s(self) -> float:
        """How long it was seen."""
        return (self.end_ns - self.start_ns) * 1e-9


class StopMemory:
    """The last stops, oldest first."""

    def __init__(self) -> None:
        self.stops: deque[Stop] = deque()
        self._open = False

    def interrupt(self) -> None:
        """End the newest stop: a window was not steady."""
        self._open = False

    def keep(self, stops: Sequence[Stop]) -> None:
        """Forget all others."""
        self.stops = deque(stops)

    def shift(self, change: Array) -> None:
        """From now on `change` (6,) more is taken off."""
        for stop in self.stops:
            stop.mean = stop.mean - change
            stop.recent.clear()
            stop.fitted = False

    def add(self, window: StillWindow) -> Stop:
        """Put a window to the newest stop, or begin another; returns the stop."""
        unit = np.asarray(gravity_in_sensor(*window.angles))
        unit = unit / np.linalg.norm(unit)
        stop = self.stops[-1] if self.stops and self._open else None
        if stop is not None and _goes_on(stop, window, unit):
            count = min(stop.windows, 20)  # old windows of a long stop count less and less
            stop.mean = stop.mean + (window.mean - stop.mean) / (count + 1)
            stop.std = window.std_of_mean / np.sqrt(count + 1)
            stop.end_ns, stop.windows = window.end_ns, stop.windows + 1
        else:
            stop = Stop(
                unit, window.angles, window.mean, window.std_of_mean, window.start_ns, window.end_ns
            )
            stop.stepped = bool(self.stops) and _near(self.stops[-1], window, unit)
            self._begin(stop)
        stop.recent.append(window.mean)
        self._open = True
        return stop

    def _begin(self, stop: Stop) -> None:
        oldest_ns = stop.end_ns - _OLDEST_NS
        kept = [
            other
            for other in self.stops
            if other.end_ns >= oldest_ns
            and other.windows >= 2
            and np.linalg.norm(other.gravity - stop.gravity) >= _SAME_PLACE
        ]
        self.stops = deque(kept[-(REMEMBERED - 1) :])
        self.stops.append(stop)


def as_arrays(stops: Sequence[Stop]) -> Stops:
    """Stops as `galen_gravcomp.calibration_monitor.evidence` takes them."""
    return Stops(
        np.array([stop.mean for stop in stops]),
        np.array([stop.std for stop in stops]),
        np.array([stop.angles for stop in stops]),
        np.array([stop.end_ns for stop in stops]),
    )


def _goes_on(stop: Stop, window: StillWindow, unit: Array) -> bool:
    if not _near(stop, window, unit):
        return False
    if not stop.recent:  # a tare just moved it
        return True
    level = np.mean(stop.recent, axis=0)
    allowed = _STEP_SIGMAS * window.std_of_mean * np.sqrt(1.0 + 1.0 / len(stop.recent))
    return bool(np.all(np.abs(window.mean - level) <= allowed + _STEP_FLOOR))


def _near(stop: Stop, window: StillWindow, unit: Array) -> bool:
    """Whether a window is at a stop's pose and follows it soon."""
    soon = window.start_ns - stop.end_ns < _SOON_NS
    return soon and float(np.linalg.norm(unit - stop.gravity)) < _SAME_POSE
