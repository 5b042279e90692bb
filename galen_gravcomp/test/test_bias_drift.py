# SPDX-License-Identifier: Apache-2.0
"""The sensor's bias drift: what is learned of it, and what never may be."""

import numpy as np
import pytest
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections import bias_drift as bias_drift_module
from galen_gravcomp.corrections.bias_drift import BiasDrift, BiasDriftState
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN
from untouched_arm import UntouchedArm, push, tool_file

FORCE_5N = 5.0 * np.array([0.6, 0.64, 0.48])


SLOW_RISES = [(0.0, 0.0), (0.0, 0.03), (1.0, 0.0), (60.0, 0.0)]


class Watched:
    """A bias drift with all that it took off."""

    def __init__(self, **arm):
        self.bias_drift = BiasDrift(enabled=True, arm=GALEN)
        self.taken = [np.zeros(6)]
        self.arm = UntouchedArm(self._take, **arm)

    def _take(self, stamp_ns, angles, wrench):
        self.bias_drift.push(stamp_ns, angles, wrench)
        self.taken.append(self.bias_drift.offset_at(stamp_ns))

    def change(self):
        """The largest change (6,) of what was taken off since the last call."""
        taken = np.array(self.taken)
        self.taken = self.taken[-1:]
        return np.abs(taken - taken[0]).max(axis=0)


@pytest.mark.slow
def test_drift_is_followed_without_a_jump():
    watched = Watched()
    arm = watched.arm
    arm.drift_per_h = np.array([0.3, -0.2, 0.1, 0.003, -0.002, 0.001])
    arm.hold(400.0)
    truth = arm.drift_per_h * arm.time_s / 3600.0
    assert watched.bias_drift.state is BiasDriftState.LEARNING
    # Best possible: the noise of 30 s of samples; what is left is the lag of half a minute.
    error = np.abs(watched.bias_drift.settled - truth)
    assert np.all(error < 0.15 * np.abs(truth) + np.repeat([0.002, 5e-5], 3))
    steps = np.abs(np.diff(watched.taken, axis=0)).max(axis=0)
    assert np.all(steps <= np.repeat([2e-5, 5e-7], 3))


@pytest.mark.parametrize(
    ("rise_s", "tremor"),
    [(10.0, 0.0), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW_RISES)],
)
def test_a_steady_push_of_a_minute_is_not_learned(rise_s, tremor):
    watched = Watched()
    watched.arm.hold(12.0)
    assert watched.bias_drift.state is BiasDriftState.LEARNING
    watched.change()
    rise = max(rise_s, 1e-9)
    watched.arm.hold(rise_s + 60.0, lambda t: push(FORCE_5N) * min(t / rise, 1.0), tremor)
    assert watched.bias_drift.state in (BiasDriftState.CONTACT, BiasDriftState.HELD)
    watched.arm.hold(5.0)
    change = watched.change()
    assert np.all(change < np.repeat([0.004, 1e-4], 3))  # asked for: 0.02 N
    assert watched.bias_drift.state is BiasDriftState.LEARNING


@pytest.mark.parametrize(
    ("force_n", "begins"),
    [
        (0.1, "at the start"),
        (5.0, "in motion"),
        (5.0, "in a tare"),
        pytest.param(5.0, "at the start", marks=pytest.mark.slow),
        pytest.param(0.1, "in motion", marks=pytest.mark.slow),
        pytest.param(0.3, "in a tare", marks=pytest.mark.slow),
    ],
)
def test_a_push_is_not_learned_as_a_whole_however_it_begins(force_n, begins):
    watched = Watched()
    extra = push(force_n * FORCE_5N / 5.0)
    arm, bias_drift = watched.arm, watched.bias_drift
    if begins != "at the start":
        arm.hold(8.0)
    if begins == "in motion":
        arm.move((0.5, 0.2), extra=extra)
    watched.change()
    if begins == "in a tare":  # half of it with the hand on, so it holds half the push
        arm.hold(0.5, extra)
        bias_drift.tared(bias_drift._newest_ns, (0.0, 0.0), extra / 2.0)
    arm.hold(60.0, extra)
    arm.hold(4.0)
    # The rate's limit alone would allow 0.015 N in this minute.
    assert np.all(watched.change()[:3] < 0.01)


