# SPDX-License-Identifier: Apache-2.0
"""The compensator's core: what comes out, what is rejected and why, tare, restarts."""

import itertools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from calibration_files import pointer
from galen_common.stream.samples import Notice, PairedWrench, Rejected, Rejection, Result
from galen_gravcomp.compensator import Compensator, TareRejectedError
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array

MS = 1_000_000
S = 1_000_000_000
START = 100 * S


TOOL = pointer(residual_offset=np.array([0.01, -0.02, 0.03, 1e-3, -2e-3, 3e-3]))
PUSH = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])


def loaded(**settings: object) -> Compensator:
    compensator = Compensator(GravcompParameters(**settings), arm=GALEN)  # type: ignore[arg-type]
    compensator.set_tool(TOOL)
    return compensator


def outputs(results: list[Result]) -> list[PairedWrench]:
    return [result for result in results if isinstance(result, PairedWrench)]


def reasons(results: list[Result]) -> list[Rejection]:
    return [result.reason for result in results if isinstance(result, Rejected)]


def balanced(compensator: Compensator) -> bool:
    """Every wrench ended in exactly one way."""
    ended = (
        compensator.compensated
        + sum(compensator.pairing.rejections.values())
        + compensator.pairing.waiting
    )
    return compensator.pairing.received == ended


class Rig:
    """A still or moving arm at 500 Hz that feeds a compensator."""

    def __init__(self, compensator: Compensator, start_ns: int = START) -> None:
        self.compensator = compensator
        self.stamp = start_ns
        self.roll, self.tilt = 0.2, -0.1
        self.touch: Array = np.zeros(6)

    def step(self, step_ns: int = 2 * MS) -> list[Result]:
        raw = TOOL.predict((self.roll, self.tilt)) + self.touch
        results = self.compensator.push_joints(self.stamp, (self.roll, self.tilt))
        results += self.compensator.push_wrench(self.stamp, raw, "ft_sensor")
        self.stamp += step_ns
        return results

    def steps(self, count: int) -> list[PairedWrench]:
        return list(itertools.chain.from_iterable(outputs(self.step()) for _ in range(count)))


# Compensation and interpolation


def ramp(stamp_ns: int) -> tuple[float, float]:
    t = (stamp_ns - START) * 1e-9
    return -0.5 + 0.8 * t, 0.4 - 0.6 * t


@pytest.mark.parametrize("wrench_offset_ns", [0, 300_000, 1_999_999])
@pytest.mark.parametrize("lag_samples", [0, 1, 9])
def test_moving_arm_uses_the_angles_of_the_stamp(wrench_offset_ns: int, lag_samples: int) -> None:
    """Joints and wrenches interleave; either may arrive late. The newest angles would be wrong."""
    compensator = loaded()
    events = [(START + i * 2 * MS, 0) for i in range(300)]
    events += [(START + i * 2 * MS + wrench_offset_ns, 1) for i in range(300)]
    lag_ns = {0: 2 * MS * lag_samples, 1: 0}
    delayed = sorted(events, key=lambda event: (event[0] + lag_ns[event[1]], event[1]))
    results: list[Result] = []
    for stamp, kind in delayed:
        if kind == 0:
            results += compensator.push_joints(stamp, ramp(stamp))
        else:
            results += compensator.push_wrench(
                stamp, TOOL.predict(np.stack(ramp(stamp), axis=-1)) + PUSH
            )
    got = outputs(results)
    count = 300 if wrench_offset_ns == 0 else 299  # the last one still waits
    assert [out.stamp_ns for out in got] == [
        START + i * 2 * MS + wrench_offset_ns for i in range(count)
    ]
    for out in got:
        np.testing.assert_allclose(out.wrench, PUSH, atol=1e-12)
    assert compensator.pairing.waiting == (0 if wrench_offset_ns == 0 else 1)
    assert not compensator.pairing.rejections and balanced(compensator)


