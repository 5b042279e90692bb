# SPDX-License-Identifier: Apache-2.0
"""The node over real DDS: streams, services, trajectories, clock, admittance."""

import os
import time

import galen_sim_driver.ros.node as node_module
import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from galen_model.arm.galen import GALEN, SENSOR, galen_urdf
from galen_model.load.model import ADAPTER, TOOLS, Load, nominal_reading
from galen_ros.messages import (
    LATCHED,
    STREAM,
    fill_wrench,
    stamp_to_ns,
    wrench_to_array,
)
from galen_ros.node.testing import Harness, parameters
from galen_sim_driver.ros.node import SimDriverNode, main
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_msgs.srv import PushTool, SetTool

TIMEOUT_S = 30.0
SIGMA = np.sqrt(SENSOR.noise_std**2 + SENSOR.quantum**2 / 12)


class Cell:
    """A driver and a probe that hears and commands it."""

    def __init__(self, harness, **overrides):
        self.harness = harness
        self._answer = None
        self.driver = harness.add(
            lambda context: SimDriverNode(
                context=context, parameter_overrides=parameters(**overrides)
            )
        )
        self.probe = harness.add(lambda context: Node("probe", context=context))
        self.joints, self.wrenches = [], []
        self.clocks, self.tool_poses, self.base_poses = [], [], []
        self.diagnostics = []
        subscribe = self.probe.create_subscription
        subscribe(JointState, "joint_states", self.joints.append, STREAM)
        subscribe(WrenchStamped, "wrench_raw", self._on_wrench, STREAM)
        subscribe(PoseStamped, "tracker/tool_pose", self.tool_poses.append, STREAM)
        subscribe(PoseStamped, "tracker/base_pose", self.base_poses.append, STREAM)
        subscribe(Clock, "/clock", self.clocks.append, 100)
        subscribe(
            DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.append(m.status[0]), 10
        )
        self.trajectory = self.probe.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self.compensated = self.probe.create_publisher(WrenchStamped, "wrench_compensated", STREAM)
        self.bias = self.probe.create_client(Trigger, "zero_ft_sensor")
        self.attach = self.probe.create_client(SetTool, "attach_tool")
        self.admittance = self.probe.create_client(SetBool, "sim_driver/set_admittance")
        self.hand = self.probe.create_client(Trigger, "sim_driver/run_hand")
        self.wait(lambda: len(self.wrenches) > 20 and len(self.joints) > 20, "samples")
        self.wait(
            lambda: (
                self.trajectory.get_subscription_count()
                and self.compensated.get_subscription_count()
            ),
            "the driver's subscriptions",
        )

    def _on_wrench(self, message):
        self.wrenches.append(message)
        if self._answer is not None:
            self._answer(message)

    def answer_wrenches_with(self, reply, frame="ft_sensor"):
        """Publish `reply(wrench (6,))` as compensated for every raw wrench, None to stop."""

        def answer(message):
            message.header.frame_id = frame
            fill_wrench(message, reply(wrench_to_array(message)))
            self.compensated.publish(message)

        self._answer = None if reply is None else answer

    def wait(self, predicate, what):
        return self.harness.wait_for(predicate, TIMEOUT_S, what)

    def call(self, client, request):
        return self.harness.call(client, request, TIMEOUT_S)

    def positions(self):
        return np.array(self.joints[-1].position)

    def velocities(self):
        return np.array(self.joints[-1].velocity)

    def sim_now_ns(self):
        """The plant's time. What was sent before may still be on its way, in any order."""
        return self.driver._plant.now_ns

    def fresh_wrenches(self, count):
        """The first `count` readings (count, 6) that are taken from now on."""
        now_ns = self.sim_now_ns()

        def fresh():
            newest = list(self.wrenches[-5 * count :])
            return [m for m in newest if stamp_to_ns(m.header.stamp) > now_ns]

        self.wait(lambda: len(fresh()) >= count, f"{count} wrenches")
        return np.array([wrench_to_array(message) for message in fresh()[:count]])

    def send(self, names, positions, duration_s):
        zeros = [0.0] * len(names)
        point = JointTrajectoryPoint(
            positions=[float(value) for value in positions], velocities=zeros, accelerations=zeros
        )
        point.time_from_start = Duration(sec=int(duration_s), nanosec=int(duration_s % 1.0 * 1e9))
        self.trajectory.publish(JointTrajectory(joint_names=list(names), points=[point]))

    def value(self, key):
        """The newest diagnostic value of this name."""
        for status in reversed(self.diagnostics):
            for item in status.values:
                if item.key == key:
                    return item.value
        return None


