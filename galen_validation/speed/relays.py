# SPDX-License-Identifier: Apache-2.0
"""Processes beside which a node is measured: a sender, and bare relays.

    python -m galen_validation.speed.relays ROLE WRENCH_TOPIC [RATE_HZ [moving]]

- `sender`: publishes joint_states and a wrench at a rate;
- `relay`: publishes every wrench as it is;
- `relay_joints`: the same, and takes joint_states too, without looking at them;
- `relay_deflection`: takes both, and publishes a deflection and a pose for each wrench.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import rclpy
from galen_model.arm.galen import GALEN
from galen_ros.messages import STREAM, fill_stamp
from galen_ros.node.spin import run
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from galen_msgs.msg import DeflectionStamped

NUMBERS = 10_000
"""Wrenches are counted in the last four digits of their stamps, ns; then the count begins again."""

# An encoder's last digit, so that no two joint vectors that follow each other are alike.
_JOINT_STEP = 1e-6


def send(wrench_topic: str, rate_hz: float, moving: bool) -> None:
    """Publish joints and wrenches until the process is ended.

    Args:
        wrench_topic: Topic of the wrenches; joints go to `joint_states`.
        rate_hz: Pairs of both per second, with the same stamp.
        moving: Whether no two joint vectors that follow each other are alike.

    """
    # Without rclpy's handlers SIGTERM ends this endless loop at once.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("sender")
    joints_publisher = node.create_publisher(JointState, "joint_states", STREAM)
    wrench_publisher = node.create_publisher(WrenchStamped, wrench_topic, STREAM)
    joints, wrench = JointState(), WrenchStamped()
    joints.name = list(GALEN.joint_names)
    home = np.array([0.0, 0.0, 0.408, 0.2, -0.1])
    joints.position = home.tolist()
    joints.velocity = [0.0] * 5
    wrench.header.frame_id = GALEN.sensor_frame
    next_s = time.monotonic()
    count = 0
    while True:
        next_s += 1.0 / rate_hz
        time.sleep(max(0.0, next_s - time.monotonic()))
        count += 1
        if moving:
            joints.position = (home + _JOINT_STEP * (count % 10007)).tolist()
        wrench.wrench.force.x = 3.0 * np.sin(0.01 * count)
        now_ns = time.time_ns() // NUMBERS * NUMBERS + count % NUMBERS
        fill_stamp(joints.header.stamp, now_ns)
        fill_stamp(wrench.header.stamp, now_ns)
        joints_publisher.publish(joints)
        wrench_publisher.publish(wrench)


class Relay(Node):
    """Publishes something for each wrench as it comes."""

    def __init__(self, role: str, wrench_topic: str) -> None:
        super().__init__("relay")
        if role == "relay_deflection":
            self._deflection, self._pose = DeflectionStamped(), PoseStamped()
            self._deflections = self.create_publisher(
                DeflectionStamped, "relayed_deflection", STREAM
            )
            self._poses = self.create_publisher(PoseStamped, "relayed_pose", STREAM)
            on_wrench = self._publish_deflection
        else:
            on_wrench = self.create_publisher(WrenchStamped, "relayed", STREAM).publish
        self.create_subscription(WrenchStamped, wrench_topic, on_wrench, STREAM)
        if role != "relay":
            self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM)

    def _on_joint_state(self, message: JointState) -> None:
        """Cost what receiving it costs."""

    def _publish_deflection(self, message: WrenchStamped) -> None:
        self._deflection.header = self._pose.header = message.header
        self._deflections.publish(self._deflection)
        self._poses.publish(self._pose)


def main() -> None:
    """Be the sender or a relay."""
    role, wrench_topic, *rest = sys.argv[1:]
    if role == "sender":
        send(wrench_topic, float(rest[0]), "moving" in rest)
    else:
        run(lambda: Relay(role, wrench_topic), args=[])


if __name__ == "__main__":
    main()
