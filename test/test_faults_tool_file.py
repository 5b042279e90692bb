# SPDX-License-Identifier: Apache-2.0
"""A tool's file that breaks or changes under a gravcomp that runs, or before it starts.

gravcomp is a process of its own. What was loaded stays active until a good file is asked for;
every wrench that went out is compared with the contract's weight of the active mass.
"""

import json
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


def empty(path):
    path.write_bytes(b"")


def other_schema(path):
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": 99}))


def negative_mass(path):
    content = json.loads(path.read_text())
    content["load"]["mass_kg"] = -0.2
    path.write_text(json.dumps(content))


def not_a_number(path):
    path.write_text(path.read_text().replace(f'"mass_kg": {MASS_KG}', '"mass_kg": NaN'))


def link_out(path):
    """A good file, but not in the folder."""
    away = path.parent.parent / "elsewhere.json"
    away.write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(away)


def dangling_link(path):
    path.unlink()
    path.symlink_to(path.parent / "nothing.json")


def pipe(path):
    """A reader would wait for ever."""
    path.unlink()
    os.mkfifo(path)


def folder(path):
    path.unlink()
    path.mkdir()


FAULTS = [
    (missing, NOT_FOUND, "No such file", "its file is gone"),
    (truncated, INVALID, "JSON", "its file has changed"),
    (empty, INVALID, "JSON", "its file has changed"),
    (other_schema, INVALID, "schema_version is 99", "its file has changed"),
    (negative_mass, INVALID, "a mass is positive", "its file has changed"),
    (not_a_number, INVALID, "expected a finite number", "its file has changed"),
    (link_out, INVALID, "", ""),
    (dangling_link, NOT_FOUND, "", "its file is gone"),
    (pipe, INVALID, "", "its file is gone"),
    (folder, INVALID, "", "its file is gone"),
]


def fixed(path):
    """The good file in the place of whatever is there."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    path.unlink(missing_ok=True)
    return write_tool_file(path.parent)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    tools = tmp_path_factory.mktemp("tool_faults") / "tools"
    tools.mkdir()
    path = write_tool_file(tools)
    with FaultWorld(tools.parent) as world:
        world.path = path
        world.parameters = {
            "tools_dir": tools, "tool": "retractor", "calibration_monitor": False, "late_s": 0.0,
        }  # fmt: skip
        start(world)
        world.driver = world.source("driver")
        world.works(world.driver)
        yield world


def start(world):
    world.start("gravcomp", ["-m", "galen_gravcomp.ros.node"], world.parameters)


def value(world, key):
    """From the newest report."""
    return next(item.value for item in world.newest().values if item.key == key)


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
    if note:
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


@pytest.mark.parametrize("fault", [missing, truncated, other_schema, negative_mass, pipe])
def test_a_start_with_it_publishes_nothing_until_a_good_file_is_asked_for(world, fault):
    driver, path = world.driver, fixed(world.path)
    world.kill("gravcomp")
    fault(path)
    del world.listener.said["gravcomp"][:]
    start(world)
    status = world.wait_for(
        lambda: world.says("no tool: ", level=Level.ERROR),
        "the file to be told",
        lambda: world.step(driver),
    )
    assert str(path) in status.message
    first = len(world.listener.wrenches)
    assert not world.ask_for_tool(driver, "retractor").success
    # While DDS finds the new reader, samples are late by seconds.
    world.wait_for(
        lambda: int(value(world, "rejected_no_tool")) > 100,
        "wrenches to be rejected",
        lambda: world.step(driver),
    )
    last = world.step(driver)
    received = int(value(world, "received"))
    said = len(world.listener.said["gravcomp"])
    # It reports once a second, and has come to all of them by then.
    world.wait_for(lambda: len(world.listener.said["gravcomp"]) > said + 2, "three more reports")
    assert int(value(world, "received")) == int(value(world, "rejected_no_tool")) >= received
    assert world.says("no tool: ", level=Level.ERROR)
    assert len(world.listener.wrenches) == first
    fixed(path)
    assert world.ask_for_tool(driver, "retractor").success
    is_ok(world)
    assert min(world.check_outputs(first)) > last


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
