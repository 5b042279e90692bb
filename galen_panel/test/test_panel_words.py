"""The nodes in plain words: each state that the nodes' code can tell has words and advice."""

import ast
import time
from dataclasses import replace
from pathlib import Path

import pytest
from galen_calibration_behavior.commands import CalibrationState, CheckState
from galen_deflection.collection.commands import State as CollectionState
from galen_deflection.deflector import ModelRejection
from galen_deflection.monitor import DeflectorMonitor
from galen_gravcomp.monitor import Monitor
from galen_panel.messages.advice import ADVICE, LIFECYCLE, REJECTED
from galen_panel.messages.hints import PROGRAMS
from galen_panel.messages.states import (
    find_advice,
    others,
    overall,
    words_of,
    words_of_other,
)
from galen_panel.snapshot import (
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    LoadedTool,
    NodeLevel,
    NodeReport,
    SuiteState,
)
from galen_ros.node.managed_node import Stage

ROOT = Path(__file__).resolve().parents[2]
NOW_S = 1000.0
STREAM = ("galen_ros/galen_ros/stream/monitor.py",)
SOURCES = {
    "gravcomp": (*STREAM, "galen_gravcomp/galen_gravcomp/monitor.py"),
    "deflection": (*STREAM, "galen_deflection/galen_deflection/monitor.py"),
}
MONITORS = {"gravcomp": Monitor, "deflection": DeflectorMonitor}
ENUMERATED = {
    "calibration": [state.name for states in (CalibrationState, CheckState) for state in states],
    "collection": [state.name for state in CollectionState],
    "deflection": [],
    "gravcomp": [],
    "sim_driver": [],
}


def calls(path, name):
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(name):
            yield node


def level_of(severity):
    return NodeLevel[ast.unparse(severity).rsplit(".", 1)[-1]]


def states_of_streams(role):
    """(level, name) of each State(...) in the code that has a name of its own."""
    found = set()
    for path in (*SOURCES[role], "galen_ros/galen_ros/stream/node.py"):
        for call in calls(path, "State"):
            level, name = call.args[0], call.args[1]
            text = ast.unparse(name)
            if text.startswith("ModelRejection."):
                found.add((level_of(level), ModelRejection[text.split(".")[1]].value))
            elif isinstance(name, ast.Constant):
                found.add((level_of(level), name.value))
        for call in calls(path, "_warning"):
            if isinstance(call.args[0], ast.Constant):
                found.add((NodeLevel.WARN, call.args[0].value))
    monitor = MONITORS[role]
    found.add((NodeLevel.OK, monitor.working))
    found.add((NodeLevel.WARN, monitor.working))
    for reason in monitor.reasons:
        if reason not in monitor.not_shown:
            found |= {(level, reason.value) for level in (NodeLevel.WARN, NodeLevel.ERROR)}
    return found


def states_of_driver():
    tree = ast.parse((ROOT / "galen_sim_driver/galen_sim_driver/node.py").read_text())
    (state,) = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "_state")
    returned = [n.value for n in ast.walk(state) if isinstance(n, ast.Return)]
    return {(NodeLevel[one.elts[0].id], one.elts[1].value) for one in returned}


def states_of_goals(role):
    path = "galen_ros/galen_ros/goal/node.py"
    tree = ast.parse((ROOT / path).read_text())
    (report,) = (
        n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "_report_status"
    )
    idle = {
        (NodeLevel[one.elts[0].id], one.elts[1].value)
        for one in ast.walk(report)
        if isinstance(one, ast.Tuple)
        and len(one.elts) == 2
        and isinstance(one.elts[1], ast.Constant)
    }
    assert len(idle) == 3
    return idle | {(NodeLevel.OK, name) for name in ENUMERATED[role]}


def all_states():
    for role in SOURCES:
        for level, name in states_of_streams(role):
            yield role, level, name
    for role in ("calibration", "collection"):
        for level, name in states_of_goals(role):
            yield role, level, name
    for level, name in states_of_driver():
        yield "sim_driver", level, name


ALL = sorted(
    {(role, level, name) for role, level, name in all_states() if name != "inactive"},
    key=lambda one: (one[0], one[2], one[1].value),
)


def report(name, level, state="", heard_s=NOW_S, message="says", **values):
    values = {"state": state, **values} if state else values
    return NodeReport(name, level, message, values, heard_s)


def state_of(*reports, **changes):
    return SuiteState(nodes={one.name: one for one in reports}, **changes)


def role(name):
    return next(one for one in PROGRAMS if one.node == name)


