# SPDX-License-Identifier: Apache-2.0
"""The state machine against a pure arm: every way through it, and out of it."""

import dataclasses

import numpy as np
import pytest
from calibration_fake_arm import NO_TOOL, POINTER, FakeArm
from galen_calibration_behavior.calibration.procedure import (
    CalibrationProcedure,
    CalibrationRequest,
)
from galen_calibration_behavior.common.commands import (
    AttachTool,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.common.commands import CalibrationCode as ErrorCode
from galen_calibration_behavior.common.commands import CalibrationState as State
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_common.goal.procedure import DISCOVERY_S, MoveTo, Stop
from galen_model.arm.galen import GALEN

SETTINGS = CalibrationParameters(
    settle_s=0.1,
    average_s=0.3,
    max_delta_velocity_m_s=0.2,
    max_angle_velocity_rad_s=2.0,
    max_delta_acceleration_m_s2=2.0,
    max_angle_acceleration_rad_s2=20.0,
    motion_timeout_s=2.0,
    max_rejected_in_a_row=3,
    service_timeout_s=5.0,
    confirm_timeout_s=20.0,
)
POSES = np.array([[r, t] for r in (-1.0, 0.0, 1.0) for t in (-0.6, 0.6)])


class World:
    """An arm, a driver that answers, and a procedure; `run` until it ends or `until` says so."""

    def __init__(self, settings=SETTINGS, *, seed=1, arm=None, **request):
        request = {
            "tool": "pointer", "one_sweep": False, "attach_by_service": True, "poses": POSES
        } | request  # fmt: skip
        self.arm = arm or FakeArm(seed)
        self.procedure = CalibrationProcedure(settings, CalibrationRequest(**request))
        self.commands = []
        self.states = []
        self.answers = {"zero_ft_sensor": (True, ""), "attach_tool": (True, "")}
        self.dead = set()  # topics or services that say nothing any more
        self.confirms = {State.REMOVE_TOOL, State.ATTACH_TOOL}
        self.wrench_offset_ns = 0
        self.wall_s = 0.0
        self.procedure.start()

    @property
    def end(self):
        return next((c for c in self.commands if isinstance(c, PosesEnd)), None)

    @property
    def estimate(self):
        return next((c for c in self.commands if isinstance(c, Measurements)), None)

    def of(self, kind):
        return [c for c in self.commands if isinstance(c, kind)]

    def run(self, until=lambda world: False, limit_s=200.0):
        """Go on until the end, or `until(self)`; the wall runs as fast as the stamps."""
        for _ in range(round(limit_s / 0.01)):
            self._obey()
            if self.end or until(self):
                return self
            stamp, position, velocity, wrench = self.arm.step()
            if "joint_states" not in self.dead:
                self.procedure.on_joints(stamp, position, velocity)
            if "wrench_raw" not in self.dead:
                self.procedure.on_wrench(stamp + self.wrench_offset_ns, wrench)
            self.wall_s += 0.01
            if round(self.wall_s * 100) % 10 == 0:
                self.procedure.on_wall(self.wall_s)
        raise AssertionError(f"no end in {limit_s} s, in state {self.procedure.state.name}")

    def _obey(self):
        while commands := self.procedure.take_commands():
            self.commands += commands
            for command in commands:
                self._obey_one(command)

    def _obey_one(self, command):
        match command:
            case PoseFeedback():
                if not self.states or self.states[-1] != command.state:
                    self.states.append(command.state)
            case MoveTo():
                self.arm.move_to(command.joints, command.duration_s)
            case Stop():
                self.arm.stop()
            case ZeroSensor() if "zero_ft_sensor" not in self.dead:
                assert not self.arm.moving and self.arm.tool is NO_TOOL
                if self.answers["zero_ft_sensor"][0]:
                    self.arm.zero()
                self.procedure.on_service(*self.answers["zero_ft_sensor"])
            case AttachTool() if "attach_tool" not in self.dead:
                self.arm.tool = POINTER if command.tool else NO_TOOL
                self.procedure.on_service(*self.answers["attach_tool"])
            case Measurements():
                self.procedure.on_estimated()
        if self.procedure.waiting_for_person and self.procedure.state in self.confirms:
            off = self.procedure.state == State.REMOVE_TOOL
            self.arm.tool = NO_TOOL if off else POINTER
            assert self.procedure.confirm()


def failed(world, code, *words):
    assert world.end is not None
    assert world.end.error_code == code, world.end
    assert all(word in world.end.error_msg for word in words), world.end.error_msg
    assert world.estimate is None
    assert world.of(Stop), "the arm was not told to stop"
    return world


def in_state(state):
    """Also true once the first move has been ordered."""
    return lambda world: world.procedure.state == state and bool(world.of(MoveTo))


TWO = [
    State.HOME, State.REMOVE_TOOL, State.ZERO, State.SWEEP_BARE, State.HOME, State.ATTACH_TOOL,
    State.SWEEP_TOOL, State.HOME, State.ESTIMATE,
]  # fmt: skip
ONE = [
    State.HOME, State.REMOVE_TOOL, State.ZERO, State.ATTACH_TOOL, State.SWEEP_TOOL, State.HOME,
    State.ESTIMATE,
]  # fmt: skip


@pytest.mark.parametrize("by_service", [True, False])
@pytest.mark.parametrize("one_sweep", [True, False])
def test_the_way_through(by_service, one_sweep):
    world = World(attach_by_service=by_service, one_sweep=one_sweep).run()
    assert world.end.error_code == ErrorCode.NONE
    assert world.states == (ONE if one_sweep else TWO)
    assert not world.of(Stop)
    attached = [c.tool for c in world.of(AttachTool)]
    assert attached == (["", "pointer"] if by_service else [])
    assert len(world.of(ZeroSensor)) == 1
    found = world.estimate
    assert (found.bare is None) == one_sweep
    assert found.tool.angles == pytest.approx(POSES, abs=1e-6)
    assert found.zero_angles == pytest.approx((0.0, 0.0), abs=1e-9)
    last_move = world.of(MoveTo)[-1]
    assert last_move.joints == pytest.approx(GALEN.home)
    sweeps = 1 if one_sweep else 2
    poses = [f for f in world.of(PoseFeedback) if f.angles]
    assert [f.done for f in poses] == list(range(1, 6 * sweeps + 1))
    assert [f.pose for f in poses] == [*range(1, 7)] * sweeps
    assert {f.total for f in world.of(PoseFeedback)} == {6 * sweeps}
    assert all(f.accepted and np.all(np.isfinite(f.wrench)) for f in poses)


@pytest.mark.parametrize("state", list(State)[:6])
def test_cancel_in_every_state_stops_the_arm_and_waits_for_it(state):
    world = World(attach_by_service=False)
    world.confirms -= {state}
    world.run(in_state(state))
    world.procedure.cancel()
    assert not world.procedure.finished, "it must see the arm stop first"
    world.run()
    failed(world, ErrorCode.CANCELED, state.name)
    assert not world.arm.moving
    off = state in (State.ZERO, State.SWEEP_BARE, State.ATTACH_TOOL)
    assert world.end.error_msg.endswith("the tool is still off: put it on again") == off


@pytest.mark.parametrize("canceled", [True, False])
def test_while_it_estimates_the_arm_may_go(canceled):
    world = World()
    world.procedure.on_estimated = lambda: None
    world.run(lambda w: w.estimate is not None)
    del world.procedure.on_estimated
    world.dead = {"joint_states", "wrench_raw"}
    with pytest.raises(AssertionError, match="no end in 10 s"):
        world.run(limit_s=10)
    if canceled:
        world.procedure.cancel()
    world.procedure.on_estimated()  # after a cancel too late, and not believed
    world.run(limit_s=0.1)
    assert world.end.error_code == (ErrorCode.CANCELED if canceled else ErrorCode.NONE)
    assert not world.of(Stop)


def test_an_arm_that_does_not_stop_after_a_cancel_is_told():
    world = World()
    world.run(in_state(State.SWEEP_BARE))
    world.arm.creep[3] = 0.05
    world.procedure.cancel()
    world.run(limit_s=5.0)
    failed(world, ErrorCode.CANCELED, "not seen to stop")


def test_topics_that_never_came_are_named():
    world = World()
    world.dead = {"joint_states", "wrench_raw"}
    world.run(limit_s=15.0)
    failed(world, ErrorCode.DRIVER_SILENT, "joint_states", "wrench_raw", "driver running")
    assert world.wall_s >= DISCOVERY_S


def test_a_first_sample_may_come_late():
    """The publishers of a busy machine take seconds to learn of the subscription."""
    world = World()
    world.dead = {"wrench_raw"}
    world.run(lambda world: world.wall_s > DISCOVERY_S - 1.0)
    world.dead = set()
    world.run(in_state(State.SWEEP_BARE))
    assert not world.procedure.ending


@pytest.mark.parametrize("topic", ["joint_states", "wrench_raw"])
@pytest.mark.parametrize("state", [State.HOME, State.SWEEP_BARE, State.ATTACH_TOOL])
def test_a_silent_topic_is_named(topic, state):
    world = World(attach_by_service=False)
    world.confirms -= {state}
    world.run(in_state(state))
    world.dead = {topic}
    began = world.wall_s
    world.run(limit_s=4.0)
    failed(world, ErrorCode.DRIVER_SILENT, topic)
    assert ("wrench_raw" in world.end.error_msg) == (topic == "wrench_raw")
    assert 1.9 <= world.wall_s - began <= 2.3


def test_stamps_that_stand_still_are_a_silence():
    world = World().run(in_state(State.SWEEP_BARE))
    world.arm.step = lambda: (5, GALEN.home, np.zeros(5), np.zeros(6))
    world.run(limit_s=4.0)
    failed(world, ErrorCode.DRIVER_SILENT, "stamps of joint_states have stood still")


def test_a_process_that_was_held_up_is_no_silence():
    """Ten seconds between two ticks of the wall, because this process did not run."""
    world = World().run(in_state(State.SWEEP_BARE))
    world.procedure.on_wall(world.wall_s + 10.0)
    assert not world.procedure.ending


@pytest.mark.parametrize("joint", [3, 4])
def test_a_stuck_joint_is_named(joint):
    world = World()
    world.arm.ignored_joints = (joint,)
    world.run()
    name = ("roll", "tilt")[joint - 3]
    failed(world, ErrorCode.MOTION_TIMEOUT, f"{name} did not reach")
    assert "overloaded" not in world.end.error_msg


@pytest.mark.parametrize("state", [State.HOME, State.SWEEP_BARE])
def test_a_timeout_after_lost_samples_names_an_overloaded_machine(state):
    world = World()
    world.run(in_state(state))
    world.arm.ignored_joints = (3,)
    world.run(lambda w: w.arm.moving)
    begin_s = world.wall_s
    world.run(lambda w: w.wall_s > begin_s + 0.1)
    world.arm.skip_ns = 1_700_000_000
    world.run()
    failed(world, ErrorCode.MOTION_TIMEOUT, "roll did not reach", "overloaded", "speed_factor")


@pytest.mark.parametrize("service", ["zero_ft_sensor", "attach_tool"])
def test_a_service_that_says_no_or_nothing_is_named(service):
    world = World()
    world.answers[service] = (False, "no such thing")
    failed(world.run(), ErrorCode.SERVICE_FAILED, service, "no such thing")
    world = World()
    world.dead = {service}
    failed(world.run(), ErrorCode.SERVICE_FAILED, service, "did not answer")


def test_a_zeroing_that_did_not_zero_is_found_out():
    world = World()
    world.arm.zero = lambda: None
    world.run()
    failed(world, ErrorCode.SERVICE_FAILED, "does not read zero", "fx = ")


def test_samples_from_before_the_zeroing_are_waited_out():
    """The answer of a service can overtake seconds of samples in the queues."""
    world = World(one_sweep=True)
    zero = world.arm.zero

    def late():
        in_s = world.arm.stamp_ns + 3_000_000_000
        step = world.arm.step

        def step_then_zero():
            if world.arm.stamp_ns > in_s:
                zero()
                world.arm.step = step
            return step()

        world.arm.step = step_then_zero

    world.arm.zero = late
    world.run()
    assert world.end.error_code == ErrorCode.NONE


@pytest.mark.parametrize("state", [State.REMOVE_TOOL, State.ATTACH_TOOL])
def test_nobody_confirms(state):
    world = World(attach_by_service=False)
    world.confirms -= {state}
    what = "removed" if state == State.REMOVE_TOOL else "put on"
    failed(world.run(), ErrorCode.CONFIRM_TIMEOUT, what)


def test_a_confirmation_nobody_asked_for_is_rejected():
    world = World(attach_by_service=False)
    assert not world.procedure.confirm()
    world.run(in_state(State.SWEEP_BARE))
    assert not world.procedure.confirm()


def touch_pose(index, times):
    """Shake the arm at the sweep's pose `index`, on its first `times` visits."""
    visits = []

    def touch(arm):
        here = np.allclose(arm.joints[3:], POSES[index], atol=1e-6)
        if here and (not visits or arm.stamp_ns - visits[-1][1] > 2e8):
            visits.append([arm.stamp_ns, arm.stamp_ns])
        if here:
            visits[-1][1] = arm.stamp_ns
        shaking = here and len(visits) <= times
        return np.array([0.4 * arm.random.standard_normal() * shaking, 0, 0, 0, 0, 0])

    return touch


def test_a_touched_pose_is_tried_again_at_the_end_of_the_sweep():
    world = World(one_sweep=True)
    world.arm.touch = touch_pose(4, times=1)
    world.run()
    assert world.end.error_code == ErrorCode.NONE
    assert world.end.rejected == ()
    rejected = [f for f in world.of(PoseFeedback) if f.angles and not f.accepted]
    assert [f.message.split(":")[0] for f in rejected] == ["tool/4"]
    assert "tried again" in rejected[0].message
    assert len(world.estimate.tool) == 6
    assert world.estimate.tool.time_s.argmax() == 4
    assert world.estimate.tool.temperature_c is None


def test_poses_have_the_times_of_their_averages_and_the_sensor_s_temperature():
    world = World()
    step = world.arm.step

    def warming():
        world.procedure.temperature_c = 20.0 + 1e-9 * world.arm.stamp_ns
        return step()

    world.arm.step = warming
    found = world.run().estimate
    time_s = np.concatenate([found.bare.time_s, found.tool.time_s])
    assert time_s[0] == 0.0
    assert np.all(np.diff(time_s) > SETTINGS.average_s)
    temperature_c = np.concatenate([found.bare.temperature_c, found.tool.temperature_c])
    assert temperature_c - temperature_c[0] == pytest.approx(time_s, abs=0.011)


def test_a_pose_that_is_never_still_is_left_out_and_listed():
    world = World(one_sweep=True)
    world.arm.touch = touch_pose(4, times=99)
    world.run()
    assert world.end.error_code == ErrorCode.NONE
    (text,) = world.end.rejected
    assert text.startswith("tool/4: fx scattered")
    found = world.estimate
    assert found.tool_indices == [0, 1, 2, 3, 5]
    assert found.tool.angles == pytest.approx(POSES[[0, 1, 2, 3, 5]], abs=1e-6)
    assert world.procedure.progress == (6, 6)


def test_too_few_still_poses_end_it():
    settings = dataclasses.replace(SETTINGS, max_rejected_in_a_row=99)
    world = World(settings, one_sweep=True)
    world.run(in_state(State.SWEEP_TOOL))
    pose = world.arm.step

    def shaky():
        stamp, position, velocity, wrench = pose()
        if np.abs(position[3]) > 0.9:  # four of six poses
            position[4] += 2e-3 * np.sin(stamp / 3e7)
        return stamp, position, velocity, wrench

    world.arm.step = shaky
    world.run()
    failed(world, ErrorCode.POSES_NOT_STILL, "only 2 of 6", "tilt moved")
    assert len(world.end.rejected) == 4


def test_a_jump_of_the_stamps_costs_a_retry_and_gives_a_warning():
    world = World(one_sweep=True, warnings=("the tip is not known",))
    world.run(in_state(State.SWEEP_TOOL))
    world.run(lambda w: w.procedure._recorder._window is not None)
    world.arm.skip_ns = 5_000_000_000
    world.run()
    assert world.end.error_code == ErrorCode.NONE
    rejected = [f for f in world.of(PoseFeedback) if f.angles and not f.accepted]
    assert len(rejected) == 1
    assert "jumped by +5.010 s" in rejected[0].message
    known, jumped = world.end.warnings
    assert known == "the tip is not known" and "time stamps jumped" in jumped
    assert world.estimate.warnings == [known, jumped]
    assert len(world.estimate.tool) == 6


def test_stamps_of_two_clocks_are_rejected_at_the_start():
    world = World()
    world.wrench_offset_ns = 3_000_000_000
    world.run()
    failed(world, ErrorCode.BAD_INPUT, "differ by +3.0")
    assert not world.of(MoveTo)


def test_a_wrench_that_reports_no_number_while_zeroing_is_bad_input():
    arm = FakeArm()
    step = arm.step
    arm.step = lambda: (*step()[:3], np.array([np.nan, 0, 0, 0, 0, 0]))
    failed(World(arm=arm).run(), ErrorCode.BAD_INPUT, "wrench_raw: fx not finite")


def test_zeroing_is_tried_again_when_someone_still_holds_the_arm():
    world = World(one_sweep=True)
    world.run(in_state(State.ZERO))
    world.run(lambda w: w.procedure._recorder and w.procedure._recorder._window is not None)
    world.arm.creep[4] = 0.05
    world.run(lambda w: w.procedure._zero_attempts == 2)
    world.arm.creep[4] = 0.0
    world.run()
    assert world.end.error_code == ErrorCode.NONE
    assert world.estimate.zero_angles[1] == pytest.approx(0.0, abs=2e-3)


def test_a_hopeless_sweep_ends_early():
    world = World(one_sweep=True)
    world.run(in_state(State.SWEEP_TOOL))
    world.arm.touch = lambda arm: np.full(6, np.nan)
    world.run()
    failed(world, ErrorCode.BAD_INPUT, "3 poses in a row", "fx", "not finite")


def test_warnings_are_told_before_the_arm_moves():
    world = World(warnings=("the tip is not known",)).run(until=lambda w: w.of(MoveTo))
    move = [type(command) for command in world.commands].index(MoveTo)
    told = [command.message for command in world.commands[:move]]
    assert "warning: the tip is not known" in told