def test_waits_no_longer_than_max_joint_age() -> None:
    compensator = loaded()
    compensator.push_joints(START, (0.0, 0.0))
    stamps = [START + i * MS for i in range(1, 51)]
    for stamp in stamps:
        assert compensator.push_wrench(stamp, PUSH) == []
    results = compensator.push_wrench(START + 51 * MS, PUSH)
    assert reasons(results) == [Rejection.STALE_JOINTS] * 51
    assert [result.stamp_ns for result in results] == [*stamps, START + 51 * MS]
    detail = results[0].detail  # type: ignore[union-attr]
    assert "51 ms behind" in detail and "max_joint_age_s" in detail
    assert compensator.pairing.waiting == 0 and balanced(compensator)


# Rejections


def test_no_tool() -> None:
    compensator = Compensator(arm=GALEN)
    compensator.push_joints(START, (0.0, 0.0))
    (result,) = compensator.push_wrench(START, PUSH)
    assert isinstance(result, Rejected) and result.reason is Rejection.NO_TOOL
    compensator.set_tool(None, "pointer.json: mass is negative")
    (result,) = compensator.push_wrench(START + MS, PUSH)
    assert isinstance(result, Rejected) and "mass is negative" in result.detail


def test_disabled() -> None:
    rig = Rig(loaded())
    assert len(rig.steps(3)) == 3
    assert rig.compensator.push_wrench(rig.stamp, PUSH) == []
    rig.stamp += 2 * MS
    assert reasons(rig.compensator.set_enabled(False)) == [Rejection.DISABLED]
    assert reasons(rig.step()) == [Rejection.DISABLED]
    rig.compensator.set_enabled(True)
    assert len(rig.steps(2)) == 2
    assert balanced(rig.compensator)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(6))
