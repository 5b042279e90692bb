# SPDX-License-Identifier: Apache-2.0
"""How the arm is moved and stopped: by topic, and by action where control_msgs is installed."""

import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from galen_common.goal.parameters import MotionParameters
from galen_common.goal.procedure import MoveTo
from galen_model.arm.galen import GALEN
from galen_ros.goal import arm_link
from galen_ros.goal.arm_link import ArmPublisher
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.context import Context
from rclpy.node import Node
from rclpy.task import Future
from rclpy.utilities import try_shutdown
from trajectory_msgs.msg import JointTrajectory

try:
    from control_msgs import action as control_msgs
except ImportError:
    control_msgs = None
needs_action = pytest.mark.skipif(control_msgs is None, reason="control_msgs is not installed")
REMAP = ["--ros-args", "-r", "joint_trajectory:=controller/joint_trajectory"]
REST = MoveTo(GALEN.home, 0.4)


class Controller(Node):
    """Stands in for a joint_trajectory_controller: rejects, aborts or goes on until canceled."""

    def __init__(self, **options) -> None:
        super().__init__("controller", **options)
        self.answer, self.goals, self.hold, self.handles = "accept", [], Future(), []
        self.heard = []
        self.create_subscription(
            JointTrajectory, "controller/joint_trajectory", self.heard.append, 10
        )
        self._server = ActionServer(
            self,
            control_msgs.FollowJointTrajectory,
            "controller/follow_joint_trajectory",
            self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=lambda handle: handle.execute(),
            cancel_callback=self._on_cancel,
        )

    def _on_goal(self, goal) -> GoalResponse:
        time.sleep(0.1 if self.answer == "hold slowly" else 0.0)
        self.goals.append(goal)
        return GoalResponse.REJECT if self.answer == "reject" else GoalResponse.ACCEPT

    def _on_cancel(self, _handle) -> CancelResponse:
        self.hold.set_result(None)
        return CancelResponse.ACCEPT

    async def _execute(self, handle):
        result = control_msgs.FollowJointTrajectory.Result()
        self.handles.append(handle)
        if self.answer.startswith("hold"):
            await self.hold
            handle.canceled()
        elif self.answer == "abort":
            handle.abort()
            result.error_code, result.error_string = -4, "joint roll left its path"
        else:
            handle.succeed()
        return result


@pytest.fixture
def by_action(harness):
    """A controller, and a mover with what failed."""
    controller = harness.add(lambda context: Controller(context=context))
    node = harness.add(lambda context: Node("mover", context=context, cli_args=REMAP))
    failed: list[str] = []
    arm = harness.call_in_executor(lambda: ArmPublisher(node, GALEN, failed.append))
    harness.wait_for(lambda: arm._by_action, 10.0, "the controller")
    return controller, arm, failed


@needs_action
def test_a_motion_goes_to_the_action_and_its_refusals_are_told(harness, by_action):
    controller, arm, failed = by_action
    move = MoveTo(GALEN.home + 0.01, 1.5)

    def go(answer: str) -> None:
        controller.answer = answer
        count = len(controller.goals)
        harness.call_in_executor(lambda: arm.move(move))
        harness.wait_for(lambda: len(controller.goals) > count, 10.0, "the goal")

    go("accept")
    trajectory = controller.goals[-1].trajectory
    assert tuple(trajectory.joint_names) == GALEN.joint_names
    np.testing.assert_allclose(trajectory.points[0].positions, move.joints)
    go("reject")
    harness.wait_for(lambda: "rejected the motion" in str(failed), 10.0, "the rejection")
    go("abort")
    harness.wait_for(lambda: "left its path" in str(failed), 10.0, "the abort")
    assert len(failed) == 2
    harness.wait_for(lambda: arm._motion is None, 10.0, "the end of the aborted motion")
    go("hold")
    harness.wait_for(lambda: arm._motion is not None, 10.0, "the motion to begin")
    harness.call_in_executor(arm.stop)
    harness.wait_for(controller.hold.done, 10.0, "the motion to be canceled")
    assert len(failed) == 2


def test_a_stop_by_topic_is_a_point_where_the_arm_comes_to_rest(harness, monkeypatch):
    """A joint_trajectory_controller rejects a trajectory without points, and would go on."""
    monkeypatch.setattr(arm_link, "FollowJointTrajectory", None)
    heard = []
    probe = harness.add(lambda context: Node("probe", context=context))
    probe.create_subscription(JointTrajectory, "joint_trajectory", heard.append, 10)
    node = harness.add(lambda context: Node("mover", context=context))
    arm = harness.call_in_executor(lambda: ArmPublisher(node, GALEN, [].append))
    harness.wait_for(lambda: arm.has_listener, 10.0, "the listener")
    harness.call_in_executor(lambda: arm.move(MoveTo(GALEN.home + 0.01, 1.5)))
    harness.call_in_executor(lambda: arm.stop(REST))
    harness.wait_for(lambda: len(heard) == 3, 10.0, "the stop")
    (point,) = heard[1].points
    np.testing.assert_allclose(point.positions, REST.joints)
    assert list(point.velocities) == list(point.accelerations) == [0.0] * 5
    assert point.time_from_start.nanosec == 400_000_000
    assert not heard[2].points
    harness.call_in_executor(arm.stop)  # the joints are not known
    harness.wait_for(lambda: len(heard) == 4, 10.0, "the second stop")
    assert not heard[3].points


