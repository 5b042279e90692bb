# SPDX-License-Identifier: Apache-2.0
"""Faults of whole processes: a driver killed, two of them, a bad network, a subscriber that hangs.

The driver's wrench is the tool's weight plus a known push, so what goes out must be that push.
"""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from fault_arm import PERIOD_NS
from fault_processes import PUSH
from fault_world import FaultWorld, write_tool_file
from galen_ros.node.diagnostics import Level

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]
PROGRAM = Path(__file__).parent / "fault_processes.py"
# Between joints up to 50 ms apart roll bends by at most 0.5 rad/s^2 * (0.05 s)^2 / 8 = 0.16 mrad,
# under 3 N of weight.
INTERPOLATED_N = 1e-3


@pytest.fixture
def world(tmp_path):
    write_tool_file(tmp_path)
    with FaultWorld(tmp_path) as world:
        start_gravcomp(world)
        yield world


def start_gravcomp(world, late_s=0.0):
    """`late_s` 0: a machine with other work makes wrenches late enough by itself."""
    parameters = {"tools_dir": world.folder, "tool": "retractor", "calibration_monitor": False}
    world.start("gravcomp", ["-m", "galen_gravcomp.ros.node"], parameters | {"late_s": late_s})


def start(world, name, which, remaps=None):
    world.start(name, [str(PROGRAM), which], remaps=remaps)


def compensates(world, count=100):
    """Wait for so many more outputs."""
    wanted = len(world.listener.wrenches) + count
    world.wait_for(lambda: len(world.listener.wrenches) >= wanted, f"{count} outputs")


def values(world):
    return {item.key: item.value for item in world.newest().values}


def check(world, atol=1e-9):
    found = np.array([wrench for _, wrench in world.listener.wrenches])
    np.testing.assert_allclose(found, np.tile(PUSH, (len(found), 1)), rtol=0, atol=atol)


def test_a_driver_killed_and_back_and_then_a_second_one(world):
    start(world, "driver", "driver")
    compensates(world)
    world.kill("driver")
    world.wait_for(
        lambda: world.says("no wrench_raw for", level=Level.STALE), "the silence to be told"
    )
    before = world.listener.wrenches[-1][0]
    start(world, "driver", "driver")
    compensates(world)
    # DDS lists the killed one, too; it does not send.
    assert world.listener.wrenches[-1][0] > before
    assert values(world)["rejected_several_publishers"] == "0"
    start(world, "second", "driver", {"__node": "second_driver"})
    world.wait_for(
        lambda: world.says("/second_driver", level=Level.ERROR), "the second one to be named"
    )
    world.wait_for(lambda: world.says("nothing is published", level=Level.ERROR), "an end of it")
    world.kill("second")
    world.kill("driver")
    world.wait_for(lambda: world.says("no wrench_raw for"), "the silence to be told")
    check(world)


def test_a_bad_network_loses_what_it_lost_and_spoils_nothing(world):
    start(world, "relay", "relay")
    true = {"joint_states": "true/joint_states", "wrench_raw": "true/wrench_raw"}
    start(world, "driver", "driver", true)
    compensates(world, 400)
    check(world, INTERPOLATED_N)
    stamps = [stamp for stamp, _ in world.listener.wrenches]
    assert len(set(stamps)) == len(stamps)
    said = values(world)
    assert int(said["out_of_order_wrench"]) > 0 and int(said["out_of_order_joints"]) > 0
    assert int(said["rejected_duplicate_stamp"]) > 0
    rejected = sum(int(value) for key, value in said.items() if key.startswith("rejected_"))
    received, done = int(said["received"]), int(said["compensated"])
    assert received - done - rejected == int(said["waiting"])
    assert done > 0.9 * (received - int(said["rejected_duplicate_stamp"]))


def test_a_subscriber_that_hangs_holds_nothing_up(world):
    start(world, "subscriber", "subscriber")
    start(world, "driver", "driver")
    compensates(world, 50)
    world.processes["subscriber"].send_signal(signal.SIGSTOP)
    first = len(world.listener.wrenches)
    compensates(world, 500)
    check(world)
    stamps = np.array([stamp for stamp, _ in world.listener.wrenches[first:]])
    assert np.all(np.diff(stamps) == PERIOD_NS), "one was lost"
    assert world.newest().level == bytes([Level.OK])


@pytest.mark.parametrize("stalled", ["gravcomp", "relay"])
def test_wrenches_that_queued_up_go_out_late_and_that_is_told(world, stalled):
    """For 1.5 s the compensation, or the network before it, stands still."""
    world.kill("gravcomp")
    start_gravcomp(world, late_s=0.05)
    topics = {"joint_states": "true/joint_states", "wrench_raw": "true/wrench_raw"}
    start(world, "relay", "pass")
    start(world, "driver", "driver", topics)
    compensates(world)
    first = len(world.listener.wrenches)
    world.processes[stalled].send_signal(signal.SIGSTOP)
    time.sleep(1.5)  # how long it stands still is what is tested
    world.processes[stalled].send_signal(signal.SIGCONT)
    status = world.wait_for(lambda: world.says("came late", level=Level.WARN), "a warning")
    said = {item.key: item.value for item in status.values}
    assert said["state"] == "late" and "look at their stamps" in status.message
    compensates(world)
    check(world)
    stamps = np.array([stamp for stamp, _ in world.listener.wrenches[first:]])
    assert np.all(np.diff(stamps) == PERIOD_NS), "one was lost"
    world.wait_for(lambda: int(values(world)["late"]) > 100, "all of them to be counted")
    assert float(values(world)["late_worst_s"]) > 1.2
    world.wait_for(
        lambda: world.says("compensating 'retractor'", level=Level.OK), "it to pass by itself"
    )


def test_the_compensation_killed_and_back(world):
    start(world, "driver", "driver")
    compensates(world)
    world.kill("gravcomp")
    before = world.listener.wrenches[-1][0]
    start_gravcomp(world)
    compensates(world)
    assert world.listener.wrenches[-1][0] > before
    check(world)