def test_nonfinite_wrench(bad: float, axis: int) -> None:
    rig = Rig(loaded())
    rig.step()
    rig.touch = np.zeros(6)
    rig.touch[axis] = bad
    (result,) = rig.step()
    assert isinstance(result, Rejected) and result.reason is Rejection.NONFINITE_WRENCH
    assert "not finite" in result.detail
    rig.touch = PUSH
    (out,) = rig.steps(1)
    np.testing.assert_allclose(out.wrench, PUSH, atol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nonfinite_joints_reject_the_wrenches_beside_them(bad: float) -> None:
    compensator = loaded()
    for i in range(10):
        tilt = bad if i == 5 else 0.0
        compensator.push_joints(START + i * 2 * MS, (0.0, tilt))
    got = [compensator.push_wrench(START + i * MS, PUSH) for i in range(1, 19)]
    rejected = [i + 1 for i, results in enumerate(got) if reasons(results)]
    assert rejected == [9, 10, 11]
    assert compensator.pairing.rejections == Counter({Rejection.NONFINITE_JOINTS: 3})
    assert compensator.pairing.notices[Notice.NONFINITE_JOINTS] == 1


@pytest.mark.parametrize("frame_id", ["base_link", ""])
def test_wrong_frame(frame_id: str) -> None:
    rig = Rig(loaded())
    rig.step()
    (result,) = rig.compensator.push_wrench(rig.stamp, PUSH, frame_id)
    assert isinstance(result, Rejected) and result.reason is Rejection.WRONG_FRAME
    assert f"'{frame_id}'" in result.detail and "ft_sensor" in result.detail


@pytest.mark.parametrize("reason", [Rejection.NO_JOINTS, Rejection.BAD_JOINTS])
def test_joints_that_never_came_or_were_unusable_are_the_reason(reason: Rejection) -> None:
    compensator = loaded()
    results: list[Result] = []
    for i in range(60):
        if reason is Rejection.BAD_JOINTS:
            compensator.pairing.push_bad_joints("joint state lacks roll, tilt; it has gripper")
        results += compensator.push_wrench(START + i * 2 * MS, PUSH)
    assert set(reasons(results)) == {reason} and not outputs(results)
    assert len(results) >= 25 and balanced(compensator)
    last = results[-1].detail  # type: ignore[union-attr]
    assert ("gripper" in last) == (reason is Rejection.BAD_JOINTS)
    compensator.push_joints(START + 120 * MS, (0.0, 0.0))
    assert len(outputs(compensator.push_wrench(START + 120 * MS, PUSH))) == 1


def test_gap_in_the_joints_is_not_bridged() -> None:
    compensator = loaded()
    compensator.push_joints(START, (0.0, 0.0))
    assert compensator.push_wrench(START + 30 * MS, PUSH) == []
    (result,) = compensator.push_joints(START + 51 * MS, (1.0, 0.0))
    assert isinstance(result, Rejected) and result.reason is Rejection.STALE_JOINTS
    assert compensator.push_wrench(START + 60 * MS, PUSH) == []
    assert len(outputs(compensator.push_joints(START + 70 * MS, (1.0, 0.0)))) == 1


def test_out_of_order_wrench_is_compensated_with_its_own_angles() -> None:
    compensator = loaded()
    for i in range(20):
        stamp = START + i * 2 * MS
        compensator.push_joints(stamp, ramp(stamp))
    assert len(outputs(compensator.push_wrench(START + 30 * MS, PUSH))) == 1
    late = START + 11 * MS
    (out,) = outputs(
        compensator.push_wrench(late, TOOL.predict(np.stack(ramp(late), axis=-1)) + PUSH)
    )
    assert out.stamp_ns == late
    np.testing.assert_allclose(out.wrench, PUSH, atol=1e-12)
    assert compensator.pairing.notices[Notice.OUT_OF_ORDER_WRENCH] == 1


def test_out_of_order_and_duplicate_joints_are_noticed() -> None:
    compensator = loaded()
    for stamp in (START, START + 4 * MS, START + 2 * MS, START + 4 * MS):
        compensator.push_joints(stamp, ramp(stamp))
    assert compensator.pairing.notices[Notice.OUT_OF_ORDER_JOINTS] == 1
    assert compensator.pairing.notices[Notice.DUPLICATE_JOINTS] == 1
    late = START + 3 * MS
    (out,) = outputs(compensator.push_wrench(late, TOOL.predict(np.stack(ramp(late), axis=-1))))
    np.testing.assert_allclose(out.wrench, np.zeros(6), atol=1e-12)


def test_suspicious_units_are_noticed_but_pass() -> None:
    rig = Rig(loaded())
    rig.touch = np.array([0, 0, 0, 0, 0, 3.5])
    assert len(rig.steps(1)) == 1
    assert rig.compensator.pairing.notices == Counter({Notice.BEYOND_RANGE: 1})
    rig.touch = np.array([0, 0, 0, 0, -100.0, 0])
    assert len(rig.steps(1)) == 1
    assert rig.compensator.pairing.notices[Notice.TORQUE_UNIT] == 1
    rig.roll = 45.0
    rig.steps(1)
    assert rig.compensator.pairing.notices[Notice.ANGLE_UNIT] == 1


# Tare

PEAK_RATE = 1.5
"""Of a smoothstep, over its mean rate."""
LEFT = np.array([0.5, -0.4, 0.3, 0.01, -0.02, 0.03])
QUICK_TARE = {"tare_window_s": 0.1, "tare_ramp_s": 0.1}


Answers = list[tuple[str, np.ndarray | None]]


def start_tare(compensator: Compensator) -> Answers:
    """Ask for a tare; returns where its answer comes."""
    answers: Answers = []
    compensator.start_tare(lambda *answer: answers.append(answer))
    return answers


def tare(rig: Rig) -> tuple[str, np.ndarray | None]:
    """Ask for a tare and run until it is answered."""
    answers = start_tare(rig.compensator)
    for _ in range(300):
        rig.step()
        if answers:
            (answer,) = answers
            return answer
    raise AssertionError("the tare was not answered within 0.6 s")


def test_tare_takes_off_what_is_left_without_a_jump() -> None:
    rig = Rig(loaded())
    rig.touch = LEFT
    series = rig.steps(10)
    answers = start_tare(rig.compensator)
    series += rig.steps(1000)
    ((message, offset),) = answers
    np.testing.assert_allclose(offset, LEFT, atol=1e-12)
    assert "0.500" in message
    wrenches = np.array([out.wrench for out in series])
    np.testing.assert_allclose(wrenches[:255], np.tile(LEFT, (255, 1)), atol=1e-12)
    np.testing.assert_allclose(wrenches[-1], np.zeros(6), atol=1e-12)
    bound = PEAK_RATE * np.abs(LEFT) * 0.002 / 1.0
    assert np.all(np.abs(np.diff(wrenches, axis=0)).max(axis=0) <= bound + 1e-12)
    # and it does move: about half is off after half the ramp
    halfway = wrenches[10 + 251 + 250]
    np.testing.assert_allclose(halfway, LEFT / 2, rtol=0.02)


ALTERNATING = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
CREEPING = np.array([0.0, 0.0, 0.0, 0.001, 0.0, 0.0])


@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (lambda i: {"roll": 0.2 + 1e-5 * i}, ["roll moved", "the limit is 0.001"]),
        (lambda i: {"tilt": 0.2 - 1e-5 * i}, ["tilt moved", "the limit is 0.001"]),
        (lambda i: {"touch": ALTERNATING * (-1) ** i}, ["force was not still", "limit is 0.3"]),
        (lambda i: {"touch": CREEPING * i}, ["torque was not still", "the limit is 0.02"]),
        (lambda _: {"touch": np.array([3, 4, 1, 0, 0, 0])}, ["5.1 N", "tare_max_force_n"]),
        (lambda _: {"touch": np.array([0, 0, 0, 0.3, 0.4, 0.1])}, ["0.51 N.m", "max_torque_nm"]),
    ],
)
def test_tare_is_rejected(happens: Callable[[int], dict], words: list[str]) -> None:
    rig = Rig(loaded())
    answers = start_tare(rig.compensator)
    for i in range(300):
        vars(rig).update(happens(i))
        rig.step()
    ((message, offset),) = answers
    assert offset is None and all(word in message for word in words)
    np.testing.assert_array_equal(rig.compensator.tare_offset, np.zeros(6))
    rig.touch = PUSH
    rig.steps(1)
    np.testing.assert_allclose(rig.steps(1)[0].wrench, PUSH, atol=1e-12)


