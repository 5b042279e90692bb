"""Forward kinematics of the arm, in closed form.

T_base_sensor = Trans(delta) Trans(0, 0, 0.07614) Rx(roll) Trans(0.6085, 0, 0.013) Ry(tilt)
                Trans(0.031248, 0, 0.025) Ry(pi/2)

The turn by pi/2 is taken into the tilt, so that R_base_sensor = Rx(roll) Ry(tilt + pi/2).
`galen_model.arm.pinocchio_arm` gives the same from the URDF, and a test compares the two.
"""

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import GALEN, GRAVITY_M_S2, ArmParameters
from galen_model.arrays import Array
from galen_model.rotation import rot_x, rot_y


def sensor_rotation(roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
    """R_base_sensor, shape (..., 3, 3), for roll and tilt of shape (...), rad."""
    return rot_x(roll_rad) @ rot_y(np.asarray(tilt_rad, dtype=float) + np.pi / 2)


def gravity_in_sensor(roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
    """Gravity in ft_sensor, shape (..., 3), m/s^2: R_base_sensor^T g.

    Written out, g (cos roll cos tilt, -sin roll, cos roll sin tilt): at home it points along x.
    """
    roll, tilt = np.broadcast_arrays(
        np.asarray(roll_rad, dtype=float), np.asarray(tilt_rad, dtype=float)
    )
    cos_roll = np.cos(roll)
    direction = np.stack([cos_roll * np.cos(tilt), -np.sin(roll), cos_roll * np.sin(tilt)], axis=-1)
    return direction * -GRAVITY_M_S2[2]


def sensor_pose(joints: ArrayLike, arm: ArmParameters = GALEN) -> tuple[Array, Array]:
    """R_base_sensor (..., 3, 3) and the sensor's origin in base_link (..., 3), m.

    joints: (..., 5) in the order of `JOINT_NAMES`, m and rad.
    """
    q = np.asarray(joints, dtype=float)
    roll_rotation, tilt_rotation = rot_x(q[..., 3]), rot_y(q[..., 4])
    origin = (
        q[..., :3]
        + arm.platform_to_roll_m
        + np.einsum(
            "...ij,...j->...i",
            roll_rotation,
            arm.roll_to_tilt_m + np.einsum("...ij,j->...i", tilt_rotation, arm.tilt_to_sensor_m),
        )
    )
    return sensor_rotation(q[..., 3], q[..., 4]), origin


def tip_pose(
    joints: ArrayLike, tip_m: ArrayLike, arm: ArmParameters = GALEN
) -> tuple[Array, Array]:
    """R_base_tip (..., 3, 3) and the tip in base_link (..., 3), m.

    tip_m: (3,) in ft_sensor. The frame tool_tip is turned as ft_sensor is.
    """
    rotation, origin = sensor_pose(joints, arm)
    return rotation, origin + np.einsum("...ij,j->...i", rotation, np.asarray(tip_m, dtype=float))


def joint_axes(joints: ArrayLike, arm: ArmParameters = GALEN) -> tuple[Array, Array, Array, Array]:
    """Roll axis (point, direction) and tilt axis (point, direction) in base_link, each (3,)."""
    q = np.asarray(joints, dtype=float)
    roll_point = q[:3] + arm.platform_to_roll_m
    roll_rotation = rot_x(q[3])
    tilt_point = roll_point + roll_rotation @ arm.roll_to_tilt_m
    return roll_point, np.array([1.0, 0.0, 0.0]), tilt_point, roll_rotation[:, 1].copy()


def tip_jacobian(joints: ArrayLike, tip_m: ArrayLike, arm: ArmParameters = GALEN) -> Array:
    """Jacobian (6, 5) of the tip's twist (linear, angular; base_link) by the joints' velocities.

    A revolute column is (axis x (tip - point), axis); a prismatic one (axis, 0).
    """
    _, tip = tip_pose(joints, tip_m, arm)
    roll_point, roll_axis, tilt_point, tilt_axis = joint_axes(joints, arm)
    jacobian = np.zeros((6, 5))
    jacobian[:3, :3] = np.eye(3)
    jacobian[:3, 3], jacobian[3:, 3] = np.cross(roll_axis, tip - roll_point), roll_axis
    jacobian[:3, 4], jacobian[3:, 4] = np.cross(tilt_axis, tip - tilt_point), tilt_axis
    return jacobian