def test_switching_off_ramps_also_after_a_pause_of_what_it_is_fed():
    """As where a cable's pull is not known: samples go out, the bias drift sees none."""
    bias_drift = BiasDrift(enabled=True, arm=GALEN)
    bias_drift._newest_ns = 1_000_000_000
    bias_drift._ramp.start(0, np.full(6, 0.1))
    period_ns = 10_000_000
    stamps_ns = range(2_000_000_000, 9_000_000_000, period_ns)
    taken = []
    for stamp_ns in stamps_ns:
        if stamp_ns == 5_000_000_000:
            bias_drift.set_enabled(False)
        taken.append(bias_drift.offset_at(stamp_ns))
    steps = np.abs(np.diff(taken, axis=0))
    assert steps.max() <= 1.01 * 1.5 * 0.1 * period_ns * 1e-9
    assert not taken[-1].any()


def test_no_gate_at_all_keeps_the_rate(monkeypatch):
    watched = Watched(rate_hz=20.0)
    watched.arm.hold(8.0)
    monkeypatch.setattr(bias_drift_module, "_FLOOR", np.full(6, np.inf))
    watched.change()
    watched.arm.hold(60.0, push(FORCE_5N))
    change = watched.change()[:3]
    assert np.all(change < 0.02)
    assert change.max() > 0.01  # so the gate was off indeed


@pytest.mark.slow
def test_an_error_of_the_calibration_is_no_bias_drift_while_the_arm_goes_around():
    watched = Watched()
    watched.arm.on = type(watched.arm.on)(0.205, watched.arm.on.com_m + [0.001, 0.0, -0.001])
    watched.arm.visit(50, hold_s=2.5)
    assert np.all(watched.change() < np.repeat([0.012, 3e-4], 3))
    assert watched.bias_drift.state in (BiasDriftState.LEARNING, BiasDriftState.HELD)


def test_limit_freezes_warns_and_a_tare_begins_anew(monkeypatch):
    monkeypatch.setattr(bias_drift_module, "LIMITS", np.repeat([0.01, 0.02], 3))
    watched = Watched(rate_hz=20.0)
    bias_drift = watched.bias_drift
    watched.arm.drift_per_h = np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    watched.arm.hold(150.0)
    assert bias_drift.state is BiasDriftState.LIMIT
    assert "fx" in bias_drift.trouble and "tare" in bias_drift.trouble
    assert 0.009 < bias_drift.settled[0] <= 0.01
    assert bias_drift.values()["bias_drift"] == "limit"
    watched.change()
    watched.arm.hold(20.0)
    assert not watched.change().any()
    stamp_ns = bias_drift._newest_ns
    bias_drift.tared(stamp_ns, (0.0, 0.0), watched.arm.left(watched.arm.pose))
    assert bias_drift.trouble == ""
    assert np.allclose(bias_drift.offset_at(stamp_ns + 2_000_000_000), 0.0)
    watched.arm.hold(10.0)
    assert bias_drift.state is BiasDriftState.LEARNING


@pytest.mark.slow
def test_a_tare_does_not_count_twice_and_nothing_jumps():
    compensator = Compensator(
        GravcompParameters(bias_drift=True, calibration_monitor=False), arm=GALEN
    )
    tool = tool_file()
    compensator.set_tool(tool)
    out, outcomes = [], []

    def take(stamp_ns, angles, left):
        reading = left + tool.predict(angles)
        compensator.push_joints(stamp_ns, angles)
        out.extend(result.wrench for result in compensator.push_wrench(stamp_ns, reading))

    arm = UntouchedArm(take, tool, noise=0.0)
    arm.drift_per_h = np.array([0.5, -0.5, 0.3, 0.004, 0.0, 0.0])
    arm.hold(90.0)
    bias_drift = compensator.bias_drift.settled.copy()
    assert np.abs(bias_drift[:3]).min() > 0.003
    arm.offset = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])  # zeroed elsewhere: what a tare is for
    compensator.start_tare(lambda _, offset: outcomes.append(offset))
    out.clear()
    arm.hold(0.6)
    before_n = out[10][2]
    arm.hold(2.0)
    assert outcomes[0] is not None
    truth = arm.left(arm.pose) + arm.drift_per_h * arm.time_s / 3600.0
    assert np.allclose(compensator.tare_offset, truth, atol=4e-3)
    assert np.all(np.abs(out[-1]) < np.repeat([0.006, 2e-4], 3))
    assert not compensator.bias_drift.settled.any()
    # A smoothstep's steepest, and the quantum.
    steps = np.abs(np.diff(out, axis=0))[:, 2]
    assert steps.max() <= 1.5 * before_n * arm.period_s + 0.0051
    arm.hold(60.0)
    assert np.all(np.abs(out[-1]) < np.repeat([0.012, 3e-4], 3))
