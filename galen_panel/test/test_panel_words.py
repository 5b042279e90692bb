# SPDX-License-Identifier: Apache-2.0
"""The nodes in plain words: each state that the nodes' code can tell has words and advice."""

import ast
from dataclasses import replace
from pathlib import Path

import pytest
from fake_suite import ACTIVE
from galen_calibration_behavior.common.commands import CalibrationState, CheckState
from galen_deflection.collection.plan import State as CollectionState
from galen_deflection.deflector import ModelRejection
from galen_deflection.monitor import DeflectorMonitor
from galen_gravcomp.monitor import Monitor
from galen_panel.messages import programs
from galen_panel.messages.programs import PROGRAMS, compensates, overall, setup_sentence, words_of
from galen_panel.state.snapshot import (
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    NodeLevel,
    NodeReport,
    SuiteState,
)
from galen_ros.node.managed_node import Stage

ROOT = Path(__file__).resolve().parents[2]
NOW_S = 1000.0
STREAM = ("galen_common/galen_common/stream/monitor.py",)
SOURCES = {
    "gravcomp": (*STREAM, "galen_gravcomp/galen_gravcomp/monitor.py"),
    "deflection": (*STREAM, "galen_deflection/galen_deflection/monitor.py"),
}
MONITORS = {"gravcomp": Monitor, "deflection": DeflectorMonitor}
ENUMERATED = {
    "calibration": [state.name for states in (CalibrationState, CheckState) for state in states],
    "collection": [state.name for state in CollectionState],
}


def nodes_of(path):
    return ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8")))


def function(path, name):
    (found,) = (n for n in nodes_of(path) if isinstance(n, ast.FunctionDef) and n.name == name)
    return found


def calls(path, name):
    for node in nodes_of(path):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(name):
            yield node


def level_of(severity):
    return NodeLevel[ast.unparse(severity).rsplit(".", 1)[-1]]


def states_of_streams(role):
    """(level, name) of each State(...) in the code that has a name of its own."""
    found = set()
    for path in (*SOURCES[role], "galen_ros/galen_ros/node/stream_node.py"):
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
    state = function("galen_sim_driver/galen_sim_driver/ros/node.py", "_state")
    returned = [n.value for n in ast.walk(state) if isinstance(n, ast.Return)]
    return {(NodeLevel[one.elts[0].id], one.elts[1].value) for one in returned}


def states_of_goals(role):
    report = function("galen_ros/galen_ros/goal/node.py", "_report_status")
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


def gravcomp(level, state="", **values):
    return report("gravcomp", level, state, **values)


def state_of(*reports, **changes):
    return SuiteState(nodes={one.name: one for one in reports}, **changes)


def role(name):
    return next(one for one in PROGRAMS if one.node == name)


def test_the_list_of_states_is_that_of_the_code():
    one_of_each_source = {
        ("gravcomp", "frozen_wrench"), ("gravcomp", "late"), ("gravcomp", "incompatible_qos"),
        ("gravcomp", "cable_outside"), ("deflection", "predicting"), ("sim_driver", "slow"),
        ("calibration", "ATTACH_TOOL"), ("collection", "HOLD"), ("calibration", "failed"),
    }  # fmt: skip
    assert one_of_each_source <= {(role, name) for role, _, name in ALL}
    assert len(ALL) > 90


@pytest.mark.parametrize(
    ("name", "level", "state"), ALL, ids=[f"{one[0]}-{one[2]}-{one[1].name}" for one in ALL]
)
def test_each_state_has_words_and_trouble_has_advice(name, level, state):
    advice = programs.find_advice(name, state, level)
    assert advice is not None
    assert advice.doing.endswith(".") and advice.doing[0].isupper()
    if level is not NodeLevel.OK:
        assert advice.todo
    words = words_of(state_of(report(name, level, state, tool="pointer")), role(name), NOW_S)
    assert words.level is level and words.running
    assert "{" not in words.doing + words.todo
    assert words.said == "says"


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


OK, WARN, ERROR, STALE = NodeLevel.OK, NodeLevel.WARN, NodeLevel.ERROR, NodeLevel.STALE


@pytest.mark.parametrize(
    ("node", "told", "level", "stopped", "words"),
    [
        ("gravcomp", gravcomp(ERROR, "several_publishers"), ERROR, True, "two drivers publish"),
        ("gravcomp", gravcomp(WARN, "several_publishers"), WARN, False, "joint_states"),
        ("gravcomp", gravcomp(WARN, "stale_joints"), WARN, False, "some wrenches"),
        ("gravcomp", gravcomp(ERROR, "stale_joints"), ERROR, True, "No compensation: "),
        ("gravcomp", gravcomp(WARN, "compensating", clock="stands still"), WARN, False, "/clock"),
        ("gravcomp", gravcomp(ERROR, "from_the_future", message="new"), ERROR, True, "New"),
        ("gravcomp", gravcomp(OK, "compensating", heard_s=NOW_S - 7.0), STALE, True, "for 7 s"),
        ("gravcomp", report("right/gravcomp", OK, "compensating"), STALE, True, "not running"),
        ("sim_driver", gravcomp(OK, wrench_raw_publisher_nodes="/ati"), OK, False, "/ati"),
    ],
)
def test_words_of_a_node(node, told, level, stopped, words):
    found = words_of(state_of(told), role(node), NOW_S)
    assert (found.level, found.stopped) == (level, stopped)
    assert words in found.doing and bool(found.todo) == (level is not OK)


