# SPDX-License-Identifier: Apache-2.0
"""Results and feedback of the three actions in words, without nodes."""

import math

import pytest
from galen_model.files.calibration_file import ToolNameError
from galen_panel.page.outcome import sentence_of
from galen_panel.ros.goal_kinds import KINDS, rejected_pose
from galen_panel.ros.thread import CallError
from galen_panel.state.snapshot import BehaviourKind, Goal

from galen_msgs.action import CalibrateTool, CheckTool, CollectPushes

CALIBRATE, CHECK, COLLECT = KINDS


def goal(kind, *args, **options):
    return Goal(kind.kind, *args, **options)


def test_every_state_of_every_action_has_words():
    assert [kind.kind for kind in KINDS] == list(BehaviourKind)
    for kind in KINDS:
        for state in kind.states:
            assert kind.phases[state] and kind.phase_text(state.name) == kind.phases[state]


def test_goals_become_those_of_the_actions():
    request = CALIBRATE.request(goal(CALIBRATE, "pointer", one_sweep=True, by_hand=True))
    assert (request.tool, request.one_sweep, request.attach_by_service) == ("pointer", True, False)
    assert all(math.isnan(value) for value in request.tip_m)
    request = CALIBRATE.request(goal(CALIBRATE, "pointer", hand_guided=True))
    assert (request.by_hand, request.attach_by_service) == (True, False)
    assert CHECK.request(goal(CHECK)).tool == ""
    request = COLLECT.request(goal(COLLECT, "pointer", name="monday"))
    assert (request.name, request.tool, request.push_by_service) == ("monday", "pointer", True)


@pytest.mark.parametrize("tool", ["../pointer", "\ud800"])
def test_a_tool_that_no_file_can_have_as_its_name_is_no_goal(tool):
    with pytest.raises(ToolNameError):
        CALIBRATE.request(goal(CALIBRATE, tool))


@pytest.mark.parametrize("tip_m", [(math.inf, 0.0, 0.0), (0.0, math.nan, 0.0), (0.0, 0.0)])
def test_a_tip_has_three_finite_numbers(tip_m):
    with pytest.raises(CallError, match="three finite"):
        CALIBRATE.request(goal(CALIBRATE, "pointer", tip_m=tip_m))


def test_a_check_tells_its_sentence_and_its_numbers():
    result = CheckTool.Result(answer=CheckTool.Result.RETARE, text="tare it")
    outcome = CHECK.outcome(result, "pointer", new=False)
    assert (outcome.error, outcome.text) == ("", "tare it")
    assert outcome.values["answer"] == CheckTool.Result.RETARE


def test_a_collection_tells_what_was_left_out_and_where_it_is():
    result = CollectPushes.Result(
        pushes=11, pushes_asked=12, directory="recordings/monday", left_out=["set 1: touched"]
    )
    outcome = COLLECT.outcome(result, "pointer", new=False)
    assert outcome.text == "11 of 12 pushes are recorded" and outcome.file == "recordings/monday"
    assert outcome.values["left_out"] == ["set 1: touched"]
    result.error_code, result.error_msg = CollectPushes.Result.OVERLOAD, "more than 20 N"
    outcome = COLLECT.outcome(result, "pointer", new=False)
    assert outcome.error == "OVERLOAD"
    assert "more than 20 N" in outcome.text and outcome.file == "recordings/monday"


def test_what_to_do_after_a_cancel_is_the_last_that_is_told():
    result = CalibrateTool.Result(error_code=CalibrateTool.Result.CANCELED)
    result.error_msg = "canceled; the tool is still off: put it on again"
    outcome = CALIBRATE.outcome(result, "pointer", new=False)
    assert outcome.error == "CANCELED"
    assert sentence_of(outcome) == (
        "Not calibrated, and nothing is written: canceled; the tool is still off: put it on again."
    )


def test_what_a_newer_node_says_is_shown_all_the_same():
    outcome = CALIBRATE.outcome(CalibrateTool.Result(error_code=77), "pointer", new=True)
    assert outcome.error == "CODE_77" and "CODE_77" in outcome.text
    assert CALIBRATE.state_name(42) == "" and CALIBRATE.phase_text("") == ""


def test_only_a_pose_that_was_not_still_is_rejected():
    feedback = CalibrateTool.Feedback(state=3, angles=[0.1, 0.0], message="bare/1: moved")
    assert rejected_pose(feedback) == "bare/1: moved"
    feedback.accepted = True
    assert rejected_pose(feedback) == ""
    assert rejected_pose(CalibrateTool.Feedback(state=3, message="hm")) == ""
    assert rejected_pose(CollectPushes.Feedback(message="push")) == ""


def test_only_where_a_tool_is_put_on_or_taken_off_a_person_is_asked():
    asked = {state.name: CALIBRATE.asked(state.name) for state in CALIBRATE.states}
    assert {value for value in asked.values() if value} == {"REMOVE_TOOL", "ATTACH_TOOL"}
    assert CHECK.asked("MEASURE") is None
