# SPDX-License-Identifier: Apache-2.0
"""The collection node with real rclpy, the simulated driver and the compensation beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

from galen_deflection.ros.collection_node import CollectionNode
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_ros.node.testing import parameters
from galen_sim_driver.ros.node import SimDriverNode
from rclpy.action import ActionClient
from rclpy.node import Node

from galen_msgs.action import CollectPushes

ROOT = Path(__file__).resolve().parents[2]
TOOL = "retractor"
# A real arm is gentler; the simulated one does not ring.
QUICK = {
    "settle_s": 0.1,
    "max_angle_velocity_rad_s": 1.4,
    "max_angle_acceleration_rad_s2": 5.5,
    "max_delta_velocity_m_s": 0.15,
    "max_delta_acceleration_m_s2": 0.9,
    "untouched_s": 1.2,
    "hold_s": 0.3,
    "rest_s": 0.3,
}
POSITIONS = [*GALEN.home.tolist(), 0.03, -0.03, 0.42, 0.5, -0.4]


class CollectionWorld:
    """Nodes in a Harness, folders in `path`, and a client; `without` leaves nodes out."""

    def __init__(self, harness, path, *, speed=2.0, driver=None, without=(), **changes):
        self.harness = harness
        self.recordings = path / "recordings"
        tools = path / "tools"
        tools.mkdir()
        shutil.copy(ROOT / "bags" / "tools" / f"{TOOL}.json", tools)
        sim = {"use_sim_time": speed != 1.0}  # at 1 there is no /clock
        self.driver = self.gravcomp = None
        if "driver" not in without:
            values = {"speed_factor": speed, "initial_tool": TOOL} | (driver or {})
            self.driver = self._add(SimDriverNode, values)
        if "gravcomp" not in without:
            self.gravcomp = self._add(GravcompNode, {"tools_dir": str(tools), "tool": TOOL} | sim)
        values = {"tools_dir": str(tools), "recordings_dir": str(self.recordings)}
        self.node = self._add(CollectionNode, values | sim | QUICK | changes)
        self.client_node = harness.add(lambda context: Node("client", context=context))
        self.client = ActionClient(self.client_node, CollectPushes, "collect_pushes")
        harness.wait_for(self.client.server_is_ready, 10.0, "the action server")

    def _add(self, kind, values):
        return self.harness.add(
            lambda context: kind(context=context, parameter_overrides=parameters(**values))
        )

    def send(self, **fields):
        """Send a goal; return its handle."""
        goal = {
            "name": "monday", "tool": TOOL, "push_by_service": True, "positions": POSITIONS,
            "forces_n": [8.0],
        }  # fmt: skip
        asked = CollectPushes.Goal(**goal | fields)
        return self.harness.answer_of(
            lambda: self.client.send_goal_async(asked), 10.0, "an answer to the goal"
        )

    def cancel(self, handle):
        return self.harness.answer_of(handle.cancel_goal_async, 5.0, "the cancel's answer")

    def result(self, handle, timeout_s=30.0):
        """Wait for the goal's result; return status and result."""
        answer = self.harness.answer_of(handle.get_result_async, timeout_s, "the goal's result")
        return answer.status, answer.result

    @property
    def left(self):
        """What lies in the recordings' directory."""
        return sorted(path.name for path in self.recordings.glob("*"))
