"""The live page without a browser: what is sent to it, when the streams are listened to."""

import asyncio
import csv
import io
import json

import numpy as np
import pytest
from fake_suite import FakeSuite
from galen_model.arm.galen import GALEN
from galen_model.rotation import quaternion_to_matrix
from galen_panel.page import live
from galen_panel.page.arm import FORCE_M_PER_N, parts, place
from page_user import on_page

START_S = 1_000_000.0


class Shown:
    """The tab, and a browser that notes what it is sent and says that it has it."""

    def __init__(self, suite):
        self.suite = suite
        self.tab = True
        self.arrives = True
        self.patches, self.placements = [], []

    def build(self, page):
        live.build(page, lambda: self.tab)

    def listen(self, user):
        user.answers(r"galenPlots\.patch\(\d+, (.*)\)", self._patched)
        user.answers(r"return runMethod\(\d+, \"run_method_on_component\", (.*)\)", self._placed)

    def _patched(self, match):
        self.patches.append(json.loads(match[1]))
        return self.arrives

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


def test_pause_holds_the_picture_through_another_window():
    async def story(user, shown):
        await user.until(lambda: shown.patches)
        user.click("pause")
        assert user.get("pause").props["aria-pressed"] == "true"
        shown.suite.stream(START_S + 30.0, 0.5)
        user.enter("window", 60)
        await user.until(lambda: shown.patches[-1]["span"] == 60.0)
        held = shown.patches[-1]["streams"][0]["rows"]
        assert held[-1][0] - held[0][0] < 30_001.0, "what came after the pause is not shown"
        user.click("pause")
        await user.until(lambda: len(shown.patches[-1]["streams"][0]["rows"]) > 0
                         and shown.patches[-1]["now"] == 0.0
                         and shown.patches[-1]["streams"][0]["rows"] != held)  # fmt: skip
        assert user.get("pause").props["aria-pressed"] == "false"

    on_live(story)


def test_the_arm_is_placed_bent_and_told_in_numbers():
    async def story(user, shown):
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

    on_live(story)


# Pictures of the arm, and what is missing, without a page

TIP, COM = np.array([0.15, 0.0, 0.05]), np.array([0.055, 0.002, 0.045])
JOINTS = np.array([0.03, -0.02, 0.42, 0.7, -0.3])
DEFLECTION = np.array([2e-2, -1e-2, 3e-2, 1e-2, 2e-2, -1e-2])
WRENCH = np.array([3.0, -2.0, 1.0, 0.0, 0.0, 0.0])


def ends(place):
    middle, axis = np.array(place[:3]), quaternion_to_matrix(place[3:7])[:, 2]
    return middle - axis * place[7] / 2.0, middle + axis * place[7] / 2.0


def test_the_chain_goes_from_the_base_to_the_tip_and_the_bent_one_to_the_displaced_tip():
    placed = place(GALEN, JOINTS, TIP, COM, DEFLECTION, WRENCH)
    assert {part["name"] for part in parts(GALEN)} == set(placed)
    rotation, sensor = GALEN.sensor_pose(JOINTS)
    _, tip = GALEN.tip_pose(JOINTS, TIP)
    np.testing.assert_allclose(ends(placed["straight/6"]), [sensor, tip], atol=2e-5)
    np.testing.assert_allclose(ends(placed["straight/0"])[0], 0.0, atol=2e-5)
    for piece in range(6):
        before, after = ends(placed[f"straight/{piece}"]), ends(placed[f"straight/{piece + 1}"])
        np.testing.assert_allclose(before[1], after[0], atol=4e-5)
    np.testing.assert_allclose(ends(placed["bent/6"])[1], tip + DEFLECTION[:3], atol=2e-5)
    np.testing.assert_allclose(placed["com"][:3], sensor + rotation @ COM, atol=1e-5)
    force = rotation @ WRENCH[:3]
    size = np.linalg.norm(force)
    np.testing.assert_allclose(
        quaternion_to_matrix(placed["force"][3:7])[:, 2], force / size, atol=1e-4
    )
    assert placed["force"][7] == pytest.approx(FORCE_M_PER_N * size, abs=1e-4)
    assert json.loads(json.dumps([parts(GALEN), placed]))


def test_what_is_not_known_is_not_drawn():
    placed = place(GALEN, GALEN.home, np.zeros(3), None, None, 0.01 * WRENCH)
    assert placed["force"] is None and placed["com"] is None
    assert {value for name, value in placed.items() if name.startswith("bent/")} == {None}
    assert placed["straight/6"] is None, "no tool"
