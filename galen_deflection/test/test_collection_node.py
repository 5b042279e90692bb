# SPDX-License-Identifier: Apache-2.0
"""The collection's node, client and driver together, with real rclpy."""

import json
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from collection_world import POSITIONS, CollectionWorld
from diagnostic_msgs.msg import DiagnosticArray
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_common.command import EXIT_USAGE
from galen_deflection.collection.plan import ErrorCode, State
from galen_deflection.measurement.measured_deflection import measure_deflection
from galen_deflection.measurement.push_recording import read_pushes
from galen_deflection.measurement.samples import find_pushes
from galen_deflection.models.spring_fit import fit_stiffness
from galen_deflection.models.springs import kinds, tip_wrench
from galen_deflection.ros.collect import format_result, parse, result_fields
from galen_deflection.ros.recorder import BagRecording
from galen_deflection.scoring.cross_check import sets_of
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_ros.node.testing import Harness
from rclpy.node import Node

from galen_msgs.action import CollectPushes


@pytest.fixture
def idle(tmp_path):
    """The node alone: nothing of the arm is there."""
    with Harness() as harness:
        yield CollectionWorld(harness, tmp_path, without=("driver", "gravcomp"))


def test_goals_that_make_no_sense_end_at_once_with_the_reason(idle):
    (idle.recordings / "taken").mkdir(parents=True)
    for fields, code, words in (
        ({"name": "../x"}, ErrorCode.INVALID_NAME, "recording's name '../x'"),
        ({"tool": "drill"}, ErrorCode.TOOL_FILE, "drill.json"),
        ({"name": "taken"}, ErrorCode.WRITE_FAILED, "taken: is there already"),
        ({"positions": [0.5] * 5}, ErrorCode.OUT_OF_REACH, "position 1: delta_x = 0.5 m"),
        ({"forces_n": [30.0]}, ErrorCode.BAD_INPUT, "30 N along +x"),
        ({"sets": 200}, ErrorCode.BAD_INPUT, "sets is 200"),
    ):
        status, result = idle.result(idle.send(**fields))
        assert status == GoalStatus.STATUS_ABORTED
        assert ErrorCode(result.error_code) == code, result.error_msg
        assert words in result.error_msg
        assert (result.directory, result.messages) == ("", 0)
    assert idle.left == ["taken"]


def test_a_second_goal_is_rejected_with_the_reason_on_diagnostics(idle):
    found = []
    idle.client_node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: found.extend(m.status), 10
    )
    first = idle.send()
    assert first.accepted
    assert not idle.send(name="tuesday").accepted

    def reason():
        return [v.value for s in found for v in s.values if v.key == "rejected"]

    (text, *_) = idle.harness.wait_for(reason, 5.0, "the reason on /diagnostics")
    assert "'tuesday' rejected: collecting 'monday' now" in text
    idle.cancel(first)
    status, result = idle.result(first)
    assert status == GoalStatus.STATUS_CANCELED
    assert result.error_code == ErrorCode.CANCELED
    assert idle.left == []


def test_error_codes_and_states_are_the_action_s():
    assert {c.name: int(c) for c in ErrorCode} == {
        c.name: getattr(CollectPushes.Result, c.name) for c in ErrorCode
    }
    assert {s.name: int(s) for s in State} == {
        s.name: getattr(CollectPushes.Feedback, s.name) for s in State
    }


# --- the client ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["monday"],
        ["../x", "--tool", "retractor"],
        ["monday", "--tool", "a b"],
        ["monday", "--tool", "retractor", "--forces-n", "nan"],
        ["monday", "--tool", "retractor", "--sets", "0"],
        ["monday", "--tool", "retractor", "--timeout-s", "0"],
    ],
)
def test_wrong_arguments_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == EXIT_USAGE
    assert "collect: error:" in capsys.readouterr().err


def test_the_result_for_a_person_and_for_a_program():
    result = CollectPushes.Result(
        pushes=5,
        pushes_asked=6,
        left_out=["set 1, position 2, 6 N along -x: reason"],
        calibration_shift=[3e-4, 0.0, -4e-4, 0.0, 1e-3, 0.0],
        messages=1234,
        warnings=["odd"],
        directory="x/monday",
    )
    text = format_result(result)
    for words in (
        "5 of 6 pushes, 1234 messages",
        "moved by 0.500 mm and 1.000 mrad",
        "left out: set 1, position 2",
        "warning: odd",
        "recorded: x/monday",
    ):
        assert words in text
    assert result_fields(result)["calibration_shift"] == [3e-4, 0.0, -4e-4, 0.0, 1e-3, 0.0]
    result.calibration_shift = [math.nan] * 6
    assert json.loads(json.dumps(result_fields(result), allow_nan=False))["messages"] == 1234
    assert "calibration" not in format_result(result)