@pytest.fixture
def harness():
    with Harness() as world:
        yield world


@pytest.fixture
def cell(harness):
    return Cell(harness, speed_factor=2.0, seed=1)


def test_streams_have_equal_stamps_500_times_a_second_and_the_clock_goes_on(harness):
    before_s = time.monotonic()
    cell = Cell(harness, speed_factor=2.0, seed=1)
    cell.wait(lambda: len(cell.wrenches) > 1000, "1000 wrenches")
    joints = [stamp_to_ns(m.header.stamp) for m in list(cell.joints)]
    wrenches = [stamp_to_ns(m.header.stamp) for m in list(cell.wrenches)]
    assert np.all(np.diff(joints) == 2_000_000)
    assert np.all(np.diff(wrenches) == 2_000_000)
    # One may have been discovered before the other; from then on they are pairs.
    common = set(joints) & set(wrenches)
    assert len(common) > 900
    assert cell.wrenches[-1].header.frame_id == "ft_sensor"
    assert tuple(cell.joints[-1].name) == GALEN.joint_names
    assert np.allclose(cell.positions(), GALEN.home, atol=1e-9)
    # No tool, no tool marker; the base marker at 100 Hz.
    base = [stamp_to_ns(m.header.stamp) for m in list(cell.base_poses)]
    assert np.all(np.diff(base) == 10_000_000) and len(base) > 150
    assert cell.tool_poses == []
    assert cell.base_poses[-1].header.frame_id == "tracker"
    clocks = np.array([stamp_to_ns(m.clock) for m in list(cell.clocks)])
    assert np.all(np.diff(clocks) == 10_000_000)
    assert clocks[0] % 10_000_000 == 2_000_000  # with the first sample, then every fifth
    # Simulated time is never ahead of what was asked, from its start at 1 s.
    sim_s = cell.sim_now_ns() * 1e-9 - 1.0
    assert 2.0 <= sim_s <= 2.0 * (time.monotonic() - before_s)


def test_effects_are_parameters_and_their_delays_are_in_the_stamps(harness):
    cell = Cell(
        harness, speed_factor=2.0, noise=False, initial_tool="pointer",
        joint_zero_offset_tilt_rad=0.1, wrench_delay_s=0.0213, tracker_delay_s=0.0107,
    )  # fmt: skip
    cell.wait(lambda: len(cell.tool_poses) > 5 and cell.value("effects"), "the tracker's poses")
    every_ns = 2_000_000
    assert {stamp_to_ns(m.header.stamp) % every_ns for m in list(cell.joints)} == {0}
    assert {stamp_to_ns(m.header.stamp) % every_ns for m in list(cell.wrenches)} == {1_300_000}
    assert {stamp_to_ns(m.header.stamp) % every_ns for m in list(cell.tool_poses)} == {700_000}
    # The joints say nothing of it.
    assert cell.positions() == pytest.approx(GALEN.home, abs=1e-9)
    tool = TOOLS["pointer"].load
    expected = nominal_reading((0.0, 0.1), tool, ADAPTER, (0.0, 0.1), arm=GALEN)
    assert wrench_to_array(cell.wrenches[-1]) == pytest.approx(expected, abs=1e-9)
    assert cell.value("effects") == "joint_zero_offset:tilt, wrench_delay, tracker_delay"


def test_joint_states_go_out_before_their_wrench(cell):
    # At the publishers: DDS itself keeps the order within a topic only.
    order = []

    def record(publisher, kind, publish):
        def recorded(data):
            order.append((kind, stamp_to_ns(deserialize_message(data, kind).header.stamp)))
            publish(data)

        publisher.publish = recorded

    def start():
        for publisher in cell.driver.publishers:
            if publisher.topic_name in ("/joint_states", "/wrench_raw"):
                record(publisher, publisher.msg_type, publisher.publish)

    cell.harness.call_in_executor(start)
    cell.wait(lambda: len(order) > 200, "200 messages")
    pairs = list(zip(order[0:200:2], order[1:200:2], strict=True))
    for joints, wrench in pairs:
        assert joints[0] is JointState and wrench[0] is WrenchStamped
        assert joints[1] == wrench[1]


