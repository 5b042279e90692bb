# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from calibration_fake_arm import FakeArm
from galen_common.goal.arrival import (
    ArrivalSettings,
    MotionTimeoutError,
    PoseRecorder,
    PoseRejection,
    StampsError,
)
from galen_model.arm.galen import GALEN
from galen_model.rest.segments import PoseRecord, StillnessSettings, wrench_fault

ARRIVAL = ArrivalSettings(
    position_tolerance=np.array([5e-4] * 3 + [3e-3] * 2),
    velocity_tolerance=np.array([5e-4] * 3 + [2e-3] * 2),
    velocity_window_s=0.1,
    settle_s=0.2,
    max_stamp_step_s=0.05,
    arm=GALEN,
)
STILLNESS = StillnessSettings(
    joint_motion=np.array([1e-4] * 3 + [5e-4] * 2),
    scatter_ratio=1.5,
    trend_sigmas=6.0,
    min_samples=20,
)
TARGET = GALEN.home + np.array([0.0, 0.0, 0.0, 0.5, -0.3])


def record(arm, target=TARGET, allowance_s=5.0, arrival=ARRIVAL, each=None, limit=4000):
    """Feed the recorder from the arm until it has a result; `each(arm, recorder)` before a step."""
    recorder = PoseRecorder(arrival, STILLNESS, 0.5, target, allowance_s)
    for _ in range(limit):
        if each is not None:
            each(arm, recorder)
        stamp, position, velocity, wrench = arm.step()
        recorder.add_joints(stamp, position, velocity)
        recorder.add_wrench(stamp, wrench)
        if recorder.result is not None:
            return recorder.result
    raise AssertionError("the recorder came to no result")


def averaging(recorder):
    return recorder._window is not None


@pytest.mark.parametrize("with_velocity", [True, False])
def test_a_still_pose_is_averaged_after_arrival_and_settling(with_velocity):
    arm = FakeArm()
    arm.report_velocity = with_velocity
    arm.move_to(TARGET, 1.0)
    started = arm.stamp_ns
    result = record(arm)
    assert isinstance(result, PoseRecord)
    assert result.joints == pytest.approx(TARGET, abs=1e-9)
    expected = arm.true_reading()
    assert np.all(np.abs(result.wrench - expected) < 5 * result.std_of_mean)
    assert result.samples == 51
    assert (arm.stamp_ns - started) / 1e9 >= 1.0 + ARRIVAL.settle_s + 0.5


def test_where_the_average_lies_hangs_on_the_stamps_and_not_on_when_the_recorder_began():
    arm = FakeArm()
    arm.stamp_ns += 3_000_000
    arm.move_to(TARGET, 1.0)
    samples = [arm.step() for _ in range(300)]
    results = []
    for first in (0, 1, 7, 60):  # the arm arrives at the 100th
        recorder = PoseRecorder(ARRIVAL, STILLNESS, 0.5, TARGET, 5.0)
        for stamp, position, velocity, wrench in samples[first:]:
            recorder.add_joints(stamp, position, velocity)
            recorder.add_wrench(stamp, wrench)
        results.append((recorder.window_ns, recorder.result.wrench.tolist()))
    assert all(result == results[0] for result in results)
    assert results[0][0][1] - results[0][0][0] == 500_000_000


@pytest.mark.parametrize("with_velocity", [True, False])
def test_a_joint_that_never_stops_is_named(with_velocity):
    arm = FakeArm(start=TARGET)
    arm.report_velocity = with_velocity
    arm.creep[4] = 0.004
    with pytest.raises(MotionTimeoutError, match="tilt did not stop") as error:
        record(arm, allowance_s=0.3)
    assert "roll" not in str(error.value)


def test_a_joint_that_does_not_get_there_is_named_with_both_values():
    arm = FakeArm()
    arm.ignored_joints = (3,)
    arm.move_to(TARGET, 0.5)
    with pytest.raises(MotionTimeoutError, match=r"roll did not reach 0\.5000 rad.*at 0\.0000"):
        record(arm, allowance_s=2.0)


def test_motion_inside_the_window_rejects_and_names_the_joint():
    arm = FakeArm(start=TARGET)
    arm.report_velocity = True

    def push(arm, recorder):
        if averaging(recorder):
            arm.creep[3] = 0.01

    result = record(arm, each=push)
    assert isinstance(result, PoseRejection)
    assert "roll moved by" in result.reason
    assert "tilt" not in result.reason


@pytest.mark.parametrize("jump_s", [3600.0, 0.2, -0.5, -100.0])
def test_a_jump_of_the_stamps_inside_the_window_rejects(jump_s):
    arm = FakeArm(start=TARGET)
    jumped = []

    def jump(arm, recorder):
        if averaging(recorder) and not jumped:
            jumped.append(True)
            arm.skip_ns = round(jump_s * 1e9)

    result = record(arm, each=jump)
    assert isinstance(result, PoseRejection)
    assert "stamps of joint_states jumped by" in result.reason
    assert f"{jump_s + 0.01:+.3f}" in result.reason


