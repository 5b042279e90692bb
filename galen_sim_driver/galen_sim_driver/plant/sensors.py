"""The force/torque sensor: noise, quantum, range, and the zero that is subtracted.

The element sees the whole load, so noise, quantum and range act on what is not zeroed
yet; the zero is a number that is subtracted afterwards.

The optical tracker: poses of the tool's marker and of the marker on the base's stand.

It sees the true tip, deflection included. Base to tracker is fixed and known to nobody else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from galen_sim_driver.plant.config import PlantError, SensorConfig, TrackerConfig
from galen_sim_driver.plant.geometry import (
    Quaternion,
    Vector,
    from_rotvec,
    multiply,
    rotate_by,
)

_BLOCK = 2048


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
            raise PlantError("the sensor is being zeroed already")
        self._zeroing = Zeroing(samples)
        return self._zeroing

    def spoil_zeroing(self, reason: str) -> None:
        """End a zeroing under way without effect."""
        if self._zeroing is not None:
            self._zeroing.error = PlantError(reason)
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


_BLOCK = 512


@dataclass(frozen=True)
class MarkerPose:
    """A marker in `tracker`: position (m) and quaternion x, y, z, w."""

    position_m: Vector
    quaternion: Quaternion


@dataclass(frozen=True)
class TrackerSample:
    """What the tracker sees at once; there is no tool marker without a tool."""

    tool: MarkerPose | None
    base: MarkerPose


class Tracker:
    """Turns true poses in base_link into noisy ones in `tracker`."""

    def __init__(self, config: TrackerConfig, rng: np.random.Generator) -> None:
        self._rng = rng
        self._noisy = config.noise
        self._std = np.repeat([config.position_noise_m, config.rotation_noise_rad], 3)
        self._block: list[list[float]] = []
        self._next = 0
        self._base_position = config.base_in_tracker.translation_m
        self._base_turn = from_rotvec(config.base_in_tracker.rotvec_rad)
        self._marker_position = config.tool_marker.translation_m
        self._marker_turn = from_rotvec(config.tool_marker.rotvec_rad)
        base = config.base_marker
        self._base_marker_in_base = (base.translation_m, from_rotvec(base.rotvec_rad))
        self._base_marker = self._seen(*self._base_marker_in_base)

    def sample(
        self,
        tip: tuple[Vector, Quaternion] | None,
        deflection: Sequence[float] | None,
        seen: Callable[[MarkerPose], MarkerPose] | None = None,
        base_shift: Sequence[float] | None = None,
    ) -> TrackerSample:
        """Look once.

        `tip` is the undeflected tool_tip in base_link, `deflection` (6,) its displacement there:
        translation (m), rotation vector (rad), or None for no touch. `seen` makes of a marker's
        pose what the tracker tells; `base_shift` (6,) is how far the base's marker has moved.
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
            tool = self._with_noise(there if seen is None else seen(there))
        return TrackerSample(tool, self._with_noise(base if seen is None else seen(base)))

    def _shifted_base(self, shift: Sequence[float]) -> MarkerPose:
        """The base's marker, moved and turned about itself along base_link's axes."""
        position, turn = self._base_marker_in_base
        return self._seen(_add(position, shift[:3]), multiply(from_rotvec(shift[3:]), turn))

    def _seen(self, position: Sequence[float], turn: Quaternion) -> MarkerPose:
        return MarkerPose(
            _add(self._base_position, rotate_by(self._base_turn, position)),
            multiply(self._base_turn, turn),
        )

    def _with_noise(self, pose: MarkerPose) -> MarkerPose:
        if not self._noisy:
            return pose
        if self._next == len(self._block):
            self._block = (self._rng.standard_normal((_BLOCK, 6)) * self._std).tolist()
            self._next = 0
        noise = self._block[self._next]
        self._next += 1
        return MarkerPose(
            _add(pose.position_m, noise[:3]), multiply(from_rotvec(noise[3:]), pose.quaternion)
        )


def _add(a: Sequence[float], b: Sequence[float]) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
