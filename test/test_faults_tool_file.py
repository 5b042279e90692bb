# SPDX-License-Identifier: Apache-2.0
"""A tool's file that breaks or changes under a gravcomp that runs.

gravcomp is a process of its own. What was loaded stays active until a good file is asked for;
every wrench that went out is compared with the contract's weight of the active mass.
"""

import os

import numpy as np
import pytest
from fault_arm import MASS_KG, weight
from fault_world import FaultWorld, write_tool_file
from galen_ros.node.diagnostics import Level

from galen_msgs.srv import SetTool

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]
INVALID, NOT_FOUND = SetTool.Response.INVALID_FILE, SetTool.Response.NOT_FOUND


def missing(path):
    path.unlink()


def truncated(path):
    path.write_bytes(path.read_bytes()[:200])


def pipe(path):
    """A reader would wait for ever."""
    path.unlink()
    os.mkfifo(path)


FAULTS = [
    (missing, NOT_FOUND, "No such file", "its file is gone"),
    (truncated, INVALID, "JSON", "its file has changed"),
    (pipe, INVALID, "", "its file is gone"),
]


def fixed(path):
    """The good file in the place of whatever is there."""
    path.unlink(missing_ok=True)
    return write_tool_file(path.parent)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    tools = tmp_path_factory.mktemp("tool_faults") / "tools"
    tools.mkdir()
    path = write_tool_file(tools)
    with FaultWorld(tools.parent) as world:
        world.path = path
        parameters = {
            "tools_dir": tools, "tool": "retractor", "calibration_monitor": False, "late_s": 0.0,
        }  # fmt: skip
        world.start("gravcomp", ["-m", "galen_gravcomp.ros.node"], parameters)
        world.driver = world.source("driver")
        world.works(world.driver)
        yield world


def is_ok(world):
    """Feed until nothing is said against it."""
    world.wait_for(
        lambda: world.says("compensating 'retractor'", level=Level.OK),
        "all to be well",
        lambda: world.step(world.driver),
    )


@pytest.mark.parametrize(
    ("fault", "code", "words", "note"), FAULTS, ids=[row[0].__name__ for row in FAULTS]
)
def test_what_was_loaded_stays_active(world, fault, code, words, note):
    driver, path = world.driver, fixed(world.path)
    assert world.ask_for_tool(driver, "retractor").success
    is_ok(world)
    first, begin = len(world.listener.wrenches), world.stamp
    fault(path)
    world.wait_for(
        lambda: world.says(note, level=Level.WARN),
        "the file's change to be told",
        lambda: world.step(driver),
    )
    assert world.newest().message.startswith("compensating 'retractor': ")
    answer = world.ask_for_tool(driver, "retractor")
    assert not answer.success and answer.error_code == code, answer.error_msg
    assert words in answer.error_msg and "retractor.json" in answer.error_msg
    assert (answer.tool, answer.mass_kg) == ("retractor", MASS_KG), "the old one stays"
    for _ in range(50):
        last = world.step(driver)
    fixed(path)
    answer = world.ask_for_tool(driver, "retractor")
    assert answer.success and answer.error_msg == ""
    is_ok(world)
    fed = {stamp for stamp in world.raw if begin < stamp <= last}
    world.wait_for(lambda: last in {s for s, _ in world.listener.wrenches}, "the last wrench")
    assert fed <= set(world.check_outputs(first)), "one was lost"


def test_files_swapped_and_loaded_under_a_running_stream_lose_nothing(world):
    """While each file is loaded, a wrench is compensated by one of the two, never by a mixture."""
    driver = world.driver
    fixed(world.path)
    world.ask_for_tool(driver, "retractor")
    world.works(driver)
    first, begin = len(world.listener.wrenches), world.stamp
    masses = [MASS_KG, MASS_KG + 0.1]
    for turn in range(60):
        write_tool_file(world.path.parent, masses[turn % 2])
        answer = world.ask_for_tool(driver, "retractor")
        assert answer.success and answer.mass_kg == masses[turn % 2]
    last = world.step(driver)
    world.wait_for(lambda: last in world.out, "the last wrench")
    fed = {stamp for stamp in world.raw if begin < stamp <= last}
    by = dict.fromkeys(masses, 0)
    for number in range(first, len(world.listener.wrenches)):
        stamp = world.listener.wrenches[number][0]
        mass = next(mass for mass in masses if is_by(world, number, mass))
        by[mass] += 1
        fed.discard(stamp)
    assert not fed, "one was lost"
    assert min(by.values()) > 30


def is_by(world, number, mass_kg):
    """Whether this output is by a tool of that mass."""
    stamp, found = world.listener.wrenches[number]
    expected = world.raw[stamp] - weight(*world.angles[stamp], mass_kg)
    return np.allclose(found, expected, rtol=0, atol=1e-9)
