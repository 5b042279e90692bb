# SPDX-License-Identifier: Apache-2.0
"""Does the tool's file still fit: reasons, recovery, and no alarm for a hand."""

import numpy as np
import pytest
from galen_common.stream.monitor import Severity
from galen_gravcomp.calibration_monitor import CalibrationMonitor
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.evidence import FitEvidence, Segments
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN
from galen_model.load.model import Load
from galen_model.load.verdict import Cause
from scipy.stats import multivariate_normal
from untouched_arm import NO_TOOL, POINTER, RETRACTOR, START_NS, UntouchedArm, push, tool_file


class Watched:
    """A monitor with every verdict that it had: (time, cause)."""

    def __init__(self, **arm):
        self.watch = CalibrationMonitor(arm=GALEN)
        self.states = []
        self.arm = UntouchedArm(self._take, **arm)
        self.watch.set_tool(self.arm.file)

    def _take(self, stamp_ns, angles, wrench):
        self.watch.push(stamp_ns, angles, wrench)
        cause = self.watch.verdict.cause
        if not self.states or self.states[-1][1] != cause:
            self.states.append((self.arm.time_s, cause))

    @property
    def now(self):
        return self.watch.verdict.cause

    @property
    def warnings(self):
        return [state for state in self.states if state[1] not in (Cause.UNKNOWN, Cause.FITS)]


def judged(evidence, stops):
    work = evidence.judge(stops)
    while True:
        try:
            next(work)
        except StopIteration as end:
            return end.value


FITS = Cause.FITS


@pytest.mark.parametrize(
    ("reason", "spoil"),
    [
        (Cause.LOAD, lambda arm: setattr(arm, "on", POINTER)),
        (Cause.NO_TOOL, lambda arm: setattr(arm, "on", NO_TOOL)),
        (Cause.LOAD, lambda arm: setattr(arm, "on", Load(0.215, RETRACTOR.com_m))),
        (
            Cause.DRIFT,
            lambda arm: setattr(arm, "offset", np.array([0.3, -0.3, 0.2, 0.003, 0.0, 0.002])),
        ),
        (Cause.LOOSE_TOOL, lambda arm: setattr(arm, "sag_m", 0.006)),
    ],
    ids=["wrong tool", "no tool", "15 g", "offset", "loose"],
)
def test_the_reason_is_found_within_a_few_stops_and_goes_by_itself(reason, spoil):
    watched = Watched(seed=1, rate_hz=40.0)
    arm = watched.arm
    arm.visit(6)
    assert watched.now == FITS
    assert not watched.warnings
    spoil(arm)
    arm.visit(5)
    assert watched.now is reason
    assert watched.watch.trouble
    arm.on, arm.sag_m, arm.offset = arm.file.load.load, 0.0, np.zeros(6)
    arm.visit(4)
    assert watched.now == FITS
    assert watched.watch.trouble == ""


def test_a_lone_pose_tells_a_load_from_what_leans_on_the_tool():
    watched = Watched(seed=2)
    arm = watched.arm
    arm.visit(4)
    arm.hold(3.0)
    arm.hold(10.0, push(np.array([0.0, 2.0, 0.5])))
    assert not watched.warnings  # a push, so far
    arm.hold(3.0)
    arm.hold(20.0, push(np.array([0.0, 2.0, 0.5])))
    assert watched.now is Cause.CONTACT
    arm.hold(3.0)
    assert watched.now == FITS
    arm.on = POINTER
    arm.hold(20.0)
    assert watched.now is Cause.LOAD


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "tremor"), [(1, 0.0), (1, 0.02), (2, 0.0)])
def test_a_hand_that_never_lets_go_is_no_alarm(seed, tremor):
    """Another push at every stop looks like a pull that changes from pose to pose."""
    watched = Watched(seed=seed, rate_hz=40.0)
    arm, rng = watched.arm, np.random.default_rng(seed)

    def some_push():
        force = rng.normal(size=3)
        size_n = np.exp(rng.uniform(np.log(0.1), np.log(3.0)))
        return push(size_n * force / np.linalg.norm(force))

    for _ in range(40):
        arm.move(rng.uniform([-1.3, -0.9], [1.3, 0.9]), 1.0, some_push())
        arm.hold(rng.uniform(1.0, 4.0), some_push(), tremor)
    assert not watched.warnings


def test_a_tare_moves_what_is_remembered():
    watched = Watched(seed=4)
    arm = watched.arm
    arm.offset = np.array([0.4, -0.3, 0.3, 0.004, 0.0, 0.002])
    arm.visit(6)
    assert watched.now is Cause.DRIFT
    watched.watch.offset_changed(arm.offset, arm.offset)
    arm.offset = np.zeros(6)
    arm.hold(0.4)  # no window's length: it is what was seen before, moved
    assert watched.now == FITS
    arm.visit(3)
    assert watched.now == FITS


def test_a_tare_in_the_first_stop_s_first_moments_is_no_end():
    """Of one window nothing is judged: a node once ended here."""
    watched = Watched(seed=4)
    arm = watched.arm
    arm.visit(2)
    arm.hold(1.6)
    assert [stop.windows for stop in watched.watch._memory.segments] == [1]
    watched.watch.offset_changed(np.zeros(6), np.zeros(6))
    arm.hold(2.0)
    assert watched.now == FITS


