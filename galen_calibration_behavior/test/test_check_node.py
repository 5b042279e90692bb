# SPDX-License-Identifier: Apache-2.0
"""The check of calibration_node and its client's words with real rclpy, against a fake driver."""

import json
import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from calibration_fake_arm import NO_TOOL, POINTER
from check_pointer_file import POINTER_FILE
from diagnostic_msgs.msg import DiagnosticArray
from galen_calibration_behavior.common.commands import CheckCode as ErrorCode
from galen_calibration_behavior.ros.check import format_result, parse, result_fields
from galen_calibration_behavior.ros.node import CalibrationNode
from galen_model.files.calibration_file import write_calibration
from galen_model.load.verdict import Cause, CheckAnswer
from galen_ros.messages import LATCHED
from galen_ros.node.testing import Harness, parameters
from rclpy.action import ActionClient
from rclpy.node import Node
from test_calibration_node import FakeDriver

from galen_msgs.action import CheckTool
from galen_msgs.msg import ActiveTool


def check_action(node):
    return next(action for action in node._servers if action.name == "check_tool")


@pytest.mark.slow
def test_the_active_tool_is_checked_with_its_tare_and_an_unknown_one_is_rejected(tmp_path):
    write_calibration(tmp_path / "pointer.json", POINTER_FILE)
    before = (tmp_path / "pointer.json").read_bytes()
    values = parameters(
        tools_dir=str(tmp_path), settle_s=0.1, average_s=0.3, max_angle_velocity_rad_s=4.0,
        max_angle_acceleration_rad_s2=40.0,
    )  # fmt: skip
    with Harness() as harness:
        driver = harness.add(FakeDriver)
        driver.arm.tool = NO_TOOL
        driver.arm.zero()
        driver.arm.tool = POINTER
        push = np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
        driver.arm.touch = lambda _arm: push
        node = harness.add(
            lambda context: CalibrationNode(context=context, parameter_overrides=values)
        )
        person = harness.add(lambda context: Node("person", context=context))
        client = ActionClient(person, CheckTool, "check_tool")
        harness.wait_for(client.server_is_ready, 10.0, "the action server")

        def check(**goal):
            request = CheckTool.Goal(**goal)
            handle = harness.answer_of(
                lambda: client.send_goal_async(request), 10.0, "an answer to the goal"
            )
            answer = harness.answer_of(handle.get_result_async, 30.0, "the result")
            return answer.status, answer.result

        status, result = check(tool="spoon")
        assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, ErrorCode.TOOL_FILE)
        assert result_fields(result)["answer"] is None
        assert "spoon.json" in result.error_msg

        status, result = check(tool="pointer", poses=4)
        assert (status, result.error_code) == (GoalStatus.STATUS_SUCCEEDED, 0), result.error_msg
        assert (result.answer, result.cause) == (CheckAnswer.RETARE, Cause.OFFSET), result.text
        assert result.offset == pytest.approx(push, abs=0.02)
        assert result.poses_used == 4
        assert abs(result.mass_change_kg) < 5 * result.mass_change_std_kg

        publisher = person.create_publisher(ActiveTool, "gravcomp/active_tool", LATCHED)
        active_tool = ActiveTool(tool="pointer", tared=True)
        active_tool.tare.force.y = 0.3
        harness.call_in_executor(lambda: publisher.publish(active_tool))
        harness.wait_for(lambda: check_action(node)._active is not None, 10.0, "the active tool")
        _, result = check()
        assert (result.tool, result.answer) == ("pointer", CheckAnswer.GOOD), result.text
        assert "tare" in result.warnings[0]
        assert (tmp_path / "pointer.json").read_bytes() == before
        assert len(list(tmp_path.iterdir())) == 1
        harness.call_in_executor(client.destroy)


