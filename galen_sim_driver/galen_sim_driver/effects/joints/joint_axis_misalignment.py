"""A joint's axis is turned in its parent link (contract, section 6).

With the turn A of an axis in its parent link, the joint's rotation R(q) becomes A R(q) A^T: at
q = 0 the link is where it should be. For the tilt axis turned about the roll link's z,

    R_base_sensor = Rx(roll) Rz(a) Ry(tilt) Rz(a)^T Ry(pi/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arm.galen import ArmParameters
from galen_model.arrays import Array
from galen_model.rotation import rot_x, rot_y, rotvec_to_matrix
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import ROTARY_JOINTS, Effect, Fitted, check_rotary
from galen_sim_driver.errors import ConfigError

_ABOUT = ("x", "y", "z")


@dataclass(frozen=True)
class JointAxisMisalignment(Effect):
    """The axis of `joint` is turned by `angle_rad` about an axis of its parent link."""

    name: ClassVar[str] = "joint_axis_misalignment"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("angle_rad", "rad", 0.02, -0.5, 0.5),)
    of_a_joint: ClassVar[bool] = True

    joint: str = param("tilt", "the joint whose axis is turned: roll tilt")
    about: str = param("z", "axis of the parent link that it is turned about: x y z")
    angle_rad: float = param(0.0, "by how much it is turned, rad", -0.5, 0.5)

    def validate(self) -> None:
        """Raise ConfigError unless the joint turns and `about` is an axis."""
        check_rotary(self.name, self.joint)
        if self.about not in _ABOUT:
            raise ConfigError(f"{self.name}: about is {self.about!r}, not one of x, y, z")

    @property
    def axis_turns(self) -> Array:
        """The turn of its own joint's axis; the other's is zero."""
        turns = np.zeros((len(ROTARY_JOINTS), 3))
        turns[ROTARY_JOINTS.index(self.joint), _ABOUT.index(self.about)] = self.angle_rad
        return turns


def sensor_pose(joints: Array, axis_turns: Array, arm: ArmParameters) -> tuple[Array, Array]:
    """Compute the sensor's pose with turned joint axes.

    Args:
        joints: (n, 5) true ones, m and rad.
        axis_turns: (2, 3) rotation vectors of roll and tilt axis in their parent links, rad.
        arm: dimensions.

    Returns:
        R_base_sensor (n, 3, 3) and the sensor's origin (n, 3) in base_link, m.

    """
    roll_axis, tilt_axis = rotvec_to_matrix(axis_turns)
    roll = roll_axis @ rot_x(joints[:, 3]) @ roll_axis.T
    turned = roll @ tilt_axis @ rot_y(joints[:, 4]) @ tilt_axis.T
    origin = joints[:, :3] + arm.platform_to_roll_m + roll @ arm.roll_to_tilt_m
    return turned @ rot_y(np.pi / 2), origin + turned @ arm.tilt_to_sensor_m
