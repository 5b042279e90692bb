# SPDX-License-Identifier: Apache-2.0
"""The force/torque sensor and the optical tracker, with their noise.

The sensing element sees the whole load, so noise, quantum and range act on what is not zeroed yet;
the zero is a number that is subtracted afterwards. The tracker sees the true tip, deflection
included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from galen_model.arm.galen import TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD
from galen_model.arrays import Array

from galen_sim_driver.plant.config import BASE_IN_TRACKER, BASE_MARKER, PlantConfig, PlantError
from galen_sim_driver.plant.geometry import (
    Quaternion,
    Vector,
    from_rotvec,
    multiply,
    rotate_by,
)

MarkerPose = tuple[Vector, Quaternion]
"""A marker in `tracker`: position (m) and quaternion x, y, z, w."""

_BLOCK = 512


def _noise(rng: np.random.Generator, std: Array) -> Iterator[list[float]]:
    """Yield rows (6,): one draw for many, since a call of numpy costs more than the numbers."""
    while True:
        yield from (rng.standard_normal((_BLOCK, 6)) * std).tolist()


class Zeroing:
    """A zeroing under way: the mean of the next `samples` readings becomes the zero."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._count = 0
        self._sum = [0.0] * 6
        self.error: PlantError | None = None

    @property
    def done(self) -> bool:
        """Whether it is over, well or not."""
        return self.error is not None or self._count >= self._samples

    def add(self, raw: Sequence[float]) -> list[float] | None:
        """Take one reading.

        Args:
            raw: (6,) in ft_sensor, N and N.m, before zeroing.

        Returns:
            The new zero (6,) when it was the last; None before.

        """
        self._sum = [total + value for total, value in zip(self._sum, raw, strict=True)]
        self._count += 1
        if self._count < self._samples:
            return None
        return [total / self._samples for total in self._sum]


class ForceTorqueSensor:
    """Turn the load's true wrench into a reading. Wrenches are lists (6,), N and N.m."""

    def __init__(
        self, config: PlantConfig, zero: Sequence[float], rng: np.random.Generator
    ) -> None:
        self._noise = _noise(rng, config.sensor.noise_std) if config.noise else None
        self._quantum = config.sensor.quantum.tolist() if config.quantise else None
        self._range = config.sensor.range.tolist()
        self.zero = list(zero)
        self._zeroing: Zeroing | None = None

    def start_zeroing(self, samples: int) -> Zeroing:
        """Average the next readings into a new zero; it holds from the one after.

        Args:
            samples: number of readings, at least 1.

        Returns:
            The zeroing under way.

        Raises:
            PlantError: one is under way already.

        """
        if self._zeroing is not None:
            raise PlantError("the sensor is being zeroed already")
        self._zeroing = Zeroing(samples)
        return self._zeroing

    def spoil_zeroing(self, reason: str) -> None:
        """End a zeroing under way without effect.

        Args:
            reason: text of its error.

        """
        if self._zeroing is not None:
            self._zeroing.error = PlantError(reason)
            self._zeroing = None

    def read(
        self,
        wrench: list[float],
        after_noise: Callable[[list[float]], list[float]] | None = None,
    ) -> list[float]:
        """Return the reading of a wrench.

        Args:
            wrench: (6,) in ft_sensor, N and N.m, before zeroing.
            after_noise: changes it (6,) after the noise and before the quantum.

        Returns:
            Reading (6,), zeroed.

        """
        raw = wrench
        if self._noise is not None:
            raw = [a + b for a, b in zip(raw, next(self._noise), strict=True)]
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
        reading = [a - b for a, b in zip(raw, self.zero, strict=True)]
        if self._zeroing is not None:
            new = self._zeroing.add(raw)
            if new is not None:
                self.zero, self._zeroing = new, None
        return reading


class Tracker:
    """Turn true poses in base_link into noisy ones in `tracker`."""

    def __init__(self, config: PlantConfig, rng: np.random.Generator) -> None:
        std = np.repeat([TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD], 3)
        self._noise = _noise(rng, std) if config.noise else None
        self._base_position = BASE_IN_TRACKER.translation_m
        self._base_turn = from_rotvec(BASE_IN_TRACKER.rotvec_rad)
        self._marker_position = config.tool_marker.translation_m
        self._marker_turn = from_rotvec(config.tool_marker.rotvec_rad)
        self._base_marker_in_base = (BASE_MARKER.translation_m, from_rotvec(BASE_MARKER.rotvec_rad))
        self._base_marker = self._seen(*self._base_marker_in_base)

    def sample(
        self,
        tip: tuple[Vector, Quaternion] | None,
        deflection: Sequence[float] | None,
        seen: Callable[[MarkerPose], MarkerPose],
        base_shift: Sequence[float] | None,
    ) -> tuple[MarkerPose | None, MarkerPose]:
        """Measure both markers once.

        Args:
            tip: undeflected tool_tip in base_link, m; None without a tool.
            deflection: its displacement (6,) there: translation (m), rotation vector (rad); None
                for none.
            seen: turns a marker's pose in `tracker` into the tracker's reading.
            base_shift: displacement (6,) of the base's marker in base_link, m and rad; None for
                none.

        Returns:
            The tool's marker, None without a tool, and the base's, in `tracker`.

        """
        base = self._base_marker if base_shift is None else self._shifted_base(base_shift)
        tool = None
        if tip is not None:
            position, turn = tip
            if deflection is not None:
                position = _add(position, deflection[:3])
                turn = multiply(from_rotvec(deflection[3:]), turn)
            marker = _add(position, rotate_by(turn, self._marker_position))
            there = self._seen(marker, multiply(turn, self._marker_turn))
            tool = self._with_noise(seen(there))
        return tool, self._with_noise(seen(base))

    def _shifted_base(self, shift: Sequence[float]) -> MarkerPose:
        position, turn = self._base_marker_in_base
        return self._seen(_add(position, shift[:3]), multiply(from_rotvec(shift[3:]), turn))

    def _seen(self, position: Sequence[float], turn: Quaternion) -> MarkerPose:
        return (
            _add(self._base_position, rotate_by(self._base_turn, position)),
            multiply(self._base_turn, turn),
        )

    def _with_noise(self, pose: MarkerPose) -> MarkerPose:
        if self._noise is None:
            return pose
        noise = next(self._noise)
        position, turn = pose
        return _add(position, noise[:3]), multiply(from_rotvec(noise[3:]), turn)


def _add(a: Sequence[float], b: Sequence[float]) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
