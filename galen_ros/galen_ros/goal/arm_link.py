"""What the nodes that move the arm share: its trajectories, and who publishes what they hear."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from galen_model.arm.arm import Arm
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.subscription import Subscription
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_ros.goal.procedure import MoveTo
from galen_ros.messages import publisher_nodes

DISCOVERY_S = 5.0
"""A driver that runs may take so long to be found: DDS repeats a lost announcement after 3 s."""
_DEPTH = 10


class ArmPublisher:
    """Sends the arm somewhere, and stops it, over `joint_trajectory`; hears who else does."""

    def __init__(self, node: Node, arm: Arm) -> None:
        self._node = node
        self._joint_names = list(arm.joint_names)
        self._publisher = node.create_publisher(JointTrajectory, "joint_trajectory", _DEPTH)
        self._not_heard: deque[JointTrajectory] = deque(maxlen=_DEPTH)

    @property
    def topic_name(self) -> str:
        """Of the trajectories."""
        return str(self._publisher.topic_name)

    @property
    def has_listener(self) -> bool:
        """Whether the topic has a subscriber."""
        return bool(self._publisher.get_subscription_count() > 0)

    def move(self, move: MoveTo) -> None:
        """Move from rest to rest."""
        point = JointTrajectoryPoint(
            positions=[float(value) for value in move.joints],
            velocities=[0.0] * len(self._joint_names),
            accelerations=[0.0] * len(self._joint_names),
            time_from_start=Duration(seconds=move.duration_s).to_msg(),
        )
        self._send([point])

    def stop(self) -> None:
        """No points: stop where you are."""
        self._send([])

    def _send(self, points: list[JointTrajectoryPoint]) -> None:
        message = JointTrajectory(joint_names=self._joint_names, points=points)
        self._not_heard.append(message)
        self._publisher.publish(message)

    def stop_and_wait(self) -> None:
        """Stop; returns when the message is out: else the process could be gone before it is."""
        self.stop()
        self._publisher.wait_for_all_acked(Duration(seconds=0.2))

    def hear_others(self, on_command: Callable[[str], None]) -> Subscription:
        """Call `on_command`, with a message, when another node commands the arm.

        Own commands come back over the topic as well. Their content identifies them, for rclpy
        doesn't tell who sent a message; a stranger's that says the same does no harm.
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


class PublisherWatch:
    """Looks up who publishes topics (full names), again and again."""

    def __init__(self, node: Node, topics: Sequence[str]) -> None:
        self._node = node
        self._topics = list(topics)
        self._known: dict[str, frozenset[bytes]] = {}

    def silent(self) -> list[str]:
        """Return the topics without a publisher."""
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
