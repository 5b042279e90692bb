# SPDX-License-Identifier: Apache-2.0
"""Closed-form kinematics against Pinocchio, finite differences and analytic cases."""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import KinematicsError

from galen_validation.pinocchio_arm import PinocchioArm

TIP = np.array([0.18, 0.01, 0.05])


def random_joints(count, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(GALEN.lower, GALEN.upper, (count, 5))


def test_closed_form_equals_pinocchio_on_the_urdf():
    arm = PinocchioArm(TIP)
    for q in random_joints(50):
        for closed, frame in (
            (GALEN.sensor_pose(q), "ft_sensor"),
            (GALEN.tip_pose(q, TIP), "tool_tip"),
        ):
            rotation, origin = arm.pose(q, frame)
            np.testing.assert_allclose(closed[0], rotation, atol=1e-12)
            np.testing.assert_allclose(closed[1], origin, atol=1e-12)
        np.testing.assert_allclose(GALEN.tip_jacobian(q, TIP), arm.jacobian(q), atol=1e-12)


def test_home_is_where_the_chain_of_offsets_puts_it():
    rotation, origin = GALEN.sensor_pose(GALEN.home)
    # 0.6085 + 0.031248 forward; 0.408 + 0.07614 + 0.013 + 0.025 up; z of the sensor along x
    np.testing.assert_allclose(origin, [0.639748, 0.0, 0.52214], atol=1e-12)
    np.testing.assert_allclose(rotation, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)


def test_delta_forward_undoes_inverse():
    delta = GALEN.delta
    np.testing.assert_allclose(delta.carriages(GALEN.home[:3]), 0.0, atol=1e-15)
    for q in random_joints(200, seed=4):
        carriages = delta.carriages(q[:3], check_travel=False)
        np.testing.assert_allclose(delta.platform(carriages), q[:3], atol=1e-12)


def test_delta_rods_keep_their_length_and_jacobian_equals_finite_differences():
    delta, step = GALEN.delta, 1e-6
    for q in random_joints(20, seed=5):
        p = q[:3]
        np.testing.assert_allclose(np.linalg.norm(delta.rod_directions(p), axis=1), 1.0, atol=1e-12)
        numeric = np.column_stack(
            [
                (
                    delta.carriages(p + step * axis, check_travel=False)
                    - delta.carriages(p - step * axis, check_travel=False)
                )
                / (2 * step)
                for axis in np.eye(3)
            ]
        )
        np.testing.assert_allclose(delta.jacobian(p), numeric, atol=1e-8)


def test_delta_says_what_it_cannot_reach():
    delta = GALEN.delta
    with pytest.raises(KinematicsError, match=r"rod . does not reach"):
        delta.carriages([0.7, 0.0, 0.4])
    with pytest.raises(KinematicsError, match="outside its travel"):
        delta.carriages([0.0, 0.0, 0.8])
    with pytest.raises(KinematicsError, match="no platform position"):
        delta.platform([0.0, 0.0, 3.0])


def test_where_the_joint_limits_are_inside_the_carriages_travel():
    """Up to 0.503 m everywhere in the box, no higher in its worst corner; never too low."""
    delta = GALEN.delta
    highest = []
    for x in np.linspace(GALEN.lower[0], GALEN.upper[0], 15):
        for y in np.linspace(GALEN.lower[1], GALEN.upper[1], 15):
            for z in (GALEN.lower[2], GALEN.home[2]):
                assert np.all(np.isfinite(delta.carriages([x, y, z])))
            # a carriage goes with the platform, one to one, when only z changes
            above = delta.carriages([x, y, GALEN.home[2]]).max()
            highest.append(GALEN.home[2] + GALEN.delta.carriage_travel_m - above)
    assert min(highest) == pytest.approx(0.503, abs=1e-3)
    assert max(highest) == pytest.approx(0.658, abs=1e-3)
    assert min(highest) < GALEN.upper[2]
