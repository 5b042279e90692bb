# SPDX-License-Identifier: Apache-2.0
"""The action server with real rclpy, against a small driver whose stamps run 20 times too fast."""

import math
import threading

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from calibration_fake_arm import NO_TOOL, POINTER, FakeArm
from diagnostic_msgs.msg import DiagnosticArray
from galen_calibration_behavior.calibration.estimate import EstimateError, estimate
from galen_calibration_behavior.common.commands import CalibrationCode as ErrorCode
from galen_calibration_behavior.common.commands import CalibrationState as State
from galen_calibration_behavior.common.commands import CheckCode, CheckState
from galen_calibration_behavior.ros.node import CalibrationNode
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_ros.messages import STREAM, fill_stamp, fill_wrench
from galen_ros.node.testing import Harness, parameters
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import JointState, Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_msgs.action import CalibrateTool, CheckTool
from galen_msgs.srv import SetTool

TICK_S = 0.005
MANY_POSES = {"iters_t": 6, "iters_r": 6}  # for a goal that something ends


class FakeDriver(Node):
    """joint_states, wrench_raw, joint_trajectory, zero_ft_sensor and attach_tool around FakeArm."""

    def __init__(self, context, without=()):
        super().__init__("fake_driver", context=context)
        self.arm = FakeArm()
        self.silent = set()
        self.frame_id = "ft_sensor"
        self.names = list(GALEN.joint_names)
        self.moves = 0
        self.stops = 0
        self.paused = False
        self.sent = []
        self._joint_publisher = self.create_publisher(JointState, "joint_states", STREAM)
        self._wrench_publisher = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_trajectory, 10)
        if "zero_ft_sensor" not in without:
            self.create_service(Trigger, "zero_ft_sensor", self._on_bias)
        if "attach_tool" not in without:
            self.create_service(SetTool, "attach_tool", self._on_attach)
        self.create_timer(TICK_S, self._on_timer)

    def _on_timer(self):
        if self.paused:
            return
        listened_to = self._joint_publisher.get_subscription_count() > 0
        for _ in range(10):
            stamp, position, velocity, wrench = self.arm.step()
            if not listened_to:  # leave the processor to those who start up
                continue
            if "joint_states" not in self.silent:
                joints = JointState(name=self.names)
                fill_stamp(joints.header.stamp, stamp)
                joints.position, joints.velocity = position.tolist(), velocity.tolist()
                self._joint_publisher.publish(joints)
                self.sent.append((position, velocity))
            if "wrench_raw" not in self.silent:
                message = WrenchStamped()
                message.header.frame_id = self.frame_id
                fill_stamp(message.header.stamp, stamp)
                fill_wrench(message, wrench)
                self._wrench_publisher.publish(message)

    def _on_trajectory(self, message):
        if not message.points:
            self.stops += 1
            self.arm.stop()
            return
        (point,) = message.points
        duration = point.time_from_start
        assert list(point.velocities) == list(point.accelerations) == [0.0] * 5
        self.moves += 1
        self.arm.move_to(point.positions, duration.sec + duration.nanosec * 1e-9)

    def _on_bias(self, _request, response):
        self.arm.zero()
        response.success = True
        return response

    def _on_attach(self, request, response):
        self.arm.tool = POINTER if request.tool else NO_TOOL
        response.success = True
        return response


