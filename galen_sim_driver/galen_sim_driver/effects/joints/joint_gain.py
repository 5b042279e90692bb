"""A joint turns by more than it reports: true = (1 + gain) reported (contract, section 6).

With an offset of the zero as well: (1 + gain) reported + offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arm.galen import JOINT_NAMES
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, check_rotary


@dataclass(frozen=True)
class JointGain(Effect):
    """true angle of `joint` = (1 + `gain`) reported."""

    name: ClassVar[str] = "joint_gain"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("gain", "", 0.02, -0.5, 0.5),)
    of_a_joint: ClassVar[bool] = True

    joint: str = param("tilt", "the joint with the gain: roll tilt")
    gain: float = param(0.0, "true angle over the reported one, minus 1", -0.5, 0.5)

    def validate(self) -> None:
        """Raise ConfigError unless the joint turns."""
        check_rotary(self.name, self.joint)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Multiply by 1 + gain."""
        true = joints.copy()
        true[:, JOINT_NAMES.index(self.joint)] *= 1.0 + self.gain
        return true
