"""The tracker's scale, and a base marker whose stand is knocked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.cause import Cause, Moment, size_of
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import any_direction


@dataclass(frozen=True)
class TrackerScale(Cause):
    """Positions are (1 + size) times true, about the tracker's origin."""

    name: ClassVar[str] = "tracker_scale"
    typical: ClassVar[float] = 0.002
    largest: ClassVar[float] = 0.2

    def track(self, at: Moment, position: Array) -> Array:
        """Farther away."""
        return position * (1.0 + self.size)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """The gain."""
        return {"gain": self.size}


@dataclass(frozen=True)
class BaseShift(Cause):
    """The stand goes by size (m) times way and turns by size times `turn`, within `takes_s`."""

    name: ClassVar[str] = "base_shift"
    typical: ClassVar[float] = 1e-4
    largest: ClassVar[float] = 0.2

    way: tuple[float, float, float] = (1.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 1.0)
    time_s: float = 50.0
    takes_s: float = 0.1

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Once, in the middle three quarters."""
        x, y, z = size_of(any_direction(rng))
        a, b, c = size_of(rng.uniform(0.5, 5.0) * any_direction(rng))
        end_s = session.takes["push"].end_s if "push" in session.takes else 100.0
        return cls(
            cls.typical, (x, y, z), (a, b, c), end_s * rng.uniform(0.12, 0.88),
            rng.uniform(0.06, 0.15),
        )  # fmt: skip

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """All six ways at some times."""
        families: list[list[Cause]] = []
        if "push" not in session.takes:
            return families
        none = (0.0, 0.0, 0.0)
        ways = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        end_s = session.takes["push"].end_s
        for share in np.linspace(0.1, 0.9, 9):
            moved = [cls(cls.typical, way, none, share * end_s) for way in ways]
            turned = [cls(cls.typical, none, way, share * end_s) for way in ways]
            families.append([*moved, *turned])
        return families

    def stand(self, at: Moment) -> Array | None:
        """Where it is by then."""
        s = np.clip((at.bag_s - self.time_s) / self.takes_s, 0.0, 1.0)
        gone = s * s * (3.0 - 2.0 * s)
        return np.asarray(self.size * np.outer(gone, [*self.way, *self.turn]))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """translation_m, rotvec_rad, time_s."""
        return {
            "translation_m": size_of(self.size * np.array(self.way)),
            "rotvec_rad": size_of(self.size * np.array(self.turn)),
            "time_s": self.time_s + 0.5 * self.takes_s,
        }
