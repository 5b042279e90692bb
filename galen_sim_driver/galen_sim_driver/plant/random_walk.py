"""The sensor's random walk, added to what the element sees.

    b(t) = sum of steps,   step ~ N(0, s^2 T)   a period T

with s its standard deviation after one hour. It acts before the quantum, and zeroing takes away
what there is of it at that moment, and no more. A steady drift is the effect `sensor_drift`.
"""

from __future__ import annotations

import numpy as np

from galen_sim_driver.plant.config import BiasDriftConfig

_BLOCK = 2048
_HOUR_S = 3600.0


class SensorBiasDrift:
    """What bias drift adds to the reading, sample by sample."""

    def __init__(self, config: BiasDriftConfig, period_s: float, rng: np.random.Generator) -> None:
        """Start at none; `rng` is this bias drift's own."""
        self._rng = rng
        self._step = np.array(config.per_sqrt_hour) * np.sqrt(period_s / _HOUR_S)
        self._at = np.zeros(6)
        self._block: list[list[float]] = []
        self._next = 0

    def next(self) -> list[float]:
        """The bias drift (6,) of the next sample, N and N.m."""
        if self._next == len(self._block):
            steps = self._rng.standard_normal((_BLOCK, 6)) * self._step
            path = self._at + np.cumsum(steps, axis=0)
            self._at, self._block, self._next = path[-1], path.tolist(), 0
        value = self._block[self._next]
        self._next += 1
        return value