def test_the_list_of_states_is_that_of_the_code():
    names = {(role, name) for role, _, name in ALL}
    assert {("gravcomp", "frozen_wrench"), ("gravcomp", "file_changed"), ("gravcomp", "late"),
            ("deflection", "out_of_reach"), ("deflection", "predicting"),
            ("sim_driver", "slow"), ("sim_driver", "running"),
            ("calibration", "ATTACH_TOOL"), ("collection", "HOLD"), ("calibration", "failed"),
            ("gravcomp", "incompatible_qos"), ("gravcomp", "cable_outside")} <= names  # fmt: skip
    assert len(ALL) > 90


@pytest.mark.parametrize(
    ("name", "level", "state"), ALL, ids=[f"{one[0]}-{one[2]}-{one[1].name}" for one in ALL]
)
def test_each_state_has_words_and_trouble_has_advice(name, level, state):
    advice = find_advice(name, state, level)
    assert advice is not None
    assert advice.doing.endswith(".") and advice.doing[0].isupper()
    if level is not NodeLevel.OK:
        assert advice.todo
    words = words_of(state_of(report(name, level, state, tool="pointer")), role(name), NOW_S)
    assert words.level is level and words.running
    assert "{" not in words.doing + words.todo
    assert words.said == "says"


def test_no_words_are_left_that_no_node_can_tell():
    told = {(role, name) for role, _, name in ALL}
    for role_name, advices in ADVICE.items():
        for key in advices:
            name = key.removesuffix(" warn").removesuffix(" stale")
            assert (role_name, name) in told
    names = {name for _, name in told}
    assert set(REJECTED) <= names


@pytest.mark.parametrize(
    ("stage", "level"),
    [(stage, NodeLevel.WARN) for stage in Stage if stage is not Stage.ACTIVE]
    # A transition that failed leaves a node unconfigured.
    + [(Stage.UNCONFIGURED, NodeLevel.ERROR)],
)
def test_each_stage_of_a_nodes_life_has_words(stage, level):
    name = "inactive" if stage is Stage.INACTIVE else ""
    told = report("left/gravcomp", level, name, lifecycle=stage.value)
    state = state_of(told, namespace="left")
    words = words_of(state, role("gravcomp"), NOW_S)
    assert words.level is level and words.stopped and words.todo
    assert stage is Stage.FINALIZED or "/left/gravcomp" in words.todo
    assert ("could not start" in words.doing) == (level is NodeLevel.ERROR)
    assert len(LIFECYCLE) == 4


def test_two_drivers_are_said_with_what_to_do():
    both = report("gravcomp", NodeLevel.ERROR, "several_publishers", lifecycle="active")
    words = words_of(state_of(both), role("gravcomp"), NOW_S)
    assert words.doing == "No compensation: two drivers publish the same topic."
    assert "Stop all but one" in words.todo and words.stopped
    joints = report("gravcomp", NodeLevel.WARN, "several_publishers", lifecycle="active")
    words = words_of(state_of(joints), role("gravcomp"), NOW_S)
    assert "joint_states" in words.doing and not words.stopped


def test_some_rejected_wrenches_are_less_than_all():
    some = words_of(
        state_of(report("gravcomp", NodeLevel.WARN, "stale_joints")), role("gravcomp"), NOW_S
    )
    all_of_them = words_of(
        state_of(report("gravcomp", NodeLevel.ERROR, "stale_joints")), role("gravcomp"), NOW_S
    )
    assert "some wrenches" in some.doing and not some.stopped
    assert all_of_them.doing.startswith("No compensation: ") and all_of_them.stopped


def test_a_node_not_heard_of_is_not_running_and_says_how_to_start():
    state = state_of(report("gravcomp", NodeLevel.OK, "compensating", heard_s=NOW_S - 7.0))
    words = words_of(state, role("gravcomp"), NOW_S)
    assert words.level is NodeLevel.STALE and not words.running
    assert "silent for 7 s" in words.doing and "gravcomp_node" in words.todo
    assert words_of(state, role("gravcomp"), NOW_S - 4.5).level is NodeLevel.OK


@pytest.mark.parametrize("one", PROGRAMS, ids=[one.node for one in PROGRAMS])
def test_without_any_node_each_card_says_how_to_start_it(one):
    words = words_of(SuiteState(), one, time.monotonic())
    assert not words.running and "ros2 " in words.todo
    assert words.level is (NodeLevel.STALE if one.needed else NodeLevel.OK)


def test_a_service_without_a_report_yet_is_there():
    state = SuiteState(available=frozenset({"calibrate_tool"}))
    words = words_of(state, role("calibration"), NOW_S)
    assert words.doing.startswith("Calibration is there")


