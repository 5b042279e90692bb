# SPDX-License-Identifier: Apache-2.0
"""A recording's still phases, averaged and judged."""

import dataclasses

import numpy as np
import pytest
from calibration_tape import NO_TOOL, NS, POINTER, Tape, grid
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.visits import find_visits
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, gravity_wrench
from galen_model.rest.segments import PoseRecord

SETTINGS = CalibrationParameters()
POSES = grid()


def visits_of(tape):
    return find_visits(tape.recording(), SETTINGS).visits


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 500.0])
@pytest.mark.parametrize("velocities_known", [True, False])
def test_every_pose_is_averaged_after_settling_for_as_long_as_a_live_one(rate_hz, velocities_known):
    tape = Tape(rate_hz=rate_hz, tool=POINTER)
    tape.velocities_known = velocities_known
    visits = visits_of(tape.sweep(POSES))
    assert len(visits) == len(POSES)
    for visit, pose in zip(visits, POSES, strict=True):
        record = visit.outcome
        assert isinstance(record, PoseRecord)
        assert record.joints[3:] == pytest.approx(pose, abs=5e-5)
        assert visit.window_ns[1] - visit.window_ns[0] == NS // 2
        assert record.samples == rate_hz // 2 + 1
        arrived_ns = visit.end_ns - NS  # the phases are 1 s long
        assert -0.1 < (visit.window_ns[0] - arrived_ns) / NS - SETTINGS.arrival.settle_s < 0.2
        gravity = GALEN.gravity_in_sensor(np.stack(pose, axis=-1))
        expected = gravity_wrench(gravity, POINTER) + gravity_wrench(gravity, ADAPTER)
        assert np.all(np.abs(record.wrench - expected) < 5 * record.std_of_mean)


def test_an_arm_that_is_never_still_is_said_to_be_so():
    tape = Tape(tool=POINTER).sweep(POSES, still_s=0.3)
    with pytest.raises(GalenError, match=r"tape: the arm never .* 0\.8 s .*\(12 shorter stops"):
        visits_of(tape)


def test_a_jump_of_the_stamps_inside_an_average_rejects_the_pose_and_is_told():
    tape = Tape(tool=POINTER).sweep(POSES[:4])
    tape.move(POSES[4]).stay(0.6).jump(-30.0).stay(0.3).sweep(POSES[5:])
    found = find_visits(tape.recording(), SETTINGS)
    assert len(found.visits) == len(POSES) - 1
    assert all(isinstance(visit.outcome, PoseRecord) for visit in found.visits)
    assert found.warnings == [
        f"time stamps jumped 1 times; the last: the stamps of {topic} jumped by -29.990 s"
        for topic in ("joint_states", "wrench_raw")
    ]


def test_late_wrenches_are_waited_for():
    recording = Tape(tool=POINTER).sweep(POSES[:3]).recording()
    late = dataclasses.replace(recording, wrench_log_ns=recording.wrench_log_ns + 300_000_000)
    on_time = [v.outcome.wrench for v in find_visits(recording, SETTINGS).visits]
    assert np.array_equal([v.outcome.wrench for v in find_visits(late, SETTINGS).visits], on_time)


def test_readings_of_another_frame_or_clock_are_rejected():
    tape = Tape(tool=POINTER).sweep(POSES[:3])
    recording = tape.recording("here/bag")
    with pytest.raises(GalenError, match=r"here/bag: wrench_raw has frame_id 'tool0'"):
        find_visits(dataclasses.replace(recording, frame_ids=("ft_sensor", "tool0")), SETTINGS)
    other = dataclasses.replace(recording, wrench_stamp_ns=recording.wrench_stamp_ns - 3600 * NS)
    with pytest.raises(GalenError, match="must come from one clock"):
        find_visits(other, SETTINGS)


def test_a_topic_slower_than_the_stamps_may_step_is_named_with_the_parameter():
    with pytest.raises(GalenError, match=r"joint_states jumped by \+0\.100 s.*max_stamp_step"):
        visits_of(Tape(tool=POINTER, rate_hz=10.0).sweep(POSES, still_s=4.0))
    slow = CalibrationParameters(max_stamp_step_s=0.2, average_s=2.0)
    tape = Tape(tool=POINTER, rate_hz=10.0).sweep(POSES, still_s=4.0)
    assert len(find_visits(tape.recording(), slow).visits) == len(POSES)


def test_a_platform_that_the_recording_does_not_hold_is_taken_to_stand_still():
    recording = Tape(tool=POINTER).sweep(POSES[:3]).recording()
    recording.joints[:, :3] = np.nan
    found = find_visits(recording, SETTINGS)
    assert "joint_states does not hold delta_x, delta_y, delta_z" in found.warnings[0]
    assert [v.joints[:3].tolist() for v in found.visits] == [GALEN.home[:3].tolist()] * 3


def test_levels_tell_the_reading_before_and_after_what_happened_in_a_phase():
    tape = Tape(tool=POINTER).stay(2.0)
    tape.tool = NO_TOOL
    (visit,) = visits_of(tape.stay(2.0).zero().stay(2.0))
    gravity = GALEN.gravity_in_sensor((0.0, 0.0))
    both = gravity_wrench(gravity, POINTER) + gravity_wrench(gravity, ADAPTER)
    assert np.all(np.abs(visit.first.wrench - both) < 5 * visit.first.std)
    assert np.all(np.abs(visit.last.wrench) < 5 * visit.last.std)
