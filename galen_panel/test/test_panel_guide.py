# SPDX-License-Identifier: Apache-2.0
"""The guide: which step is next, and what its button does."""

from dataclasses import replace

import pytest
from fake_suite import ACTIVE, ALL, BROKEN, CALIBRATION_READY, COMPENSATING, POINTER, FakeSuite
from galen_model.evidence.verdict import CheckAnswer
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
from page_user import on_page

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
    for command in (
        "ros2 run galen_sim_driver sim_driver_node --ros-args -r __ns:=/left",
        "ros2 run galen_gravcomp gravcomp_node --ros-args -r __ns:=/left",
        "ros2 run galen_calibration_behavior calibration_node --ros-args -r __ns:=/left",
    ):
        assert command in step.todo


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
    behaviours = {
        BehaviourKind.CALIBRATE: Behaviour(1, BehaviourKind.CALIBRATE, "x", outcome=failed)
    }
    assert "roll did not arrive" in next_step(replace(state, behaviours=behaviours)).doing.lower()


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


def on_guide(story, **changes):
    suite = FakeSuite()
    suite.put(**changes)
    on_page(suite, lambda user: story(user, suite), guide.build)


def test_the_check_starts_once_the_area_is_said_to_be_clear():
    async def story(user, suite):
        assert user.all("step-3-go") == [], "a step that is done has no button"
        user.click("step-4-go")
        await user.until(lambda: user.all("dialog-ok"))
        assert suite.calls == []
        user.click("dialog-ok")
        goal = Goal(BehaviourKind.CHECK, "pointer")
        await user.until(lambda: suite.calls == [("start", goal)])

    on_guide(story)


def test_the_last_step_activates_the_tool_that_was_calibrated():
    async def story(user, suite):
        user.click("step-5-go")
        await user.until(lambda: suite.calls == [("activate", "pointer")])
        suite.put(active_tool=ACTIVE, nodes=reports(COMPENSATING))
        await user.until(lambda: "5 of 5" in user.get("guide").text)
        await user.until(lambda: not user.get("guide").value)

    on_guide(
        story,
        behaviours={BehaviourKind.CHECK: GOOD},
        tools=(replace(POINTER, active_tool=False),),
        active_tool=replace(ACTIVE, tool=""),
        nodes=reports(NO_TOOL),
    )


def test_a_button_whose_node_is_absent_says_so():
    async def story(user, suite):
        await user.until(lambda: not user.get("step-4-go").enabled)

    on_guide(story, available=ALL - {"check_tool"})
