# SPDX-License-Identifier: Apache-2.0
"""The guide: which step is next, and what its button does."""

from dataclasses import replace

import pytest
from fake_suite import (
    ACTIVE,
    ALL,
    BROKEN,
    CALIBRATION_READY,
    COMPENSATING,
    DRIVER_READY,
    POINTER,
    FakeSuite,
)
from galen_model.load.verdict import CheckAnswer
from galen_panel.messages.steps import current, steps
from galen_panel.page import guide
from galen_panel.state.snapshot import (
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    Goal,
    NodeLevel,
    SuiteState,
)
from page_user import page_test

NAMES = ("Connect", "Check", "Calibrate", "Verify", "Use")
GOOD = Behaviour(
    3, BehaviourKind.CHECK, "pointer",
    outcome=BehaviourOutcome("", "good", "pointer", values={"answer": CheckAnswer.GOOD}),
)  # fmt: skip
NO_TOOL = replace(COMPENSATING, level=NodeLevel.WARN, values={"state": "no_tool"})


def state_of(**changes):
    return replace(FakeSuite().state, **changes)


def reports(gravcomp):
    return {one.name: one for one in (gravcomp, CALIBRATION_READY)}


def next_step(state):
    found = steps(state, 0.0)
    assert tuple(step.name for step in found) == NAMES
    return found[min(current(found), len(found) - 1)]


def test_a_first_visit_names_all_that_is_missing_with_the_namespace():
    step = next_step(SuiteState(namespace="left"))
    assert step.name == "Connect"
    assert step.doing == "Missing: driver, compensation, calibration."
    for program in (
        "galen_sim_driver sim_driver_node",
        "galen_gravcomp gravcomp_node",
        "galen_calibration_behavior calibration_node",
    ):
        assert f"ros2 run {program} --ros-args -r __ns:=/left" in step.todo


def test_who_reports_but_cannot_be_called_yet_is_not_connected():
    nodes = reports(COMPENSATING) | {DRIVER_READY.name: DRIVER_READY}
    step = next_step(state_of(nodes=nodes, available=ALL - {"attach_tool"}))
    assert (step.name, step.doing) == ("Connect", "Not to be called yet: driver.")
    assert step.todo
    assert next_step(state_of(nodes=nodes)).name != "Connect"
    values = {**COMPENSATING.values, "wrench_raw_publisher_nodes": "/ur"}
    nodes = reports(replace(COMPENSATING, values=values))
    state = state_of(nodes=nodes, available=ALL - {"attach_tool"})
    assert next_step(state).name != "Connect", "a driver of somebody else has no such service"


@pytest.mark.parametrize("trouble", ["silent", "waiting", "stale_joints", "wrong_frame"])
def test_a_stream_that_does_not_come_holds_the_check(trouble):
    report = replace(COMPENSATING, level=NodeLevel.ERROR, values={"state": trouble})
    step = next_step(state_of(nodes=reports(report)))
    assert step.name == "Check"
    assert step.todo


def test_without_a_calibration_that_can_be_used_the_next_step_is_to_calibrate():
    active = replace(ACTIVE, tool="")
    state = state_of(tools=(BROKEN,), active_tool=active, nodes=reports(NO_TOOL))
    assert next_step(state).name == "Calibrate"
    failed = BehaviourOutcome("MOTION_TIMEOUT", "roll did not arrive")
    calibration = Behaviour(1, BehaviourKind.CALIBRATE, "x", outcome=failed)
    state = replace(state, behaviours={calibration.kind: calibration})
    assert "roll did not arrive" in next_step(state).doing.lower()


def test_under_way_it_says_keep_off_or_what_it_waits_for():
    calibration = Behaviour(1, BehaviourKind.CALIBRATE, "pointer")
    found = {one: replace(calibration, asked=one) for one in (None, "REMOVE_TOOL", "ATTACH_TOOL")}
    todo = {
        one: next_step(state_of(behaviours={behaviour.kind: behaviour})).todo
        for one, behaviour in found.items()
    }
    assert "Keep off" in todo[None]
    assert "Take the tool off" in todo["REMOVE_TOOL"]
    assert "Put pointer on" in todo["ATTACH_TOOL"]


def test_a_check_that_was_not_good_verifies_nothing():
    assert next_step(state_of()).name == "Verify"
    bad = replace(GOOD.outcome, values={"answer": CheckAnswer.RECALIBRATE}, text="another load")
    checked = {BehaviourKind.CHECK: replace(GOOD, outcome=bad)}
    assert "another load" in next_step(state_of(behaviours=checked)).doing.lower()
    checked = {BehaviourKind.CHECK: GOOD}
    assert current(steps(state_of(behaviours=checked), 0.0)) == len(NAMES)


def test_what_is_not_published_is_not_in_use():
    state = state_of(
        behaviours={BehaviourKind.CHECK: GOOD},
        active_tool=replace(ACTIVE, tool=""),
        nodes=reports(NO_TOOL),
    )
    step = next_step(state)
    assert (step.name, step.done) == ("Use", False)


@page_test(guide.build, available=ALL - {"check_tool"})
async def test_the_check_starts_once_its_node_is_there_and_the_area_is_said_to_be_clear(
    user, suite
):
    await user.until(lambda: not user.get("step-4-go").enabled)
    suite.put(available=ALL)
    await user.until(lambda: user.get("step-4-go").enabled)
    assert user.all("step-3-go") == [], "a step that is done has no button"
    await user.answer("step-4-go")
    await user.until(lambda: suite.calls == [("start", Goal(BehaviourKind.CHECK, "pointer"))])


@page_test(
    guide.build,
    behaviours={BehaviourKind.CHECK: GOOD},
    tools=(replace(POINTER, active_tool=False),),
    active_tool=replace(ACTIVE, tool=""),
    nodes=reports(NO_TOOL),
)
async def test_the_last_step_activates_the_tool_that_was_calibrated(user, suite):
    user.click("step-5-go")
    await user.until(lambda: suite.calls == [("activate", "pointer")])
    suite.put(active_tool=ACTIVE, nodes=reports(COMPENSATING))
    await user.until(lambda: "5 of 5" in user.get("guide").text)
    await user.until(lambda: not user.get("guide").value)
