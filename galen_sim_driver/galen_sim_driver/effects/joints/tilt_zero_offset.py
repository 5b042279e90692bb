"""The tilt joint's zero is wrong: true tilt = reported + offset (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants

_TILT = 4


@dataclass(frozen=True)
class TiltZeroOffset(Effect):
    """true tilt = reported + `offset_rad`."""

    name: ClassVar[str] = "tilt_zero_offset"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("offset_rad", "rad", 0.01, -0.5, 0.5),)
    order: ClassVar[int] = 1

    offset_rad: float = param(0.0, "true tilt less what the encoder tells, rad", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """The tilt is farther by the offset."""
        true = joints.copy()
        true[:, _TILT] += self.offset_rad
        return true
