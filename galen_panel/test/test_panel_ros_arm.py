# SPDX-License-Identifier: Apache-2.0
"""Which arm the panel shows: of its parameters, or of the topic robot_description."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_panel.messages.programs import DRIVER
from galen_panel.ros.suite import RosSuite
from galen_ros.messages import LATCHED, STREAM
from panel_ros_world import panel_world
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

FILE = Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf"
SIX_AXIS = FILE.read_text()
JOINTS = [0.1, -0.2, 0.3, -0.4, 0.5, -0.6]


class Driver(Node):
    """Publishes a description, and the six joints among others."""

    def __init__(self, context, **_):
        super().__init__("driver", context=context)
        self.description = self.create_publisher(String, "robot_description", LATCHED)
        self.joints = self.create_publisher(JointState, "joint_states", STREAM)
        self.count = 0
        self.names = ["finger"]
        self.create_timer(0.01, self.on_timer)

    def on_timer(self):
        self.count += 1
        message = JointState(name=self.names, position=[9.0, *JOINTS][: len(self.names)])
        message.header.stamp.sec = self.count
        self.joints.publish(message)

    def describe(self, text):
        self.description.publish(String(data=text))


def start(*arguments):
    return ["--ros-args", *(word for one in arguments for word in ("-p", one))]


def test_the_panel_waits_for_the_description_and_then_shows_its_joints(monkeypatch):
    with panel_world(monkeypatch, *start("use_robot_description:=true")) as world:
        assert world.state.drawing is None
        assert "waiting for /robot_description" in world.state.arm_problem
        driver = world.add(Driver)
        driver.describe("<robot/>")
        world.wait_for(lambda state: "Description not used" in state.arm_problem, "a reason")
        driver.describe(SIX_AXIS)
        world.wait_for(lambda state: state.drawing, "the arm")
        arm = world.state.drawing.arm
        world.wait_for(lambda state: all(state.drawing.links), "its shapes")
        assert world.state.arm_problem == "" and arm.name == "six_axis"
        driver.names = ["finger", *arm.joint_names]
        with world.suite.watch():
            world.wait_for(lambda _: world.suite.history.joints.newest_ns, "joints")
        np.testing.assert_array_equal(world.suite.history.joints.last(0.0).values[0], JOINTS)
        driver.describe(SIX_AXIS.replace("0 0 0.392", "0 0 0.5"))
        world.wait_for(lambda state: "joint wrist_1 has another" in state.arm_problem, "a reason")
        driver.describe(SIX_AXIS)
        world.wait_for(lambda state: not state.arm_problem, "the arm's own description again")
        assert world.state.drawing.arm is arm


def test_another_arm_on_the_topic_is_reported_with_the_reason(world):
    assert world.state.drawing.arm.joint_names == GALEN.joint_names
    driver = world.add(Driver)
    for text, reason in (
        (SIX_AXIS, "robot_description has six_axis: the joints are"),
        (SIX_AXIS.replace("ft_sensor", "tool1"), "no frame 'ft_sensor'"),
    ):
        driver.describe(text)
        world.wait_for(lambda state, reason=reason: reason in state.arm_problem, reason)
    driver.describe(GALEN.urdf)
    world.wait_for(lambda state: not state.arm_problem, "the same arm")


def test_the_arm_of_a_file_is_shown_with_its_frames(monkeypatch):
    given = start(f"urdf_file:={FILE}", "sensor_frame:=tool0", "base_frame:=shoulder_link")
    with panel_world(monkeypatch, *given) as world:
        assert world.state.drawing.arm.joint_names[0] == "shoulder_lift"


def test_printed_commands_start_nodes_for_the_panel_s_arm(monkeypatch):
    monkeypatch.chdir(FILE.parent)
    given = [*start(f"urdf_file:={FILE.name}", "sensor_frame:=tool0"), "-r", "wrench_raw:=/ft/raw"]
    with panel_world(monkeypatch, *given, tools_dir=Path("my tools")) as world:
        answer = world.ask(world.suite.tare())
        words = shlex.split(answer.text.partition("ros2 run galen_gravcomp gravcomp_node ")[2])
        driver = DRIVER.start(world.state)
    arm = ["-r", "wrench_raw:=/ft/raw", "-p", f"urdf_file:={FILE}", "-p", "sensor_frame:=tool0"]
    tools = ["-p", f"tools_dir:={FILE.parent / 'my tools'}"]
    assert words == ["--ros-args", *arm, *tools]
    assert shlex.split(driver)[4:] == ["--ros-args", *arm]  # it keeps no files


def test_a_file_that_can_not_be_read_ends_it_with_a_sentence():
    with pytest.raises(GalenError, match=r"nothing\.urdf: can't be read"):
        RosSuite(["panel", *start("urdf_file:=/nothing.urdf")])