def test_zero_ft_sensor_zeroes_here_and_answers_when_done(harness):
    cell = Cell(harness, speed_factor=2.0, seed=3, initial_tool="retractor")
    before = cell.fresh_wrenches(100).mean(axis=0)
    expected = nominal_reading((0.0, 0.0), TOOLS["retractor"].load, Load(0.0), arm=GALEN)
    assert np.all(np.abs(before - expected) < 5 * SIGMA / np.sqrt(100))
    asked_ns = cell.sim_now_ns()
    response = cell.call(cell.bias, Trigger.Request())
    assert response.success, response.message
    # It answered after its window of 0.5 s, and the plant went on all the while.
    assert cell.sim_now_ns() - asked_ns >= 500_000_000
    after = cell.fresh_wrenches(500).mean(axis=0)
    assert np.all(np.abs(after) < 5 * SIGMA * np.sqrt(1 / 250 + 1 / 500))


def test_zero_ft_sensor_that_was_spoilt_by_a_motion_answers_so(harness):
    cell = Cell(harness, speed_factor=2.0, bias_window_s=3.0)
    future = cell.bias.call_async(Trigger.Request())
    cell.fresh_wrenches(200)  # a part of the window
    cell.send(["roll"], [0.8], 0.5)
    cell.wait(future.done, "the answer")
    assert not future.result().success and "moved" in future.result().message


def test_a_tool_adds_its_weight_and_its_marker(cell):
    bare = cell.fresh_wrenches(400).mean(axis=0)
    response = cell.call(cell.attach, SetTool.Request(tool="retractor"))
    assert response.success and response.error_code == SetTool.Response.NONE
    assert (response.tool, response.mass_kg) == ("retractor", 0.2)
    assert response.com_m.tolist() == [0.07, -0.01, 0.055]
    assert response.tip_m.tolist() == [0.18, 0.01, 0.05]
    heavy = cell.fresh_wrenches(400).mean(axis=0)
    expected = nominal_reading((0.0, 0.0), TOOLS["retractor"].load, ADAPTER, arm=GALEN)
    assert np.all(np.abs(heavy - bare - expected) < 5 * SIGMA * np.sqrt(2 / 400))
    cell.wait(lambda: cell.tool_poses, "the tool's marker")
    cell.wait(lambda: cell.value("tool") == "retractor", "the tool on /diagnostics")

    response = cell.call(cell.attach, SetTool.Request(tool="knife"))
    assert not response.success and response.error_code == SetTool.Response.NOT_FOUND
    assert "knife" in response.error_msg and response.tool == "retractor"
    response = cell.call(cell.attach, SetTool.Request(tool="../etc"))
    assert response.error_code == SetTool.Response.INVALID_NAME
    assert cell.call(cell.attach, SetTool.Request(tool="")).success


def test_a_trajectory_moves_the_arm_and_an_empty_one_stops_it(cell):
    cell.send(["tilt", "roll"], [-0.3, 0.6], 1.0)
    cell.wait(
        lambda: (
            np.allclose(cell.positions(), GALEN.home + [0, 0, 0, 0.6, -0.3], atol=1e-4)
            and not cell.velocities().any()
        ),
        "the target",
    )
    cell.send(GALEN.joint_names, GALEN.home, 8.0)
    cell.wait(lambda: cell.velocities()[3] < -0.05, "motion")
    cell.trajectory.publish(JointTrajectory())
    cell.wait(lambda: not cell.velocities().any(), "rest")
    stopped = cell.positions()
    assert 0.05 < stopped[3] < 0.59
    start = len(cell.joints)
    cell.wait(lambda: len(cell.joints) > start + 300, "more samples")
    assert np.array_equal(cell.positions(), stopped)


def test_a_bad_trajectory_is_rejected_and_told(cell):
    cell.send(["tilt"], [1.3], 1.0)
    cell.wait(
        lambda: any("tilt at 1.3 is outside" in status.message for status in cell.diagnostics),
        "the rejection on /diagnostics",
    )
    assert cell.value("trajectories_rejected") == "1"
    assert cell.value("state") == "trajectory_rejected"
    assert np.allclose(cell.positions(), GALEN.home, atol=1e-9)
    # A good one clears it.
    cell.send(["tilt"], [0.1], 0.5)
    cell.wait(lambda: cell.diagnostics[-1].message == "running", "the all-clear")
    cell.wait(lambda: abs(cell.positions()[4] - 0.1) < 1e-4, "the target")


def test_a_speed_that_the_machine_does_not_keep_up_with_is_told(harness):
    cell = Cell(harness, speed_factor=1000.0)  # a tick takes 40 steps, of 1000 due
    cell.wait(lambda: cell.diagnostics and cell.value("state") == "slow", "the warning")
    reached = float(cell.value("speed_reached"))
    assert 0.0 < reached < 900.0
    assert f"runs at {reached:.3g} times real time" in cell.diagnostics[-1].message
    assert cell.diagnostics[-1].message.endswith("or lower speed_factor")


