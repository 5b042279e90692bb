# SPDX-License-Identifier: Apache-2.0
"""Behaviours on the page: start, progress, what a person is asked, cancel, the outcome."""

from dataclasses import replace

import pytest
from fake_suite import ACTIVE, ALL, POINTER, RETRACTOR, FakeSuite
from galen_panel.state.snapshot import (
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    CallAnswer,
    Goal,
)
from nicegui import ui
from page_user import on_page, page_test

VALUES = {
    "mass_kg": 0.2, "mass_std_kg": 3e-5, "com_m": [0.07, -0.01, 0.055],
    "com_std_m": [2e-5, 2e-5, 3e-5], "rmse_force_n": [1e-3, 1e-3, 2e-3],
    "rmse_torque_nm": [3e-5, 3e-5, 3e-5], "poses_used": 55,
    "poses_rejected": ["tool/9: not still"],
    "model": "constant bias", "model_reason": "8 blocks: none is better",
}  # fmt: skip
CALIBRATING = Behaviour(
    7, BehaviourKind.CALIBRATE, "retractor", "sweep with tool", "at a pose", 12, 112
)
CALIBRATED = replace(
    CALIBRATING,
    outcome=BehaviourOutcome("", "it is calibrated", "retractor", "/tools/retractor.json", VALUES),
)
NEW = replace(CALIBRATED, outcome=replace(CALIBRATED.outcome, new=True))
CHECKED = Behaviour(8, BehaviourKind.CHECK, "pointer", total=6, done=6)


@page_test()
async def test_the_arm_is_not_moved_at_one_click(user, suite):
    asked = await user.answer("calibrate", "dialog-cancel")
    assert "Calibrate pointer?" in asked
    assert "about 3 min" in asked, "two sweeps of 102 s, as the node says"
    assert "area around the arm" in asked and "removed and put on" not in asked
    user.enter("calibrate-one-sweep", True)
    user.enter("calibrate-by-hand", True)
    asked = await user.answer("calibrate", "dialog-cancel")
    assert "about 2 min" in asked and "removed and put on" in asked
    user.enter("calibrate-hand-guided", True)
    asked = await user.answer("calibrate", "dialog-cancel")
    assert "The arm is not moved: turn the wrist" in asked
    assert suite.calls == []


@page_test()
async def test_what_began_while_the_question_was_open_is_told(user, suite):
    user.click("calibrate")
    await user.until(lambda: user.all("dialog-ok"))
    suite.put(behaviours={BehaviourKind.CHECK: replace(CHECKED, done=2)})
    await user.until(lambda: user.all("running"))
    user.click("dialog-ok")
    await user.until(lambda: user.notices())
    assert "Quick check of pointer is under way" in user.notices()[0]
    assert suite.calls == []


@page_test()
async def test_each_is_started_with_what_was_chosen(user, suite):
    await user.answer("calibrate")
    await user.until(lambda: suite.calls == [("start", Goal(BehaviourKind.CALIBRATE, "pointer"))])
    user.enter("calibrate-tool", "retractor")
    user.enter("calibrate-one-sweep", True)
    user.enter("calibrate-by-hand", True)
    await user.answer("calibrate")
    goal = Goal(BehaviourKind.CALIBRATE, "retractor", one_sweep=True, by_hand=True)
    assert not goal.hand_guided
    await user.until(lambda: suite.calls[1:] == [("start", goal)])
    user.click("check")
    await user.until(lambda: suite.calls[2:] == [("start", Goal(BehaviourKind.CHECK, ""))])
    user.click("collect")
    await user.until(lambda: user.get("collect-name").error)
    assert "maxlength" not in user.get("collect-name").props
    user.enter("collect-name", "x" * 300)
    user.click("collect")
    await user.until(lambda: "xxx" in (user.get("collect-name").error or ""))
    user.enter("collect-name", "monday")
    user.click("collect")
    goal = Goal(BehaviourKind.COLLECT, "pointer", name="monday", by_hand=True)
    await user.until(lambda: suite.calls[3:] == [("start", goal)])


@page_test(available=ALL - {"check_tool"})
async def test_a_node_that_is_absent_is_named_where_its_button_is(user, suite):
    assert not user.get("check").enabled
    assert "ros2 run galen_calibration_behavior calibration_node" in user.text("card-check")
    assert user.get("calibrate").enabled
    suite.put(available=ALL)
    await user.until(lambda: user.get("check").enabled)


@page_test()
async def test_progress_is_followed_and_cancel_is_there(user, suite):
    assert user.all("cancel") == []
    others = replace(CALIBRATING, ours=False)
    suite.put(behaviours={BehaviourKind.CALIBRATE: others})
    await user.until(lambda: user.all("cancel"))
    title = "Calibration of retractor (started elsewhere): sweep with tool"
    assert title in user.text("running")
    assert user.text("count") == "12 of 112 poses"
    assert user.all("calibrate") == [], "it can't be started twice"
    assert not user.get("check").enabled
    assert "Calibration of retractor is under way" in user.text("card-check")
    strip = user.get("running")
    suite.put(behaviours={BehaviourKind.CALIBRATE: replace(CALIBRATING, done=56)})
    await user.until(lambda: user.get("progress").value == pytest.approx(0.5))
    assert user.get("running") is strip, "another one would lose the focus"
    user.click("cancel")
    await user.until(lambda: suite.calls == [("cancel", BehaviourKind.CALIBRATE)])
    suite.put(behaviours={BehaviourKind.CALIBRATE: replace(CALIBRATING, canceling=True)})
    await user.until(lambda: user.text("cancel") == "Canceling")
    ended = replace(
        CALIBRATING, outcome=BehaviourOutcome("CANCELED", "it was canceled", "retractor")
    )
    suite.put(behaviours={BehaviourKind.CALIBRATE: ended})
    await user.until(lambda: user.all("outcome"))
    assert user.all("running") == []
    assert "Canceled · retractor" in user.text("outcome")
    assert user.all("keep") == []
    assert user.get("calibrate").enabled


