# SPDX-License-Identifier: Apache-2.0
"""The sensor's motion and a load's wrench in motion, against Pinocchio and analytic cases."""

import numpy as np
import pinocchio
import pytest
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.arm.sensor_motion import MotionOfSensor, sensor_motion
from galen_model.errors import CalibrationFileError
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.inertia import (
    InertiaEstimate,
    LoadInMotion,
    inertia_matrix,
    inertia_numbers,
    inertial_wrench,
    point_mass_inertia,
)
from galen_model.load.model import Load, gravity_wrench
from model_files import SIX_AXIS_URDF, calibration, read_content
from test_model_description import random_robot

from galen_validation.pinocchio_arm import PinocchioArm

INERTIA = np.array([2e-3, 3e-3, 4e-3, 1e-4, -2e-4, 3e-4])
LOAD = Load(0.3, np.array([0.04, -0.01, 0.05]))


def random_motion(count=30, seed=3):
    rng = np.random.default_rng(seed)
    scale = np.array([0.2, 0.2, 0.2, 1.5, 1.5])
    return (
        rng.uniform(GALEN.lower, GALEN.upper, (count, 5)),
        rng.standard_normal((count, 5)) * scale,
        rng.standard_normal((count, 5)) * 4 * scale,
    )


def pinocchio_motion(arm, q, v, a):
    """The frame's velocity, spatial and classical acceleration in its own axes."""
    data = arm.model.createData()
    frame = arm.model.getFrameId("ft_sensor")
    pinocchio.forwardKinematics(arm.model, data, q, v, a)
    pinocchio.updateFramePlacements(arm.model, data)
    at = (arm.model, data, frame, pinocchio.LOCAL)
    return (
        pinocchio.getFrameVelocity(*at),
        pinocchio.getFrameAcceleration(*at),
        pinocchio.getFrameClassicalAcceleration(*at),
    )


def test_the_sensors_motion_and_a_loads_wrench_are_pinocchios():
    arm = PinocchioArm()
    p = LOAD.com_m
    about_centre = inertia_matrix(INERTIA + point_mass_inertia(LOAD)) - LOAD.mass_kg * (
        p @ p * np.eye(3) - np.outer(p, p)
    )
    body = pinocchio.Inertia(LOAD.mass_kg, p, about_centre)
    inertia = INERTIA + point_mass_inertia(LOAD)
    np.testing.assert_allclose(inertia_matrix(inertia_numbers(about_centre)), about_centre)
    q, v, a = random_motion()
    motion = sensor_motion(q, v, a, arm=GALEN)
    wrench = inertial_wrench(-motion.acceleration_m_s2, *motion[:2], LOAD.moments, inertia)
    for k in range(len(q)):
        velocity, spatial, classical = pinocchio_motion(arm, q[k], v[k], a[k])
        expected = [velocity.angular, spatial.angular, classical.linear]
        np.testing.assert_allclose([part[k] for part in motion], expected, atol=1e-11)
        rate = body * spatial + velocity.cross(body * velocity)
        np.testing.assert_allclose(wrench[k], -np.r_[rate.linear, rate.angular], atol=1e-12)
        # one moment at a time, in plain floats
        single = MotionOfSensor(arm=GALEN).at(q[k], v[k], a[k])
        np.testing.assert_allclose(single, [part[k] for part in motion], atol=1e-12)
        w, al, linear = single
        fast = LoadInMotion(LOAD.moments, inertia).wrench(tuple(-x for x in linear), w, al)
        np.testing.assert_allclose(fast, wrench[k], atol=1e-12)


