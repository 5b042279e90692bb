# SPDX-License-Identifier: Apache-2.0
"""The deflector without ROS: the model's own numbers, and when it keeps silent or forgets."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_made_model import made_model, offline
from deflection_synthetic import TIP_M
from galen_common.stream.monitor import NOTICE_HOLD_S, Severity
from galen_common.stream.samples import Rejected, Rejection
from galen_deflection.deflector import (
    Deflected,
    DeflectionParameters,
    Deflector,
    GravcompState,
    ModelRejection,
    corrected_tip,
)
from galen_deflection.monitor import DeflectorMonitor
from galen_model.arm.galen import GALEN
from galen_model.load.model import TOOLS
from galen_model.registration import Transform
from galen_model.rotation import quaternion_to_matrix

MS = 1_000_000
START = 100_000 * MS
HOME = (0.0, 0.0, 0.408, 0.1, -0.2)
PUSH = np.array([4.0, -3.0, 2.0, 0.3, -0.2, 0.1])
MODEL = made_model()


class Rig:
    """A deflector, and what came out of it."""

    def __init__(self, model=MODEL, **settings):
        self.forgotten = []
        self.deflector = Deflector(
            DeflectionParameters(**settings), on_forgotten=self.forgotten.append, arm=GALEN
        )
        self.deflector.set_model(model)
        self.results = []
        self.stamp = START

    def step(self, wrench=PUSH, joints=HOME, frame="ft_sensor", after_ms=2.0):
        self.stamp += round(after_ms * MS)
        self.results += self.deflector.push_joints(self.stamp, joints)
        self.results += self.deflector.push_wrench(self.stamp, wrench, frame)
        return self.results[-1]

    @property
    def outputs(self):
        return [r for r in self.results if isinstance(r, Deflected)]

    @property
    def rejected(self):
        return [r for r in self.results if isinstance(r, Rejected)]


def same(outputs, expected):
    assert len(outputs) == len(expected.mean)
    for k, output in enumerate(outputs):
        for ours, theirs in zip(output.predicted, [part[k] for part in expected], strict=False):
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-15)


def walk(size, seed=0):
    """Loads that go to and fro, and joints that move a little, stand, and move on."""
    rng = np.random.default_rng(seed)
    wrenches = np.cumsum(rng.normal(size=(size, 6)), axis=0) * [0.6, 0.6, 0.6, 0.08, 0.08, 0.08]
    joints = (
        np.array(HOME) + np.repeat(rng.normal(size=(size // 4 + 1, 5)) * 1e-3, 4, axis=0)[:size]
    )
    return wrenches, joints


# --- numbers ------------------------------------------------------------------------------------


def test_joints_are_those_of_the_wrenchs_stamp():
    rig = Rig()
    ahead = tuple(np.array(HOME) + [0.002, 0.0, -0.002, 0.02, 0.04])
    rig.results += rig.deflector.push_joints(START, HOME)
    assert rig.deflector.push_wrench(START + MS, PUSH, "ft_sensor") == []
    rig.results += rig.deflector.push_joints(START + 4 * MS, ahead)
    between = np.array(HOME) + 0.25 * (np.array(ahead) - HOME)
    np.testing.assert_allclose(rig.outputs[0].joints, between, atol=1e-15)
    same(rig.outputs, offline(MODEL, [PUSH], [between]))


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-5, 0.3, 3.0])
def test_the_corrected_tip_is_the_tip_displaced(size):
    rng = np.random.default_rng(3)
    for _ in range(20):
        joints = np.array(HOME) + rng.normal(size=5) * [0.05, 0.05, 0.05, 0.5, 0.4]
        by = size * rng.normal(size=6) / np.sqrt(6)
        position, quaternion = corrected_tip(*GALEN.tip_pose(joints, TIP_M), by.tolist())
        expected = Transform(*GALEN.tip_pose(joints, TIP_M)).displaced(by)
        np.testing.assert_allclose(position, expected.translation, atol=1e-15)
        np.testing.assert_allclose(
            quaternion_to_matrix(quaternion), expected.rotation, rtol=0, atol=1e-14
        )


@pytest.mark.parametrize("seed", range(2))
def test_faulty_streams_give_what_predict_gives_between_the_faults(seed):
    """Whatever lacks, jumps or is repeated: each output is the model's of the loads it was fed."""
    rng = np.random.default_rng(seed)
    wrenches, joints = walk(400, seed)
    rig = Rig()
    segment, fed = [], []
    cuts = 0
    previous_ns = None
    for k in range(400):
        fault = rng.choice(
            ["none"] * 12 + ["nan", "twice", "old", "gap", "late", "joints", "reset"]
        )
        wrench, at = wrenches[k], tuple(joints[k])
        if fault == "gap":
            rig.stamp += round(rng.uniform(0.02, 0.3) * 1e9)
        if fault == "reset":
            rig.deflector.forget("asked for")
            cuts += previous_ns is not None
            previous_ns = None
        if fault == "nan":
            wrench = np.where(np.arange(6) == rng.integers(6), np.nan, wrench)
        if fault == "joints":
            at = (*at[:3], np.inf, at[4])
        before = len(rig.outputs)
        rig.step(wrench, at)
        if fault == "twice":
            rig.results += rig.deflector.push_wrench(rig.stamp, 2.0 * wrench, "ft_sensor")
        if fault == "old":
            rig.results += rig.deflector.push_wrench(rig.stamp - MS, 2.0 * wrench, "ft_sensor")
        if len(rig.outputs) > before:
            assert len(rig.outputs) == before + 1, "two of one sample"
            stamp = rig.outputs[-1].stamp_ns
            if previous_ns is not None and stamp - previous_ns > 100 * MS:
                cuts += 1
            previous_ns = stamp
            segment.append(cuts)
            fed.append(k)
    assert cuts > 3 and len(fed) > 250 and len(rig.forgotten) == cuts
    same(rig.outputs, offline(MODEL, wrenches[fed], joints[fed], segment))
    assert (
        len(rig.outputs) + sum(rig.deflector.pairing.rejections.values())
        == rig.deflector.pairing.received
    )


