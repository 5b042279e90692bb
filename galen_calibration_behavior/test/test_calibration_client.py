# SPDX-License-Identifier: Apache-2.0
"""`calibrate`, and both ends as processes of their own."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time

import pytest
from calibration_fake_arm import NO_TOOL, POINTER
from galen_calibration_behavior.calibration.estimate import format_result
from galen_calibration_behavior.ros.calibrate import main, parse
from galen_common.command import EXIT_USAGE
from galen_ros.goal.client import result_to_dict
from galen_ros.node.testing import Harness
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from test_calibration_node import FakeDriver, World

from galen_msgs.action import CalibrateTool

NODE_PARAMETERS = {
    "itersT": 3, "itersR": 3, "settle_s": 0.1, "average_s": 0.3,
    "max_angle_velocity_rad_s": 4.0, "max_angle_acceleration_rad_s2": 40.0,
}  # fmt: skip


MANY = ("--iters-t", "6", "--iters-r", "6")  # so that it still runs when something ends it


class Process:
    """A module run with `python -m` in the harness's domain; ended by id when the test ends."""

    def __init__(self, harness, module, *arguments, stdin=subprocess.PIPE):
        self.harness = harness
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            env=os.environ | {"ROS_DOMAIN_ID": str(harness.domain_id), "PYTHONUNBUFFERED": "1"},
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Under nohup, and in a shell's background, they would be ignored.
            preexec_fn=lambda: [
                signal.signal(one, signal.SIG_DFL) for one in (signal.SIGHUP, signal.SIGINT)
            ],
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    def signal(self, number):
        self.process.send_signal(number)

    def end(self, timeout_s=30.0, text=None):
        """Return exit code, standard output, standard error."""
        out, error = self.process.communicate(text, timeout=timeout_s)
        return self.process.returncode, out, error


def calibrate(harness, *arguments, **options):
    return Process(harness, "galen_calibration_behavior.ros.calibrate", *arguments, **options)


def hear(client, *words):
    """Read what it says to a person up to a line with these words."""
    for line in client.process.stderr:
        if all(word in line for word in words):
            return
    raise AssertionError(f"it never said {words}")


