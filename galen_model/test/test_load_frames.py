# SPDX-License-Identifier: Apache-2.0
"""Loads in other frames, against Pinocchio's frames, weights and drawn samples."""

import numpy as np
import pinocchio
import pytest
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.load.frames import (
    FrameError,
    FrameNeedsJointsError,
    frames,
    joint_vector,
    needed_joints,
    sensor_in_frame,
)
from galen_model.load.model import LoadEstimate, gravity_wrench
from model_files import SIX_AXIS_URDF

from galen_validation.pinocchio_arm import PinocchioArm

TIP_M = np.array([0.15, -0.02, 0.05])
COVARIANCE = np.cov(
    np.random.default_rng(3).normal(size=(4, 40)) * [[1e-4], [2e-4], [1e-4], [3e-4]]
)
LOAD = LoadEstimate(0.2, np.array([0.07, -0.01, 0.055]), COVARIANCE)


@pytest.mark.parametrize("frame", frames(arm=GALEN))
def test_the_weight_pulls_at_the_centre_in_every_frame(frame):
    """The weight's wrench, moved to the frame, is the centre there crossed with the force there."""
    joints = np.array([0.05, -0.03, 0.45, 0.7, -0.4])
    rotation = PinocchioArm(TIP_M).pose(joints, frame)[0]
    place = sensor_in_frame(frame, TIP_M, joints, arm=GALEN)
    wrench = place.wrench(gravity_wrench(GALEN.gravity_in_sensor((0.7, -0.4)), LOAD.load))
    force = LOAD.mass_kg * rotation.T @ GRAVITY_M_S2
    np.testing.assert_allclose(wrench[:3], force, atol=1e-12)
    np.testing.assert_allclose(wrench[3:], np.cross(place.load(LOAD).com_m, force), atol=1e-12)


def test_the_covariance_is_that_of_the_moved_estimates():
    """Estimates drawn in the sensor's frame and moved one by one scatter as it says."""
    place = sensor_in_frame("base_link", TIP_M, np.array([0.05, -0.03, 0.45, 0.7, -0.4]), arm=GALEN)
    rng = np.random.default_rng(11)
    drawn = rng.multivariate_normal([LOAD.mass_kg, *LOAD.com_m], COVARIANCE, size=20000)
    moved = np.column_stack([drawn[:, 0], [place.point(com) for com in drawn[:, 1:]]])
    said = place.load(LOAD).covariance
    scale = np.sqrt(np.diag(said))
    np.testing.assert_allclose(
        np.cov(moved.T) / np.outer(scale, scale), said / np.outer(scale, scale), atol=0.04
    )
    assert not np.allclose(said, COVARIANCE, rtol=0.2)  # it is no covariance that a turn keeps


def test_what_lacks_is_named():
    with pytest.raises(FrameError, match="no frame 'tool0'; there are ft_sensor, tool_tip"):
        sensor_in_frame("tool0", TIP_M, arm=GALEN)
    with pytest.raises(FrameNeedsJointsError, match="'roll_link' depends on tilt; unknown: tilt"):
        sensor_in_frame("roll_link", TIP_M, arm=GALEN)
    with pytest.raises(FrameNeedsJointsError, match=r"unknown: delta_x, delta_y, delta_z$"):
        sensor_in_frame("base_link", TIP_M, joint_vector([0.1, 0.2], arm=GALEN), arm=GALEN)
    for wrong in ([0.1], [0.1] * 3, [0.1, np.nan]):
        with pytest.raises(FrameNeedsJointsError, match="or roll, tilt alone"):
            joint_vector(wrong, arm=GALEN)
    np.testing.assert_array_equal(joint_vector([0.1, 0.2], arm=GALEN), [np.nan] * 3 + [0.1, 0.2])
    np.testing.assert_array_equal(joint_vector(GALEN.home.tolist(), arm=GALEN), GALEN.home)


BRANCHES = """
  <link name="stand"/><joint name="stand_fixed" type="fixed">
    <parent link="base_link"/><child link="stand"/><origin xyz="0.1 0 -0.5" rpy="0 0 1"/></joint>
  <link name="finger"/><joint name="grip" type="prismatic"><parent link="ft_sensor"/>
    <child link="finger"/><axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/>
  </joint></robot>"""


def test_frames_that_fixed_joints_carry_are_those_of_the_description():
    text = SIX_AXIS_URDF.replace("</robot>", BRANCHES)
    arm = read_arm(text)
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    rng = np.random.default_rng(7)
    joints = rng.uniform(-2.0, 2.0, model.nq)
    pinocchio.framesForwardKinematics(model, data, joints)
    assert {"tool0", "stand", "wrist_3_link", "base_link"} < set(frames(arm))
    assert needed_joints("tool0", arm) == () and needed_joints("stand", arm) == arm.joint_names
    sensor = data.oMf[model.getFrameId("ft_sensor")]
    for frame in set(frames(arm)) - {"tool_tip"}:
        known = [name in needed_joints(frame, arm) for name in arm.joint_names]
        given = np.where(known, joints[: len(known)], np.nan)
        place = sensor_in_frame(frame, TIP_M, given, arm=arm)
        expected = data.oMf[model.getFrameId(frame)].actInv(sensor)
        np.testing.assert_allclose(place.rotation, expected.rotation, atol=1e-12)
        np.testing.assert_allclose(place.origin_m, expected.translation, atol=1e-12)
    with pytest.raises(
        FrameError, match="'finger' hangs on the joint 'grip', which is not between"
    ):
        sensor_in_frame("finger", TIP_M, None, arm=arm)
    with pytest.raises(FrameError, match=r"no frame 'flange'; there are ft_sensor.*tool0"):
        sensor_in_frame("flange", TIP_M, None, arm=arm)