@pytest.mark.parametrize("text", [SIX_AXIS_URDF, *map(random_robot, range(4))])
def test_the_sensors_motion_on_any_chain_is_that_of_the_whole_robot(text):
    arm = read_arm(text, sensor_frame="ft_sensor" if text is SIX_AXIS_URDF else "sensor")
    model = pinocchio.buildModelFromXML(text)
    data, at = model.createData(), (model.getFrameId(arm.sensor_frame), pinocchio.LOCAL)
    joints = [model.joints[model.getJointId(name)] for name in arm.joint_names]
    q, v, a = np.random.default_rng(1).standard_normal((3, 5, len(joints)))
    motion, one = sensor_motion(q, v, a, arm), MotionOfSensor(arm)
    for k in range(len(q)):
        place, rate, rate_2 = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        for column, joint in enumerate(joints):
            angle = q[k, column]
            place[joint.idx_q : joint.idx_q + joint.nq] = (
                angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
            )
            rate[joint.idx_v], rate_2[joint.idx_v] = v[k, column], a[k, column]
        pinocchio.forwardKinematics(model, data, place, rate, rate_2)
        velocity = pinocchio.getFrameVelocity(model, data, *at)
        classical = pinocchio.getFrameClassicalAcceleration(model, data, *at)
        expected = [velocity.angular, classical.angular, classical.linear]
        np.testing.assert_allclose([part[k] for part in motion], expected, atol=1e-11)
        np.testing.assert_allclose(one.at(q[k], v[k], a[k]), expected, atol=1e-11)


def test_at_rest_it_is_the_weight_and_a_pendulum_in_free_fall_of_its_swing_reads_nothing_along_it():
    gravity = np.array([0.0, -9.80665, 0.0])
    still = inertial_wrench(gravity, np.zeros(3), np.zeros(3), LOAD.moments, INERTIA)
    np.testing.assert_allclose(still, gravity_wrench(gravity, LOAD), atol=1e-15)
    # A point mass on a massless rod that swings freely about the sensor's origin (z axis) carries
    # no torque there: I al = m g l sin(angle) of the pendulum's own equation.
    bob = Load(0.2, np.array([0.3, 0.0, 0.0]))
    swing = np.cross(bob.com_m, gravity) * bob.mass_kg / (bob.mass_kg * 0.09)
    spin = np.array([0.0, 0.0, 2.0])
    wrench = inertial_wrench(gravity, spin, swing, bob.moments, point_mass_inertia(bob))
    np.testing.assert_allclose(wrench[3:], 0.0, atol=1e-15)
    # the rod pulls inward with m w^2 l, so the sensor is pulled outward, along +x
    np.testing.assert_allclose(wrench[0], 0.2 * 4.0 * 0.3, atol=1e-14)


def test_a_tools_file_holds_the_inertia_or_no_key_for_it(tmp_path):
    estimate = InertiaEstimate(INERTIA, np.diag(np.full(6, 1e-10)))
    write_calibration(tmp_path / "a.json", calibration("a", inertia=estimate))
    again = read_calibration(tmp_path / "a.json", arm=GALEN).inertia
    assert again is not None
    np.testing.assert_array_equal(again.about_sensor_kg_m2, INERTIA)
    np.testing.assert_allclose(again.std_kg_m2, 1e-5)
    assert "inertia" not in calibration().to_json()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"about_sensor_kg_m2": [0.0] * 5}, "inertia.about_sensor_kg_m2 has shape"),
        ({"about_sensor_kg_m2": [-1e-3, 1e-3, 1e-3, 0, 0, 0]}, "principal inertia"),
        ({"about_sensor_kg_m2": [11.0, 11.0, 11.0, 0, 0, 0]}, "more than 10"),
        ({"order": ["xx", "xy", "xz", "yy", "yz", "zz"]}, "inertia.order"),
        ({"covariance": [[-1.0] * 6] * 6}, "negative variance"),
    ],
)
def test_a_wrong_inertia_is_named(tmp_path, change, message):
    content = calibration(inertia=InertiaEstimate(INERTIA, np.eye(6) * 1e-12)).to_json()
    content["inertia"] |= change
    with pytest.raises(CalibrationFileError, match=message):
        read_content(tmp_path, content)