@page_test(behaviours={BehaviourKind.CALIBRATE: replace(CALIBRATING, asked="REMOVE_TOOL")})
async def test_a_person_is_asked_and_answers(user, suite):
    assert user.text("asked") == "Take the tool off, then press."
    user.click("confirm")
    await user.until(lambda: suite.calls == [("confirm",)])
    suite.put(behaviours={BehaviourKind.CALIBRATE: replace(CALIBRATING, asked="ATTACH_TOOL")})
    await user.until(lambda: user.text("asked") == "Put retractor on, then press.")
    assert user.text("confirm") == "The tool is on"
    suite.put(behaviours={BehaviourKind.CALIBRATE: CALIBRATING})
    await user.until(lambda: not user.all("confirm"))


@page_test()
async def test_poses_that_were_not_still_are_told_while_it_runs(user, suite):
    reasons = tuple(f"tool/{number}: moved" for number in range(1, 8))
    suite.put(behaviours={BehaviourKind.CALIBRATE: replace(CALIBRATING, rejected=reasons)})
    await user.until(lambda: "tool/7: moved" in user.text("calibrate-rejected"))
    assert "and 3 before" in user.text("calibrate-rejected")
    suite.put(behaviours={BehaviourKind.CALIBRATE: CALIBRATED})
    await user.until(lambda: not user.all("calibrate-rejected"))


@page_test(behaviours={BehaviourKind.CALIBRATE: CALIBRATED})
async def test_a_calibration_is_shown_beside_the_old_one_and_kept(user, suite):
    await user.until(lambda: ("compare", "retractor") in suite.calls)
    await user.until(lambda: "+0.10 g" in user.text("beside"))
    assert "Residual of the averaged readings: 2.4 mN, 0.052 mN·m." in user.text("outcome")
    shown = user.text("outcome")
    assert "The load and a constant offset explain all poses." in shown
    assert "Model: constant bias - 8 blocks: none is better." in shown  # folded
    folded = [one for one in user.get("outcome").descendants() if isinstance(one, ui.expansion)]
    assert "1 not used" in [one.text for one in folded]
    user.click("keep")
    await user.until(lambda: ("activate", "retractor") in suite.calls)
    active_tool = replace(ACTIVE, tool="retractor", mass_kg=0.2, com_m=(0.07, -0.01, 0.055))
    suite.put(active_tool=active_tool)
    await user.until(lambda: user.text("fate") == "The new file is active.")
    assert not user.get("keep").enabled


@page_test(behaviours={BehaviourKind.CALIBRATE: NEW})
async def test_of_a_new_tool_all_that_was_found_is_shown(user, suite):
    await user.until(lambda: "no file before" in user.text("beside"))
    for part in ("200.00 ± 0.03 g", "70.00 ± 0.02 mm", "-10.00 ± 0.02 mm"):
        assert part in user.text("outcome"), part
    assert ("compare", "retractor") not in suite.calls


@pytest.mark.parametrize(
    ("ended", "call"), [(CALIBRATED, "revert_tool"), (NEW, "remove_tool")], ids=["old", "new"]
)
@page_test()
async def test_a_calibration_is_discarded_once(user, suite, ended, call):
    suite.put(behaviours={BehaviourKind.CALIBRATE: ended})
    await user.until(lambda: user.get("discard").enabled)
    await user.answer("discard")
    await user.until(lambda: (call, "retractor") in suite.calls)
    # The old file is back: going back again would bring the discarded one.
    suite.put(tools=(POINTER, replace(RETRACTOR, mass_kg=0.1999)))
    await user.until(lambda: not user.get("discard").enabled)
    assert not user.get("keep").enabled
    assert "another one by now" in user.text("fate")


def test_a_list_from_before_the_calibration_is_not_taken_for_a_discarded_file():
    suite = FakeSuite()
    suite.answer = CallAnswer(False, "gravcomp_node has not answered")
    suite.put(
        tools=(POINTER, replace(RETRACTOR, mass_kg=0.1999)),
        behaviours={BehaviourKind.CALIBRATE: CALIBRATED},
    )

    async def story(user):
        await user.until(lambda: user.notices())
        assert user.text("fate") == "Reading the new file."
        assert not user.get("discard").enabled
        suite.put(tools=(POINTER, RETRACTOR))
        await user.until(lambda: user.get("discard").enabled)

    on_page(suite, story)


@pytest.mark.parametrize(
    ("answer", "cause", "title"),
    [
        (0, 0, "Good"), (1, 1, "Tare it"), (2, 5, "calibrate again"), (2, 3, "another tool is on"),
        (3, 8, "check again"), (99, 0, "check again"), (None, 0, "check again"),
    ],
)  # fmt: skip
@page_test()
async def test_a_quick_check_says_what_to_do(user, suite, answer, cause, title):
    values = {"answer": answer, "cause": cause}
    outcome = BehaviourOutcome("", "so it is", "pointer", values=values)
    suite.put(behaviours={BehaviourKind.CHECK: replace(CHECKED, outcome=outcome)})
    await user.until(lambda: title in user.text("outcome"))
    assert "So it is." in user.text("outcome")
    user.click("outcome-close")
    await user.until(lambda: not user.all("outcome"))