# --- rejections -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "reason", "words"),
    [
        ({"wrench": PUSH * np.nan}, Rejection.NONFINITE_WRENCH, "wrench_compensated holds"),
        ({"frame": "tool0"}, Rejection.WRONG_FRAME, "frame_id 'tool0', expected 'ft_sensor'"),
        ({"joints": (np.nan, *HOME[1:])}, Rejection.NONFINITE_JOINTS, "not finite"),
        ({"joints": (0.5, *HOME[1:])}, ModelRejection.OUT_OF_REACH, "does not reach"),
    ],
)
def test_what_is_not_used_leaves_the_memory_as_it_was(step, reason, words):
    rig, clean = Rig(), Rig()
    for number in range(20):
        rig.step(PUSH * number / 10)
        clean.step(PUSH * number / 10)
    rejected = rig.step(**step)
    assert isinstance(rejected, Rejected) and rejected.reason is reason and words in rejected.detail
    assert rig.deflector.pairing.rejections[reason] == 1
    # after bad joints, those beside are not trusted either
    rig.step(after_ms=10), clean.step(after_ms=12)
    np.testing.assert_array_equal(rig.outputs[-1].predicted.mean, clean.outputs[-1].predicted.mean)


def test_a_model_of_another_tip_is_not_used():
    rig = Rig()
    rig.step()
    rig.deflector.set_tool("pointer", TOOLS["pointer"].tip_m)
    rejected = rig.step()
    assert rejected.reason is ModelRejection.OTHER_TIP
    assert "'pointer'" in rejected.detail and "(0.15, 0, 0.05)" in rejected.detail
    rig.deflector.set_tool("retractor", TIP_M + 5e-6)
    assert isinstance(rig.step(), Deflected)
    rig.deflector.set_tool("retractor", TIP_M + [0, 2e-5, 0])
    assert rig.step().reason is ModelRejection.OTHER_TIP
    rig.deflector.set_model(made_model(tip_m=TIP_M + [0, 2e-5, 0]))
    assert isinstance(rig.step(), Deflected)
    rig.deflector.set_tool("unknown", None)
    assert isinstance(rig.step(), Deflected)


def test_a_model_that_gives_no_number_is_silent():
    rig = Rig(replace(MODEL, values=MODEL.values * np.nan))
    assert rig.step().reason is ModelRejection.NONFINITE
    assert not rig.outputs


# --- memory -------------------------------------------------------------------------------------


