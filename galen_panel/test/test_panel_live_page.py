"""The live page without a browser: what is sent to it, when the streams are listened to."""

import asyncio
import csv
import io
import json
import time
from dataclasses import replace

import numpy as np
from fake_suite import ACTIVE, FakeSuite
from galen_panel.history import NS_PER_S
from galen_panel.page.live import live
from page_user import on_page

START_S = 1_000_000.0


class Shown:
    """The tab, and a browser that notes what it is sent and says that it has it."""

    def __init__(self, suite):
        self.suite = suite
        self.tab = True
        self.arrives = True
        self.patches, self.scripts, self.placements = [], [], []

    def build(self, page):
        live.build(page, lambda: self.tab)

    def listen(self, user):
        user.answers(r"galenPlots\.patch\(\d+, (.*)\)", self._patched)
        user.answers(r"galenPlots\.png\(\d+, (.*)\)", self._saved)
        user.answers(r"return runMethod\(\d+, \"run_method_on_component\", (.*)\)", self._placed)

    def _patched(self, match):
        self.patches.append(json.loads(match[1]))
        return self.arrives

    def _saved(self, match):
        self.scripts.append(match[1])
        return True

    def _placed(self, match):
        self.placements.append(json.loads(match[1])[2])
        return True


def on_live(story, seconds=30.0):
    suite = FakeSuite()
    if seconds:
        suite.stream(START_S, seconds)
    shown = Shown(suite)

    async def whole(user):
        shown.listen(user)
        await story(user, shown)

    on_page(suite, whole, shown.build)


def test_streams_are_listened_to_only_while_somebody_looks():
    async def story(user, shown):
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

    on_live(story)


def test_a_page_that_is_deleted_listens_no_more():
    shown = Shown(FakeSuite())

    async def story(user):
        await user.until(lambda: shown.suite.watching == 1)

    on_page(shown.suite, story, shown.build)
    assert shown.suite.watching == 0


def test_nothing_is_sent_while_the_tab_is_hidden():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        shown.tab = False
        await user.until(lambda: shown.suite.watching == 0)
        await asyncio.sleep(0.3)
        sent = len(shown.patches)
        shown.suite.stream(START_S + 30.0, 1.0)
        await asyncio.sleep(0.6)
        assert len(shown.patches) == sent

    on_live(story)


def test_first_all_of_the_window_then_only_what_is_new():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        first = shown.patches[0]
        assert first["span"] == 30.0
        assert first["option"]["xAxis"][0]["min"] == -30.0
        assert [stream["whole"] for stream in first["streams"]] == [True] * 3
        assert [len(stream["rows"][0]) for stream in first["streams"]] == [7, 7, 5]
        for stream in first["streams"]:
            assert 500 < len(stream["rows"]) <= 602
        shown.suite.stream(START_S + 30.0, 0.2)
        await user.until(lambda: len(shown.patches) > 1)
        patch = shown.patches[1]
        assert [stream["whole"] for stream in patch["streams"]] == [False] * 3
        assert all(0 < len(stream["rows"]) < 10 for stream in patch["streams"])
        assert "option" not in patch
        assert len(json.dumps(patch)) < 2000
        await asyncio.sleep(0.6)
        assert len(shown.patches) == 2, "nothing new, nothing sent"

    on_live(story)


def test_a_browser_that_lacks_what_came_before_is_sent_all_again():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        shown.arrives = False
        shown.suite.stream(START_S + 30.0, 0.2)
        await user.until(lambda: len(shown.patches) > 2)
        assert not shown.patches[1]["streams"][0]["whole"]
        assert shown.patches[2]["streams"][0]["whole"]
        shown.arrives = True
        count = len(shown.patches)
        await user.until(lambda: len(shown.patches) > count)
        assert shown.patches[-1]["streams"][0]["whole"]
        assert "option" in shown.patches[-1]

    on_live(story)


