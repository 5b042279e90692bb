# SPDX-License-Identifier: Apache-2.0
"""The header: the active tool, compensation, tare, the lamp; and how the page asks."""

import asyncio
from dataclasses import replace

import pytest
from fake_suite import ACTIVE, ALL, COMPENSATING, FakeSuite
from galen_panel.state.snapshot import NodeLevel
from page_user import on_page, page_test


@page_test()
async def test_it_shows_what_gravcomp_says(user, suite):
    assert "pointer" in user.text("active")
    assert "60.10 g" in user.text("active")
    assert user.text("enable") == "Compensation on"
    suite.put(active_tool=replace(ACTIVE, tool="", mass_kg=0.0, enabled=False))
    await user.until(lambda: "no tool" in user.text("active"))
    assert user.text("enable") == "Compensation off"
    assert user.get("enable").props["aria-checked"] == "false"
    suite.put(active_tool=replace(ACTIVE, file_state="changed"))
    await user.until(lambda: "has changed" in user.text("active"))


@page_test()
async def test_the_switch_asks_for_the_other_state_and_waits_for_gravcomp(user, suite):
    user.click("enable")
    await user.until(lambda: suite.calls == [("set_enabled", False)])
    assert user.text("enable") == "Compensation on", "clicked is not yet switched"
    suite.put(active_tool=replace(ACTIVE, enabled=False))
    await user.until(lambda: user.text("enable") == "Compensation off")
    user.click("enable")
    await user.until(lambda: suite.calls[-1] == ("set_enabled", True))


@pytest.mark.parametrize(
    ("active_tool", "level", "state"),
    [
        (replace(ACTIVE, tool=""), NodeLevel.WARN, "no_tool"),
        (replace(ACTIVE, tool=""), NodeLevel.OK, "compensating"),  # said a moment ago
        (ACTIVE, NodeLevel.ERROR, "stale_joints"),
    ],
)
@page_test()
async def test_the_switch_is_on_only_while_something_is_published(
    user, suite, active_tool, level, state
):
    assert "panel-switch-on" in user.get("enable").classes
    report = replace(COMPENSATING, level=level, values={"state": state})
    suite.put(active_tool=active_tool, nodes={"gravcomp": report})
    await user.until(lambda: user.text("enable") == "No compensation (switched on)")
    assert "panel-switch-on" not in user.get("enable").classes
    user.click("enable")
    await user.until(lambda: suite.calls == [("set_enabled", False)])


@page_test()
async def test_tare_says_what_it_takes_off(user, suite):
    assert user.text("tare-value") == "Tare: none."
    user.click("tare")
    await user.until(lambda: suite.calls == [("tare",)])
    suite.put(active_tool=replace(ACTIVE, tare=(0.03, 0.0, 0.04, 0.0, 1e-3, 0.0)))
    await user.until(lambda: user.text("tare-value") == "Tare: subtracts 50 mN, 1.0 mN·m.")


@page_test()
async def test_without_gravcomp_all_says_so(user, suite):
    suite.put(active_tool=None, available=frozenset(), tools=None)
    await user.until(lambda: not user.get("enable").enabled)
    assert user.text("enable") == "Compensation: unknown"
    assert "gravcomp is not running" in user.text("active")
    assert "gravcomp_node" in user.get("tare").props["title"]
    assert not user.get("tare").enabled
    assert "ros2 run galen_gravcomp gravcomp_node" in user.text("tools-note")
    suite.put(active_tool=ACTIVE, available=ALL)
    await user.until(lambda: user.get("enable").enabled and user.get("tare").enabled)
    assert "title" not in user.get("tare").props


class _Slow(FakeSuite):
    """Answers when it is let."""

    def __init__(self):
        super().__init__()
        self.free = asyncio.Event()

    async def _called(self, *call):
        self.calls.append(call)
        await self.free.wait()
        return self.answer


def test_two_clicks_ask_once_and_the_state_frees_nothing_that_waits():
    suite = _Slow()

    async def story(user):
        button = user.get("tare")
        user.click("tare")
        user.click("tare")
        await user.until(lambda: "loading" in button.props)
        assert button.enabled, "disabled, it would lose the keyboard's focus"
        suite.put(active_tool=None, available=frozenset())
        await user.until(lambda: not button.enabled)
        suite.put(active_tool=ACTIVE, available=ALL)
        await user.until(lambda: button.enabled)
        assert "loading" in button.props
        user.click("tare")
        suite.free.set()
        await user.until(lambda: "loading" not in button.props)
        assert suite.calls == [("tare",)]
        assert user.notices() == ["done"]
        user.click("tare")
        await user.until(lambda: suite.calls == [("tare",), ("tare",)])

    on_page(suite, story)


class _Failing(FakeSuite):
    async def tare(self):
        raise RuntimeError("a bug")


def test_a_bug_is_told_and_frees_the_button():
    suite = _Failing()

    async def story(user):
        user.click("tare")
        await user.until(lambda: user.notices())
        assert "a bug" in user.notices()[0]
        assert "loading" not in user.get("tare").props

    with pytest.raises(AssertionError, match="the panel failed to ask"):
        on_page(suite, story)