@needs_action
def test_a_motion_sent_by_topic_is_stopped_by_topic_though_the_action_came_later(
    harness, by_action
):
    controller, arm, _ = by_action
    action, arm._action = arm._action, None
    harness.call_in_executor(lambda: arm.move(MoveTo(GALEN.home + 0.01, 1.5)))
    arm._action = action
    harness.call_in_executor(lambda: arm.stop(REST))
    harness.wait_for(lambda: len(controller.heard) == 3, 10.0, "the stop")
    assert [len(message.points) for message in controller.heard] == [1, 1, 0]


@needs_action
def test_a_motion_that_another_client_canceled_ends_the_goal(harness, by_action):
    controller, arm, failed = by_action
    controller.answer = "hold"
    harness.call_in_executor(lambda: arm.move(MoveTo(GALEN.home + 0.01, 1.5)))
    harness.wait_for(lambda: arm._motion is not None, 10.0, "the motion to begin")
    goal_id = arm._motion.goal_id
    other = harness.add(lambda context: Node("other", context=context, cli_args=REMAP))
    client = other.create_client(
        control_msgs.FollowJointTrajectory.Impl.CancelGoalService,
        "controller/follow_joint_trajectory/_action/cancel_goal",
    )
    request = control_msgs.FollowJointTrajectory.Impl.CancelGoalService.Request()
    request.goal_info.goal_id = goal_id
    harness.call(client, request)
    harness.wait_for(lambda: failed, 10.0, "the reason")
    assert failed == ["follow_joint_trajectory was canceled by another client"]


@needs_action
@pytest.mark.parametrize("answer", ["hold", "hold slowly"])
def test_a_mover_that_ends_has_its_motion_canceled(harness, answer):
    """The second has its goal accepted only after the stop."""
    controller = harness.add(lambda context: Controller(context=context))
    controller.answer = answer
    context = Context()
    rclpy.init(context=context, domain_id=harness.domain_id)
    node = Node("mover", context=context, cli_args=REMAP)
    arm = ArmPublisher(node, GALEN, [].append)
    cancel = "/controller/follow_joint_trajectory/_action/cancel_goal"
    harness.wait_for(lambda: arm._by_action, 10.0, "the controller")
    harness.wait_for(lambda: controller.count_clients(cancel), 10.0, "the mover")
    arm.move(MoveTo(GALEN.home + 0.01, 1.5))
    arm.stop_and_wait()
    assert not arm._unanswered
    node.destroy_node()
    try_shutdown(context=context)
    harness.wait_for(controller.hold.done, 5.0, "the motion to be canceled")


def test_braking_comes_to_rest_ahead_within_the_limits_of_acceleration():
    settings = MotionParameters()
    velocity = np.array([0.05, 0.0, -0.08, 0.8, -0.4])
    rest, duration_s = settings.braking(GALEN.home, velocity)
    np.testing.assert_allclose(rest - GALEN.home, velocity * duration_s / 2)
    for speed, way, most in zip(
        velocity, rest - GALEN.home, settings.max_acceleration, strict=True
    ):
        peak = np.max(np.abs(quintic_acceleration(way, speed, duration_s)))
        assert peak <= 1.001 * most
    back, duration_s = settings.braking(GALEN.home, None)
    np.testing.assert_allclose(back, GALEN.home)
    for speed, most in zip(settings.max_velocity, settings.max_acceleration, strict=True):
        assert np.max(np.abs(quintic_acceleration(0.0, speed, duration_s))) <= 1.001 * most
    at_limit, _ = settings.braking(GALEN.upper, velocity)
    assert np.all(at_limit <= GALEN.upper)
    assert settings.braking(GALEN.home, np.zeros(5))[1] == pytest.approx(0.1)


def quintic_acceleration(way, speed, duration_s):
    """Of the polynomial from `speed` to rest, both ends without acceleration."""
    t = duration_s
    rows = np.array([[t**k for k in (3, 4, 5)], [k * t ** (k - 1) for k in (3, 4, 5)],
                     [k * (k - 1) * t ** (k - 2) for k in (3, 4, 5)]])  # fmt: skip
    c = np.linalg.solve(rows, [way - speed * t, -speed, 0.0])
    s = np.linspace(0.0, t, 1001)
    return sum(c[k - 3] * k * (k - 1) * s ** (k - 2) for k in (3, 4, 5))


def test_a_joint_goes_no_faster_than_its_description_allows():
    slow = replace(GALEN.joints[3], max_velocity=0.3)
    arm = replace(GALEN, joints=(*GALEN.joints[:3], slow, GALEN.joints[4]))
    np.testing.assert_allclose(MotionParameters(arm=arm).max_velocity, [0.08, 0.08, 0.08, 0.3, 0.8])