def test_second_tare_starts_from_the_offset_active() -> None:
    rig = Rig(loaded(tare_window_s=0.1, tare_ramp_s=1.0))
    rig.touch = LEFT
    series: list[PairedWrench] = []
    for touch in (LEFT, 2 * LEFT):
        before = rig.compensator.compensated
        rig.touch = touch
        answers = start_tare(rig.compensator)
        part = rig.steps(200)  # the second request comes while the first ramp runs
        ((_, offset),) = answers
        assert offset is not None and rig.compensator.compensated == before + 200
        series += part
    series += rig.steps(600)
    wrenches = np.array([out.wrench for out in series])
    steps = np.abs(np.diff(wrenches, axis=0))
    steps[199] = 0.0  # here the touch itself jumped
    bound = PEAK_RATE * np.abs(2 * LEFT) * 0.002
    assert np.all(steps.max(axis=0) <= bound + 1e-12)
    np.testing.assert_allclose(wrenches[-1], np.zeros(6), atol=1e-12)
    np.testing.assert_allclose(rig.compensator.tare_offset, 2 * LEFT, atol=1e-12)


def test_tare_that_cannot_start() -> None:
    compensator = Compensator(arm=GALEN)
    with pytest.raises(TareRejectedError, match="no tool"):
        start_tare(compensator)
    compensator.set_tool(TOOL)
    compensator.set_enabled(False)
    with pytest.raises(TareRejectedError, match="switched off"):
        start_tare(compensator)
    compensator.set_enabled(True)
    start_tare(compensator)
    with pytest.raises(TareRejectedError, match="already running"):
        start_tare(compensator)


