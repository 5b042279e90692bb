"""The reading jumps once and stays (contract, section 6).

It stays for the bags after, too: sweep, motion and push are recorded in this order. With an empty
bag's name, as in a driver that runs on, the time is that of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import BAG_ORDER, Effect, Fitted, Instants
from galen_sim_driver.errors import ConfigError


@dataclass(frozen=True)
class BiasStep(Effect):
    """`step` from `time_s` on, since the first stamp of `bag`."""

    name: ClassVar[str] = "bias_step"
    fitted: ClassVar[tuple[Fitted, ...]] = (
        Fitted("step", "", (0.3, 0.3, 0.3, 0.01, 0.01, 0.01), -50.0, 50.0, 6),
    )
    order: ClassVar[int] = 4
    recording_only: ClassVar[tuple[str, ...]] = ("bag",)

    time_s: float = param(0.0, "when the reading jumps, since the start, s", minimum=0.0)
    step: tuple[float, ...] = param((0.0,) * 6, "how far it jumps, and stays, N and Nm")
    bag: str = param("", "the bag from whose first stamp the time counts, empty for the first")

    def validate(self) -> None:
        """The bag is one of a recording."""
        if self.bag and self.bag not in BAG_ORDER:
            raise ConfigError(
                f"{self.name}: bag is {self.bag!r}, not one of {', '.join(BAG_ORDER)}"
            )

    def read(self, when: Instants, wrench: Array) -> Array:
        """The reading with the jump."""
        return wrench + self._at(when)

    def unread(self, when: Instants, reading: Array) -> Array:
        """The reading without it."""
        return reading - self._at(when)

    def _at(self, when: Instants) -> Array:
        if not self.bag:
            jumped = when.session_s >= self.time_s
        elif when.bag == self.bag:
            jumped = when.bag_s >= self.time_s
        else:
            later = when.bag in BAG_ORDER and BAG_ORDER.index(when.bag) > BAG_ORDER.index(self.bag)
            jumped = np.full(len(when), later)
        return np.outer(jumped, self.step)
