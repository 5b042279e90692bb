"""Gains of the sensor's six axes: reading_k = (1 + gain_k) true_k (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants


@dataclass(frozen=True)
class AxisGain(Effect):
    """reading_k = (1 + gain_k) true_k."""

    name: ClassVar[str] = "axis_gain"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("gain", "", 0.03, -0.9, 2.0, 6),)
    order: ClassVar[int] = 1

    gain: tuple[float, ...] = param(
        (0.0,) * 6, "what each axis of the sensor reads too much of itself, fx to tz", -0.9, 2.0
    )

    def read(self, when: Instants, wrench: Array) -> Array:
        """Each axis times its gain."""
        return wrench * (1.0 + np.asarray(self.gain))

    def unread(self, when: Instants, reading: Array) -> Array:
        """Each axis over its gain."""
        return reading / (1.0 + np.asarray(self.gain))