@pytest.mark.parametrize(("age_s", "believed"), [(1.4, True), (1.6, False)])
def test_a_lost_compensation_is_not_believed_in_for_long_after_a_report_is_due(age_s, believed):
    """Reports come once a second; every part of the page says the same."""
    told = gravcomp(OK, "compensating", heard_s=NOW_S - age_s, setup="verified")
    state = state_of(told, active_tool=ACTIVE)
    assert compensates(state, NOW_S) is believed
    assert (overall(state, NOW_S)[0] is OK) is believed
    assert bool(setup_sentence(state, NOW_S)) is believed


def test_on_a_busy_machine_reports_that_come_late_do_not_make_it_flicker():
    told = gravcomp(OK, "compensating", heard_s=NOW_S - 2.0)
    late = replace(told, heard_s=NOW_S).after(told)
    assert compensates(state_of(late, active_tool=ACTIVE), NOW_S + 2.8)
    assert not compensates(state_of(late, active_tool=ACTIVE), NOW_S + 3.1)
    for second in range(1, 10):
        late = replace(late, heard_s=NOW_S + second).after(late)
    assert not compensates(state_of(late, active_tool=ACTIVE), NOW_S + 9.0 + 1.6)


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        ("verified", "Set-up verified: at rest the readings fit"),
        ("not yet verified: fits at rest in 1 of 3 orientations", "1 of 3 orientations. Let the"),
        ("wrong: torques are in N.mm", "wrong: torques are in N.mm. Correct what"),
        ("not checked: no tool", "Set-up not checked: no tool."),
        ("", ""),
        ("of another {version}", ""),
    ],
)
def test_the_set_up_is_told_in_plain_words(setup, words):
    told = setup_sentence(state_of(gravcomp(OK, "compensating", setup=setup)), NOW_S)
    assert words in told and bool(words) is bool(told)


@pytest.mark.parametrize("one", PROGRAMS, ids=[one.node for one in PROGRAMS])
def test_without_any_node_each_card_says_how_to_start_it(one):
    words = words_of(SuiteState(), one, NOW_S)
    assert not words.running and "ros2 " in words.todo
    assert words.level is (STALE if one.needed else OK)
    if one.offers and not one.needed:
        there = SuiteState(available=frozenset({one.offers}))
        assert words_of(there, one, NOW_S).doing.startswith(f"{one.title} is there")


def test_other_nodes_and_those_of_another_arm_are_listed_by_their_own_message():
    own = report("left/gravcomp", OK, "compensating")
    another = report("right/gravcomp", ERROR, "bad_tool_file", message="cut off")
    state = state_of(own, another, namespace="left")
    assert words_of(state, role("gravcomp"), NOW_S).level is OK
    assert programs.others(state) == [another]
    assert programs.words_of_other(another, NOW_S).doing == "Cut off"
    assert programs.words_of_other(another, NOW_S + 10.0).level is STALE


GOOD = (
    report("sim_driver", OK, "running"),
    gravcomp(OK, "compensating", tool="pointer"),
    report("calibration", OK, "ready"),
)
FAILED = report("calibration", WARN, "failed")
BROKEN = report("deflection", ERROR, "bad_model_file")
NO_FIT = gravcomp(WARN, "does_not_fit", tool="pointer")
LATE = gravcomp(WARN, "late", tool="pointer")


def calibrating(**changes):
    return {BehaviourKind.CALIBRATE: Behaviour(1, BehaviourKind.CALIBRATE, "pointer", **changes)}


ENDED = calibrating(outcome=BehaviourOutcome("CANCELED", "canceled"))


@pytest.mark.parametrize(
    ("reports", "behaviours", "level", "words"),
    [
        (GOOD, {}, OK, "Compensates 'pointer'."),
        ((), {}, STALE, "No compensation: not running"),
        ((*GOOD, BROKEN, gravcomp(WARN, "disabled")), {}, WARN, "Compensation is off"),
        ((*GOOD, FAILED, BROKEN), {}, ERROR, "Deflection: No prediction"),
        ((*GOOD, NO_FIT, FAILED), {}, WARN, "does not fit"),
        # A calibration is done without the tool; when it has ended, that is a warning again.
        ((*GOOD, NO_FIT), calibrating(), OK, "not judged during a calibration"),
        ((*GOOD, NO_FIT), ENDED, WARN, "does not fit"),
        ((*GOOD, LATE), calibrating(), WARN, "late"),
    ],
)
def test_the_lamp_names_the_worst_and_what_stops_the_compensation_first(
    reports, behaviours, level, words
):
    found, text = overall(state_of(*reports, behaviours=behaviours), NOW_S)
    assert found is level and words in text
