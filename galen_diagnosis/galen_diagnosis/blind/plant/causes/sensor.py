"""Errors of the sensor that stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arm.galen import SENSOR, WRENCH_AXES
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.cause import Cause, Moment, size_of
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import any_direction, turned_by

_NEWTONS_A_NM = float(SENSOR.noise_std[0] / SENSOR.noise_std[3])
"""How many N count as much as 1 N.m: by the noise."""


@dataclass(frozen=True)
class SensorMountRotation(Cause):
    """The element is turned by size times way in ft_sensor; the tool isn't."""

    name: ClassVar[str] = "sensor_mount_rotation"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.5
    order: ClassVar[int] = 0

    way: tuple[float, float, float] = (1.0, 0.0, 0.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Any axis."""
        x, y, z = size_of(any_direction(rng))
        return cls(cls.typical, (x, y, z))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """All three."""
        ways = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        return [[cls(cls.typical, way) for way in ways]]

    def sense(self, at: Moment, total: Array) -> Array:
        """In the element's axes: E^T f, a row times E."""
        turn = turned_by(self.size * np.array([self.way]))[0]
        return np.concatenate([total[:, :3] @ turn, total[:, 3:] @ turn], axis=1)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """rotvec_rad."""
        return {"rotvec_rad": size_of(self.size * np.array(self.way))}


@dataclass(frozen=True)
class AxisGain(Cause):
    """reading_k = (1 + size way_k) true_k."""

    name: ClassVar[str] = "axis_gain"
    typical: ClassVar[float] = 0.02
    largest: ClassVar[float] = 0.6
    order: ClassVar[int] = 1

    way: tuple[float, ...] = (1.0,) * 6

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """One axis in half of the cases, else all six as they come."""
        sign = float(rng.choice([-1.0, 1.0]))
        one = sign * np.eye(6)[rng.integers(6)]
        every = rng.uniform(-1.0, 1.0, 6)
        way = one if rng.random() < 0.5 else every / np.max(np.abs(every))
        return cls(cls.typical, tuple(size_of(way)))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """All six."""
        return [[cls(cls.typical, tuple(size_of(one))) for one in np.eye(6)]]

    def sense(self, at: Moment, total: Array) -> Array:
        """Each axis times its gain."""
        return total * (1.0 + self.size * np.array(self.way))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """The gain."""
        return {"gain": size_of(self.size * np.array(self.way))}


@dataclass(frozen=True)
class Crosstalk(Cause):
    """reading_to += size unit true_from."""

    name: ClassVar[str] = "crosstalk"
    typical: ClassVar[float] = 0.02
    largest: ClassVar[float] = 1.0
    order: ClassVar[int] = 2

    axis_from: int = 0
    axis_to: int = 1

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Of any axis into any other."""
        a, b = (int(axis) for axis in rng.choice(6, 2, replace=False))
        return cls(cls.typical * float(rng.choice([-1.0, 1.0])), a, b)

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Each of the thirty by itself."""
        pairs = [(a, b) for a in range(6) for b in range(6) if a != b]
        return [[cls(cls.typical, a, b)] for a, b in pairs]

    @property
    def coefficient(self) -> float:
        """In N and N.m; size is over the axes' noises."""
        force_to, force_from = self.axis_to < 3, self.axis_from < 3
        return self.size * _NEWTONS_A_NM ** (int(force_to) - int(force_from))

    def sense(self, at: Moment, total: Array) -> Array:
        """The one axis has some of the other."""
        sensed = np.array(total)
        sensed[:, self.axis_to] += self.coefficient * total[:, self.axis_from]
        return sensed

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """from, to, coefficient."""
        axes = WRENCH_AXES[self.axis_from], WRENCH_AXES[self.axis_to]
        return {"from": axes[0], "to": axes[1], "coefficient": self.coefficient}


@dataclass(frozen=True)
class SensorSaturation(Cause):
    """An axis clips: hard, or soft with x / (1 + |x / L|^p)^(1 / p).

    At L = peak exp(-size), peak twice the largest that the session has on that axis. Of what shows,
    or of the whole load on the sensor (`raw`): the limit is then told as it shows, on the side
    where it clips more.
    """

    name: ClassVar[str] = "sensor_saturation"
    typical: ClassVar[float] = 1.0
    largest: ClassVar[float] = 4.0
    order: ClassVar[int] = 5
    linear: ClassVar[bool] = False

    axis: int = 2
    peak: float = 10.0
    power: float = 0.0
    raw: bool = False

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Of any axis; soft in half of the cases."""
        axis = int(rng.integers(6))
        power = float(rng.uniform(12.0, 40.0)) if rng.random() < 0.5 else 0.0
        return cls(cls.typical, axis, _peaks(session)[axis], power, bool(rng.random() < 0.5))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Every axis at some limits."""
        peaks = _peaks(session)
        return [[cls(size, axis, peaks[axis])] for axis in range(6) for size in (0.8, 1.1, 1.7)]

    def sense(self, at: Moment, total: Array) -> Array:
        """The whole load clipped."""
        return self._clipped(total) if self.raw else total

    def show(self, at: Moment, reading: Array) -> Array:
        """The reading clipped."""
        return reading if self.raw else self._clipped(reading)

    @property
    def limit(self) -> float:
        """Where it clips."""
        return float(self.peak * np.exp(-self.size))

    def _clipped(self, values: Array) -> Array:
        clipped = np.array(values)
        x = values[:, self.axis]
        if self.power:
            clipped[:, self.axis] = x / (1.0 + np.abs(x / self.limit) ** self.power) ** (
                1.0 / self.power
            )
        else:
            clipped[:, self.axis] = np.clip(x, -self.limit, self.limit)
        return clipped

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """The limit as it shows, and the axis."""
        shown = self.limit
        if self.raw:
            offset = float(machine.zeroing[self.axis])
            healthy = Machine(machine.session)
            above, below = 0.0, 0.0
            for bag, take in machine.session.takes.items():
                whole = healthy.reading(bag, take.wrench.taken_s[::20])[:, self.axis] + offset
                above += float(np.sum(np.maximum(0.0, whole - self.limit)))
                below += float(np.sum(np.maximum(0.0, -whole - self.limit)))
            shown = self.limit - offset if above >= below else self.limit + offset
        return {"limit": shown, "axis": WRENCH_AXES[self.axis]}


def _peaks(session: Session) -> list[float]:
    """Twice the largest reading of each axis, nearly."""
    machine = Machine(session)
    most = [
        np.max(np.abs(machine.reading(bag, take.wrench.taken_s[::20])), axis=0)
        for bag, take in session.takes.items()
    ]
    return size_of(2.0 * np.max(most, axis=0))
