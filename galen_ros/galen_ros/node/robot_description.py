# SPDX-License-Identifier: Apache-2.0
"""The arm of a node, from its parameters or from the topic `robot_description`."""

from __future__ import annotations

from collections.abc import Callable

from galen_common.arm import ArmParameters
from galen_model.arm.arm import Arm
from galen_model.errors import GalenError
from rclpy.node import Node
from std_msgs.msg import String

from galen_ros.messages import LATCHED
from galen_ros.node.parameters import Held


class ArmSource:
    """Reads the arm; a description that comes later and is another arm's is rejected."""

    def __init__(
        self,
        node: Node,
        held: Held[ArmParameters],
        on_change: Callable[[], None],
        remedy: str,
    ) -> None:
        """Subscribe to the description.

        Args:
            node: that works with the arm.
            held: its parameters of the arm.
            on_change: called when a description came, whether rejected or not.
            remedy: how the node takes another arm, to end a sentence.

        """
        self._node = node
        self._held = held
        self._on_change = on_change
        self._remedy = remedy
        self.text = ""
        """The newest description; empty where none came."""
        self._arm: Arm | None = None
        self.trouble = ""
        """Why the newest description was rejected; empty where it was not."""
        self._topic = node.resolve_topic_name("robot_description")
        self._subscription = node.create_subscription(
            String, "robot_description", self._on_description, LATCHED
        )

    @property
    def waiting(self) -> str:
        """What is waited for, in words; empty where the arm can be read."""
        if self.text or not self._held.now.use_robot_description:
            return ""
        return f"waiting for {self._topic}: is the driver or robot_state_publisher running?"

    def take(self) -> Arm:
        """Return the arm as it is described now, to work with from here on.

        Returns:
            The arm.

        Raises:
            GalenError: no description came, or it, or the file, can't be used.

        """
        if self.waiting:
            raise GalenError(f"no robot description: {self.waiting}")
        parameters = self._held.now
        self._arm = parameters.arm(self.text if parameters.use_robot_description else "")
        self.trouble = ""
        return self._arm

    def leave(self) -> None:
        """Work with no arm any longer: any description may come."""
        self._arm = None
        self.trouble = ""

    def _on_description(self, message: String) -> None:
        self.text = message.data
        if self._arm is not None and self._held.now.use_robot_description:
            try:
                change = self._arm.difference(self._held.now.arm(message.data))
            except GalenError as error:
                change = str(error)
            self.trouble = (
                f"a new {self._topic} is rejected: {change}; {self._remedy}" if change else ""
            )
            if change:
                self._node.get_logger().error(self.trouble)
        self._on_change()
