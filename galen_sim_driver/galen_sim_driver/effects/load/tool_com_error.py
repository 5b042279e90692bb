"""The tool's centre of mass isn't where its file says: true - file's (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class ToolComError(Effect):
    """true centre = file's + `delta_m`, in ft_sensor."""

    name: ClassVar[str] = "tool_com_error"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delta_m", "m", 0.003, -0.5, 0.5, 3),)

    delta_m: tuple[float, ...] = param(
        (0.0,) * 3,
        "the tool's centre of mass less where its numbers say, in `ft_sensor`, m",
        -0.5,
        0.5,
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The mass stays."""
        return mass_kg, com_m + np.asarray(self.delta_m)
