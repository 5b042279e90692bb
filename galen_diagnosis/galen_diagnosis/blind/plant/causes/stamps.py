"""Stamps that are late: by a delay that beats a little, as a polled buffer's does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.cause import Cause
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session


@dataclass(frozen=True)
class _Delay(Cause):
    """Taken size (1 + beat saw(t)) before the stamp; saw between -1 and 1, every `period_s`."""

    topic: ClassVar[str]
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.5

    beat: float = 0.05
    period_s: float = 10.0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Late, never early."""
        return cls(cls.typical, rng.uniform(0.0, 0.12), rng.uniform(2.0, 15.0))

    def late(self, stamp_s: Array, of: str) -> Array:
        """Taken before."""
        if of != self.topic:
            return stamp_s
        saw = 2.0 * np.mod(stamp_s / self.period_s, 1.0) - 1.0
        return stamp_s - self.size * (1.0 + self.beat * saw)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """delay_s, the mean."""
        return {"delay_s": self.size}


@dataclass(frozen=True)
class WrenchDelay(_Delay):
    """Of wrenches against joints."""

    name: ClassVar[str] = "wrench_delay"
    topic: ClassVar[str] = "wrench"


@dataclass(frozen=True)
class TrackerDelay(_Delay):
    """Of the tracker against joints and wrenches."""

    name: ClassVar[str] = "tracker_delay"
    topic: ClassVar[str] = "tracker"
