"""Asks a running gravcomp_node what it has active: the latched topic, heard once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import rclpy
from galen_model.errors import GalenError
from galen_ros.messages import LATCHED
from galen_ros.node.spin import init_ros
from geometry_msgs.msg import Wrench
from rclpy.node import Node

from galen_msgs.msg import ActiveTool

_FILE_STATES = {
    ActiveTool.FILE_NONE: "none",
    ActiveTool.FILE_AS_LOADED: "as loaded",
    ActiveTool.FILE_CHANGED: "changed",
    ActiveTool.FILE_GONE: "gone",
}


class NoAnswerError(GalenError):
    """No node says what it has active."""


def read(node_name: str, timeout_s: float, ros_args: Sequence[str] = ()) -> dict[str, Any]:
    """What the node has active: plain numbers, lists and texts, SI. Raises NoAnswerError."""
    # Ctrl-C ends the wait as any other command's.
    init_ros(list(ros_args))
    try:
        node = Node("tools")
        received: list[ActiveTool] = []
        topic = f"{node_name}/active_tool"
        node.create_subscription(ActiveTool, topic, received.append, LATCHED)
        deadline = time.monotonic() + timeout_s
        while not received:
            if time.monotonic() > deadline:
                raise NoAnswerError(
                    f"nothing came on {node.resolve_topic_name(topic)} within {timeout_s:g} s: is"
                    " gravcomp_node running?"
                )
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
        return to_dict(received[-1])
    finally:
        rclpy.try_shutdown()


def to_dict(message: ActiveTool) -> dict[str, Any]:
    """The message as plain numbers, lists and texts; tare and drift None where there is none."""
    return {
        "tool": message.tool,
        "enabled": message.enabled,
        "frame": message.header.frame_id,
        "mass_kg": message.mass_kg,
        "com_m": [float(value) for value in message.com_m],
        "covariance": np.reshape(message.covariance, (4, 4)).tolist(),
        "tip_m": [float(value) for value in message.tip_m],
        "adapter": {
            "mass_kg": message.adapter_mass_kg,
            "com_m": [float(value) for value in message.adapter_com_m],
        },
        "parts": list(message.parts),
        "calibrated_at": message.calibrated_at,
        "path": message.path,
        "sha256": message.sha256,
        "file_state": _FILE_STATES.get(message.file_state, "unknown"),
        "tare": _wrench(message.tare) if message.tared else None,
        "bias_drift": _wrench(message.bias_drift) if message.bias_drift_estimated else None,
    }


def _wrench(wrench: Wrench) -> list[float]:
    force, torque = wrench.force, wrench.torque
    return [force.x, force.y, force.z, torque.x, torque.y, torque.z]