def test_the_process_gives_way_to_the_nodes_that_it_feeds(monkeypatch):
    order = []
    monkeypatch.setattr(os, "nice", order.append)
    monkeypatch.setattr(node_module, "run", order.append)
    main()
    assert order == [10, SimDriverNode]


def test_a_second_driver_is_told(cell):
    cell.wait(lambda: cell.diagnostics and cell.diagnostics[-1].message == "running", "the first")
    second = cell.harness.add(
        lambda context: SimDriverNode(
            context=context, parameter_overrides=parameters(speed_factor=2.0)
        )
    )
    cell.wait(
        lambda: "another node publishes joint_states" in cell.diagnostics[-1].message,
        "the second on /diagnostics",
    )
    assert second.count_publishers("joint_states") == 2
    assert cell.value("state") == "several_drivers"


def test_robot_description_reaches_a_late_subscriber_with_the_tip(cell):
    cell.call(cell.attach, SetTool.Request(tool="pointer"))
    received = []
    cell.harness.call_in_executor(
        lambda: cell.probe.create_subscription(
            String, "robot_description", received.append, LATCHED
        )
    )
    cell.wait(lambda: received, "the description")
    assert received[-1].data == galen_urdf(GALEN, TOOLS["pointer"].tip_m)


def test_admittance_follows_the_compensated_wrench_of_its_own_frame(harness):
    # A generous time-out: how late an answer may be is the plant's test.
    cell = Cell(harness, admittance_timeout_s=0.5)
    cell.call(cell.attach, SetTool.Request(tool="retractor"))
    # At home the sensor's z is base_link's x. No torque about the tip: tau = tip x f.
    push = np.array([0.0, 0.0, 2.0])
    wrench = np.concatenate([push, np.cross(TOOLS["retractor"].tip_m, push)])
    assert cell.call(cell.admittance, SetBool.Request(data=True)).success
    cell.answer_wrenches_with(lambda raw: wrench, "base_link")
    words = "frame 'base_link'"
    cell.wait(lambda: any(words in s.message for s in cell.diagnostics), "the wrong frame")
    assert np.allclose(cell.positions(), GALEN.home, atol=1e-9)
    cell.answer_wrenches_with(lambda raw: wrench)
    cell.wait(lambda: cell.positions()[0] > 0.01, "the tip to go with the push")
    cell.answer_wrenches_with(None)
    cell.wait(lambda: not cell.velocities().any(), "rest when the topic is silent")
    moved = cell.positions() - GALEN.home
    assert np.abs(moved[1:]).max() < 0.1 * moved[0]
    cell.call(cell.admittance, SetBool.Request(data=False))
    cell.wait(lambda: cell.value("admittance") == "false", "the end on /diagnostics")


def test_pushes_on_request_along_the_axes_of_base_link(harness):
    cell = Cell(
        harness,
        speed_factor=2.0,
        initial_tool="pointer",
        hand_pushes=[0.0, 0.5, -6.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    )
    push = cell.probe.create_client(PushTool, "push_tool")
    before = cell.fresh_wrenches(100).mean(axis=0)
    asked = PushTool.Request(force_n=[6.0, 0.0, 0.0], rise_s=0.3, hold_s=1.5, fall_s=0.3)
    answer = cell.call(push, asked)
    assert (answer.success, answer.error_code, answer.error_msg) == (True, 0, "")
    # At home base_link's x is the sensor's z.
    cell.wait(lambda: wrench_to_array(cell.wrenches[-1])[2] - before[2] > 5.8, "the push of 6 N")
    answer = cell.call(push, asked)
    assert (answer.success, answer.error_code) == (False, PushTool.Response.BUSY)
    assert "already" in answer.error_msg
    cell.wait(lambda: abs(wrench_to_array(cell.wrenches[-1])[2] - before[2]) < 0.2, "its end")
    assert cell.call(cell.hand, Trigger.Request()).success
    cell.wait(lambda: wrench_to_array(cell.wrenches[-1])[2] - before[2] < -5.8, "the script's push")
    answer = cell.call(push, PushTool.Request(force_n=[1.0, 0.0, 0.0]))  # without a duration
    assert (answer.success, answer.error_code) == (False, PushTool.Response.BAD_INPUT)
    assert answer.error_msg
