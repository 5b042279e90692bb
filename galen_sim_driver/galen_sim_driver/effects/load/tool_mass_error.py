"""The tool weighs other than its file says: true mass - file's mass, same centre (contract, 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class ToolMassError(Effect):
    """true mass = file's + `delta_kg`."""

    name: ClassVar[str] = "tool_mass_error"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delta_kg", "kg", 0.005, -1.0, 5.0),)

    delta_kg: float = param(
        0.0, "how much the tool weighs more than its number says, kg", -1.0, 5.0
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The centre stays."""
        return mass_kg + self.delta_kg, com_m
