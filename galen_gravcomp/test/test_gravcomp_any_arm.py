# SPDX-License-Identifier: Apache-2.0
"""The node on an arm of a robot description: from the topic, from a file, and changed meanwhile."""

from pathlib import Path

import numpy as np
import pytest
from calibration_files import tool_file
from diagnostic_msgs.msg import DiagnosticArray
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.description import read_arm
from galen_model.files.calibration_file import calibration_path, write_calibration, zeroed_at
from galen_ros.messages import LATCHED, STREAM, fill_stamp, fill_wrench, wrench_to_array
from galen_ros.node.testing import Harness, Lifecycle, parameters
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

URDF = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
SENSOR = "tool0"
LONGER = URDF.replace('xyz="0 0 0.392" rpy="0 1.57', 'xyz="0 0 0.5" rpy="0 1.57')
JOINTS = np.array([0.3, -1.2, 1.4, 0.5, -0.7, 2.1])
TOUCH = np.array([1.0, -2.0, 0.5, 0.1, 0.0, -0.05])


class World:
    """A compensator, what it says, and a driver of the six-axis arm with a tool on."""

    def __init__(self, harness: Harness, tools_dir: Path, **values) -> None:
        arm = read_arm(URDF, sensor_frame=SENSOR)
        self.tool = tool_file(arm=arm, zeroing=zeroed_at(JOINTS * 0.0, arm=arm))
        write_calibration(calibration_path(tools_dir, "retractor"), self.tool)
        self.harness, self.outputs, self.reports = harness, [], []
        self.peer = harness.add(lambda context: Node("peer", context=context))
        peer = self.peer
        peer.create_subscription(WrenchStamped, "wrench_compensated", self.outputs.append, STREAM)
        peer.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self.joints = peer.create_publisher(JointState, "joint_states", STREAM)
        self.wrench = peer.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self.description = peer.create_publisher(String, "robot_description", LATCHED)
        values |= {"tools_dir": str(tools_dir), "tool": "retractor", "sensor_frame": SENSOR}
        self.node = harness.add(
            lambda context: GravcompNode(
                context=context, parameter_overrides=parameters(late_s=0.0, **values)
            )
        )
        self.stamp_ns = 10**11

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.reports += [(status.level[0], status.message) for status in message.status]

    def says(self, text: str, level: int) -> None:
        self.harness.wait_for(
            lambda: any(level == found and text in words for found, words in self.reports),
            10.0,
            f"a report with {text!r}",
        )
        self.reports.clear()

    def compensated(self) -> np.ndarray:
        """Feed samples with a touch until one comes out."""
        reading = self.tool.predict(JOINTS) + TOUCH
        self.outputs.clear()

        def fed() -> bool:
            self.stamp_ns += 2_000_000
            joints = JointState(name=list(self.tool.arm.joint_names), position=JOINTS.tolist())
            wrench = WrenchStamped()
            wrench.header.frame_id = SENSOR
            fill_wrench(wrench, reading)
            for message, publisher in ((joints, self.joints), (wrench, self.wrench)):
                fill_stamp(message.header.stamp, self.stamp_ns)
                publisher.publish(message)
            return bool(self.outputs)

        self.harness.wait_for(fed, 10.0, "a compensated wrench")
        return wrench_to_array(self.outputs[-1])


def test_waits_for_the_description_and_rejects_another_one(harness, tmp_path):
    world = World(harness, tmp_path, use_robot_description=True)
    world.says("waiting for /robot_description: is the driver or robot_state_publisher", 1)
    world.description.publish(String(data=URDF.replace('name="tool0"', 'name="flange"')))
    world.says("configure failed: robot_description", 2)
    world.description.publish(String(data=URDF))
    harness.wait_for(lambda: world.node.active, 10.0, "the node to become active")
    np.testing.assert_allclose(world.compensated(), TOUCH, atol=1e-9)

    world.description.publish(String(data=URDF.replace("six-axis", "6-axis")))
    world.description.publish(String(data=LONGER))
    world.says("a new /robot_description is rejected: joint wrist_1 has another place", 1)
    np.testing.assert_allclose(world.compensated(), TOUCH, atol=1e-9)

    life = Lifecycle(harness, world.peer, "gravcomp")
    assert life.go("deactivate", "cleanup", "configure", "activate")
    assert not world.node.arm.difference(read_arm(LONGER, sensor_frame=SENSOR))
    np.testing.assert_allclose(world.compensated(), TOUCH, atol=1e-9)  # no joint turned otherwise


def test_takes_the_description_of_a_file(harness, tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(URDF)
    world = World(harness, tmp_path, urdf_file=str(file))
    np.testing.assert_allclose(world.compensated(), TOUCH, atol=1e-9)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"urdf_file": "/nowhere.urdf"}, "/nowhere.urdf: can't be read: No such file"),
        ({"urdf_file": "a", "use_robot_description": True}, "both name an arm: set one"),
        ({"gravity_m_s2": [0.0, 9.8]}, r"'gravity_m_s2' is \[0.0, 9.8\], but must be three"),
        ({"joint_names": ["a", "b"]}, "'joint_names' is .* must name 5 joints: delta_x"),
    ],
)
def test_names_what_is_wrong_with_the_arm(harness, tmp_path, values, text):
    with pytest.raises(Exception, match=text):
        World(harness, tmp_path, **values)
