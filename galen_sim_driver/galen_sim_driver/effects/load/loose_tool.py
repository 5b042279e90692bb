"""The tool sags in its mount (contract, section 6).

centre = file's + shift (d_x, d_y, 0),   d: the unit vector of gravity in ft_sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class LooseTool(Effect):
    """The tool's centre moves by `shift_m` times x and y of gravity's direction."""

    name: ClassVar[str] = "loose_tool"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("shift_m", "m", 0.003, -0.2, 0.2),)

    shift_m: float = param(
        0.0,
        "a tool that sags in its mount: its centre moves by this length times the x and y parts, "
        "in `ft_sensor`, of gravity's unit vector, m",
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The centre hangs lower."""
        return mass_kg, com_m + self.shift_m * direction * np.array([1.0, 1.0, 0.0])