def loaded_rig(**settings):
    """Pushed to and fro, and let go: something of the deflection is left."""
    rig = Rig(**settings)
    for size in (*np.linspace(0, 4, 20), *np.linspace(4, 0, 20)):
        rig.step(size * PUSH)
    return rig


def test_forgetting_without_loads_is_none():
    rig = Rig()
    assert not rig.deflector.forget("again") and rig.forgotten == []
    assert rig.deflector.forgotten == 0


@pytest.mark.parametrize(("gap_ms", "forgets"), [(99.0, False), (101.0, True), (900.0, True)])
def test_a_gap_longer_than_its_limit_is_forgotten_loads(gap_ms, forgets):
    rig = loaded_rig()
    rig.step(0 * PUSH, after_ms=gap_ms)
    assert len(rig.forgotten) == forgets
    assert (np.linalg.norm(rig.outputs[-1].predicted.mean) == 0.0) == forgets
    if forgets:
        assert "no usable wrench_compensated for 0." in rig.forgotten[0]


def test_rejected_wrenches_are_a_gap_as_well():
    rig = loaded_rig(memory_gap_s=0.02)
    for _ in range(5):
        rig.step(PUSH * np.inf)
    rig.step(0 * PUSH)
    assert rig.forgotten == []
    for _ in range(12):
        rig.step(PUSH * np.inf)
    rig.step(0 * PUSH)
    assert len(rig.forgotten) == 1


@pytest.mark.parametrize("jump_s", [-3.0, 5.0])
def test_stamps_that_jump_restart_it(jump_s):
    rig = loaded_rig()
    rig.stamp += round(jump_s * 1e9)
    rig.step(0 * PUSH)
    assert "driver restarted" in rig.forgotten[0] and len(rig.forgotten) == 1
    # What goes on later may also be a compensation that was switched off and on.
    assert ("messages are lacking" in rig.forgotten[0]) == (jump_s > 0)
    np.testing.assert_array_equal(rig.outputs[-1].predicted.mean, 0.0)


def test_a_new_model_has_seen_no_load():
    rig = loaded_rig()
    rig.deflector.set_model(made_model(softer=1.5))
    rig.step(0 * PUSH)
    np.testing.assert_array_equal(rig.outputs[-1].predicted.mean, 0.0)


def test_started_under_load_it_does_not_freeze_a_false_offset():
    """Two nodes, one from the start, one from the middle of a push: they agree once it is swept."""
    arm = np.concatenate([np.linspace(0, 9, 50), np.linspace(9, -9, 100), np.linspace(-9, 1, 60)])
    whole, late = Rig(), Rig()
    push = PUSH * [6.0, 1.0, 1.0, 1.0, 1.0, 1.0]  # mostly down, so that every carriage is loaded
    errors, stds = [], []
    for k, size in enumerate(arm):
        whole.step(size * push)
        if k >= 70:  # on the way back: the play is on its other side
            late.stamp = whole.stamp - 2 * MS
            late.step(size * push)
            predicted = late.outputs[-1].predicted
            errors.append(predicted.mean - whole.outputs[-1].predicted.mean)
            stds.append(np.sqrt(np.diag(predicted.covariance)))
    errors, stds = np.abs(errors), np.array(stds)
    assert errors[0].max() > 1e-5, "it can't know"
    assert np.all(errors[0] < 3.0 * stds[0]), "and its covariance covers it"
    assert np.all(errors[-1] < 1e-12), "nothing false is kept"
    assert late.outputs[-1].predicted.start is None
    assert late.outputs[0].predicted.start is not None
    assert np.all(stds[0][:3] > stds[-1][:3])


# --- what it says -------------------------------------------------------------------------------


class Watched(Rig):
    def __init__(self, model=MODEL):
        super().__init__(model, late_s=0.0)
        self.monitor = DeflectorMonitor(self.deflector)
        self.now_s = 50.0

    def watch(self, count=10, **step):
        for _ in range(count):
            self.now_s += 0.05
            self.monitor.on_joints(self.now_s)
            self.monitor.on_wrench(self.now_s)
            result = self.step(**step)
            if isinstance(result, Deflected):
                self.monitor.on_output(self.now_s - 1e-3, self.now_s, result.stamp_ns)
            else:
                self.monitor.on_rejected(result, self.now_s)
            self.monitor.tick(self.now_s)
        return self.monitor.state(self.now_s)


