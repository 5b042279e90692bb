# SPDX-License-Identifier: Apache-2.0
"""What the nodes that move the arm share: its trajectories, and who publishes what they hear.

A trajectory goes out on the topic `joint_trajectory`, or, where control_msgs is installed and a
server is there, as a goal of `follow_joint_trajectory` in the same namespace, as a
joint_trajectory_controller offers both: that one says why it rejects or aborts a motion.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from action_msgs.msg import GoalStatus
from galen_common.goal.procedure import MoveTo
from galen_model.arm.arm import Arm
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.subscription import Subscription
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_ros.messages import publisher_nodes
from galen_ros.node.spin import make_executor

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:  # not on PyPI
    FollowJointTrajectory = None

_ANSWER_S = 0.5
_DEPTH = 10


class ArmPublisher:
    """Sends the arm somewhere, and stops it; hears who else does."""

    def __init__(self, node: Node, arm: Arm, on_failed: Callable[[str], None]) -> None:
        """Offer the trajectories, and look for a server of the action.

        Args:
            node: that publishes.
            arm: whose joints are named in the trajectories.
            on_failed: called with a sentence when a motion was rejected or aborted.

        """
        self._node = node
        self._on_failed = on_failed
        self._joint_names = list(arm.joint_names)
        self._publisher = node.create_publisher(JointTrajectory, "joint_trajectory", _DEPTH)
        self._not_heard: deque[JointTrajectory] = deque(maxlen=_DEPTH)
        self._action: Any = None
        self._motion: Any = None
        """Handle of the newest goal that runs."""
        self._sent = 0
        self._unanswered: set[Any] = set()
        """Futures of goals and cancels."""
        self._moved_by_topic = False
        if FollowJointTrajectory is not None:
            namespace = self._publisher.topic_name.rpartition("/")[0]
            name = f"{namespace}/follow_joint_trajectory"
            self._action = ActionClient(node, FollowJointTrajectory, name)

    @property
    def topic_name(self) -> str:
        """Of the trajectories."""
        return str(self._publisher.topic_name)

    @property
    def has_listener(self) -> bool:
        """Whether the topic has a subscriber, or the action a server."""
        return bool(self._publisher.get_subscription_count() > 0) or self._by_action

    @property
    def _by_action(self) -> bool:
        return self._action is not None and bool(self._action.server_is_ready())

    def move(self, move: MoveTo) -> None:
        """Move from rest to rest.

        Args:
            move: joints (n,) to come to, m and rad, and duration, s.

        """
        self._moved_by_topic = not self._by_action
        if self._moved_by_topic:
            self._publish([_rest_point(move)])
        else:
            self._send_goal([_rest_point(move)])

    def stop(self, rest: MoveTo | None = None) -> None:
        """Stop in the way that the newest motion was sent, and by the topic where that is gone.

        A joint_trajectory_controller rejects a trajectory without points, and would finish the
        move:
        https://github.com/ros-controls/ros2_controllers/pull/902. So the topic gets the point of
        rest
        first; then no points, by which a driver that takes it brakes as it can.

        Args:
            rest: where the arm comes to rest if it brakes now; None where that is not known.

        """
        self._sent += 1  # so that what is accepted later is canceled
        if self._motion is not None:
            self._cancel(self._motion)
        if self._moved_by_topic or not self._by_action:
            if rest is not None:
                self._publish([_rest_point(rest)])
            self._publish([])

    def _publish(self, points: list[JointTrajectoryPoint]) -> None:
        message = JointTrajectory(joint_names=self._joint_names, points=points)
        self._not_heard.append(message)
        self._publisher.publish(message)

    def _send_goal(self, points: list[JointTrajectoryPoint]) -> None:
        self._sent += 1
        number = self._sent
        handle: Any = None

        def on_answer(future: Any) -> None:
            nonlocal handle
            handle = future.result()
            if not handle.accepted:
                self._fail(number, "rejected the motion")
                return
            if number != self._sent:  # stopped meanwhile
                self._cancel(handle)
                return
            self._motion = handle
            handle.get_result_async().add_done_callback(on_result)

        def on_result(future: Any) -> None:
            answer = future.result()
            if self._motion is handle:
                self._motion = None
            if answer.status == GoalStatus.STATUS_ABORTED:
                result = answer.result
                self._fail(number, f"aborted: {result.error_string or result.error_code}")
            elif answer.status == GoalStatus.STATUS_CANCELED:  # own ones have another number
                self._fail(number, "was canceled by another client")

        message = JointTrajectory(joint_names=self._joint_names, points=points)
        goal = FollowJointTrajectory.Goal(trajectory=message)
        self._await(self._action.send_goal_async(goal), on_answer)

    def _cancel(self, handle: Any) -> None:
        self._await(handle.cancel_goal_async(), lambda _future: None)

    def _await(self, future: Any, on_done: Callable[[Any], None]) -> None:
        def on_answer(future: Any) -> None:
            on_done(future)
            self._unanswered.discard(future)

        self._unanswered.add(future)
        future.add_done_callback(on_answer)

    def _fail(self, number: int, what: str) -> None:
        if number == self._sent:
            self._on_failed(f"follow_joint_trajectory {what}")

    def stop_and_wait(self, rest: MoveTo | None = None) -> None:
        """Stop, of a node that nothing spins any more; returns when that is out, and answered.

        Else the process could be gone before it is. It waits 0.7 s at most.

        Args:
            rest: where the arm comes to rest if it brakes now; None where that is not known.

        """
        self.stop(rest)
        self._publisher.wait_for_all_acked(Duration(seconds=0.2))
        until_s = time.monotonic() + _ANSWER_S
        if self._unanswered:
            executor = make_executor(self._node.context)
            executor.add_node(self._node)
            while self._unanswered and time.monotonic() < until_s:
                executor.spin_once(timeout_sec=0.02)
            executor.remove_node(self._node)
            executor.shutdown()

    def hear_others(self, on_command: Callable[[str], None]) -> Subscription:
        """Subscribe to the trajectories that other nodes send.

        Own commands come back over the topic as well. Their content identifies them, for rclpy
        doesn't name the sender of a message; another node's that has the same content does no harm.

        Args:
            on_command: called with a sentence, which names the nodes that it could be.

        Returns:
            The subscription, for the caller to destroy.

        """
        self._not_heard.clear()

        def on_message(message: JointTrajectory) -> None:
            if message in self._not_heard:
                self._not_heard.remove(message)
            else:
                on_command(self._others_text())

        return self._node.create_subscription(
            JointTrajectory, self._publisher.topic_name, on_message, _DEPTH
        )

    def _others_text(self) -> str:
        names = publisher_nodes(self._node, self.topic_name)
        names.remove(self._node.get_fully_qualified_name())  # once: another may be called the same
        who = f"; it could be {' or '.join(names)}" if names else ""
        return f"another node commands the arm on {self.topic_name}{who}"


def _rest_point(move: MoveTo) -> JointTrajectoryPoint:
    zeros = [0.0] * len(move.joints)
    return JointTrajectoryPoint(
        positions=[float(value) for value in move.joints],
        velocities=zeros,
        accelerations=zeros,
        time_from_start=Duration(seconds=move.duration_s).to_msg(),
    )


class PublisherWatch:
    """Looks up who publishes topics (full names), again and again."""

    def __init__(self, node: Node, topics: Sequence[str]) -> None:
        self._node = node
        self._topics = list(topics)
        self._known: dict[str, frozenset[bytes]] = {}

    def silent(self) -> list[str]:
        """Return the topics without a publisher.

        Returns:
            Names as they were given.

        """
        return [topic for topic in self._topics if not self._node.count_publishers(topic)]

    def several(self) -> str:
        """Return which topic has more than one publisher; empty when none has."""
        for topic in self._topics:
            names = publisher_nodes(self._node, topic)
            if len(names) > 1:
                text = f"{len(names)} publishers on {topic}: {', '.join(names)}"
                if len(set(names)) < len(names):
                    # DDS is not notified of a kill -9; it finds out by its own time-out.
                    text += "; a driver that was killed is forgotten after some 20 s"
                return text
        return ""

    def changed(self) -> str:
        """Return which topic has another publisher than at first; empty when none has."""
        for topic in self._topics:
            infos = self._node.get_publishers_info_by_topic(topic)
            now = frozenset(bytes(info.endpoint_gid) for info in infos)
            if infos and self._known.setdefault(topic, now) != now:
                return f"{topic} has another publisher than before"
        return ""
