# SPDX-License-Identifier: Apache-2.0
"""The list of tools, and what is asked before a file changes."""

import math
from dataclasses import replace

from fake_suite import ACTIVE, ALL, DRIVER_READY, POINTER, RETRACTOR
from galen_panel.page.outcome import is_shown
from galen_panel.state.snapshot import BehaviourKind, Goal, ListedTool, QuantityDifference
from page_user import page_test


@page_test()
async def test_a_button_a_tool_puts_it_active(user, suite):
    text = user.text("tool-pointer")
    for part in ("60.10 ± 0.03 g", "55.0, 2.0, 45.0 mm", "2026-11-21 14:03 UTC", "active"):
        assert part in text, part
    assert "Residual 3.6 mN" in text
    assert "field 'load' is missing" in user.text("tool-drill")
    assert not user.get("tool-drill").enabled
    assert "active" not in user.text("tool-retractor")
    assert user.get("tool-pointer").props["aria-pressed"] == "true"
    user.click("tool-retractor")
    await user.until(lambda: suite.calls == [("activate", "retractor")])
    suite.put(
        tools=(replace(POINTER, active_tool=False), replace(RETRACTOR, active_tool=True)),
        active_tool=replace(ACTIVE, tool="retractor", calibrated_at=RETRACTOR.calibrated_at),
    )
    await user.until(lambda: "active" in user.text("tool-retractor"))
    assert "active" not in user.text("tool-pointer")
    user.click("no-tool")
    await user.until(lambda: suite.calls[-1] == ("activate", ""))


@page_test()
async def test_a_new_calibration_is_not_taken_for_the_one_that_is_compensated(user, suite):
    new = replace(POINTER, mass_kg=0.0647, calibrated_at="2026-11-23T08:00:00+00:00")
    suite.put(tools=(new, RETRACTOR))
    await user.until(lambda: "64.70" in user.text("tool-pointer"))
    text = user.text("tool-pointer")
    assert "active" not in text.splitlines()
    assert "not active yet" in text
    assert "Compensated now: 60.10 g, calibrated 2026-11-21 14:03 UTC" in text
    assert "Press to load this file" in text
    assert user.get("tool-pointer").props["aria-pressed"] == "false"
    assert not user.get("tool-pointer-remove").enabled
    user.click("tool-pointer")
    await user.until(lambda: suite.calls == [("activate", "pointer")])
    suite.put(active_tool=replace(ACTIVE, mass_kg=0.0647, calibrated_at=new.calibrated_at))
    await user.until(lambda: "active" in user.text("tool-pointer").splitlines())
    assert "Compensated now" not in user.text("tool-pointer")


@page_test()
async def test_a_file_that_was_changed_otherwise_is_not_active_either(user, suite):
    suite.put(active_tool=replace(ACTIVE, file_state="changed"))
    await user.until(lambda: "not active yet" in user.text("tool-pointer"))
    broken = ListedTool(
        "pointer", problem="pointer.json: field 'load' is missing", active_tool=True
    )
    suite.put(tools=(broken, RETRACTOR))
    await user.until(lambda: "is missing" in user.text("tool-pointer"))
    text = user.text("tool-pointer")
    assert "Compensated now: 60.10 g" in text and "Press" not in text


@page_test()
async def test_removing_is_asked_first(user, suite):
    assert not user.get("tool-pointer-remove").enabled, "it is active"
    await user.answer("tool-retractor-remove", "dialog-cancel")
    assert suite.calls == []
    user.click("tool-retractor-remove")
    await user.until(lambda: user.all("dialog-ok"))
    suite.put(tools=(POINTER,))  # its row goes while the question is open
    await user.until(lambda: not user.all("tool-retractor"))
    user.click("dialog-ok")
    await user.until(lambda: suite.calls == [("remove_tool", "retractor")])
    await user.until(lambda: user.notices() == ["done"])