def test_states_in_words():
    rig = Watched(None)
    assert rig.watch().name == "no_model" and "model_file" in rig.watch().message
    rig.monitor.set_model_error("x.json: can't be read: No such file or directory")
    state = rig.watch()
    assert (state.severity, state.name) == (Severity.ERROR, "bad_model_file")
    assert "x.json: can't be read" in state.message and "set model_file" in state.message
    rig.monitor.set_model_error("")
    rig.deflector.set_model(MODEL)
    state = rig.watch(20)
    assert (state.severity, state.name) == (Severity.OK, "start_unknown")
    assert "until the arm has been pushed both ways" in state.message
    for size in (*np.linspace(0, 5, 10), *np.linspace(5, -5, 20), *np.linspace(-5, 0, 10)):
        state = rig.watch(1, wrench=size * PUSH * [6.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    rig.now_s += NOTICE_HOLD_S
    state = rig.watch(60, wrench=0 * PUSH)
    assert (state.severity, state.name) == (Severity.OK, "predicting")
    state = rig.watch(10, wrench=7 * PUSH)
    assert (state.severity, state.name) == (Severity.WARN, "extrapolating")
    assert 0.0 < rig.monitor.extrapolated_share < 1.0 and "beyond what" in state.message
    state = rig.watch(20, frame="elsewhere")
    assert (state.severity, state.name) == (Severity.ERROR, "wrong_frame")
    assert rig.monitor.state(rig.now_s + 2.0).severity is Severity.STALE
    rig.deflector.set_tool("pointer", TOOLS["pointer"].tip_m)
    state = rig.watch()
    assert (state.severity, state.name) == (Severity.ERROR, "other_tip")


def test_values_are_measured():
    rig = Watched()
    rig.watch(100)
    rig.deflector.forget("asked for")
    rig.monitor.on_forgotten("asked for", rig.now_s)
    assert "forgotten: asked for" in rig.monitor.state(rig.now_s).message
    rig.watch(1)
    values = rig.monitor.values(rig.now_s)
    last = rig.outputs[-1].predicted
    assert values["model"] == "joint_hysteresis"
    assert values["wrench_compensated_hz"] == pytest.approx(20.0)
    assert values["deflection_hz"] == pytest.approx(20.0)
    assert values["std_mm"] == pytest.approx(1e3 * np.sqrt(np.trace(last.covariance[:3, :3])))
    assert values["std_of_unknown_start_mm"] < values["std_mm"]
    assert values["deflection_mm"].split()[0] == f"{1e3 * last.mean[0]:.6g}"
    assert (values["predicted"], values["forgotten"]) == (101, 1)
    assert values["last_forgotten"] == "asked for"
    assert {"rejected_other_tip", "rejected_stale_joints", "rejected_no_model"} <= values.keys()
    assert "rejected_no_tool" not in values


REPORT = {
    "tool": "retractor", "tip_m": "0.18 0.01 0.05", "calibrated_at": "2026-01-01", "tare": "none",
    "tare_force_n": "0 0 0", "tare_torque_nm": "0 0 0",
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ""),
        ({"tare": "averaging"}, ""),
        ({"mass_kg": "0.3"}, ""),
        ({"tool": "pointer"}, "from 'retractor' to 'pointer'"),
        ({"calibrated_at": "2026-01-02"}, "another calibration of 'retractor'"),
        ({"tare": "ramping"}, "tare changed"),
        ({"tare_force_n": "0.1 0 0"}, "tare changed"),
    ],
)
def test_what_changes_the_wrenchs_meaning(change, words):
    before, now = GravcompState.of(REPORT), GravcompState.of(REPORT | change)
    found = now.change_since(before)
    assert words in found and bool(found) == bool(words)


@pytest.mark.parametrize("tip", ["", "1 2", "a b c", "nan 0 0", "1 2 3 4"])
def test_a_tip_that_is_none_is_not_known(tip):
    assert GravcompState.of(REPORT | {"tip_m": tip}).tip_m is None
    np.testing.assert_array_equal(GravcompState.of(REPORT).tip_m, [0.18, 0.01, 0.05])
    assert GravcompState.of({}).tip_m is None
