# SPDX-License-Identifier: Apache-2.0
"""Faults around a calibration: canceled at every moment, two clients, a client that is killed.

Driver, calibration and client are processes of their own.
"""

import json

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from fault_world import PATIENCE_S, TIP_M, FaultWorld
from galen_bringup.processes import QUICK
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import TOOLS
from galen_ros.messages import STREAM
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import JointState

from galen_msgs.action import CalibrateTool, CheckTool

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]
STATES = ("HOME", "REMOVE_TOOL", "ZERO", "SWEEP_BARE", "ATTACH_TOOL", "SWEEP_TOOL", "ESTIMATE")


class Client(Node):
    def __init__(self, **options):
        super().__init__("client", **options)
        self.calibrate = ActionClient(self, CalibrateTool, "calibrate_tool")
        self.check = ActionClient(self, CheckTool, "check_tool")
        self.states, self.joints = [], []
        self.create_subscription(JointState, "joint_states", self.joints.append, STREAM)

    def on_feedback(self, message):
        self.states.append(message.feedback.state)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibration")
    with FaultWorld(folder) as world:
        world.start(
            "driver",
            ["-m", "galen_sim_driver.ros.node"],
            {"speed_factor": 4.0, "seed": 3},
        )
        parameters = {"tools_dir": folder, "itersT": 3, "itersR": 3} | QUICK
        world.start("calibration", ["-m", "galen_calibration_behavior.ros.node"], parameters)
        world.client = world.harness.add(lambda context: Client(context=context))
        world.wait_for(world.client.calibrate.server_is_ready, "the action server")
        world.wait_for(lambda: world.client.joints, "the driver")
        yield world


def ask(world, question):
    return world.harness.answer_of(question, PATIENCE_S, "an answer of the action server")


def send(world):
    goal = CalibrateTool.Goal(tool="retractor", attach_by_service=True, tip_m=TIP_M)
    world.client.states.clear()
    return ask(
        world, lambda: world.client.calibrate.send_goal_async(goal, world.client.on_feedback)
    )


def result_of(world, handle):
    return world.harness.answer_of(handle.get_result_async, 300.0, "the goal's end")


def stands_still(world):
    """Two reports half a second of the driver's time apart are the same but for the encoders."""
    del world.client.joints[:]
    world.wait_for(lambda: len(world.client.joints) > 250, "joint states")
    first, last = (np.array(world.client.joints[k].position) for k in (0, 250))
    return np.abs(last - first).max() < 2e-4


# Into the sweeps at several moments: moving, settling, averaging.
MOMENTS = [(state, 0) for state in STATES] + [
    (state, samples) for state in ("SWEEP_BARE", "SWEEP_TOOL") for samples in (40, 170, 300, 430)
]


@pytest.mark.parametrize(("state", "samples"), MOMENTS)
def test_a_cancel_at_any_moment_stops_the_arm_and_writes_nothing(world, state, samples):
    file = world.folder / "retractor.json"
    file.unlink(missing_ok=True)
    handle = send(world)
    assert handle.accepted
    number = getattr(CalibrateTool.Feedback, state)
    end = world.harness.call_in_executor(handle.get_result_async)

    def there():
        assert not end.done() or number == CalibrateTool.Feedback.ESTIMATE, end.result().result
        return end.done() or [s for s in world.client.states if s >= number]

    world.wait_for(there, state, patience_s=300.0)
    del world.client.joints[:]
    world.wait_for(lambda: len(world.client.joints) >= samples, "a moment in it")
    ask(world, handle.cancel_goal_async)
    answer = result_of(world, handle)
    if answer.status == GoalStatus.STATUS_SUCCEEDED:
        assert state == "ESTIMATE", "it went on"  # too late: it was being written
        assert read_calibration(file, arm=GALEN).tool == "retractor"
        return
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert answer.result.error_code == CalibrateTool.Result.CANCELED
    assert answer.result.file == "" and not file.exists()
    assert not list(world.folder.glob("*.tmp")) and not list(world.folder.glob(".*retractor*"))
    assert stands_still(world)
    world.wait_for(lambda: world.says("ready; ", "calibration"), "the node to be ready")


def test_a_client_that_is_killed_and_another_at_once(world):
    file = world.folder / "retractor.json"
    file.unlink(missing_ok=True)
    tip = [repr(float(value)) for value in TIP_M]
    command = [
        "-m",
        "galen_calibration_behavior.ros.calibrate",
        "retractor",
        "--json",
        "--tip",
        *tip,
    ]
    world.start("calibrate", command)
    world.wait_for(lambda: world.says("SWEEP_BARE", "calibration"), "the sweep", patience_s=300.0)
    world.kill("calibrate")
    rejected = send(world)  # the goal of the one that is gone goes on
    assert not rejected.accepted
    status = world.wait_for(
        lambda: next((v for v in world.newest("calibration").values if v.key == "rejected"), None),
        "the rejection to be told",
    )
    assert "retractor" in status.value
    world.wait_for(lambda: world.says("ready; ", "calibration"), "its end", patience_s=300.0)
    found = read_calibration(file, arm=GALEN)
    truth = TOOLS["retractor"].load
    assert abs(found.load.mass_kg - truth.mass_kg) < 5 * found.load.mass_std_kg
    assert json.loads(file.read_text())["tool"] == "retractor"
    handle = send(world)
    assert handle.accepted, "another client may calibrate now"
    assert not send(world).accepted, "two at once"
    ask(world, handle.cancel_goal_async)
    assert result_of(world, handle).status == GoalStatus.STATUS_CANCELED