class World:
    """Driver, calibration node and a client in one Harness."""

    def __init__(self, harness, tools_dir, without=(), **changes):
        self.harness = harness
        self.tools_dir = tools_dir
        values = {
            "tools_dir": str(tools_dir),
            "itersT": 2,
            "itersR": 3,
            "settle_s": 0.1,
            "average_s": 0.3,
            "max_angle_velocity_rad_s": 5.0,
            "max_angle_acceleration_rad_s2": 50.0,
            "silent_timeout_s": 1.0,
        } | changes
        self.driver = None
        if "driver" not in without:
            self.driver = harness.add(lambda context: FakeDriver(context, without))
        self.node = harness.add(
            lambda context: CalibrationNode(
                context=context, parameter_overrides=parameters(**values)
            )
        )
        self.client_node = harness.add(lambda context: Node("client", context=context))
        self.client = ActionClient(self.client_node, CalibrateTool, "calibrate_tool")
        self.confirm = self.client_node.create_client(Trigger, "calibration/confirm")
        self.diagnostics = []
        self.client_node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status), 10
        )
        self.feedback = []
        harness.wait_for(self.client.server_is_ready, 10.0, "the action server")

    def send(self, **fields):
        """Send a goal; return its handle."""
        goal = CalibrateTool.Goal(
            **{"tool": "pointer", "attach_by_service": True, "tip_m": [math.nan] * 3} | fields
        )
        return self.harness.answer_of(
            lambda: self.client.send_goal_async(
                goal, feedback_callback=lambda m: self.feedback.append(m.feedback)
            ),
            10.0,
            "an answer to the goal",
        )

    def cancel(self, handle):
        return self.harness.answer_of(handle.cancel_goal_async, 10.0, "the cancel's answer")

    def result(self, handle, timeout_s=30.0):
        """Wait for the goal's result; return status and result."""
        answer = self.harness.answer_of(handle.get_result_async, timeout_s, "the goal's result")
        return answer.status, answer.result

    def wait_for_pose(self, count=2):
        self.harness.wait_for(
            lambda: self.feedback and self.feedback[-1].done >= count, 20.0, f"{count} poses"
        )

    @property
    def files(self):
        return sorted(path.name for path in self.tools_dir.glob("**/*") if path.is_file())

    def fails(self, handle, code, *words):
        """Expect an aborted goal with this error, no file, and the arm stopped."""
        status, result = self.result(handle)
        assert status == GoalStatus.STATUS_ABORTED
        assert ErrorCode(result.error_code) == code, result.error_msg
        assert all(word in result.error_msg for word in words), result.error_msg
        assert result.file == ""
        assert self.files == []


@pytest.fixture
def quick_discovery(monkeypatch):
    """Whatever runs here is found at once."""
    monkeypatch.setattr("galen_ros.goal.node.DISCOVERY_S", 1.5)


@pytest.fixture
def world(tmp_path, plain_fit):
    with Harness() as harness:
        yield World(harness, tmp_path / "tools")


def make(harness, tmp_path, **changes):
    return World(harness, tmp_path / "tools", **changes)


def test_a_calibration_recovers_the_tool_and_writes_its_file(world, monkeypatch):
    monkeypatch.undo()  # models are compared
    status, result = world.result(world.send(tip_m=[0.15, 0.0, 0.05], iters_t=3, iters_r=3))
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert (result.error_code, result.error_msg) == (0, "")
    assert abs(result.mass_kg - 0.060) < 5 * result.mass_std_kg
    assert abs(result.adapter_mass_kg - 0.100) < 5 * result.adapter_mass_std_kg
    assert np.all(np.abs(result.com_m - POINTER.com_m) < 5 * result.com_std_m)
    assert 0 < result.mass_std_kg < 0.005
    assert np.all(result.rmse_force_n < 0.02)
    left_out = [text for text in result.poses_rejected if text.startswith("tool/")]
    assert result.poses_used + len(left_out) == 9
    file = read_calibration(result.file, arm=GALEN)
    assert world.files == ["pointer.json"]
    assert file.load.mass_kg == result.mass_kg
    assert file.tip_m == pytest.approx([0.15, 0.0, 0.05])
    assert world.driver.stops == 0
    # idle, it does not listen to the streams
    world.harness.wait_for(
        lambda: world.client_node.count_subscribers("joint_states") == 0, 5.0, "no subscriber"
    )
    states = [f.state for f in world.feedback]
    assert [s for k, s in enumerate(states) if k == 0 or states[k - 1] != s] == [
        State.HOME, State.REMOVE_TOOL, State.ZERO, State.SWEEP_BARE, State.HOME,
        State.ATTACH_TOOL, State.SWEEP_TOOL, State.HOME, State.ESTIMATE,
    ]  # fmt: skip
    poses = [f for f in world.feedback if f.angles]
    assert [f.done for f in poses] == list(range(1, 19))


