# SPDX-License-Identifier: Apache-2.0
"""The tools' buttons over ROS, on a real gravcomp node; and on none, and one that hangs."""

import asyncio
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_panel.ros import board as ros_board
from galen_panel.ros.suite import RosSuite
from galen_panel.state.snapshot import BehaviourKind, Goal, NodeLevel, ToolComparison
from galen_ros.messages import STREAM
from galen_ros.node.testing import parameters
from galen_ros.rclpy_workarounds import DeferredService
from geometry_msgs.msg import WrenchStamped
from panel_ros_world import panel_world
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from galen_msgs.srv import SetTool

TOOLS = Path(__file__).resolve().parents[2] / "bags" / "tools"


@pytest.fixture
def tools_dir(tmp_path):
    """Two tools, one of them with a calibration before its present one, and a broken file."""
    folder = tmp_path / "tools"
    folder.mkdir()
    shutil.copy(TOOLS / "retractor.json", folder)
    pointer = read_calibration(TOOLS / "retractor.json", arm=GALEN)
    for mass_kg in (0.050, 0.060):
        load = replace(pointer.load, mass_kg=mass_kg)
        write_calibration(folder / "pointer.json", replace(pointer, tool="pointer", load=load))
    (folder / "drill.json").write_text("{}")
    return folder


@pytest.fixture
def with_gravcomp(world, tools_dir):
    world.add(GravcompNode, tools_dir=str(tools_dir), tool="retractor")
    world.wait_for(lambda state: state.active_tool and state.tools, "gravcomp and its tools")
    return world


def names(state):
    return [tool.name for tool in state.tools]


def tool(state, name):
    return next(tool for tool in state.tools if tool.name == name)


def test_the_tools_are_listed_with_their_numbers_as_soon_as_gravcomp_is_there(
    with_gravcomp, tools_dir
):
    state = with_gravcomp.state
    assert names(state) == ["drill", "pointer", "retractor"]
    assert state.tools_dir == str(tools_dir)
    file = read_calibration(tools_dir / "retractor.json", arm=GALEN)
    listed = tool(state, "retractor")
    assert listed.mass_kg == file.load.mass_kg
    assert listed.com_m == tuple(file.load.com_m)
    assert (*listed.rmse_force_n, *listed.rmse_torque_nm) == tuple(file.rmse)
    assert (listed.poses_used, listed.calibrated_at) == (file.poses_used, file.calibrated_at)
    assert listed.active_tool and not listed.has_previous and not listed.problem
    assert not tool(state, "pointer").active_tool and tool(state, "pointer").has_previous
    assert "drill.json" in tool(state, "drill").problem
    assert state.nodes["gravcomp"].level is NodeLevel.STALE  # no wrenches come


def test_a_tool_is_activate_and_taken_out_again(with_gravcomp):
    world = with_gravcomp
    answer = world.ask(world.suite.activate("pointer"))
    assert answer.ok and "pointer" in answer.text
    world.wait_for(
        lambda state: state.active_tool.tool == "pointer" and tool(state, "pointer").active_tool,
        "the active pointer",
    )
    assert world.state.active_tool.mass_kg == 0.060
    assert not tool(world.state, "retractor").active_tool
    for name, reason in (("drill", "drill.json"), ("../pointer", "name")):
        answer = world.ask(world.suite.activate(name))
        assert not answer.ok and reason in answer.text
    assert world.state.active_tool.tool == "pointer"
    assert world.ask(world.suite.activate("")).ok
    world.wait_for(lambda state: state.active_tool.tool == "", "no active tool")
    assert not any(tool.active_tool for tool in world.state.tools)


def test_a_tool_is_removed_and_its_file_kept_but_not_the_one_active(with_gravcomp, tools_dir):
    world = with_gravcomp
    answer = world.ask(world.suite.remove_tool("pointer"))
    assert answer.ok
    assert names(world.state) == ["drill", "retractor"]  # with the answer, not some time later
    kept_as = Path(answer.text.rsplit(" ", 1)[1])
    assert json.loads(kept_as.read_text())["tool"] == "pointer"
    answer = world.ask(world.suite.remove_tool("retractor"))
    assert not answer.ok and "active" in answer.text
    assert (tools_dir / "retractor.json").is_file()


