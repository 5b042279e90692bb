"""Nominal deflection of the tool's tip under an applied wrench.

Three springs in series, each a rigid displacement that adds up at the tip:

1. The platform on its six rods. Rod (i, +-) has the row a = [n_i, B x n_i] with
   B = r u_i +- h (-sin theta_i, cos theta_i, 0). With G the 6 x 3 matrix that holds n_iz of each
   rod in its carriage's column, K_p = A^T (I / k_rod + G G^T / k_q)^-1 A is the stiffness at
   the platform's centre.
2. and 3. Roll and tilt: the wrench's moment about the axis, over that joint's stiffness.

Each gives a compliance J_k C_k J_k^T at the tip, so that the whole is symmetric.
"""

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.delta import LinearDelta
from galen_model.arm.galen import GALEN, ArmParameters
from galen_model.arm.kinematics import joint_axes, sensor_pose, tip_pose
from galen_model.arrays import Array
from galen_model.rotation import skew
from galen_model.wrench import move_wrench


def platform_stiffness(platform_m: ArrayLike, arm: ArmParameters = GALEN) -> Array:
    """K_p (6, 6) at the platform's centre: wrench over twist, base_link, SI."""
    rows = LinearDelta(arm).rod_rows(platform_m)
    carriage = np.zeros((6, 3))
    carriage[np.arange(6), np.repeat(np.arange(3), 2)] = rows[:, 2]
    flexibility = (
        np.eye(6) / arm.rod_stiffness_n_m + carriage @ carriage.T / arm.carriage_stiffness_n_m
    )
    return np.asarray(rows.T @ np.linalg.solve(flexibility, rows))


def tip_compliance(joints: ArrayLike, tip_m: ArrayLike, arm: ArmParameters = GALEN) -> Array:
    """C (6, 6): twist of the tip (m, rad) over the wrench at the tip (N, N.m), base_link.

    joints (5,), tip_m (3,) in ft_sensor.
    """
    q = np.asarray(joints, dtype=float)
    _, tip = tip_pose(q, tip_m, arm)
    # v_tip = v_platform + w x (tip - platform)
    transport = np.eye(6)
    transport[:3, 3:] = -skew(tip - q[:3])
    compliance = transport @ np.linalg.solve(platform_stiffness(q[:3], arm), transport.T)
    roll_point, roll_axis, tilt_point, tilt_axis = joint_axes(q, arm)
    for point, axis, stiffness in (
        (roll_point, roll_axis, arm.roll_stiffness_nm_rad),
        (tilt_point, tilt_axis, arm.tilt_stiffness_nm_rad),
    ):
        column = np.concatenate([np.cross(axis, tip - point), axis])
        compliance = compliance + np.outer(column, column) / stiffness
    return np.asarray(compliance)


def deflection(
    joints: ArrayLike, applied_wrench: ArrayLike, tip_m: ArrayLike, arm: ArmParameters = GALEN
) -> Array:
    """Displacement (6,) of tool_tip: translation (m) and rotation vector (rad) in base_link.

    applied_wrench (6,): in ft_sensor about the sensor's origin, N and N.m. joints (5,), tip_m (3,).
    """
    rotation, origin = sensor_pose(joints, arm)
    _, tip = tip_pose(joints, tip_m, arm)
    return tip_compliance(joints, tip_m, arm) @ move_wrench(applied_wrench, rotation, origin - tip)
