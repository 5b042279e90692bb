"""Functions of before `Arm`, until every package has switched."""

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array


def sensor_rotation(roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
    """Use `Arm.rotation`."""
    return GALEN.rotation(np.stack(np.broadcast_arrays(roll_rad, tilt_rad), axis=-1))


def gravity_in_sensor(roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
    """Use `Arm.gravity_in_sensor`."""
    return GALEN.gravity_in_sensor(np.stack(np.broadcast_arrays(roll_rad, tilt_rad), axis=-1))


def sensor_pose(joints: ArrayLike, arm: Arm = GALEN) -> tuple[Array, Array]:
    """Use `Arm.sensor_pose`."""
    return arm.sensor_pose(joints)


def tip_pose(joints: ArrayLike, tip_m: ArrayLike, arm: Arm = GALEN) -> tuple[Array, Array]:
    """Use `Arm.tip_pose`."""
    return arm.tip_pose(joints, tip_m)


def joint_axes(joints: ArrayLike, arm: Arm = GALEN) -> tuple[Array, Array, Array, Array]:
    """Use `Arm.joint_axes`."""
    origins, axes = arm.joint_axes(joints)
    return origins[3], axes[3], origins[4], axes[4]


def tip_jacobian(joints: ArrayLike, tip_m: ArrayLike, arm: Arm = GALEN) -> Array:
    """Use `Arm.tip_jacobian`."""
    return arm.tip_jacobian(joints, tip_m)
