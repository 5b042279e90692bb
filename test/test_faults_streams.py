# SPDX-License-Identifier: Apache-2.0
"""Faults of the streams, with gravcomp and deflection as processes: what a user then sees.

In every test each wrench that went out is compared with the one read minus the tool's weight at
the joints of its stamp, computed here from the contract's numbers. All that is rejected is in the
tests of the compensator; here are one fault of each kind and what needs several processes.
"""

import numpy as np
import pytest
from fault_arm import PERIOD_NS
from fault_world import FaultWorld, write_model_file, write_tool_file
from galen_ros.node.diagnostics import Level

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]
WARN, ERROR, STALE = Level.WARN, Level.ERROR, Level.STALE


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    write_tool_file(folder)
    write_model_file(folder / "model.json")
    with FaultWorld(folder) as world:
        # Here stamps advance as the test gets on; what is late: test_faults_processes.
        parameters = {
            "tools_dir": folder,
            "tool": "retractor",
            "calibration_monitor": False,
            "late_s": 0.0,
        }
        world.start("gravcomp", ["-m", "galen_gravcomp.ros.node"], parameters)
        parameters = {"model_file": folder / "model.json", "late_s": 0.0}
        world.start("deflection", ["-m", "galen_deflection.ros.node"], parameters)
        world.driver = world.source("driver")
        world.works(world.driver)
        world.works(world.driver, "deflection")
        yield world


def nan(world, driver):
    return world.step(driver, wrench=with_channel(world, 1, np.nan))


def with_channel(world, channel, value):
    """What the sensor reads, but for one of its channels; all the same would be a frozen one."""
    wrench = world.arm()[2]
    wrench[channel] = value
    return wrench


def joints_stop(world, driver):
    world.stamp += PERIOD_NS
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def no_stamp(world, driver):
    world.stamp += PERIOD_NS
    world.wrench(driver, 0, world.arm()[2])
    return 0


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (nan, "wrench_raw holds a value that is not finite"),
        (joints_stop, "joint_states are stale"),
        (no_stamp, "has no stamp"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_cannot_be_compensated_is_rejected_and_named(world, fault, words):
    driver = world.driver
    world.works(driver)
    first = len(world.listener.wrenches)
    bad = []
    status = world.wait_for(
        lambda: world.says("nothing is published", level=ERROR),
        "an error",
        lambda: bad.append(fault(world, driver)),
    )
    assert words in status.message
    world.wait_for(
        lambda: world.says("no wrench_compensated for", "deflection", STALE),
        "deflection to miss its wrench",
        lambda: bad.append(fault(world, driver)),
    )
    good = world.works(driver)
    world.works(driver, "deflection")
    out = set(world.check_outputs(first))
    assert not out & set(bad)
    assert not set(world.listener.deflections) & set(bad)
    # All good ones but, where stamps were wrong, the first: what it is compared with was cleared.
    assert out >= set(good[8:])


def repeat(second, stamp):
    """The second one's wrenches, so many of a stamp that no pause of the first one hides it."""
    for _ in range(3):
        second.wrench(stamp, np.ones(6))


def test_two_drivers_at_once_are_rejected_by_name(world):
    driver = world.driver
    world.works(driver)
    first = len(world.listener.wrenches)
    words = "nothing is published: wrench_raw has 2 publishers (/driver, /second_driver)"
    with world.beside(driver, "second_driver") as second:

        def both():
            repeat(second, world.step(driver))

        world.wait_for(lambda: world.says(words, level=ERROR), "both drivers' names", both)
        while_two = len(world.listener.wrenches)
        for _ in range(50):
            both()
    good = world.works(driver)
    world.works(driver, "deflection")
    out = world.check_outputs(first)  # the second one's would be false
    assert set(good[-10:]) <= set(out[while_two - first :])


def test_a_second_compensation_is_rejected_by_name_downstream(world):
    driver = world.driver
    remaps = ["wrench_raw:=wrench_compensated", "joint_states:=unused"]
    words = "wrench_compensated has 2 publishers (/gravcomp, /other_gravcomp): stop all but one"
    first = len(world.listener.wrenches)
    with world.beside(driver, "other_gravcomp", remaps) as second:
        world.wait_for(
            lambda: world.says(words, "deflection", ERROR),
            "both names",
            lambda: repeat(second, world.step(driver)),
        )
    del world.listener.wrenches[first:]  # the other one's among them
    world.works(driver, "deflection")
