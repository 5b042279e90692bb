# SPDX-License-Identifier: Apache-2.0
"""Calibration and check of a six-axis arm from where it stands, against a small arm."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from calibration_fake_arm import ADAPTER, NO_TOOL, POINTER, FakeArm
from check_pointer_file import POINTER_FILE
from galen_calibration_behavior.common.commands import CalibrationCode, CheckCode, PoseFeedback
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_common.goal.procedure import MoveTo
from galen_common.parameters import ParameterError
from galen_model.arm.description import read_arm
from galen_model.errors import GalenError, NotExcitedError
from galen_model.files.calibration_file import zeroed_at
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.verdict import CheckAnswer
from test_calibration_procedure import World, failed
from test_check_procedure import Course

URDF = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
ARM = read_arm(URDF)
HERE = np.array([0.2, -1.2, 1.6, -1.2, -1.57, 0.3])
FAST = CalibrationParameters(
    arm=ARM,
    settle_s=0.1,
    chosen_average_s=0.3,
    average_s=0.3,
    max_angle_velocity_rad_s=4.0,
    max_angle_acceleration_rad_s2=40.0,
)


def calibrating(settings=FAST, start=HERE):
    arm = FakeArm(1, start, ARM)
    arm.noise[3:] *= 0.2  # so that few short averages tell the load
    return World(settings.of_sweep(), arm=arm, poses=None, tip_m=[0.0, 0.0, 0.1])


def test_it_calibrates_around_where_it_stands_with_the_wrist_alone():
    world = calibrating().run()
    assert world.end.error_code == CalibrationCode.NONE, world.end
    feedback = world.of(PoseFeedback)
    assert "choosing poses around the present one" in [f.message for f in feedback]
    assert (feedback[-1].done, feedback[-1].total) == (36, 36)
    moves = np.array([move.joints for move in world.of(MoveTo)])
    assert np.all(np.abs(moves - HERE) <= FAST.pose_box_rad + 1e-9)
    assert np.all(moves[:, :4] == HERE[:4])
    np.testing.assert_allclose(world.arm.joints, HERE, atol=1e-9)  # home is where it stood
    found = world.estimate
    np.testing.assert_allclose(found.zero_angles, HERE, atol=1e-3)
    result = identify_two_sweeps(found.bare, found.tool, found.zero_angles)
    for load, true in ((result.load, POINTER), (result.adapter, ADAPTER)):
        assert abs(load.mass_kg - true.mass_kg) < 5.0 * load.mass_std_kg < 0.005
        assert np.all(np.abs(load.com_m - true.com_m) < 5.0 * load.com_std_m)


@pytest.mark.parametrize(
    ("change", "start", "code", "words"),
    [
        ({"pose_box_rad": 0.05}, HERE, "NOT_EXCITED", ["enlarge pose_box_rad (0.05 rad)"]),
        ({}, [0, -0.5, 2.7, 0.2, -1.57, 0], "BAD_INPUT", ["ft_sensor", "in upper_arm_link"]),
        ({}, [0, -0.5, 2.85, 0, 0, 0], "BAD_INPUT", ["elbow", "outside its limits"]),
    ],
)
def test_an_arm_that_has_no_good_poses_does_not_move(change, start, code, words):
    world = calibrating(dataclasses.replace(FAST, **change), np.array(start, float)).run()
    failed(world, CalibrationCode[code], *words)
    assert world.of(MoveTo) == []


def test_another_joint_is_looked_at_where_it_is_reported():
    plate = '<collision><geometry><box size="3 3 0.02"/></geometry></collision>'
    text = URDF.replace(
        "</robot>",
        f'<link name="table">{plate}</link><joint name="lift" type="prismatic">'
        '<parent link="base_link"/><child link="table"/><origin xyz="0 0 -3"/><axis xyz="0 0 1"/>'
        '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint></robot>',
    )
    world = calibrating(dataclasses.replace(FAST, arm=read_arm(text, base_frame="base_link")))
    world.procedure.beside["lift"] = 3.0 + ARM.sensor_pose(HERE)[1][2]
    failed(world.run(), CalibrationCode.BAD_INPUT, "table")
    assert world.of(MoveTo) == []


def test_the_grid_is_the_galens():
    assert CalibrationParameters().pose_kind == "grid"
    assert (FAST.pose_kind, FAST.pose_count) == ("chosen", 18)
    FAST.validate()  # the Galen's home and grid are not asked
    with pytest.raises(ParameterError, match="the arm is 'six_axis': set it to 'chosen' or"):
        dataclasses.replace(FAST, poses="grid").validate()
    with pytest.raises(GalenError, match="once the arm's pose is"):
        FAST.sweep_s()
    assert 5.0 < FAST.standing_at(HERE).sweep_s() < 30.0
    listed = dataclasses.replace(FAST, poses="listed", listed_poses_rad=tuple(HERE) * 3)
    assert listed.pose_count == 3
    with pytest.raises(NotExcitedError):
        listed.standing_at(HERE).plan(np.zeros(3))


@pytest.mark.parametrize(("tool", "answer"), [(POINTER, "GOOD"), (NO_TOOL, "RECALIBRATE")])
def test_it_is_checked_around_where_it_stands(tool, answer):
    file = dataclasses.replace(POINTER_FILE, arm=ARM, zeroing=zeroed_at(HERE, arm=ARM))
    course = Course(FAST, 6, tool, HERE, file, FakeArm(1, HERE, ARM))
    end = course.run()
    assert (end.error_code, end.check.answer) == (CheckCode.NONE, CheckAnswer[answer]), end
    moves = np.array([move.joints for move in course.of(MoveTo)])
    assert np.all(np.abs(moves - HERE) <= FAST.check_reach_rad + 1e-9)
    assert np.all(moves[:, :2] == HERE[:2])
    np.testing.assert_allclose(course.arm.joints, HERE, atol=1e-9)


ENDLESS = read_arm(URDF.replace('<joint name="wrist_3" type="revolute">',
                                '<joint name="wrist_3" type="continuous">'))  # fmt: skip


class WrappedArm(FakeArm):
    """It reports its last joint within half a turn, and takes commands from there."""

    def step(self):
        stamp, position, velocity, wrench = super().step()
        self.reported = position
        position[-1] -= 2.0 * np.pi * np.round(position[-1] / (2.0 * np.pi))
        return stamp, position, velocity, wrench

    def move_to(self, joints, duration_s):
        super().move_to(self.joints + (joints - self.reported), duration_s)


@pytest.mark.parametrize("report_velocity", [True, False])
def test_an_endless_wrist_at_half_a_turn_goes_the_short_way(report_velocity):
    assert ENDLESS.endless.tolist() == [False] * 5 + [True]
    start = np.array([*HERE[:5], 3.1])
    arm = WrappedArm(1, start, ENDLESS)
    arm.report_velocity = report_velocity
    arm.noise[3:] *= 0.2
    settings = dataclasses.replace(FAST, arm=ENDLESS).of_sweep()
    world = World(settings, arm=arm, poses=None, tip_m=[0.0, 0.0, 0.1])
    furthest = []

    def look(world):
        furthest.append(np.max(np.abs(world.arm.joints - start)))
        return False

    world.run(look)
    assert world.end.error_code == CalibrationCode.NONE, world.end
    assert max(furthest) <= FAST.pose_box_rad + 1e-6
    reported = world.estimate.tool.angles[:, -1]
    assert reported.min() < -2.0 and reported.max() > 2.0  # on both sides
