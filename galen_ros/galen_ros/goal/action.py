"""What one action on the arm adds to the node that runs it: its goals, commands and results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

from galen_model.arm.galen import JOINT_NAMES
from geometry_msgs.msg import WrenchStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from galen_ros.goal.arm_link import PublisherWatch
from galen_ros.goal.commands import End
from galen_ros.goal.procedure import GoalProcedure
from galen_ros.messages import STREAM, JointStateReader

if TYPE_CHECKING:
    from galen_ros.goal.node import GoalNode


class RejectedGoalError(Exception):
    """A goal that can't be begun."""

    def __init__(self, code: IntEnum, message: str) -> None:
        super().__init__(message)
        self.code = code


class RunningGoal:
    """One running goal and what belongs to it alone."""

    def __init__(
        self, action: ArmAction, handle: ServerGoalHandle, procedure: GoalProcedure[Any, Any]
    ) -> None:
        self.action = action
        self.handle = handle
        self.procedure: Any = procedure
        self.reader = JointStateReader(JOINT_NAMES)
        self.subscriptions: list[Subscription] = []
        self.publishers: PublisherWatch | None = None
        self.preflight_s: float | None = 0.0
        self.ticks = 0


class ArmAction(ABC):
    """One action; what happens when is in the goal's procedure, what all share in the node."""

    action_type: ClassVar[Any]
    name: ClassVar[str]
    codes: ClassVar[type[IntEnum]]
    """The action's error codes, as the procedure's."""
    subject: ClassVar[str] = "tool"
    """The field of the action's goal that names what it is about."""
    doing: ClassVar[str]
    unit: ClassVar[str]
    restarted: ClassVar[str]
    """What it means that a publisher is another one."""

    def __init__(self, node: GoalNode) -> None:
        self.node = node

    @abstractmethod
    def make_goal(self, handle: ServerGoalHandle) -> RunningGoal:
        """Return the goal to run; raises RejectedGoalError."""

    @abstractmethod
    def introduce(self, goal: Any) -> str:
        """Describe in the log what begins."""

    @abstractmethod
    def make_end(self, code: IntEnum, message: str, goal: Any) -> End:
        """Return an end that the procedure doesn't know of; `goal` is None without one."""

    @abstractmethod
    def make_result(self, handle: ServerGoalHandle, end: Any, goal: Any) -> tuple[Any, str]:
        """Return the action's result, and a sentence for /diagnostics."""

    @abstractmethod
    def obey(self, goal: Any, command: Any) -> None:
        """Do what the procedure asks for, beside motion and its end."""

    def subject_of(self, request: Any) -> str:
        """Return what a goal is about."""
        return str(getattr(request, self.subject))

    def rejection(self, request: Any) -> str:
        """Return why this goal can't even begin; empty where it can."""
        return ""

    def subscribe(self, goal: Any) -> list[Subscription]:
        """Subscribe to what the goal hears."""
        node, topic = self.node, goal.procedure.wrench_topic
        return [
            node.create_subscription(JointState, "joint_states", node.on_joint_state, STREAM),
            node.create_subscription(WrenchStamped, topic, node.on_wrench, STREAM),
        ]

    def also_watched(self) -> list[str]:
        """Name topics that it doesn't hear, and whose publishers matter all the same."""
        return []

    def needed_clients(self, goal: Any) -> list[Client]:
        """Return the clients of the services that the goal can't do without."""
        return []

    def find_missing(self, goal: Any) -> tuple[IntEnum, str] | None:
        """Return what the goal waits for beside topics, services and the arm."""
        return None

    def silent_text(self, topics: list[str]) -> str:
        """Return what is wrong where topics have no publisher."""
        return f"no publisher on {' and '.join(topics)}: is the driver running?"

    def look_after(self, goal: Any) -> None:  # noqa: B027 - most have nothing to do
        """Do what is to be done ten times a second."""

    def put_away(self, goal: Any, end: Any) -> Any:
        """Close what the goal has open; returns the end that it came to."""
        return end

    def status_values(self, goal: Any) -> dict[str, object]:
        """Return more values for /diagnostics."""
        return {}

    def status_remark(self, goal: Any) -> str:
        """Return what /diagnostics adds to the progress."""
        return ""
