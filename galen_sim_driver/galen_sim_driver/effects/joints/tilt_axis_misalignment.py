"""The tilt axis isn't square to the roll axis (contract, section 6).

In the roll link the tilt turns about Rz(a) e_y = (-sin a, cos a, 0) instead of e_y; at tilt 0 the
sensor stands as it should:

    R_base_sensor = Rx(roll) Rz(a) Ry(tilt) Rz(a)^T Ry(pi/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arm.galen import ArmParameters
from galen_model.arrays import Array
from galen_model.rotation import rot_x, rot_y, rot_z
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class TiltAxisMisalignment(Effect):
    """The tilt axis is turned by `about_z_rad` about the roll link's z."""

    name: ClassVar[str] = "tilt_axis_misalignment"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("about_z_rad", "rad", 0.02, -0.5, 0.5),)

    about_z_rad: float = param(
        0.0, "the tilt axis is turned so far about the roll link's z, rad", -0.5, 0.5
    )

    @property
    def tilt_axis_about_z_rad(self) -> float:
        """The angle itself; the geometry follows it."""
        return self.about_z_rad


def sensor_pose(joints: Array, about_z_rad: float, arm: ArmParameters) -> tuple[Array, Array]:
    """R_base_sensor (n, 3, 3) and its origin in base_link (n, 3), m, with the axis turned so far.

    joints (n, 5): true ones, m and rad.
    """
    aside = rot_z(about_z_rad)
    roll = rot_x(joints[:, 3])
    turned = roll @ aside @ rot_y(joints[:, 4]) @ aside.T
    origin = joints[:, :3] + arm.platform_to_roll_m + roll @ arm.roll_to_tilt_m
    return turned @ rot_y(np.pi / 2), origin + turned @ arm.tilt_to_sensor_m
