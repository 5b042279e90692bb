# SPDX-License-Identifier: Apache-2.0
"""The suite over ROS on the real nodes, each a process of its own that is killed."""

import asyncio
import time

import pytest
from galen_panel.ros.suite import RosSuite
from galen_panel.state.snapshot import BehaviourKind, Goal
from panel_processes import PanelWorld

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

PATIENCE_S = 120.0


def test_nodes_that_are_killed_are_missed_and_found_again(monkeypatch, tmp_path):
    with PanelWorld(tmp_path) as world:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain_id))
        with RosSuite(["panel"]) as suite:
            kill_and_start_again(world, suite)


def kill_and_start_again(world, suite):
    def wait_for(predicate, what):
        return world.wait_for(lambda: predicate(suite.state), what, PATIENCE_S)

    def outcome(state):
        behaviour = state.behaviours.get(BehaviourKind.CALIBRATE)
        return behaviour and behaviour.outcome

    goal = Goal(BehaviourKind.CALIBRATE, "retractor")
    world.start_driver(initial_tool="retractor")
    world.start_gravcomp()
    world.start_calibration()
    names = {"attach_tool", "calibrate_tool"}
    wait_for(lambda state: names <= state.available and state.active_tool, "the nodes")
    # It tells its tool on connecting, its state a second later: by this one it is missed.
    wait_for(lambda state: state.report_of("gravcomp"), "its report")
    assert asyncio.run(suite.start(goal)).ok
    world.kill("calibration_node")
    world.kill("gravcomp_node")
    began_s = time.monotonic()
    wait_for(lambda state: state.active_tool is None, "that gravcomp is gone")
    # DDS itself hears of it some 20 s later.
    assert time.monotonic() - began_s < 10.0
    ended = wait_for(outcome, "the loss")
    assert ended.error == "LOST" and "calibration_node" in ended.text
    wait_for(lambda state: "calibrate_tool" not in state.available, "that it is gone, too")

    world.start_gravcomp()
    world.start_calibration()
    wait_for(lambda state: state.active_tool, "gravcomp again")
    wait_for(lambda state: "calibrate_tool" in state.available, "calibration_node again")
    answer = asyncio.run(suite.start(goal))
    assert answer.ok, answer.text
    answer = asyncio.run(suite.cancel(BehaviourKind.CALIBRATE))
    assert answer.ok, answer
    assert wait_for(outcome, "the end").error == "CANCELED"