def test_numbers_are_the_signed_mean_of_the_last_two_seconds():
    async def story(user, shown):
        history = shown.suite.history
        end_s = START_S + 30.0
        stamps = ((end_s + np.arange(1, 1500) / 500.0) * 1e9).astype(np.int64)
        pushed = np.tile([-8.0, 0.5, 0.0, 0.0, 0.0, -0.25], (len(stamps), 1))
        history.compensated.append(stamps, pushed)
        history.raw.append(stamps, pushed + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        history.deflection.append(
            stamps, np.tile([-3e-4, 0.0, 4e-4, 0.0, 0.0, 0.0], (len(stamps), 1))
        )
        await user.until(lambda: user.text("mean-fx") == "-8.000")
        assert user.text("mean-raw-fx") == "raw -7.000"
        assert user.text("mean-fy") == "0.500"
        assert user.text("mean-fz") == "0.000"
        assert user.text("mean-tz") == "-250.0"
        assert user.text("mean-tip") == "0.500"

    on_live(story)


def test_it_says_what_does_not_come():
    async def story(user, shown):
        await user.until(lambda: "No wrench_raw" in user.text("silence"))
        shown.suite.put(active_tool=replace(ACTIVE, enabled=False))
        history = shown.suite.history

        async def raw_only():
            at_ns = int(START_S * NS_PER_S)
            while True:
                at_ns += NS_PER_S // 10
                history.raw.append(np.array([at_ns]), np.ones((1, 6)))
                await asyncio.sleep(0.05)

        task = asyncio.ensure_future(raw_only())
        await user.until(lambda: "compensation is off" in user.text("silence"))
        task.cancel()
        assert user.text("mean-fx") == "–"

    on_live(story, seconds=0.0)


def test_pause_holds_the_picture_and_zoom_shows_single_samples():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.click("pause")
        assert user.get("pause").props["aria-pressed"] == "true"
        await user.until(lambda: shown.patches[-1]["span"] == 120.0)
        assert shown.patches[-1]["option"]["xAxis"][0]["min"] == -120.0
        shown.suite.stream(START_S + 30.0, 0.5)
        await asyncio.sleep(0.5)
        count = len(shown.patches)
        user.trigger("plot", "chart:datazoom", {"start": 99.0, "end": 99.5})
        await user.until(lambda: len(shown.patches) > count)
        rows = np.array(shown.patches[-1]["streams"][0]["rows"])
        inside = rows[(rows[:, 0] >= -1200.0) & (rows[:, 0] < -600.0), 0]
        assert len(inside) == 300, "each sample of 0.6 s at 500 Hz"
        assert rows[-1, 0] == 0.0, "what came after the pause is not shown"
        user.click("pause")
        await user.until(lambda: shown.patches[-1]["span"] == 30.0)
        assert user.get("pause").props["aria-pressed"] == "false"

    on_live(story)


def test_a_zoom_that_is_nonsense_changes_nothing():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.click("pause")
        await user.until(lambda: shown.patches[-1]["span"] == 120.0)
        await asyncio.sleep(0.5)
        count = len(shown.patches)
        for arguments in (
            {"start": 50, "end": 10}, {"start": None, "end": 5}, {"start": "a", "end": "b"}, {}, 7,
            {"start": float("nan"), "end": 20}, {"start": -5, "end": 1e9},
        ):  # fmt: skip
            user.trigger("plot", "chart:datazoom", arguments)
        await asyncio.sleep(0.5)
        assert len(shown.patches) == count

    on_live(story)


def test_another_window_is_sent_whole():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.enter("window", 10)
        await user.until(lambda: shown.patches[-1]["span"] == 10.0)
        assert shown.patches[-1]["streams"][0]["whole"]
        assert min(row[0] for row in shown.patches[-1]["streams"][0]["rows"]) >= -10_001.0
        user.enter("window", 77)
        await asyncio.sleep(0.4)
        assert shown.patches[-1]["span"] == 10.0

    on_live(story)


def test_csv_has_every_sample_of_the_window():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.enter("window", 10)
        user.click("csv")
        await user.until(lambda: user.downloads())
        rows = list(csv.DictReader(io.StringIO(user.downloads()[0].decode())))
        assert len(rows) == 5001
        assert float(rows[-1]["stamp_s"]) - float(rows[0]["stamp_s"]) == 10.0
        newest = shown.suite.history.compensated.last(0.0).values[0]
        np.testing.assert_allclose(float(rows[-1]["compensated_tz_nm"]), newest[5], rtol=1e-6)
        assert sum(bool(row["deflection_x_m"]) for row in rows) == 1000

    on_live(story)


def test_png_is_asked_of_the_browser_by_a_name_with_the_date():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.click("png")
        await user.until(lambda: shown.scripts)
        year = time.strftime("%Y")
        assert json.loads(shown.scripts[0]).startswith(f"galen_plots_{year}-")
        assert json.loads(shown.scripts[0]).endswith(".png")

    on_live(story)


def test_the_arm_is_told_in_numbers_and_placed():
    async def story(user, shown):
        user.trigger("arm", "init")
        await user.until(lambda: shown.placements)
        placed = shown.placements[0]
        joints = shown.suite.history.joints.last(0.0).values[0]
        np.testing.assert_allclose(placed["straight/delta_platform"][:3], joints[:3], atol=1e-5)
        assert placed["bent/tool_tip"] is not None
        await user.until(lambda: user.text("arm-roll") != "–")
        assert user.text("arm-platform-z") == f"z {1e3 * joints[2]:.1f} mm"
        assert user.text("arm-roll") == f"{np.degrees(joints[3]):.2f}°"
        assert user.text("arm-deflection-size").endswith(" mm")

    on_live(story)


def test_the_factor_is_told_on_the_picture_and_bends_more():
    async def story(user, shown):
        user.trigger("arm", "init")
        assert user.text("factor") == "Bend × 100"

        def moved():
            straight, bent = (
                np.array(shown.placements[-1][f"{arm}/tool_tip"][:3])
                for arm in ("straight", "bent")
            )
            return np.linalg.norm(bent - straight)

        await user.until(lambda: shown.placements)
        before = moved()
        count = len(shown.placements)
        user.enter("exaggeration", 200)
        assert user.text("factor") == "Bend × 200"
        await user.until(lambda: len(shown.placements) > count)
        assert moved() > 1.5 * before
        user.enter("exaggeration", 1e9)
        assert user.text("factor") == "Bend × 200"

    on_live(story)


def test_another_tool_is_another_drawing():
    async def story(user, shown):
        user.trigger("arm", "init")
        await user.until(lambda: shown.placements)
        before = shown.placements[-1]["straight/tool_tip"][:3]
        shown.suite.put(active_tool=replace(ACTIVE, tip_m=(0.18, 0.01, 0.05)))
        await user.until(lambda: shown.placements[-1]["straight/tool_tip"][:3] != before)

    on_live(story)
