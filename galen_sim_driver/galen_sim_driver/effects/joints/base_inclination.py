"""The base doesn't stand level: gravity in base_link is (Rx(a) Ry(b))^T g (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_model.rotation import rot_x, rot_y
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class BaseInclination(Effect):
    """Gravity in base_link is (Rx(`about_x_rad`) Ry(`about_y_rad`))^T (0, 0, -g)."""

    name: ClassVar[str] = "base_inclination"
    fitted: ClassVar[tuple[Fitted, ...]] = (
        Fitted("about_x_rad", "rad", 0.01, -0.5, 0.5),
        Fitted("about_y_rad", "rad", 0.01, -0.5, 0.5),
    )

    about_x_rad: float = param(0.0, "the base is inclined so far about its x, rad", -0.5, 0.5)
    about_y_rad: float = param(0.0, "the same about its y, after x, rad", -0.5, 0.5)

    def gravity(self, gravity_base: Array) -> Array:
        """Gravity is turned the other way."""
        turn = rot_x(self.about_x_rad) @ rot_y(self.about_y_rad)
        return np.asarray(turn.T @ gravity_base)
