"""Results and feedback of the three actions in words, without nodes."""

import math

import pytest
from galen_panel.messages.results import told
from galen_panel.ros.goal_kinds import KINDS, CalibrationGoals, CheckGoals, CollectionGoals, kind_of
from galen_panel.ros.thread import CallError
from galen_panel.snapshot import Asked, BehaviourKind, CalibrateGoal, CheckGoal, CollectGoal

from galen_msgs.action import CalibrateTool, CheckTool, CollectPushes


def test_every_state_of_every_action_has_words():
    for kind in KINDS:
        for state in kind.states:
            assert kind.phases[state] and kind.phase_text(state.name) == kind.phases[state]
        assert kind.phase_text("SOMETHING_NEW") == "something new"


def test_goals_go_to_their_behaviours():
    goals = (CalibrateGoal("pointer"), CheckGoal(), CollectGoal("monday", "pointer"))
    assert [kind_of(goal) for goal in goals] == list(BehaviourKind)
    assert [kind.kind for kind in KINDS] == list(BehaviourKind)


def test_goals_become_those_of_the_actions():
    goal = CalibrationGoals().request(CalibrateGoal("pointer", None, one_sweep=True, by_hand=True))
    assert (goal.tool, goal.one_sweep, goal.attach_by_service) == ("pointer", True, False)
    assert all(math.isnan(value) for value in goal.tip_m)
    assert CheckGoals().request(CheckGoal()).tool == ""
    assert CheckGoals().tool(CheckGoal(), "retractor") == "retractor"
    goal = CollectionGoals().request(CollectGoal("monday", "pointer", by_hand=False))
    assert (goal.name, goal.tool, goal.push_by_service) == ("monday", "pointer", True)
    with pytest.raises(CallError, match="three finite"):
        CalibrationGoals().request(CalibrateGoal("pointer", (math.inf, 0.0, 0.0)))


def test_a_check_tells_its_sentence_and_its_numbers():
    result = CheckTool.Result(
        tool="pointer", answer=CheckTool.Result.RETARE, text="tare it", poses_used=4
    )
    outcome = CheckGoals().outcome(result, "pointer", new=False)
    assert (outcome.error, outcome.text) == ("", "tare it")
    assert outcome.values["answer"] == CheckTool.Result.RETARE
    step = CheckGoals().step(
        CheckTool.Feedback(state=0, done=1, total=4, roll=math.nan, message="at 1")
    )
    assert (step.pose, step.phase, step.message) == (None, "MEASURE", "at 1")


def test_a_collection_tells_what_was_left_out_and_where_it_is():
    result = CollectPushes.Result(
        pushes=11, pushes_asked=12, directory="recordings/monday", left_out=["set 1: touched"]
    )
    outcome = CollectionGoals().outcome(result, "pointer", new=False)
    assert outcome.text == "11 of 12 pushes are recorded" and outcome.file == "recordings/monday"
    assert outcome.notes == ("left out: set 1: touched",)
    result.error_code, result.error_msg = CollectPushes.Result.OVERLOAD, "more than 20 N"
    outcome = CollectionGoals().outcome(result, "pointer", new=False)
    assert outcome.error == "OVERLOAD"
    assert "more than 20 N" in outcome.text and "recordings/monday" in outcome.text


def test_what_to_do_after_a_cancel_is_the_last_that_is_told():
    result = CalibrateTool.Result(error_code=CalibrateTool.Result.CANCELED)
    result.error_msg = "canceled; the tool is still off: put it on again"
    outcome = CalibrationGoals().outcome(result, "pointer", new=False)
    assert outcome.error == "CANCELED"
    assert told(outcome) == (
        "Not calibrated, and nothing is written: canceled; the tool is still off: put it on again."
    )


def test_what_a_newer_node_says_is_shown_all_the_same():
    outcome = CalibrationGoals().outcome(CalibrateTool.Result(error_code=77), "pointer", new=True)
    assert outcome.error == "CODE_77" and "CODE_77" in outcome.text
    step = CalibrationGoals().step(CalibrateTool.Feedback(state=42, roll=math.nan, message="hm"))
    assert step.phase == "" and CalibrationGoals().phase_text(step.phase) == ""


def test_only_where_a_tool_is_put_on_or_taken_off_a_person_is_asked():
    asked = {state.name: CalibrationGoals().asked(state.name) for state in CalibrationGoals.states}
    assert {name for name, value in asked.items() if value} == {"REMOVE_TOOL", "ATTACH_TOOL"}
    assert asked["REMOVE_TOOL"] is Asked.REMOVE_TOOL
    assert CheckGoals().asked("MEASURE") is None