def test_a_calibration_is_compared_with_the_one_before_and_reverted_to_it(with_gravcomp, tools_dir):
    world = with_gravcomp
    comparison = world.ask(world.suite.compare("pointer"))
    assert isinstance(comparison, ToolComparison)
    mass = next(row for row in comparison.differences if row.quantity == "mass")
    assert (mass.a, mass.b, mass.unit) == (0.050, 0.060, "kg")
    assert not comparison.same_load and comparison.worst_force_n == pytest.approx(0.098, abs=1e-3)
    answer = world.ask(world.suite.compare("retractor"))
    assert not answer.ok and "retractor" in answer.text  # it has none before

    answer = world.ask(world.suite.revert_tool("pointer"))
    assert answer.ok
    assert tool(world.state, "pointer").mass_kg == 0.050
    assert read_calibration(calibration_path(tools_dir, "pointer"), arm=GALEN).load.mass_kg == 0.050
    answer = world.ask(world.suite.revert_tool("retractor"))
    assert not answer.ok


class StillArm(Node):
    """An arm at home that reads nothing: enough to compensate and to tare."""

    def __init__(self, context, **_):
        super().__init__("still_arm", context=context)
        self.joints = self.create_publisher(JointState, "joint_states", STREAM)
        self.wrenches = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self.create_timer(0.004, self.on_timer)

    def on_timer(self):
        joints = JointState(name=["delta_x", "delta_y", "delta_z", "roll", "tilt"])
        joints.header.stamp = self.get_clock().now().to_msg()
        joints.position, joints.velocity = [0.0, 0.0, 0.408, 0.0, 0.0], [0.0] * 5
        self.joints.publish(joints)
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = joints.header.stamp, "ft_sensor"
        self.wrenches.publish(wrench)


def test_switch_and_tare_are_seen_whoever_uses_them(with_gravcomp):
    world = with_gravcomp
    assert world.state.active_tool.enabled
    assert world.ask(world.suite.set_enabled(False)).ok
    world.wait_for(lambda state: not state.active_tool.enabled, "compensation off")
    somebody = world.harness.add(lambda context: Node("somebody", context=context))
    enable = somebody.create_client(SetBool, "gravcomp/enable")
    assert world.harness.call(enable, SetBool.Request(data=True)).success
    world.wait_for(lambda state: state.active_tool.enabled, "compensation on")

    world.add(StillArm)
    world.wait_for(
        lambda state: float(state.nodes["gravcomp"].values["wrench_compensated_hz"]) > 100.0,
        "compensated wrenches",
    )
    assert world.state.active_tool.tare is None
    answer = world.ask(world.suite.tare())
    assert answer.ok and "tared" in answer.text
    tare = world.wait_for(lambda state: state.active_tool.tare, "the tare")
    # The sensor reads nothing, so that the tare takes off the whole of the tool's weight.
    assert np.linalg.norm(tare[:3]) == pytest.approx(0.200 * 9.80665, abs=0.01)


def test_gravcomp_goes_and_comes_back(world, tools_dir):
    node = world.add(GravcompNode, tools_dir=str(tools_dir), tool="retractor")
    world.wait_for(lambda state: state.active_tool and state.tools, "gravcomp and its tools")
    world.harness.remove(node)
    world.wait_for(lambda state: state.active_tool is None, "that gravcomp is gone")
    assert not any(tool.active_tool for tool in world.state.tools)
    assert not any(name.startswith("gravcomp/") for name in world.state.available)
    world.add(GravcompNode, tools_dir=str(tools_dir), tool="pointer")
    # The last message of the one that went may still be on its way.
    world.wait_for(
        lambda state: state.active_tool and state.active_tool.tool == "pointer", "gravcomp again"
    )
    world.wait_for_service("gravcomp/set_tool")
    assert world.ask(world.suite.activate("retractor")).ok