@pytest.mark.parametrize("canceled", [True, False])
def test_nothing_is_written_where_it_ends_while_models_are_compared(world, monkeypatch, canceled):
    compared, go_on = [], threading.Event()

    def held(*arguments, **options):
        compared.append((arguments[3], options["progress"]))
        assert go_on.wait(30.0)
        return estimate(*arguments, **options)

    monkeypatch.setattr("galen_calibration_behavior.ros.calibration_action.estimate", held)
    warmth = world.client_node.create_publisher(Temperature, "temperature", 10)
    world.client_node.create_timer(0.02, lambda: warmth.publish(Temperature(temperature=25.0)))
    handle = world.send()
    world.harness.wait_for(lambda: compared, 20.0, "the comparison")
    told = "estimating: comparing models"
    world.harness.wait_for(lambda: world.feedback[-1].message == told, 5.0, "feedback meanwhile")
    (measurements, progress), *_ = compared
    assert measurements.tool.temperature_c == pytest.approx([25.0] * 6)
    progress("the next model")
    if canceled:
        world.cancel(handle)
        status, result = world.result(handle)
        assert (status, result.error_code) == (GoalStatus.STATUS_CANCELED, ErrorCode.CANCELED)
    threading.Timer(0.1, go_on.set).start()
    world.harness.remove(world.node)
    assert go_on.is_set(), "it went before the comparison was over"
    with pytest.raises(EstimateError):
        progress("the next model")
    assert world.files == []


def test_a_second_goal_of_either_action_is_rejected_with_the_reason_on_diagnostics(world):
    client = ActionClient(world.client_node, CheckTool, "check_tool")
    world.harness.wait_for(client.server_is_ready, 10.0, "the other action server")
    first = world.send()
    world.wait_for_pose(1)
    assert not world.send(tool="retractor").accepted
    check = world.harness.answer_of(
        lambda: client.send_goal_async(CheckTool.Goal(tool="drill")), 10.0, "an answer"
    )
    assert not check.accepted

    def reasons():
        return {v.value for s in world.diagnostics for v in s.values if v.key == "rejected"}

    for tool in ("retractor", "drill"):
        words = f"'{tool}' rejected: calibrating 'pointer' now"
        world.harness.wait_for(
            lambda words=words: any(words in text for text in reasons()), 5.0, words
        )
    status, _ = world.result(first)
    assert status == GoalStatus.STATUS_SUCCEEDED, "the first goal must not notice"
    world.harness.call_in_executor(client.destroy)


def test_somebody_else_who_commands_the_arm_ends_it(world):
    still = dict.fromkeys(("positions", "velocities", "accelerations"), [0.0] * 5)
    pendant = world.harness.add(lambda context: Node("teach_pendant", context=context))
    publisher = pendant.create_publisher(JointTrajectory, "joint_trajectory", 10)
    for points in ([JointTrajectoryPoint(**still, time_from_start=Duration(sec=1))], []):
        world.feedback.clear()
        handle = world.send(**MANY_POSES)
        world.wait_for_pose(1)
        world.harness.wait_for(
            lambda: publisher.get_subscription_count() >= 2, 10.0, "driver and node to be matched"
        )
        command = JointTrajectory(joint_names=list(GALEN.joint_names), points=points)
        world.harness.call_in_executor(lambda command=command: publisher.publish(command))
        world.fails(handle, ErrorCode.BAD_INPUT, "another node commands the arm", "/teach_pendant")
        assert not world.driver.arm.moving
    status, result = world.result(world.send())
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg


