"""Readings that change with time: drift and a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from scipy.interpolate import PchipInterpolator

from galen_diagnosis.blind.plant.cause import Cause, Moment, size_of
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import BAGS, Session
from galen_diagnosis.blind.plant.turning import any_direction

_KNOT_S = 4.0
_HOUR_S = 3600.0


@dataclass(frozen=True)
class SensorDrift(Cause):
    """size times noise times way_k w_k(t), after warming up, drifting, or both.

    Warming up: 1 - exp(-t / tau). Drifting: an Ornstein-Uhlenbeck process of time constant tau
    (a random walk for a long one), drawn every 4 s, smooth between.
    """

    name: ClassVar[str] = "sensor_drift"
    typical: ClassVar[float] = 1.0
    largest: ClassVar[float] = 500.0
    order: ClassVar[int] = 3

    way: tuple[float, ...] = (1.0,) * 6
    warmup_s: float = 300.0
    bias_drift_s: float = 300.0
    drifting: float = 0.0
    seed: int = 0
    duration_s: float = 300.0
    cosine: int = 0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """One of three kinds, on a few axes more than on others."""
        way = any_direction(rng, 6)
        drifting = float(rng.choice([0.0, 0.5, 1.0]))
        return cls(
            cls.typical, tuple(size_of(way)), rng.uniform(60.0, 900.0), rng.uniform(60.0, 2000.0),
            drifting, int(rng.integers(2**31)), session.duration_s,
        )  # fmt: skip

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Cosines of the recording's time on each axis, down to half a minute or so."""
        ways = [tuple(size_of(one)) for one in np.eye(6)]
        many = range(1, 9)
        return [[cls(1.0, w, duration_s=session.duration_s, cosine=k) for w in ways for k in many]]

    @cached_property
    def _shape(self) -> PchipInterpolator:
        rng = np.random.default_rng(self.seed)
        at_s = np.arange(0.0, self.duration_s + 2.0 * _KNOT_S, _KNOT_S)
        if self.cosine:
            wave = np.cos(np.pi * self.cosine * at_s / self.duration_s)
            return PchipInterpolator(at_s, np.tile(wave[:, None], (1, 6)))
        warm = 1.0 - np.exp(-at_s / self.warmup_s)
        warm = warm / np.max(warm)
        keep = np.exp(-_KNOT_S / self.bias_drift_s)
        walk = np.zeros((len(at_s), 6))
        for k in range(1, len(at_s)):
            walk[k] = keep * walk[k - 1] + np.sqrt(1.0 - keep**2) * rng.standard_normal(6)
        walk = walk / max(float(np.std(walk)), 1e-12)
        return PchipInterpolator(at_s, (1.0 - self.drifting) * warm[:, None] + self.drifting * walk)

    def show(self, at: Moment, reading: Array) -> Array:
        """What has come by then."""
        return reading + self._drifted(at.session_s)

    def _drifted(self, session_s: Array) -> Array:
        scale = self.size * np.array(self.way) * SENSOR.noise_std
        return np.asarray(scale * self._shape(np.clip(session_s, 0.0, None)))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """rate_per_hour, the mean."""
        first, last = self._drifted(np.array([0.0, machine.session.duration_s]))
        return {"rate_per_hour": size_of((last - first) / machine.session.duration_s * _HOUR_S)}


@dataclass(frozen=True)
class BiasStep(Cause):
    """The reading goes by size times noise times way within some tens of ms, and stays."""

    name: ClassVar[str] = "bias_step"
    typical: ClassVar[float] = 2.0
    largest: ClassVar[float] = 1000.0
    order: ClassVar[int] = 4

    way: tuple[float, ...] = (1.0,) * 6
    bag: str = "sweep"
    time_s: float = 10.0
    takes_s: float = 0.05

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """In any bag, in its middle three quarters."""
        bag = str(rng.choice(list(session.takes)))
        way = any_direction(rng, 6)
        time_s = session.takes[bag].end_s * rng.uniform(0.12, 0.88)
        return cls(cls.typical, tuple(size_of(way)), bag, time_s, rng.uniform(0.02, 0.05))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """On all axes, at some times."""
        ways = [tuple(size_of(one)) for one in np.eye(6)]
        return [
            [cls(1.0, way, bag, share * take.end_s) for way in ways]
            for bag, take in session.takes.items()
            for share in np.linspace(0.05, 0.95, 10)
        ]

    def show(self, at: Moment, reading: Array) -> Array:
        """More from then on."""
        late = BAGS.index(at.take.bag) - BAGS.index(self.bag)
        if late:
            gone = np.full(len(at), 1.0 if late > 0 else 0.0)
        else:
            s = np.clip((at.bag_s - self.time_s) / self.takes_s, 0.0, 1.0)
            gone = s * s * (3.0 - 2.0 * s)
        return reading + gone[:, None] * self._step()

    def _step(self) -> Array:
        return self.size * np.array(self.way) * SENSOR.noise_std

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """time_s, step, bag."""
        middle_s = self.time_s + 0.5 * self.takes_s
        return {"time_s": middle_s, "step": size_of(self._step()), "bag": self.bag}
