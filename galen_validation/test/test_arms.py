# SPDX-License-Identifier: Apache-2.0
"""The arms of others: MuJoCo and the suite agree on what a UR5's sensor reads."""

from dataclasses import replace

import numpy as np
import pytest
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_model.arm.galen import SENSOR
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.errors import GalenError
from galen_model.load.inertia import inertia_numbers, inertial_wrench, point_mass_inertia
from galen_model.load.model import TOOLS, gravity_regressor
from scipy.interpolate import CubicSpline

from galen_validation.arms import ROBOTS, UR5, differences
from galen_validation.arms.__main__ import PARTS, document
from galen_validation.arms.calibrations import TOOL as NAME
from galen_validation.arms.calibrations import _averaged, _calibrated, _share
from galen_validation.arms.recordings import (
    ADAPTER,
    ADAPTER_INERTIA_KG_M2,
    HOME,
    TOOL,
    TOOL_INERTIA_KG_M2,
    Ur5InMujoco,
    _record,
    held_out,
)


@pytest.fixture(scope="module", autouse=True)
def installed():
    try:
        UR5.path  # noqa: B018
    except GalenError as error:
        pytest.skip(str(error))


def test_a_part_made_again_replaces_itself_alone():
    first = document("", {"panda": "before", "kinematics": "two rows"})
    again = document(first, {"panda": "after"})
    assert again == first.replace("before\n", "after\n")
    assert again.index("two rows") < again.index("after\n")
    assert set(PARTS) >= {"panda", "kinematics"}


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_kinematics_of_every_arm_are_pinocchios(robot):
    assert len(robot.arm.joints) == len(robot.standing)
    assert robot.arm.limit_fault(robot.standing) == ""
    assert differences(robot, 5).max() < 1e-13


def test_mujoco_weighs_adapter_and_tool_as_the_arm_does():
    joints = np.array([0.3, -1.1, 1.4, -0.8, 0.9, 2.0])
    rows = gravity_regressor(UR5.arm.gravity_in_sensor(joints))
    expected = rows @ (ADAPTER.moments + TOOL.moments)
    assert np.allclose(Ur5InMujoco(tool=True).hold(joints), expected, atol=1e-9)


def test_the_sensor_reads_newtons_and_eulers_wrench_while_torques_follow_a_course():
    """The controller does not know the tool."""
    poses = HOME + np.random.default_rng(0).uniform(-0.4, 0.4, (6, 6))
    course = CubicSpline(0.6 * np.arange(6.0), poses)
    at_s, rows = Ur5InMujoco(tool=True).run(course)
    joints, rates, wrench = rows.swapaxes(0, 1)
    assert np.max(np.abs(joints - course(at_s))) < 0.01
    motion = sensor_motion(joints, rates, np.gradient(rates, at_s, axis=0), UR5.arm)
    specific = UR5.arm.gravity_in_sensor(joints) - motion.acceleration_m_s2
    centres = inertia_numbers(np.diag(np.add(ADAPTER_INERTIA_KG_M2, TOOL_INERTIA_KG_M2)))
    expected = inertial_wrench(
        specific, motion.velocity_rad_s, motion.acceleration_rad_s2,
        ADAPTER.moments + TOOL.moments, centres + point_mass_inertia(ADAPTER, TOOL),
    )  # fmt: skip
    difference = np.abs(wrench - expected)[50:-50].max(axis=0)
    assert np.all(difference < [0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3]), difference


def test_blocks_are_held_out_and_inertial_forces_explain_motion():
    rng = np.random.default_rng(1)
    turn = np.arange(2000) / 90.0
    gravity = np.column_stack([9.0 * np.cos(turn), 9.0 * np.sin(turn), np.full(2000, 3.9)])
    acceleration = rng.normal(size=(2000, 3))
    force = 1.2 * (gravity - acceleration)
    wrench = np.concatenate([force, np.zeros((2000, 3))], axis=1)
    record = _record([gravity, acceleration, np.zeros((2000, 3)), wrench], slice(None))
    assert held_out(record, record, weighted=False).max() < 1e-9
    still = replace(record, acceleration_m_s2=np.zeros((2000, 3)))
    assert held_out(still, still, weighted=False)[:3].min() > 1.0


def test_errors_of_simulated_calibrations_are_as_large_as_their_covariance_says():
    settings = replace(CalibrationParameters(), arm=UR5.arm).standing_at(np.array(UR5.standing))
    poses = settings.plan(TOOLS[NAME].tip_m).poses
    errors = np.array([_calibrated(settings, poses, seed) for seed in range(30)])
    assert 0.7 < np.sqrt(np.mean(errors**2)) < 1.3


def test_averages_scatter_as_the_sensors_noise_over_their_readings():
    means, std = _averaged(np.random.default_rng(2), np.zeros((400, 6)), 0.5)
    assert np.allclose(means.std(axis=0), SENSOR.noise_std / np.sqrt(250), rtol=0.15)
    assert np.allclose(std.mean(axis=0), means.std(axis=0), rtol=0.15)
    assert _share(np.arange(100) < 95) == "95.0 % (88.8–97.8)"