def test_a_driver_that_comes_back_has_lost_the_zero(world):
    handle = world.send(**MANY_POSES)
    world.wait_for_pose(1)
    # Both lookups of the publishers have to fall on either side of the restart.
    world.harness.wait_for(lambda: world.node._goal.exclusive._known, 5.0, "the first lookup")
    # A timer event that is already on the executor's queue must not publish any more.
    world.harness.call_in_executor(lambda: setattr(world.driver, "paused", True))
    world.harness.remove(world.driver)
    world.driver = world.harness.add(lambda context: FakeDriver(context))
    status, result = world.result(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code in (ErrorCode.DRIVER_SILENT, ErrorCode.MOTION_TIMEOUT)
    assert world.files == []


def test_joints_of_a_gripper_come_beside_the_arms(world):
    gripper = world.harness.add(lambda context: Node("gripper", context=context))
    joints = gripper.create_publisher(JointState, "joint_states", STREAM)
    gripper.create_timer(0.02, lambda: joints.publish(JointState(name=["finger"], position=[0.1])))
    _, result = world.result(world.send())
    assert result.error_code == ErrorCode.NONE, result.error_msg


def test_poses_that_tell_too_little_are_rejected_before_the_arm_moves(world):
    world.fails(world.send(iters_t=1, iters_r=1), ErrorCode.NOT_EXCITED, "at least 4")
    assert world.driver.moves == 0


def test_a_mounting_that_the_poses_do_not_identify_is_rejected_before_the_arm_moves(tmp_path):
    with Harness() as harness:
        world = make(harness, tmp_path, estimate=["joint_zero", "base_inclination"])
        handle = world.send(iters_t=4, iters_r=4)
        words = "the roll joint's zero", "the base's inclination about x"
        world.fails(handle, ErrorCode.NOT_EXCITED, *words)
        assert world.driver.moves == 0


def test_without_a_goal_its_state_is_ready_or_that_the_last_one_failed(world):
    def told():
        return [v.value for s in world.diagnostics[-1:] for v in s.values if v.key == "state"]

    world.harness.wait_for(lambda: told() == ["ready"], 10.0, "that it is ready")
    world.fails(world.send(tool="../drill"), ErrorCode.INVALID_NAME, "drill")
    world.harness.wait_for(lambda: told() == ["failed"], 10.0, "that it failed")


def test_a_tool_that_the_driver_does_not_know_is_rejected_before_anything_moves(world):
    world.harness.call_in_executor(
        lambda: world.driver.declare_parameter("tools", ["pointer", "retractor"])
    )
    world.fails(
        world.send(tool="pionter"), ErrorCode.SERVICE_FAILED, "'pionter'", "/fake_driver",
        "pointer, retractor",
    )  # fmt: skip
    assert world.driver.moves == 0


@pytest.mark.usefixtures("quick_discovery")
@pytest.mark.parametrize("service", ["zero_ft_sensor", "attach_tool"])
def test_a_missing_service_is_named_before_anything_moves(tmp_path, service):
    with Harness() as harness:
        world = make(harness, tmp_path, without=(service,), silent_timeout_s=0.5)
        world.fails(world.send(), ErrorCode.SERVICE_FAILED, f"/{service}")
        assert world.driver.moves == 0


@pytest.mark.usefixtures("quick_discovery")
def test_a_sensor_that_can_not_be_zeroed_gives_one_load_and_its_offset(tmp_path):
    with Harness() as harness:
        world = make(harness, tmp_path, without=("zero_ft_sensor",), zeroing="none")
        world.driver.arm.bias = np.array([1.0, -2.0, 3.0, 0.05, -0.02, 0.01])
        _, result = world.result(world.send(one_sweep=True))
        assert result.error_msg == ""
        file = read_calibration(result.file, arm=GALEN)
    assert file.zeroing is None and file.adapter.mass_kg == 0.0
    assert abs(file.load.mass_kg - 0.16) < 5.0 * file.load.mass_std_kg
    np.testing.assert_allclose(file.residual_offset, -world.driver.arm.bias, atol=0.02)
    assert "ago" in file.bias_note or "just now" in file.bias_note


def test_a_wrong_frame_is_named(world):
    world.driver.frame_id = "tool0"
    world.fails(world.send(), ErrorCode.BAD_INPUT, "wrench_raw", "'tool0'", "'ft_sensor'")


def test_two_drivers_are_rejected(world):
    world.harness.add(
        lambda context: FakeDriver(context, without=("zero_ft_sensor", "attach_tool"))
    )
    handle = world.send(**MANY_POSES)
    world.fails(
        handle, ErrorCode.BAD_INPUT, "2 publishers", ": /fake_driver, /fake_driver;", "was killed"
    )


def test_a_bug_ends_the_goal_and_not_the_node(world, monkeypatch):
    handle = world.send(**MANY_POSES)
    world.wait_for_pose(1)

    def bug(*_, **__):
        raise ZeroDivisionError("a bug")

    world.harness.call_in_executor(lambda: setattr(world.node._arm, "move", bug))
    world.fails(handle, ErrorCode.INTERNAL, "ZeroDivisionError: a bug")
    assert world.driver.stops == 1
    world.harness.call_in_executor(lambda: delattr(world.node._arm, "move"))
    monkeypatch.setattr("galen_calibration_behavior.ros.calibration_action.estimate", bug)
    world.fails(world.send(), ErrorCode.INTERNAL, "ZeroDivisionError: a bug")
    world.fails(world.send(tool="../drill"), ErrorCode.INVALID_NAME, "drill")


@pytest.mark.parametrize(
    ("codes", "states", "action"),
    [(ErrorCode, State, CalibrateTool), (CheckCode, CheckState, CheckTool)],
)
def test_error_codes_and_states_are_the_action_s(codes, states, action):
    for code in codes:
        assert code == getattr(action.Result, code.name)
    for state in states:
        assert state == getattr(action.Feedback, state.name)
