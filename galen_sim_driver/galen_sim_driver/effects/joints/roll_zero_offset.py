"""The roll joint's zero is wrong: true roll = reported + offset (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants

_ROLL = 3


@dataclass(frozen=True)
class RollZeroOffset(Effect):
    """true roll = reported + `offset_rad`."""

    name: ClassVar[str] = "roll_zero_offset"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("offset_rad", "rad", 0.01, -0.5, 0.5),)
    order: ClassVar[int] = 1

    offset_rad: float = param(0.0, "true roll less what the encoder tells, rad", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """The roll is farther by the offset."""
        true = joints.copy()
        true[:, _ROLL] += self.offset_rad
        return true