def test_the_node_s_state_warns_of_it_and_a_bad_file_is_worse():
    compensator = Compensator(GravcompParameters(late_s=0.0), arm=GALEN)
    monitor = Monitor(compensator)
    tool = tool_file()
    compensator.set_tool(tool)

    def take(stamp_ns, angles, left):
        compensator.push_joints(stamp_ns, angles)
        compensator.push_wrench(stamp_ns, left + tool.predict(angles))

    arm = UntouchedArm(take, tool, seed=5)
    arm.on = NO_TOOL
    arm.visit(4)
    monitor.on_wrench(0.0)
    monitor.on_joints(0.0)
    monitor.on_output(0.0, 0.0, 1)
    state = monitor.state(0.1)
    assert (state.severity, state.name) == (Severity.WARN, "does_not_fit")
    assert "no tool is on, by -199.7 +- " in state.message
    assert monitor.values(0.1)["fit_reason"] == "no_tool"
    compensator.rename_tool("hook")
    monitor.set_file_note("its file has changed")
    state = monitor.state(0.1)
    assert state.name == "does_not_fit"
    assert "'hook'" in state.message and "retractor" not in state.message
    assert "no tool is on" in state.message and "its file has changed" in state.message
    monitor.set_tool_error("torn")
    assert monitor.state(0.1).name == "bad_tool_file"


def test_a_pull_is_told_from_hands_by_poses_near_each_other():
    rng = np.random.default_rng(0)
    angles = rng.uniform([-1.3, -0.9], [1.3, 0.9], (14, 2))
    waves = np.array([[1.5, 0.7], [-0.8, 1.9], [1.0, -1.2]])
    pull = 0.12 * np.sin(np.repeat(angles @ waves.T, 2, axis=1) + np.arange(6))
    pull *= np.repeat([1.0, 0.04], 3)
    quiet = tool_file()
    quiet.rmse[:] = 0.0
    evidence = FitEvidence(quiet, arm=GALEN)
    std = np.full((14, 6), 1e-3) * np.repeat([1.0, 0.04], 3)

    def odds(mean, order):
        segments = Segments(mean[order], std, angles[order], START_NS + np.arange(14))
        return evidence.log_odds_of_pull(segments)

    assert odds(pull, np.arange(14)) > 9.2
    hands = [odds(rng.permutation(pull), np.arange(14)) for _ in range(20)]
    assert max(hands) < 0.0
    # Pushes of all sizes: small ones are alike where the arm happens to be near.
    sizes = np.exp(rng.uniform(np.log(0.1), np.log(3.0), (200, 14, 1)))
    forces = sizes * rng.normal(size=(200, 14, 3))
    pushes = np.concatenate([forces, np.cross([0.15, 0.0, 0.05], forces)], axis=2)
    assert max(odds(some, np.arange(14)) for some in pushes) < 0.0
    # A hand that changes slowly, while the arm goes from place to place nearby: can't be told.
    along = np.argsort(angles[:, 0])
    slow = 0.3 * np.cumsum(rng.normal(size=(14, 6)), axis=0) * np.repeat([1.0, 0.04], 3)
    mean = np.empty_like(slow)
    mean[along] = slow
    assert odds(mean, along) < 4.6


def test_evidence_is_the_density_of_the_stops():
    """Against scipy's normal density of all stops at once, with the parameters summed out."""
    tool = tool_file()
    evidence = FitEvidence(tool, arm=GALEN)
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.8, 0.8, (3, 2))
    gravity = GALEN.gravity_in_sensor(angles)
    mean = 0.02 * np.concatenate([gravity, np.cross([0.07, 0.0, 0.05], gravity)], axis=1)
    end_ns = START_NS + np.arange(3) * 3_000_000_000
    stops = Segments(mean, np.full((3, 6), 1e-3), angles, end_ns)
    judgement = judged(evidence, stops)
    assert judgement.explanation is Cause.LOAD
    assert not judgement.contact.any()
    assert np.isclose(judgement.load[0], 0.02, atol=3.0 * judgement.mass_std_kg)
    density = {}
    for k in (0, 1):
        rows = evidence.design(stops).reshape(18, -1)
        covariance = rows @ np.linalg.inv(evidence._prior.precision[k]) @ rows.T
        covariance += np.diag(evidence.variance(stops).ravel())
        density[k] = multivariate_normal(np.zeros(18), covariance).logpdf(mean.ravel())
    odds = density[1] + np.log(0.04) - density[0] - np.log(0.9)
    assert judgement.log_odds <= odds + 1e-6  # a file that fits may have touched stops instead
    touched = evidence.log_contact(stops).sum() - density[0]
    assert judgement.log_odds == pytest.approx(odds - max(touched, 0.0), abs=20.0)


def test_a_wrong_set_up_is_found_with_a_tare_and_after_a_restart_without():
    tool = tool_file()
    compensator = Compensator(GravcompParameters(tare_window_s=0.3, tare_ramp_s=0.1), arm=GALEN)
    compensator.set_tool(tool)

    def take(stamp_ns, angles, left):
        compensator.push_joints(stamp_ns, angles)
        compensator.push_wrench(stamp_ns, -(left + tool.predict(angles)))

    def found():
        return "the reading is reversed" in compensator.monitor.setup.contradiction

    arm = UntouchedArm(take, tool)
    arm.hold(1.0)
    assert found()
    answers = []
    compensator.start_tare(lambda answer, offset: answers.append(offset))
    arm.hold(1.0)
    assert answers[0] is not None
    arm.move([1.2, 0.5])
    arm.hold(1.0)
    assert found()
    compensator.pairing.restart("driver restarted")
    assert not found()
    arm.hold(1.0)
    assert found()
