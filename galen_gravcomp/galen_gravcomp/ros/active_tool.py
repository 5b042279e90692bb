# SPDX-License-Identifier: Apache-2.0
"""What `tools active` reads: the active tool of a node, from its latched topic."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import rclpy
from galen_model.errors import GalenError
from galen_ros.messages import LATCHED
from galen_ros.node.spin import init_ros
from rclpy.node import Node

from galen_gravcomp.ros.tool_services import FILE_STATES
from galen_msgs.msg import ActiveTool


def read_active(node_name: str, timeout_s: float, ros_args: Sequence[str] = ()) -> dict[str, Any]:
    """Read what a node has active, by the fields of its latched topic.

    Args:
        node_name: the gravcomp node's.
        timeout_s: how long to wait for the topic, s.
        ros_args: ROS' own arguments, as of remappings.

    Returns:
        Fields of ActiveTool, with `frame` for its header and `file_state` in words.

    Raises:
        GalenError: nothing came in time.

    """
    init_ros(list(ros_args))
    try:
        node = Node("tools")
        received: list[ActiveTool] = []
        topic = f"{node_name}/active_tool"
        node.create_subscription(ActiveTool, topic, received.append, LATCHED)
        deadline = time.monotonic() + timeout_s
        while not received:
            if time.monotonic() > deadline:
                raise GalenError(
                    f"nothing came on {node.resolve_topic_name(topic)} within {timeout_s:g} s: is"
                    " gravcomp_node running?"
                )
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    found: dict[str, Any] = _plain(received[-1])
    states = {number: name for number, name, _ in FILE_STATES.values()}
    found["frame"] = found.pop("header")["frame_id"]
    found["file_state"] = states.get(found["file_state"], "none")
    return found


def _plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    return value if isinstance(value, (bool, int, float, str)) else np.asarray(value).tolist()