@pytest.fixture
def terminal():
    """Both ends of a terminal: what a person types into, and what a process reads."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        with contextlib.suppress(OSError):  # a test may have closed it
            os.close(end)


@pytest.fixture
def world(tmp_path, plain_fit):
    with Harness() as harness:
        yield World(harness, tmp_path / "tools")


def test_json_is_one_object_on_standard_output(world):
    with calibrate(world.harness, "pointer", "--tip", "0.15", "0", "0.05", "--json") as client:
        code, out, error = client.end()
    assert code == 0, error
    result = json.loads(out)
    assert result["error_code"] == 0
    assert result["mass_kg"] == pytest.approx(0.060, abs=5 * result["mass_std_kg"])
    assert len(result["com_m"]) == 3
    assert result["file"] == str(world.tools_dir / "pointer.json")
    assert "sweep with pointer" in error


def test_enter_pressed_twice_answers_one_question(world, terminal):
    """The second one would send the arm off while a hand is still at the tool."""
    keyboard, stdin = terminal
    with calibrate(world.harness, "pointer", "--confirm", "--one-sweep", stdin=stdin) as client:
        for words, tool in (("take the tool off", NO_TOOL), ("put pointer", POINTER)):
            hear(client, words, "Enter")
            time.sleep(0.5)  # a person takes a while
            world.driver.arm.tool = tool
            os.write(keyboard, b"\n\n")
        code, out, error = client.end()
    assert code == 0, error
    assert all(words in out for words in ("pointer", "adapter", "warning: ", "written: "))
    warnings = [line for line in (out + error).splitlines() if line.startswith("warning: ")]
    assert len(warnings) == len(set(warnings))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_ctrl_c_and_a_terminal_that_closes_cancel_and_wait_for_the_stop(world, terminal, number):
    keyboard, stdin = terminal
    with calibrate(world.harness, "pointer", *MANY, stdin=stdin) as client:
        world.harness.wait_for(lambda: world.driver.moves > 2, 20.0, "the first poses")
        if number == signal.SIGHUP:
            os.close(keyboard)
            os.close(stdin)
        client.signal(number)
        code, out, error = client.end()
    assert code == 130, error
    assert "CANCELED" in error
    assert "Traceback" not in error
    assert out == ""
    assert world.driver.stops == 1
    assert not world.driver.arm.moving
    assert world.files == []


def test_another_terminal_cancels_it(world, terminal):
    with calibrate(world.harness, "pointer", "--confirm", stdin=terminal[1]) as client:
        hear(client, "take the tool off")
        with calibrate(world.harness, "--cancel") as other:
            code, out, error = other.end()
        assert (code, out) == (0, "1 goal canceled; the arm is stopped\n"), error
        code, _, error = client.end()
    assert code == 130 and "CANCELED" in error
    assert world.driver.stops == 1
    with calibrate(world.harness, "--cancel") as other:
        assert other.end()[1] == "calibration_node runs no goal\n"


class SlowServer(Node):
    """Takes goals only when told to; `canceled` are those that it was then asked to cancel."""

    def __init__(self, context):
        super().__init__("calibration", context=context)
        self.asked, self.go_on, self.canceled = threading.Event(), threading.Event(), 0
        self.server = ActionServer(
            self,
            CalibrateTool,
            "calibrate_tool",
            execute_callback=lambda _handle: None,
            goal_callback=self.on_goal,
            handle_accepted_callback=lambda _handle: None,
            cancel_callback=self.on_cancel,
        )

    def on_goal(self, _goal):
        self.asked.set()
        assert self.go_on.wait(20.0)
        return GoalResponse.ACCEPT

    def on_cancel(self, _handle):
        self.canceled += 1
        return CancelResponse.ACCEPT

    def destroy_node(self):
        self.server.destroy()
        super().destroy_node()


def test_a_goal_that_is_not_answered_is_not_left_running():
    """Late here; on a busy machine DDS has lost the answer, and the arm went on without anyone."""
    with Harness() as harness:
        server = harness.add(lambda context: SlowServer(context))
        with calibrate(harness, "pointer") as client:
            assert server.asked.wait(20.0)
            client.signal(signal.SIGINT)
            hear(client, "the goal may have begun")
            server.go_on.set()
            code, _, error = client.end()
        assert server.canceled == 1
    assert code == 130
    assert "before anything began" not in error
    assert error.rstrip().endswith("it had begun, and is canceled")


def test_a_node_ended_by_a_signal_stops_the_arm_and_its_client_hears_of_it(tmp_path):
    arguments = ["--ros-args", "-p", f"tools_dir:={tmp_path / 'tools'}"]
    for name, value in NODE_PARAMETERS.items():
        arguments += ["-p", f"{name}:={value}"]
    with Harness() as harness:
        driver = harness.add(lambda context: FakeDriver(context))
        with (
            Process(harness, "galen_calibration_behavior.ros.node", *arguments) as node,
            calibrate(harness, "pointer") as client,
        ):
            harness.wait_for(lambda: driver.moves > 3, 30.0, "some poses")
            node.signal(signal.SIGTERM)
            harness.wait_for(lambda: driver.stops, 5.0, "the stop")
            code, _, error = node.end()
            assert code == 0, error
            assert "Traceback" not in error
            code, _, error = client.end()
            assert code == 1
            assert "went away" in error
    assert list((tmp_path / "tools").iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["../x"],
        ["pointer", "--tip", "1", "2"],
        ["pointer", "--tip", "nan", "0", "0"],
        ["pointer", "--iters-t", "-1"],
        ["pointer", "--timeout-s", "0"],
        ["pointer", "extra"],
    ],
)
def test_wrong_arguments_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == EXIT_USAGE
    assert "calibrate: error:" in capsys.readouterr().err


@pytest.mark.parametrize("argument", ["pointer", "--cancel"])
def test_a_domain_that_ros_does_not_have_ends_with_code_2(argument, monkeypatch, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", "999")
    monkeypatch.setattr(sys, "argv", ["calibrate", argument])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == EXIT_USAGE
    assert capsys.readouterr().err.startswith("calibrate: ROS_DOMAIN_ID is 999")


def test_the_table_shows_torque_in_mnm_and_every_warning():
    result = CalibrateTool.Result(
        mass_kg=0.0601, mass_std_kg=0.0002, rmse_torque_nm=[0.0003, 0.0, 0.0], warnings=["odd"]
    )
    text = format_result(result)
    assert all(told in text for told in ("60.100 +- 0.200", "0.3000", "warning: odd"))
    assert json.loads(json.dumps(result_to_dict(result)))["rmse_torque_nm"] == [0.0003, 0.0, 0.0]