@pytest.mark.parametrize(
    ("event", "word"),
    [
        (lambda c: c.set_enabled(False), "switched off"),
        (lambda c: c.set_tool(pointer("retractor", 0.2)), "tool was changed"),
        (lambda c: c.pairing.restart("driver restarted: test"), "restarted"),
    ],
)
def test_running_tare_is_answered_when_it_cannot_end(
    event: Callable[[Compensator], object], word: str
) -> None:
    rig = Rig(loaded())
    rig.touch = LEFT
    answers = start_tare(rig.compensator)
    rig.steps(50)
    event(rig.compensator)
    rig.steps(600)
    ((message, offset),) = answers
    assert offset is None and word in message
    np.testing.assert_array_equal(rig.compensator.tare_offset, np.zeros(6))


@pytest.mark.parametrize("change", ["another tool", "off and on"])
def test_a_tool_change_drops_the_tare_and_off_and_on_does_not(change: str) -> None:
    rig = Rig(loaded(**QUICK_TARE))
    rig.touch = LEFT
    assert tare(rig)[1] is not None
    rig.steps(60)
    if change == "another tool":
        rig.compensator.set_tool(replace(TOOL))
    else:
        rig.compensator.set_enabled(False)
        rig.steps(10)
        rig.compensator.set_enabled(True)
    (out,) = rig.steps(1)
    left = LEFT if change == "another tool" else np.zeros(6)
    np.testing.assert_allclose(out.wrench, left, atol=1e-12)


# Restarts


@pytest.mark.parametrize(
    "jump_ns",
    [
        pytest.param(-50 * S, id="stamps jump back"),
        pytest.param(-60 * MS, id="stamps jump back a little"),
        pytest.param(3 * S, id="stamps jump ahead"),
    ],
)
@pytest.mark.parametrize("first", ["joints", "wrench"])
def test_nothing_leaks_across_a_restart(jump_ns: int, first: str) -> None:
    """New joints, no old tare, no waiting wrench: also where the new stamps fall among the old."""
    why: list[str] = []
    compensator = Compensator(GravcompParameters(**QUICK_TARE), why.append, arm=GALEN)
    compensator.set_tool(TOOL)
    rig = Rig(compensator)
    rig.touch = LEFT
    rig.steps(200)
    assert tare(rig)[1] is not None
    rig.steps(60)
    compensator.push_wrench(rig.stamp, PUSH)  # waits for joints that never come
    new_start = rig.stamp + jump_ns
    new_roll, new_tilt = -1.1, 0.7

    results: list[Result] = []
    for i in range(30):
        stamp = new_start + i * 2 * MS
        raw = TOOL.predict(np.stack([new_roll, new_tilt], axis=-1)) + PUSH
        feed = [
            lambda s=stamp: compensator.push_joints(s, (new_roll, new_tilt)),
            lambda s=stamp, r=raw: compensator.push_wrench(s + MS, r, "ft_sensor"),
        ]
        for push in feed if first == "joints" else reversed(feed):
            results += push()
    assert len(why) == 1 and "driver restarted" in why[0]
    assert compensator.pairing.notices[Notice.RESTART] == 1
    assert compensator.pairing.rejections[Rejection.RESTART] == 1
    np.testing.assert_array_equal(compensator.tare_offset, np.zeros(6))
    got = outputs(results)
    assert len(got) >= 28
    for out in got:
        assert new_start <= out.stamp_ns
        np.testing.assert_allclose(out.wrench, PUSH, atol=1e-12)
    assert balanced(compensator)
