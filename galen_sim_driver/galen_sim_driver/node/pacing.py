"""How many steps of the plant are due, on a clock of the caller's."""

from __future__ import annotations


class Pacer:
    """Spreads simulated periods over wall time, `speed_factor` simulated seconds to a second.

    In real time every step that a stall left out is made up, at most `max_steps` at once, since
    the stamps follow the system's clock. At another speed a stall slows simulated time down
    instead: steps in a burst would overrun the subscribers of a machine that is short of time.
    """

    def __init__(self, period_s: float, speed_factor: float, max_steps: int) -> None:
        self._steps_per_s = speed_factor / period_s
        self._max_steps = max_steps
        self._makes_up = speed_factor == 1.0
        self._origin_s = 0.0
        self._taken = 0

    def start(self, now_s: float) -> None:
        """Count from `now_s`."""
        self._origin_s = now_s
        self._taken = 0

    def due(self, now_s: float) -> int:
        """Return how many steps to take now; the caller takes them."""
        missing = int((now_s - self._origin_s) * self._steps_per_s) - self._taken
        steps = max(0, min(missing, self._max_steps))
        self._taken += steps
        if steps < missing and not self._makes_up:
            self.start(now_s)
        return steps


class SpeedMeter:
    """How fast simulated time goes, averaged over at least `window_s` of wall time."""

    def __init__(self, window_s: float) -> None:
        self._window_s = window_s
        self._last: tuple[float, int] | None = None
        self.speed: float | None = None
        """Simulated over wall time, None at first."""

    def update(self, now_s: float, sim_ns: int) -> None:
        """Tell both times; `speed` changes when the window is over."""
        if self._last is None:
            self._last = (now_s, sim_ns)
        elif now_s - self._last[0] >= self._window_s:
            self.speed = (sim_ns - self._last[1]) * 1e-9 / (now_s - self._last[0])
            self._last = (now_s, sim_ns)