# --- with the simulated arm ---------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_missing_is_named_before_the_arm_moves(idle):
    status, result = idle.result(idle.send())
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == ErrorCode.DRIVER_SILENT
    for topic in ("joint_states", "wrench_compensated", "wrench_raw", "tracker/tool_pose"):
        assert f"/{topic}" in result.error_msg
    assert idle.left == []


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_from_the_simulated_arm_to_the_compliances_of_its_joints(tmp_path):
    """Collect, read, split, fit: what comes out is what the simulated arm is made of."""
    with Harness() as harness:
        world = CollectionWorld(harness, tmp_path)
        handle = world.send()
        status, result = world.result(handle, 400.0)
        assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
        assert (result.pushes, result.pushes_asked) == (24, 24), list(result.left_out)
        assert result.calibration_holds
        assert np.linalg.norm(result.calibration_shift[:3]) < 5e-5
        assert [w for w in result.warnings if "lost on the way" in w] == []
        assert world.left == ["monday"]
        folder = world.recordings / "monday"
        assert result.directory == str(folder)

    assert sorted(path.name for path in folder.iterdir()) == [
        "calibration_1", "calibration_2", "collection.json", "push", "tool.json"
    ]  # fmt: skip
    content = json.loads((folder / "collection.json").read_text())
    assert content["finished"] and content["pushes"] == 24 and content["left_out"] == []
    messages = 0
    for bag_path in ("calibration_1", "push", "calibration_2"):
        with open_bag(folder / bag_path) as bag:
            assert set(bag.topics) == {
                "/joint_states", "/wrench_raw", "/tracker/tool_pose", "/tracker/base_pose"
            }  # fmt: skip
            messages += sum(info.count for info in bag.topics.values())
    assert messages == result.messages == content["messages"]

    recording = read_pushes(
        folder / "push", read_calibration(folder / "tool.json", arm=GALEN), arm=GALEN
    )
    assert not any("not untouched at first" in problem for problem in recording.problems)
    measured = measure_deflection(recording)
    samples = measured.samples
    assert sets_of(samples) == {0: [0, 1], 1: [0, 1]}
    # A busy machine stalls the simulation, which reading takes for jumps of the stamps.
    assert len(find_pushes(samples, tip_wrench(samples))) >= 12

    model = fit_stiffness(samples)
    nominal = np.array([kind.compliance for kind in kinds(arm=GALEN)])  # what the driver's arm has
    assert model.unresolved == ()
    assert np.all(model.std < 0.05 * nominal)
    assert np.all(np.abs(model.values - nominal) < 4.0 * model.std)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_ctrl_c_of_the_client_leaves_a_readable_bag_named_as_unfinished(tmp_path):
    """A collection that ends well is one of test_executables."""
    here = ["--positions", *map(str, POSITIONS[:5]), "--sets", "1", "--forces-n", "8"]
    with Harness() as harness:
        # A busy machine loses samples at a higher speed.
        world = CollectionWorld(harness, tmp_path, speed=1.0)
        command = [sys.executable, "-m", "galen_deflection.ros.collect", "monday"]
        with subprocess.Popen(
            [*command, "--tool", "retractor", "--by-service", *here],
            env=os.environ | {"ROS_DOMAIN_ID": str(harness.domain_id), "PYTHONUNBUFFERED": "1"},
            stderr=subprocess.PIPE,
            text=True,
            # In a job in a shell's background it would be ignored.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as process:
            lines = []
            for line in process.stderr:
                lines.append(line)
                if "push 8 N along +x" in line:
                    process.send_signal(signal.SIGINT)
            process.wait(timeout=30.0)
        error = "".join(lines)
        assert process.returncode == 130, error
        assert "CANCELED" in error and "monday.unfinished" in error
        assert world.left == ["monday.unfinished"]
    folder = tmp_path / "recordings" / "monday.unfinished"
    content = json.loads((folder / "collection.json").read_text())
    assert content["error"]["code"] == "CANCELED"
    with open_bag(folder / "push") as bag:
        assert not bag.problems
        assert bag.topics["/wrench_raw"].count > 100


def test_the_bag_that_a_dead_recorder_was_to_go_on_in_is_closed(tmp_path):
    with Harness() as harness:
        node = harness.add(lambda context: Node("recorded", context=context))
        recording = BagRecording(node, tmp_path / "first", [])

        def broken(timeout_sec):
            raise RuntimeError("out of order")

        recording._executor.spin_once = broken
        recording._thread.join(timeout=10.0)
        with pytest.raises(BagError, match="RuntimeError: out of order"):
            recording.change(tmp_path / "second")
        recording.close()
    assert (tmp_path / "second" / "metadata.yaml").exists()
