# SPDX-License-Identifier: Apache-2.0
"""The live page without a browser: what is sent to it, when the streams are listened to."""

import asyncio
import csv
import functools
import inspect
import io
import json
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from fake_suite import COMPENSATING, FakeSuite
from galen_model.arm.description import read_arm
from galen_panel.page import live
from galen_panel.state.shapes import draw
from page_user import on_page

START_S = 1_000_000.0


class Shown:
    """The tab, and a browser that notes what it is sent and says that it has it."""

    def __init__(self, suite):
        self.suite = suite
        self.tab = True
        self.arrives = True
        self.spans, self.shown, self.placements = [], [], []

    def build(self, page):
        live.build(page, lambda: self.tab)

    def listen(self, user):
        user.answers(r"galenPlots\.show\(\d+, (.*)\)", self._patched)
        user.answers(r"return runMethod\(\d+, \"run_method_on_component\", (.*)\)", self._placed)

    def _patched(self, match):
        option = json.loads(match[1])
        self.spans.append(-option["xAxis"][0]["min"])
        self.shown.append([stream["source"] for stream in option["dataset"]])
        return self.arrives

    def _placed(self, match):
        self.placements.append(json.loads(match[1])[2])
        return True


def live_test(story=None, **changes):
    """Make a test of a coroutine function `story(user, shown)`, on a live page with 30 s.

    changes: of the suite's state, before the page is drawn.
    """
    if story is None:
        return functools.partial(live_test, **changes)

    @functools.wraps(story)
    def test():
        suite = FakeSuite()
        suite.stream(START_S, 30.0)
        suite.put(**changes)
        shown = Shown(suite)

        async def whole(user):
            shown.listen(user)
            await story(user, shown)

        on_page(suite, whole, shown.build)

    test.__signature__ = inspect.Signature()
    return test


@live_test
async def test_streams_are_listened_to_only_while_somebody_looks(user, shown):
    await user.until(lambda: shown.suite.watching == 1)
    shown.tab = False
    await user.until(lambda: shown.suite.watching == 0)
    shown.tab = True
    await user.until(lambda: shown.suite.watching == 1)
    user.vanish()
    assert shown.suite.watching == 0
    await asyncio.sleep(0.5)
    assert shown.suite.watching == 0, "a browser that is gone must not listen again"
    await user.come_back()
    await user.until(lambda: shown.suite.watching == 1)


@live_test
async def test_the_set_up_s_verdict_is_above_the_plots(user, shown):
    assert user.text("setup") == ""
    verified = replace(COMPENSATING, values={"state": "compensating", "setup": "verified"})
    shown.suite.put(nodes={"gravcomp": verified})
    await user.until(lambda: user.text("setup").startswith("Set-up verified"))


@live_test
async def test_the_window_is_sent_where_something_is_new_and_again_where_it_did_not_arrive(
    user, shown
):
    await user.until(lambda: shown.shown)
    assert shown.spans == [30.0]
    assert [len(rows[0]) for rows in shown.shown[0]] == [7, 7, 5]
    assert all(500 < len(rows) <= 602 for rows in shown.shown[0])
    assert all(-30.0 <= rows[0][0] < -29.8 for rows in shown.shown[0])
    await asyncio.sleep(0.6)
    assert len(shown.shown) == 1, "nothing new, nothing sent"
    shown.arrives = False
    shown.suite.stream(START_S + 30.0, 0.2)
    await user.until(lambda: len(shown.shown) > 3)
    shown.arrives = True
    await asyncio.sleep(0.5)
    count = len(shown.shown)
    await asyncio.sleep(0.5)
    assert len(shown.shown) == count
    user.enter("window", 10)
    await user.until(lambda: shown.spans[-1] == 10.0)
    assert min(row[0] for row in shown.shown[-1][0]) >= -10.001
    user.enter("window", 77)
    await asyncio.sleep(0.4)
    assert shown.spans[-1] == 10.0