def test_the_active_tool_is_shown_again_when_a_silent_gravcomp_reports(with_gravcomp, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(ros_board, "SILENT_S", -1.0)
        with_gravcomp.wait_for(lambda state: state.active_tool is None, "a silent gravcomp")
    with_gravcomp.wait_for(lambda state: state.active_tool, "the active tool again")


def test_with_nothing_there_every_call_answers_at_once(world):
    suite = world.suite
    calls = [
        suite.list_tools(), suite.activate("retractor"), suite.activate(""),
        suite.remove_tool("retractor"), suite.revert_tool("retractor"), suite.compare("retractor"),
        suite.set_enabled(True), suite.tare(), suite.confirm(),
        suite.start(Goal(BehaviourKind.CALIBRATE, "retractor")),
        suite.start(Goal(BehaviourKind.CHECK)),
        suite.start(Goal(BehaviourKind.COLLECT, "retractor", name="monday")),
        *(suite.cancel(kind) for kind in BehaviourKind),
    ]  # fmt: skip
    for coroutine in calls:
        answer, took_s = world.timed(coroutine)
        assert not answer.ok and answer.text and took_s < 0.5, answer
    assert "ros2 run galen_gravcomp gravcomp_node" in world.ask(suite.tare()).text
    assert world.state.tools is None and world.state.active_tool is None
    assert world.state.available == frozenset()


class Mute(Node):
    """Offers services under gravcomp's names, and answers when it is told to."""

    def __init__(self, context, **_):
        super().__init__("gravcomp", context=context)
        self.unanswered = []
        for kind, name in ((SetTool, "set_tool"), (Trigger, "tare")):
            DeferredService(self, kind, f"~/{name}", self.on_call)

    def on_call(self, _request, response, respond):
        self.unanswered.append(lambda: respond(response))


def test_a_silent_node_holds_up_no_button(world, monkeypatch):
    monkeypatch.setattr(ros_board, "FILE_LIMIT_S", 0.3)
    mute = world.add(Mute)
    world.wait_for_service("gravcomp/set_tool")
    answer, took_s = world.timed(world.suite.activate("retractor"))
    assert not answer.ok and "gravcomp_node has not answered for 0.3 s" in answer.text
    assert took_s < 2.0
    # Its answer comes after all, and is nobody's.
    world.harness.call_in_executor(mute.unanswered.pop())
    for _ in range(3):
        answer, _ = world.timed(world.suite.activate(""))
        assert not answer.ok and "has not answered" in answer.text
    assert len(mute.unanswered) == 3


def test_who_waits_when_the_panel_ends_is_told_so(world):
    mute = world.add(Mute)
    world.wait_for_service("gravcomp/tare")

    async def waiting():
        # As the server does it, close is called in the event loop while calls wait in it.
        tare = asyncio.ensure_future(world.suite.tare())
        while not mute.unanswered:
            await asyncio.sleep(0.01)
        gone = asyncio.ensure_future(world.suite.activate(""))
        await asyncio.sleep(0)
        gone.cancel()  # a page that was closed
        began_s = time.monotonic()
        world.suite.close()
        world.suite.close()
        assert time.monotonic() - began_s < 2.0
        late = await world.suite.tare()
        return await tare, late

    for answer in world.ask(waiting()):
        assert not answer.ok and "being stopped" in answer.text


def test_a_namespace_is_the_panel_s_own(monkeypatch, tools_dir):
    with panel_world(monkeypatch, "--ros-args", "-r", "__ns:=/left") as world:
        values = parameters(tools_dir=str(tools_dir), tool="retractor")
        world.harness.add(
            lambda context: GravcompNode(
                context=context, namespace="left", parameter_overrides=values
            )
        )
        world.wait_for(lambda state: state.active_tool, "the left arm's gravcomp")
        assert world.state.namespace == "left"
        assert "left/gravcomp" in world.state.nodes
        assert world.ask(world.suite.activate("")).ok


def test_wrong_arguments_of_ros_are_told():
    with pytest.raises(GalenError, match="ros-args"):
        RosSuite(["panel", "--ros-args", "--nonsense"])
