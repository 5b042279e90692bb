"""A joint's zero is wrong: true angle = reported + offset (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arm.galen import JOINT_NAMES
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, check_rotary


@dataclass(frozen=True)
class JointZeroOffset(Effect):
    """true angle of `joint` = reported + `offset_rad`."""

    name: ClassVar[str] = "joint_zero_offset"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("offset_rad", "rad", 0.01, -0.5, 0.5),)
    order: ClassVar[int] = 1
    of_a_joint: ClassVar[bool] = True

    joint: str = param("tilt", "the joint whose zero is off: roll tilt")
    offset_rad: float = param(0.0, "true angle minus the reported one, rad", -0.5, 0.5)

    def validate(self) -> None:
        """Raise ConfigError unless the joint turns."""
        check_rotary(self.name, self.joint)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Add the offset."""
        true = joints.copy()
        true[:, JOINT_NAMES.index(self.joint)] += self.offset_rad
        return true