@live_test
async def test_numbers_are_the_signed_mean_of_the_last_two_seconds(user, shown):
    history = shown.suite.history
    end_s = START_S + 30.0
    stamps = ((end_s + np.arange(1, 1500) / 500.0) * 1e9).astype(np.int64)
    pushed = np.tile([-8.0, 0.5, 0.0, 0.0, 0.0, -0.25], (len(stamps), 1))
    history.compensated.append(stamps, pushed)
    history.raw.append(stamps, pushed + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    history.deflection.append(stamps, np.tile([-3e-4, 0.0, 4e-4, 0.0, 0.0, 0.0], (len(stamps), 1)))
    await user.until(lambda: user.text("mean-fx") == "-8.000")
    assert user.text("mean-raw-fx") == "raw -7.000"
    assert user.text("mean-fy") == "0.500"
    assert user.text("mean-fz") == "0.000"
    assert user.text("mean-tz") == "-250.0"
    assert user.text("mean-tip") == "0.500"


@live_test
async def test_csv_has_every_sample_of_the_window(user, shown):
    await user.until(lambda: shown.shown)
    user.enter("window", 10)
    user.click("csv")
    await user.until(lambda: user.downloads())
    rows = list(csv.DictReader(io.StringIO(user.downloads()[0].decode())))
    assert len(rows) == 5001
    assert float(rows[-1]["stamp_s"]) - float(rows[0]["stamp_s"]) == 10.0
    newest = shown.suite.history.compensated.last(0.0).values[0]
    np.testing.assert_allclose(float(rows[-1]["compensated_tz_nm"]), newest[5], rtol=1e-6)
    assert sum(bool(row["deflection_x_m"]) for row in rows) == 1000


@live_test
async def test_pause_holds_the_picture_through_another_window(user, shown):
    await user.until(lambda: shown.shown)
    user.click("pause")
    assert user.get("pause").props["aria-pressed"] == "true"
    shown.suite.stream(START_S + 30.0, 0.5)
    user.enter("window", 60)
    await user.until(lambda: shown.spans[-1] == 60.0)
    held = shown.shown[-1][0]
    assert held[-1][0] - held[0][0] < 30.001, "what came after the pause is not shown"
    user.click("pause")
    await user.until(lambda: shown.shown[-1][0][0][0] < -30.2)
    assert user.get("pause").props["aria-pressed"] == "false"


@live_test
async def test_the_arm_is_placed_bent_and_told_in_numbers(user, shown):
    user.trigger("arm", "init")
    await user.until(lambda: shown.placements)
    joints = shown.suite.history.joints.last(0.0).values[0]
    await user.until(lambda: user.text("arm-roll") != "–")
    assert user.text("arm-delta_z") == f"{1e3 * joints[2]:.1f} mm"
    assert user.text("arm-roll") == f"{np.degrees(joints[3]):.2f}°"
    assert " mm (" in user.text("arm-deflection")
    assert user.text("factor") == "Bend × 100"

    def moved():
        straight, bent = (
            np.array(shown.placements[-1][f"{arm}/6"][:3]) for arm in ("straight", "bent")
        )
        return np.linalg.norm(bent - straight)

    before, count = moved(), len(shown.placements)
    user.enter("exaggeration", 200)
    assert user.text("factor") == "Bend × 200"
    await user.until(lambda: len(shown.placements) > count)
    assert moved() > 1.5 * before
    user.enter("exaggeration", 1e9)
    assert user.text("factor") == "Bend × 200"


@live_test(drawing=None, arm_problem="No arm is shown: waiting for /robot_description")
async def test_an_arm_that_comes_later_is_shown_with_its_own_joints(user, shown):
    suite = shown.suite
    await user.until(lambda: shown.shown)
    assert user.text("arm-problem").startswith("No arm is shown: waiting")
    assert not user.all("arm")
    urdf = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
    odd = 'elbow a=b "c" <i>'
    arm = read_arm(urdf.replace('"elbow"', quoteattr(odd)))
    suite.history.follow(arm)
    suite.put(drawing=draw(arm), arm_problem="")
    suite.stream(START_S + 30.0, 0.1)
    joints = suite.history.joints.last(0.0).values[0]
    await user.until(lambda: user.text("arm-wrist_3") == f"{np.degrees(joints[5]):.2f}°")
    assert user.text(f"arm-{odd}") == f"{np.degrees(joints[2]):.2f}°"
    assert not user.all("arm-problem") and not user.all("arm-roll")
    user.trigger("arm", "init")
    await user.until(lambda: "straight/7" in (shown.placements or [{}])[-1])