def test_stamps_that_always_jump_end_it_with_the_topic_and_the_step():
    recorder = PoseRecorder(ARRIVAL, STILLNESS, 0.5, TARGET, 5.0)
    for k in range(10):
        recorder.add_joints(k * 200_000_000, TARGET, np.zeros(5))
    with pytest.raises(StampsError, match=r"joint_states jumped by \+0\.200 s.*max_stamp_step_s"):
        recorder.add_joints(2_000_000_000, TARGET, np.zeros(5))


def test_values_that_are_not_finite_reject_and_are_named():
    arm = FakeArm(start=TARGET)
    arm.touch = lambda arm: np.array([0, 0, 0, 0, np.nan, 0])
    result = record(arm)
    assert isinstance(result, PoseRejection)
    assert "wrench_raw: ty not finite" in result.reason
    assert result.not_finite


def test_too_few_wrenches_reject_with_the_counts():
    arm = FakeArm(start=TARGET)
    recorder = PoseRecorder(ARRIVAL, STILLNESS, 0.5, TARGET, 5.0)
    k = 0
    while recorder.result is None:
        stamp, position, velocity, wrench = arm.step()
        recorder.add_joints(stamp, position, velocity)
        if k % 4 == 0:
            recorder.add_wrench(stamp, wrench)
        k += 1
    assert isinstance(recorder.result, PoseRejection)
    assert "only 13 samples of wrench_raw" in recorder.result.reason


def test_wrenches_far_behind_the_joint_states_reject():
    arm = FakeArm(start=TARGET)
    recorder = PoseRecorder(ARRIVAL, STILLNESS, 0.5, TARGET, 5.0)
    samples = [arm.step() for _ in range(400)]
    for k, (stamp, position, velocity, _) in enumerate(samples):
        recorder.add_joints(stamp, position, velocity)
        if k >= 120 and recorder.result is None:
            recorder.add_wrench(samples[k - 120][0], samples[k - 120][3])
    assert isinstance(recorder.result, PoseRejection)
    assert "wrench_raw are 1.2" in recorder.result.reason
    assert "behind those of joint_states" in recorder.result.reason


def test_pure_noise_is_hardly_ever_rejected():
    """2000 poses of white noise; at 6 sigma on 6 axes not one is expected to be turned away."""
    random = np.random.default_rng(7)
    poses = []
    for _ in range(2000):
        samples = random.standard_normal((50, 6))
        poses.append(
            PoseRecord(
                joints=TARGET,
                joint_span=np.zeros(5),
                wrench=samples.mean(axis=0),
                wrench_std=samples.std(axis=0, ddof=1),
                half_difference=samples[25:].mean(axis=0) - samples[:25].mean(axis=0),
                samples=50,
            )
        )
    rejected = sum(bool(wrench_fault(p, poses[:56], STILLNESS)) for p in poses)
    assert rejected <= 2
    strict = dataclasses.replace(STILLNESS, trend_sigmas=2.0)
    assert sum(bool(wrench_fault(p, poses[:56], strict)) for p in poses) > 200, "it does judge"


@pytest.mark.parametrize("kind", ["step", "ramp", "shake"])
def test_a_touched_pose_is_told_from_the_others(kind):
    arm = FakeArm(start=TARGET)
    records = [record(arm) for _ in range(8)]
    since = [None]

    def touch(arm):
        t = 0.0 if since[0] is None else (arm.stamp_ns - since[0]) / 1e9
        size = {"step": 0.2 * (t > 0.3), "ramp": 0.3 * t, "shake": 0.2 * np.sin(60 * t)}[kind]
        return np.array([0.0, size, 0.0, 0.0, 0.0, 0.0])

    def each(arm, recorder):
        if averaging(recorder) and since[0] is None:
            since[0] = arm.stamp_ns

    arm.touch = touch
    touched = record(arm, each=each)
    assert isinstance(touched, PoseRecord)
    assert "fy" in wrench_fault(touched, [*records, touched], STILLNESS)
    assert not any(wrench_fault(r, [*records, touched], STILLNESS) for r in records)


def test_a_pose_at_half_a_turn_of_an_endless_joint_is_averaged_there():
    roll = dataclasses.replace(GALEN.joints[3], lower=-np.inf, upper=np.inf)
    endless = dataclasses.replace(GALEN, joints=(*GALEN.joints[:3], roll, GALEN.joints[4]))
    target = GALEN.home + np.array([0.0, 0.0, 0.0, np.pi, 0.0])
    arm = FakeArm(start=target)
    arm.report_velocity = False

    def tremble(arm, recorder):
        """Stay within 1e-4 rad of half a turn, reported on either side of it."""
        sign = 1.0 if arm.stamp_ns // 10_000_000 % 2 else -1.0
        arm._from[3] = arm._to[3] = sign * (np.pi - 1e-5)

    arrival = dataclasses.replace(ARRIVAL, arm=endless)
    result = record(arm, target, arrival=arrival, each=tremble)
    assert isinstance(result, PoseRecord), result
    assert abs(abs(result.joints[3]) - np.pi) < 1e-4
    assert result.joint_span[3] < 1e-4
