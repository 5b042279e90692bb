# SPDX-License-Identifier: Apache-2.0
"""The check's course against a small arm: where it goes, what it answers, how it ends."""

import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_fake_arm import NO_TOOL, POINTER, FakeArm
from check_pointer_file import POINTER_FILE
from galen_calibration_behavior.common.commands import CheckCode, CheckState, PoseFeedback, PosesEnd
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.quick_check.procedure import CheckProcedure
from galen_common.goal.procedure import MoveTo, Stop
from galen_model.arm.clearance import ArmClearance, boxes_from_numbers
from galen_model.arm.galen import GALEN
from galen_model.load.verdict import CheckAnswer

BOX = (0.721, -0.003, 0.304, 0.768, 0.111, 0.352)
START = np.array([0.02, -0.01, 0.41, 0.3, -0.2])
SLOW = CalibrationParameters()
FAST = CalibrationParameters(
    settle_s=0.1, average_s=0.3, max_angle_velocity_rad_s=4.0, max_angle_acceleration_rad_s2=40.0
)


class Course:
    """An arm that was zeroed at home without the tool, and a check of it."""

    def __init__(
        self, settings=FAST, poses=5, tool=POINTER, start=START, file=POINTER_FILE, arm=None
    ):
        self.arm = arm or FakeArm(1)
        self.arm.tool = NO_TOOL
        self.arm.zero()
        self.arm.tool = tool
        self.arm._from = self.arm._to = self.arm.joints = np.array(start)
        self.procedure = CheckProcedure(settings, file, poses, {}, None)
        self.commands = []
        self.seconds = 0.0
        self.watch = lambda arm: None
        self.procedure.start()

    def of(self, kind):
        return [c for c in self.commands if isinstance(c, kind)]

    def run(self, until=lambda course: False, limit_s=60.0):
        while self.seconds < limit_s:
            for command in self.procedure.take_commands():
                self.commands.append(command)
                if isinstance(command, MoveTo):
                    self.arm.move_to(command.joints, command.duration_s)
                elif isinstance(command, Stop):
                    self.arm.stop()
            if self.of(PosesEnd) or until(self):
                return self.of(PosesEnd)[0] if self.of(PosesEnd) else None
            stamp, position, velocity, wrench = self.arm.step()
            self.watch(self.arm)
            self.procedure.on_joints(stamp, position, velocity)
            self.procedure.on_wrench(stamp, wrench)
            self.seconds += 0.01
            if round(100 * self.seconds) % 10 == 0:
                self.procedure.on_wall(self.seconds)
        raise AssertionError(f"no end in state {self.procedure.state.name}")


def test_a_good_file_is_called_good_and_the_arm_is_where_it_was():
    course = Course(SLOW)
    end = course.run()
    assert (end.error_code, end.check.answer) == (CheckCode.NONE, CheckAnswer.GOOD), end
    assert course.arm.joints == pytest.approx(START, abs=1e-9)
    assert course.seconds < 20.0
    assert [f.done for f in course.of(PoseFeedback) if f.angles] == [1, 2, 3, 4, 5]
    assert course.of(PoseFeedback)[-1].state == CheckState.RETURN
    moves = np.array([move.joints for move in course.of(MoveTo)])
    assert np.all(moves[:, :3] == START[:3])
    assert course.of(Stop) == []


def test_an_arm_that_creeps_gives_no_answer_and_stays():
    course = Course()
    course.arm.creep = np.array([0, 0, 0, 0, 0.0019])
    end = course.run()
    assert end.error_code == CheckCode.POSES_NOT_STILL
    assert end.check is None
    assert "tilt moved by" in end.error_msg
    assert course.of(Stop)


@pytest.mark.slow
def test_it_goes_around_a_box():
    settings = replace(FAST, obstacles=BOX, obstacle_clearance_m=0.02)
    straight, around = Course(), Course(settings)
    clearance = ArmClearance(boxes_from_numbers(BOX), 0.02, POINTER_FILE.tip_m, arm=GALEN)
    nearest = {}
    for course in (straight, around):
        nearest[course] = np.inf

        def watch(arm, course=course):
            if arm.moving and round(arm.stamp_ns / 1e7) % 3 == 0:
                nearest[course] = min(nearest[course], clearance.nearest(arm.joints)[0])

        course.watch = watch
        assert course.run().check.answer is CheckAnswer.GOOD
    assert nearest[straight] < 0.01
    assert 0.02 <= nearest[around] < 0.05
    assert len(around.of(MoveTo)) > len(straight.of(MoveTo)) == 6
    assert around.arm.joints == pytest.approx(START, abs=1e-9)


@pytest.mark.parametrize(
    ("tip", "box", "words"),
    [
        (POINTER_FILE.tip_m, (0.6, -0.1, 0.2, 0.9, 0.5, 0.5), "present pose can't .* in box 1"),
        (np.zeros(3), BOX, r"its tip at \(0, 0, 0\)"),
    ],
)
def test_an_arm_that_may_hit_something_does_not_move(tip, box, words):
    settings = replace(FAST, obstacles=box, obstacle_clearance_m=0.02)
    course = Course(settings, file=replace(POINTER_FILE, tip_m=tip))
    end = course.run()
    assert end.error_code == CheckCode.BAD_INPUT
    assert re.search(words, end.error_msg)
    assert course.of(MoveTo) == []


def test_an_arm_that_reads_a_little_beyond_a_limit_is_sent_inside():
    start = [*START[:3], GALEN.upper[3] + 1e-4, -0.2]
    course = Course(start=start)
    course.run()
    assert course.of(MoveTo)[-1].joints[3] == GALEN.upper[3]  # where it was, but for that little
