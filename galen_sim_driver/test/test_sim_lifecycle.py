# SPDX-License-Identifier: Apache-2.0
"""The driver as a managed node: while it is inactive nobody hears of the arm, nor moves it."""

import time

import galen_sim_driver.ros.node
import pytest
from galen_ros.messages import stamp_to_ns
from galen_ros.node.testing import Harness, Lifecycle
from galen_sim_driver.effects.effect import ConfigError
from std_srvs.srv import SetBool, Trigger
from test_sim_node import Cell


@pytest.fixture
def cell():
    with Harness() as harness:
        cell = Cell(harness)
        cell.life = Lifecycle(harness, cell.probe, "sim_driver")
        yield cell


def newest_ns(cell):
    messages = [*cell.joints[-1:], *cell.wrenches[-1:], *cell.base_poses[-1:]]
    return max(stamp_to_ns(message.header.stamp) for message in messages)


def test_inactive_it_publishes_nothing_and_nothing_moves_the_arm(cell):
    cell.send(["delta_x"], [0.1], 5.0)
    cell.wait(lambda: cell.value("moving") == "true", "a motion")
    assert cell.life.go("deactivate")
    off_ns = cell.sim_now_ns()
    cell.wait(lambda: cell.value("moving") == "false", "the arm to stand")
    rejected = cell.call(cell.bias, Trigger.Request())
    assert not rejected.success and "inactive" in rejected.message
    rejected = cell.call(cell.admittance, SetBool.Request(data=True))
    assert not rejected.success and "inactive" in rejected.message
    cell.wait(lambda: cell.value("lifecycle") == "inactive", "its state")
    assert cell.diagnostics[-1].message == cell.driver.inactive_text
    cell.wait(lambda: cell.sim_now_ns() > off_ns + 3 * 10**8, "the world to go on")
    assert newest_ns(cell) <= off_ns
    count = len(cell.wrenches)
    assert cell.life.go("activate")
    cell.wait(lambda: len(cell.wrenches) > count + 20, "samples again")
    assert cell.positions()[0] < 0.09  # far from where it was sent
    # In real time stamps are the system's, also after a pause.
    assert stamp_to_ns(cell.wrenches[count].header.stamp) > off_ns + 3 * 10**8
    assert abs(newest_ns(cell) - time.time_ns()) < 2 * 10**9
    assert cell.clocks == []


def test_it_is_configured_anew_and_a_failure_is_fixed(cell, monkeypatch):
    assert "'initial_tool' can't be set" in cell.life.set(initial_tool="pointer")
    assert cell.life.go("deactivate", "cleanup")
    cell.wait(lambda: cell.value("lifecycle") == "unconfigured", "its state")
    assert not cell.life.set(initial_tool="pointer", joint_zero_offset_tilt_rad=0.01)
    assert "knife" in cell.life.set(initial_tool="knife")

    def no_plant(*_):
        raise ConfigError("no such arm")

    with monkeypatch.context() as patch:
        patch.setattr(galen_sim_driver.ros.node, "Plant", no_plant)
        assert not cell.life.go("configure") and cell.life.state == "unconfigured"
    cell.wait(lambda: "no such arm" in cell.diagnostics[-1].message, "the reason")
    assert not cell.driver.get_publishers_info_by_topic("/wrench_raw")
    count = len(cell.wrenches)
    assert cell.life.go("configure", "activate")
    cell.wait(lambda: len(cell.wrenches) > count + 20, "samples")
    cell.wait(lambda: cell.value("tool") == "pointer", "the new tool")
    assert cell.value("effects") == "joint_zero_offset:tilt"


def test_a_zeroing_under_way_is_answered_when_the_services_go(cell):
    waits = cell.bias.call_async(Trigger.Request())
    cell.wait(lambda: cell.driver._pending_zeroing is not None or waits.done(), "the zeroing")
    assert cell.life.go("deactivate", "cleanup")
    cell.wait(waits.done, "the answer")
