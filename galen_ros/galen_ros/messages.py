# SPDX-License-Identifier: Apache-2.0
"""Topics' quality of service; messages to arrays and back.

Stamps are integer nanoseconds; a wrench is force, then torque.
"""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

_NS_PER_S = 1_000_000_000

# For 500 Hz streams. The depth is the stall budget: 2000 samples are 4 s of a node that is busy.
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=2000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

# For what a late subscriber must still get, such as the robot's description.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def stamp_to_ns(stamp: Time) -> int:
    """Return a stamp in nanoseconds.

    Args:
        stamp: of a message's header.

    Returns:
        The same time, ns.

    """
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def fill_stamp(stamp: Time, ns: int) -> None:
    """Write a time into a stamp.

    Args:
        stamp: of a message's header; it is overwritten.
        ns: the time, ns, not negative.

    """
    stamp.sec, stamp.nanosec = divmod(ns, _NS_PER_S)


def wrench_to_array(message: WrenchStamped) -> NDArray[np.float64]:
    """Return a message's wrench as an array.

    Args:
        message: its header is not looked at.

    Returns:
        (6,): fx, fy, fz, tx, ty, tz in the message's frame, N and N·m.

    """
    force, torque = message.wrench.force, message.wrench.torque
    return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])


def fill_wrench(message: WrenchStamped, wrench: NDArray[np.float64]) -> None:
    """Write a wrench into a message; its header stays as it is.

    Args:
        message: whose wrench is overwritten.
        wrench: (6,) in the message's frame, N and N·m.

    """
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = (float(value) for value in wrench)


def publisher_nodes(node: Node, topic: str) -> list[str]:
    """Return the nodes that publish a topic.

    Args:
        node: that looks; its namespace and remaps hold for the topic.
        topic: relative or absolute name.

    Returns:
        Full names, one a publisher, sorted; a node with two publishers is there twice.

    """
    return sorted(
        f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    )