def test_another_driver_is_no_missing_one():
    compensation = report(
        "gravcomp", NodeLevel.OK, "compensating", wrench_raw_publisher_nodes="/ati_driver"
    )
    words = words_of(state_of(compensation), role("sim_driver"), NOW_S)
    assert words.level is NodeLevel.OK and "/ati_driver" in words.doing


def test_time_that_stands_still_is_said():
    still = report("gravcomp", NodeLevel.WARN, "compensating", clock="stands still")
    words = words_of(state_of(still), role("gravcomp"), NOW_S)
    assert "/clock" in words.doing and words.todo


def test_an_unknown_state_is_told_in_the_nodes_own_words():
    odd = report("gravcomp", NodeLevel.ERROR, "from_the_future", message="something new")
    words = words_of(state_of(odd), role("gravcomp"), NOW_S)
    assert words.doing == "Something new" and words.todo and words.stopped


def test_other_nodes_are_listed_by_their_own_message():
    state = state_of(report("recorder", NodeLevel.WARN, message="disk nearly full"))
    (other,) = others(state)
    assert words_of_other(other, NOW_S).doing == "Disk nearly full"
    assert words_of_other(other, NOW_S + 10.0).level is NodeLevel.STALE


def test_the_nodes_of_another_arm_are_others():
    own = report("left/gravcomp", NodeLevel.OK, "compensating")
    another = report("right/gravcomp", NodeLevel.ERROR, "bad_tool_file")
    state = state_of(own, another, namespace="left")
    assert words_of(state, role("gravcomp"), NOW_S).level is NodeLevel.OK
    assert others(state) == [another]
    alone = state_of(another, namespace="left")
    assert not words_of(alone, role("gravcomp"), NOW_S).running


GOOD = (
    report("sim_driver", NodeLevel.OK, "running"),
    report("gravcomp", NodeLevel.OK, "compensating", tool="pointer"),
    report("calibration", NodeLevel.OK, "ready"),
)
ACTIVE = LoadedTool("pointer", True, 0.06, (0, 0, 0), (0, 0, 0), "", "as loaded", None)


def test_the_lamp_is_good_when_all_is():
    assert overall(state_of(*GOOD, active_tool=ACTIVE), NOW_S) == (
        NodeLevel.OK, "Compensates 'pointer'."
    )  # fmt: skip


def test_the_lamp_names_what_stops_the_compensation_first():
    broken = report("deflection", NodeLevel.ERROR, "bad_model_file")
    off = report("gravcomp", NodeLevel.WARN, "disabled")
    level, text = overall(state_of(*GOOD, broken, off), NOW_S)
    assert level is NodeLevel.WARN and text.startswith("Compensation is off")


def test_the_lamp_names_the_worst_of_the_others_when_compensation_works():
    failed = report("calibration", NodeLevel.WARN, "failed")
    broken = report("deflection", NodeLevel.ERROR, "bad_model_file")
    level, text = overall(state_of(*GOOD[:2], failed, broken), NOW_S)
    assert level is NodeLevel.ERROR and text.startswith("Deflection: No prediction")
    fits = report("gravcomp", NodeLevel.WARN, "does_not_fit", tool="pointer")
    level, text = overall(state_of(GOOD[0], fits, failed), NOW_S)
    assert level is NodeLevel.WARN and "does not fit" in text


def calibrating(**changes):
    return {BehaviourKind.CALIBRATE: Behaviour(1, BehaviourKind.CALIBRATE, "pointer", **changes)}


def test_a_calibration_that_takes_the_tool_off_is_no_warning():
    fits = report("gravcomp", NodeLevel.WARN, "does_not_fit", tool="pointer")
    state = state_of(GOOD[0], fits, active_tool=ACTIVE, behaviours=calibrating())
    level, text = overall(state, NOW_S)
    assert level is NodeLevel.OK
    assert text.startswith("Compensates 'pointer'") and "calibration" in text
    assert not words_of(state, role("gravcomp"), NOW_S).todo
    # When it has ended, a tool that is still off is a warning again.
    ended = replace(state, behaviours=calibrating(outcome=BehaviourOutcome("CANCELED", "canceled")))
    assert overall(ended, NOW_S)[0] is NodeLevel.WARN
    assert "does not fit" in overall(ended, NOW_S)[1]


def test_a_calibration_hides_no_other_trouble():
    late = report("gravcomp", NodeLevel.WARN, "late", tool="pointer")
    level, _ = overall(state_of(*GOOD[:1], late, behaviours=calibrating()), NOW_S)
    assert level is NodeLevel.WARN


def test_the_lamp_without_any_node():
    level, text = overall(SuiteState(), NOW_S)
    assert level is NodeLevel.STALE and text.startswith("No compensation: not running")