@page_test()
async def test_going_back_shows_first_what_would_change(user, suite):
    assert user.all("tool-retractor-revert") == [], "it has none before"
    user.click("tool-pointer-revert")
    await user.until(lambda: user.all("dialog-ok"))
    assert suite.calls == [("compare", "pointer")]
    user.click("dialog-ok")
    await user.until(lambda: suite.calls[1:] == [("revert_tool", "pointer")])


@page_test()
async def test_a_new_tool_is_named_and_calibrated(user, suite):
    user.click("new-tool")
    await user.until(lambda: user.all("dialog-ok"))
    assert "about 3 min" in user.text("new-tool-before")
    assert "area around the arm" in user.text("new-tool-before")
    # A browser would cut what is longer, and say nothing.
    assert "maxlength" not in user.get("new-tool-name").props
    wrong = (("../up", "letters"), ("", "letters"), ("x" * 300, "1 to 64 letters"))
    for name, reason in (*wrong, ("pointer", "this name")):
        user.enter("new-tool-name", name)
        user.click("dialog-ok")
        field = user.get("new-tool-name")
        await user.until(lambda reason=reason, field=field: reason in (field.error or ""))
    assert suite.calls == []
    user.enter("new-tool-name", "drill_2")
    user.enter("new-tool-tip-x", 150.0)
    user.click("dialog-ok")
    await user.until(lambda: user.get("new-tool-tip-y").error)
    assert suite.calls == []
    user.enter("new-tool-tip-y", 0.0)
    user.enter("new-tool-tip-z", 50.0)
    user.click("dialog-ok")
    await user.until(lambda: suite.calls)
    ((call, goal),) = suite.calls
    assert call == "start"
    assert goal == Goal(BehaviourKind.CALIBRATE, "drill_2", tip_m=(0.15, 0.0, 0.05))
    await user.until(lambda: not user.all("dialog-ok"))


@page_test(available=ALL - {"attach_tool"})
async def test_where_nothing_takes_the_tool_off_a_person_does(user, suite):
    user.click("new-tool")
    await user.until(lambda: user.all("dialog-ok"))
    assert not user.get("new-tool-by-hand").enabled
    user.enter("new-tool-name", "drill_2")
    user.click("dialog-ok")
    goal = Goal(BehaviourKind.CALIBRATE, "drill_2", by_hand=True)
    await user.until(lambda: suite.calls == [("start", goal)])


@page_test(available=ALL - {"attach_tool"}, nodes={DRIVER_READY.name: DRIVER_READY})
async def test_a_driver_that_is_out_of_sight_for_a_moment_still_takes_the_tool_off(user, suite):
    user.click("new-tool")
    await user.until(lambda: user.all("dialog-ok"))
    assert user.get("new-tool-by-hand").enabled, "it may have been replaced by one that can't"
    user.enter("new-tool-name", "drill_2")
    user.click("dialog-ok")
    goal = Goal(BehaviourKind.CALIBRATE, "drill_2")
    await user.until(lambda: suite.calls == [("start", goal)])


MANY = tuple(ListedTool(f"tool_{i:02d}", 0.1, 1e-5, (0, 0, 0.05)) for i in range(20))


@page_test(tools=(*MANY, POINTER))
async def test_a_row_stays_while_the_list_changes_and_what_left_it_is_gone(user, suite):
    kept = user.get("tool-tool_19")
    suite.put(tools=(POINTER, *MANY[10:-1], replace(MANY[-1], mass_kg=0.3)))
    await user.until(lambda: "300.00" in user.text("tool-tool_19"))
    assert user.get("tool-tool_19") is kept, "another one would lose the focus"
    assert not user.all("tool-tool_00")


def test_a_comparison_shows_the_load_and_what_else_differs():
    same = "the same within 2 sigma"
    assert is_shown(QuantityDifference("mass", "kg", 0.1, 0.1, 1e-5, same))
    assert not is_shown(QuantityDifference("adapter_mass", "kg", 0.1, 0.1, 1e-5, same))
    assert is_shown(QuantityDifference("tip_x", "m", 0.1, 0.2, math.nan, "differs by 100 mm"))
