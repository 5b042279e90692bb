"""The force/torque sensor: noise, quantum, range, and the zero that is subtracted.

The element sees the whole load, so noise, quantum and range act on what is not zeroed
yet; the zero is a number that is subtracted afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from galen_sim_driver.errors import ZeroingError
from galen_sim_driver.plant.config import SensorConfig

_BLOCK = 2048


class Zeroing:
    """A zeroing under way: the mean of the next `samples` readings becomes the zero."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._count = 0
        self._sum = [0.0] * 6
        self.error: ZeroingError | None = None

    @property
    def done(self) -> bool:
        """Whether it is over, well or not."""
        return self.error is not None or self._count >= self._samples

    def add(self, raw: Sequence[float]) -> list[float] | None:
        """Take one raw reading (6,); return the new zero (6,) when it was the last."""
        self._sum = [total + value for total, value in zip(self._sum, raw, strict=True)]
        self._count += 1
        if self._count < self._samples:
            return None
        return [total / self._samples for total in self._sum]


class ForceTorqueSensor:
    """Turns the load's true wrench into a reading. Wrenches are lists (6,), N and N.m."""

    def __init__(
        self, config: SensorConfig, zero: Sequence[float], rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._noise = config.noise
        self._std = config.parameters.noise_std
        self._quantum = config.parameters.quantum.tolist() if config.quantise else None
        self._range = config.parameters.range.tolist()
        self._block: list[list[float]] = []
        self._next = 0
        self.zero = list(zero)
        self._zeroing: Zeroing | None = None

    @property
    def zeroing(self) -> bool:
        """Whether a zeroing is under way."""
        return self._zeroing is not None

    def start_zeroing(self, samples: int) -> Zeroing:
        """Average the next `samples` readings into a new zero; it holds from the one after."""
        if self._zeroing is not None:
            raise ZeroingError("the sensor is being zeroed already")
        self._zeroing = Zeroing(samples)
        return self._zeroing

    def spoil_zeroing(self, reason: str) -> None:
        """End a zeroing under way without effect."""
        if self._zeroing is not None:
            self._zeroing.error = ZeroingError(reason)
            self._zeroing = None

    def read(
        self,
        wrench: list[float],
        after_noise: Callable[[list[float]], list[float]] | None = None,
    ) -> list[float]:
        """Return the reading of a true wrench; `after_noise` changes it before the quantum."""
        raw = wrench
        if self._noise:
            if self._next == len(self._block):
                # One draw for many samples: a call into numpy costs more than the numbers.
                self._block = (self._rng.standard_normal((_BLOCK, 6)) * self._std).tolist()
                self._next = 0
            e = self._block[self._next]
            self._next += 1
            raw = [
                raw[0] + e[0],
                raw[1] + e[1],
                raw[2] + e[2],
                raw[3] + e[3],
                raw[4] + e[4],
                raw[5] + e[5],
            ]
        if after_noise is not None:
            raw = after_noise(raw)
        if self._quantum is not None:
            raw = [
                round(value / step) * step for value, step in zip(raw, self._quantum, strict=True)
            ]
        for index, limit in enumerate(self._range):
            if not -limit <= raw[index] <= limit:
                raw = [min(max(v, -top), top) for v, top in zip(raw, self._range, strict=True)]
                break
        zero = self.zero
        reading = [
            raw[0] - zero[0],
            raw[1] - zero[1],
            raw[2] - zero[2],
            raw[3] - zero[3],
            raw[4] - zero[4],
            raw[5] - zero[5],
        ]
        if self._zeroing is not None:
            new = self._zeroing.add(raw)
            if new is not None:
                self.zero, self._zeroing = new, None
        return reading