class Idle:
    """calibration_node without a driver, a client, and what /diagnostics says of its goals."""

    def __init__(self, harness, tools_dir):
        self.harness = harness
        self.values = parameters(tools_dir=str(tools_dir))
        self.node = self.another()
        self.person = harness.add(lambda context: Node("person", context=context))
        self.client = ActionClient(self.person, CheckTool, "check_tool")
        self.told = {}
        self.person.create_subscription(DiagnosticArray, "/diagnostics", self.hear, 10)
        harness.wait_for(self.client.server_is_ready, 10.0, "the action server")

    def another(self):
        return self.harness.add(
            lambda context: CalibrationNode(context=context, parameter_overrides=self.values)
        )

    def hear(self, message):
        for status in message.status:
            self.told = {item.key: item.value for item in status.values} | {
                "message": status.message
            }

    def rejected(self, *words, **goal):
        """Expect a goal to be rejected, for a reason with these words."""
        handle = self.harness.answer_of(
            lambda: self.client.send_goal_async(CheckTool.Goal(**goal)), 10.0, "an answer"
        )
        assert not handle.accepted
        self.harness.wait_for(
            lambda: all(word in self.told.get("rejected", "") for word in words), 5.0, f"{words}"
        )


def test_a_check_without_a_tool_is_rejected_at_once_with_the_remedy(tmp_path):
    with Harness() as harness:
        idle = Idle(harness, tmp_path)
        idle.rejected("no gravcomp_node is running", "name the tool that is on")
        publisher = idle.person.create_publisher(ActiveTool, "gravcomp/active_tool", LATCHED)
        harness.call_in_executor(lambda: publisher.publish(ActiveTool()))
        harness.wait_for(lambda: check_action(idle.node)._active is not None, 10.0, "the message")
        idle.rejected("gravcomp has none", "name the tool that is on")
        harness.call_in_executor(idle.client.destroy)


def test_a_second_server_is_an_error_of_both_and_takes_no_goal(tmp_path):
    write_calibration(tmp_path / "pointer.json", POINTER_FILE)
    with Harness() as harness:
        idle = Idle(harness, tmp_path)
        second = idle.another()
        for node in (idle.node, second):
            harness.wait_for(lambda node=node: node._other_server, 10.0, "it to see the other")
        assert "/_action/status: /calibration, /calibration" in second._other_server
        idle.rejected(
            "more than one server", "/calibration, /calibration", "end one of them", tool="pointer"
        )
        assert idle.told["state"] == "several_servers"
        harness.remove(second)
        harness.wait_for(lambda: idle.told.get("state") == "ready", 30.0, "it to be alone")
        harness.call_in_executor(idle.client.destroy)


def test_a_result_is_words_for_a_person_and_json_for_a_program():
    result = CheckTool.Result(
        tool="pointer", answer=int(CheckAnswer.RECALIBRATE), cause=int(Cause.NO_TOOL),
        text="there is no tool on", com_change_m=[math.nan] * 3, com_change_std_m=[math.nan] * 3,
        mass_change_kg=-0.06, poses_used=6, poses_rejected=["check/1: tilt moved"],
    )  # fmt: skip
    words = format_result(result)
    assert words.startswith("recalibrate: pointer: there is no tool on\n")
    assert "mass -60.00 +- 0.00 g; 6 poses" in words and "rejected check/1: tilt moved" in words
    fields = json.loads(json.dumps(result_fields(result), allow_nan=False))
    assert (fields["answer"], fields["cause"], fields["com_change_m"]) == (
        "RECALIBRATE", "NO_TOOL", None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change_kg", "std_kg", "words"),
    [
        (-0.00019, 5e-5, "a change of 0.13 g or more is no noise; the limits say whether it"),
        (0.00005, 5e-5, "a change of less than 0.13 g can be noise"),
        (-0.00018, 1e-4, "a change of less than 0.20 g can be noise"),
    ],
)
def test_the_mass_is_called_noise_or_not_by_what_was_found(change_kg, std_kg, words):
    result = CheckTool.Result(
        answer=int(CheckAnswer.GOOD), mass_change_kg=change_kg, mass_change_std_kg=std_kg,
        found_mass_kg=0.00013, poses_used=6,
    )  # fmt: skip
    assert format_result(result).splitlines()[-1].partition("6 poses; ")[2].startswith(words)


@pytest.mark.parametrize("arguments", [["a/b"], ["--poses", "-1"], ["pointer", "--timeout-s", "0"]])
def test_wrong_arguments_end_with_code_2(arguments):
    with pytest.raises(SystemExit) as error:
        parse(arguments)
    assert error.value.code == 2
