"""Plain-float geometry and least squares against galen_model."""

import math

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, LIMITS
from galen_model.arm.kinematics import joint_axes, sensor_rotation, tip_jacobian, tip_pose
from galen_model.rotation import quaternion_to_matrix, rotvec_to_matrix
from galen_sim_driver.plant.geometry import (
    ArmGeometry,
    from_rotvec,
    multiply,
    rotate,
    rotate_back,
    rotate_by,
    sensor_matrix,
    sensor_quaternion,
)
from galen_sim_driver.plant.hand import damped_joint_velocities

RNG = np.random.default_rng(11)
POSES = RNG.uniform(LIMITS.lower, LIMITS.upper, (25, 5))
TIP = [0.18, 0.01, 0.05]


@pytest.mark.parametrize("joints", POSES)
def test_rotation_and_tip_are_the_models(joints):
    matrix = sensor_matrix(joints[3], joints[4])
    expected = sensor_rotation(joints[3], joints[4])
    assert np.allclose(np.reshape(matrix, (3, 3)), expected, atol=1e-14)
    assert np.allclose(
        quaternion_to_matrix(sensor_quaternion(joints[3], joints[4])), expected, atol=1e-14
    )
    vector = RNG.normal(size=3)
    assert np.allclose(rotate(matrix, vector), expected @ vector, atol=1e-14)
    assert np.allclose(rotate_back(matrix, vector), expected.T @ vector, atol=1e-14)

    geometry = ArmGeometry(GALEN)
    _, tip = tip_pose(joints, TIP)
    assert np.allclose(geometry.tip_position(joints, matrix, TIP), tip, atol=1e-14)
    roll_point, _, tilt_point, _ = joint_axes(joints)
    from_roll, from_tilt = geometry.arms_to_tip(joints, matrix, TIP)
    assert np.allclose(from_roll, tip - roll_point, atol=1e-14)
    assert np.allclose(from_tilt, tip - tilt_point, atol=1e-14)


@pytest.mark.parametrize("damping", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("joints", POSES[:8])
def test_the_short_least_squares_is_the_whole_one(joints, damping):
    twist = RNG.normal(size=6)
    jacobian = tip_jacobian(joints, TIP)
    expected = np.linalg.solve(jacobian.T @ jacobian + damping**2 * np.eye(5), jacobian.T @ twist)
    matrix = sensor_matrix(joints[3], joints[4])
    arms = ArmGeometry(GALEN).arms_to_tip(joints, matrix, TIP)
    got = damped_joint_velocities(twist[:3], twist[3:], joints[3], *arms, damping)
    assert np.allclose(got, expected, atol=1e-12)


def test_quaternions():
    for scale in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        a, b = RNG.normal(size=3) * scale, RNG.normal(size=3)
        first, second = rotvec_to_matrix(a), rotvec_to_matrix(b)
        product = multiply(from_rotvec(a), from_rotvec(b))
        assert np.allclose(quaternion_to_matrix(product), first @ second, atol=1e-12)
        vector = RNG.normal(size=3)
        assert np.allclose(rotate_by(from_rotvec(b), vector), second @ vector, atol=1e-12)
        assert math.hypot(*product) == pytest.approx(1.0, abs=1e-12)
