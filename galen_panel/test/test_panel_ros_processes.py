"""The suite over ROS on the real nodes, each a process of its own that may be killed."""

import os
import signal
import subprocess
import sys
import time

import pytest
from galen_panel.snapshot import BehaviourKind, Goal
from panel_ros_world import panel_world

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

QUICK = {
    "use_sim_time": True,
    "settle_s": 0.05,
    "velocity_window_s": 0.06,
    "max_angle_velocity_rad_s": 1.4,
    "max_angle_acceleration_rad_s2": 5.5,
    "max_delta_velocity_m_s": 0.15,
    "max_delta_acceleration_m_s2": 0.9,
}
PATIENCE_S = 120.0


class Processes:
    """Nodes by the names of their modules."""

    def __init__(self, folder, domain_id):
        self.folder = folder
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(domain_id)}
        self.running = {}

    def start(self, module, **parameters):
        values = [word for p in parameters.items() for word in ("-p", f"{p[0]}:={p[1]}")]
        log = (self.folder / f"{module}.log").open("ab")
        self.running[module] = subprocess.Popen(
            [sys.executable, "-m", module, "--ros-args", *values],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        log.close()

    def kill(self, module):
        process = self.running.pop(module)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def close(self):
        for module in list(self.running):
            self.kill(module)


@pytest.fixture
def world(monkeypatch, tmp_path):
    with panel_world(monkeypatch) as world:
        world.processes = Processes(tmp_path, world.harness.domain_id)
        world.tools = tmp_path / "tools"
        world.tools.mkdir()
        try:
            yield world
        finally:
            world.processes.close()


def start_driver_and_gravcomp(world):
    world.processes.start("galen_sim_driver.node", speed_factor=2.0, initial_tool="retractor")
    start_gravcomp(world)


def start_gravcomp(world):
    world.processes.start("galen_gravcomp.node", use_sim_time=True, tools_dir=world.tools)


def start_calibration(world):
    world.processes.start(
        "galen_calibration_behavior.node", tools_dir=world.tools, itersT=3, itersR=3, **QUICK
    )


def outcome(world, kind):
    return world.wait_for(
        lambda state: kind in state.behaviours and state.behaviours[kind].outcome,
        f"the end of {kind.value}",
        PATIENCE_S,
    )


def test_nodes_that_are_killed_are_missed_and_found_again(world):
    start_driver_and_gravcomp(world)
    start_calibration(world)
    world.wait_for(
        lambda state: {"attach_tool", "calibrate_tool"} <= state.available and state.active_tool,
        "the nodes",
        PATIENCE_S,
    )
    # It tells its tool on connecting, its state a second later: by this one it is missed.
    world.wait_for(lambda state: state.report_of("gravcomp"), "its report", PATIENCE_S)
    assert world.ask(world.suite.start(Goal(BehaviourKind.CALIBRATE, "retractor"))).ok
    world.processes.kill("galen_calibration_behavior.node")
    world.processes.kill("galen_gravcomp.node")
    began_s = time.monotonic()
    world.wait_for(lambda state: state.active_tool is None, "that gravcomp is gone")
    # DDS itself hears of it some 20 s later.
    assert time.monotonic() - began_s < 10.0
    ended = outcome(world, BehaviourKind.CALIBRATE)
    assert ended.error == "LOST" and "calibration_node" in ended.text
    world.wait_for(lambda state: "calibrate_tool" not in state.available, "that it is gone, too")

    start_gravcomp(world)
    start_calibration(world)
    world.wait_for(lambda state: state.active_tool, "gravcomp again", PATIENCE_S)
    world.wait_for(
        lambda state: "calibrate_tool" in state.available, "calibration_node again", PATIENCE_S
    )
    answer = world.ask(world.suite.start(Goal(BehaviourKind.CALIBRATE, "retractor")))
    assert answer.ok, answer.text
    answer = world.ask(world.suite.cancel(BehaviourKind.CALIBRATE))
    assert answer.ok, (answer, world.state.behaviours[BehaviourKind.CALIBRATE])
    ended = outcome(world, BehaviourKind.CALIBRATE)
    assert ended.error == "CANCELED"
