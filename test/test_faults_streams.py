# SPDX-License-Identifier: Apache-2.0
"""Faults of the streams, with gravcomp and deflection as processes: what a user then sees.

In every test each wrench that went out is compared with the one read minus the tool's weight at
the joints of its stamp, computed here from the contract's numbers.
"""

import numpy as np
import pytest
from fault_arm import MS, PERIOD_NS
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


def infinite(world, driver):
    return world.step(driver, wrench=with_channel(world, 5, -np.inf))


def with_channel(world, channel, value):
    """What the sensor reads, but for one of its channels; all the same would be a frozen one."""
    wrench = world.arm()[2]
    wrench[channel] = value
    return wrench


def other_frame(world, driver):
    return world.step(driver, frame_id="tool0")


def other_joints(world, driver):
    return world.step(driver, names=("shoulder", "elbow"))


def joints_stop(world, driver):
    world.stamp += PERIOD_NS
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def joints_lag(world, driver):
    world.stamp += PERIOD_NS
    driver.joints(world.stamp - 200 * MS, 0.1, 0.1)
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def joints_run_backwards(world, driver):
    world.stamp += PERIOD_NS
    driver.joints(2 * world.turned_at - world.stamp - 60 * MS, 0.1, 0.1)
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def joints_nan(world, driver):
    world.stamp += PERIOD_NS
    driver.joints(world.stamp, np.nan, 0.1)
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def no_stamp(world, driver):
    world.stamp += PERIOD_NS
    world.wrench(driver, 0, world.arm()[2])
    return 0


def joints_flicker(world, driver):
    """From one sample to the next roll is elsewhere."""
    world.stamp += PERIOD_NS
    flip = world.stamp // PERIOD_NS % 2
    driver.joints(world.stamp, 3.0 + 3.0 * flip, 0.1)
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (nan, "wrench_raw holds a value that is not finite"),
        (infinite, "wrench_raw holds a value that is not finite"),
        (other_frame, "wrench_raw has frame_id 'tool0', expected 'ft_sensor'"),
        (other_joints, "lacks roll, tilt; it has shoulder, elbow"),
        (joints_stop, "joint_states are stale"),
        (joints_lag, "joint_states are stale"),
        (joints_run_backwards, "joint_states are stale"),
        (joints_nan, "joint_states hold an angle that is not finite"),
        (joints_flicker, "joint_states jumped by 3.00 rad within 10.0 ms"),
        (no_stamp, "has no stamp"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_cannot_be_compensated_is_rejected_and_named(world, fault, words):
    driver = world.driver
    world.works(driver)
    first = len(world.listener.wrenches)
    world.turned_at = world.stamp
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


def test_a_jump_costs_the_wrenches_beside_it_and_no_more(world):
    driver = world.driver
    world.works(driver)
    first = len(world.listener.wrenches)
    fed = [world.step(driver) for _ in range(20)]
    jumped = joints_glitch(world, driver)
    back = [world.step(driver) for _ in range(60)]
    world.wait_for(lambda: world.says("jumped"), "the jump to be told")
    world.wait_for(lambda: back[-1] in world.out, "the last one")
    assert set(world.check_outputs(first)) >= {*fed, *back[1:]}
    assert jumped not in {stamp for stamp, _ in world.listener.wrenches}


def joints_glitch(world, driver):
    world.stamp += PERIOD_NS
    driver.joints(world.stamp, 4.0, 0.1)
    world.wrench(driver, world.stamp, world.arm()[2])
    return world.stamp


def test_a_frozen_sensor_is_rejected_once_the_arm_turned(world):
    driver = world.driver
    world.works(driver)
    same = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    status = world.wait_for(
        lambda: world.says("nothing is published: wrench_raw has been the same", level=ERROR),
        "the frozen sensor to be told",
        lambda: world.step(driver, wrench=same),
    )
    assert "to the last bit" in status.message and "the sensor hangs" in status.message
    bad = [world.step(driver, wrench=same) for _ in range(20)]
    good = world.works(driver)
    out = set(world.check_outputs())
    assert not out & set(bad)
    assert out >= set(good[40:])  # it is looked at five times a second


@pytest.mark.parametrize("jump_ms", [3_600_000, -50_000_000, -205], ids=["ahead", "back", "little"])
def test_a_clock_that_jumps_clears_what_was_before(world, jump_ms):
    driver = world.driver
    world.works(driver)
    first = len(world.listener.wrenches)
    world.stamp += jump_ms * MS
    fed = [world.step(driver) for _ in range(30)]
    words = "stamps jumped " + ("ahead" if jump_ms > 0 else "back")
    world.wait_for(lambda: world.says(words), "the jump to be told", lambda: world.step(driver))
    world.wait_for(lambda: set(fed) <= world.out, "outputs at the new stamps")
    assert set(fed) <= set(world.check_outputs(first))


def test_repeated_and_disordered_wrenches_are_used_once_with_their_own_joints(world):
    driver = world.driver
    world.works(driver)
    first, start = len(world.listener.wrenches), world.stamp
    fed = []
    for _ in range(20):
        stamps = []
        for _ in range(3):
            world.stamp += PERIOD_NS
            roll, tilt, live = world.arm()
            world.joints(driver, world.stamp, roll, tilt)
            stamps.append((world.stamp, live))
        for at in (0, 2, 1, 2):  # the last repeats what was the newest
            world.wrench(driver, *stamps[at])
        fed += [stamp for stamp, _ in stamps]
    world.wait_for(lambda: len(world.listener.wrenches) >= first + len(fed), "all of them")
    out = [stamp for stamp in world.check_outputs(first) if stamp > start]
    assert sorted(out) == fed


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
