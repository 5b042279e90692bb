"""The live watch on the gap: its statistic, its false alarms, and the node."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from galen_diagnosis.experiment.trial import Instruments, signature, still_trial
from galen_diagnosis.monitor.gap_effects import likely_effects
from galen_diagnosis.monitor.gap_statistic import Scatter, gap_test, window_noise
from galen_diagnosis.monitor.gap_stream import gap_sentence
from galen_diagnosis.monitor.gap_watch import GapNotice, GapSettings, GapWatch
from galen_diagnosis.monitor.node import GapMonitorNode
from galen_model.arm.galen import JOINT_NAMES, SENSOR
from galen_model.files.calibration_file import LoadEstimate, ToolFile, write_tool
from galen_model.load.nominal_tools import ADAPTER, TOOLS
from galen_model.rest.windows import StillWindow
from galen_ros.node.testing import Harness, parameters
from galen_ros.qos import STREAM
from galen_sim_driver.effects.registry import EFFECTS
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

STD = np.asarray(SENSOR.noise_std) / np.sqrt(250.0)  # of half a second at 500 Hz
COVARIANCE = np.diag([1e-4, 2e-4, 2e-4, 2e-4]) ** 2
LOAD = TOOLS["pointer"].load
TOOL = ToolFile(
    "pointer",
    LoadEstimate(LOAD.mass_kg, LOAD.com_m, COVARIANCE),
    LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, COVARIANCE),
    TOOLS["pointer"].tip_m,
    np.zeros(6),
    56,
    "2026-01-01T00:00:00Z",
)


def left_by(effect):
    """What an effect leaves of the reading at poses, as the simulator has it: joints -> (6,)."""

    def at(joints):
        poses = np.array([joints[3:], [0.0, 0.0]])
        trial = still_trial(poses, np.array([2.0, 4.0]), 1.0, TOOL, Instruments(), joints)
        return signature(trial, (effect,))[:6] * trial.wrench_std

    return at


class Arm:
    """Windows of an arm that goes from pose to pose, noise correlated from window to window."""

    def __init__(self, watch, seed, correlation=0.0, left=None):
        self.watch, self.left = watch, left or (lambda joints: np.zeros(6))
        self.rng, self.correlation = np.random.default_rng(seed), correlation
        self.noise = self.rng.standard_normal(6)
        self.at_ns, self.notices = 10**9, []

    def stop(self, windows, touch=None, steady=True):
        joints = np.array([0.0, 0.0, 0.408, *self.rng.uniform([-1.5, -1.0], [1.5, 0.9])])
        self.at_ns += 1_300_000_000
        left = self.left(joints)
        for number in range(windows):
            fresh = self.rng.standard_normal(6)
            self.noise = self.correlation * self.noise + np.sqrt(1.0 - self.correlation**2) * fresh
            mean = left + STD * self.noise
            if touch is not None:
                mean = mean + touch(number)
            end_ns = self.at_ns + 498_000_000
            window = StillWindow(self.at_ns, end_ns, 250, mean, STD, (joints[3], joints[4]), steady)
            self.at_ns += 500_000_000
            if self.watch.take(window, joints):
                self.notices.append(self.watch.state.notice)


def hand(rng):
    force = rng.normal(size=3) * 2.0
    return np.concatenate([force, np.cross([0.1, 0.0, 0.05], force)])


def test_variance_and_correlation_of_short_stops_are_not_biased():
    rng = np.random.default_rng(3)
    for correlation in (0.0, 0.4):
        scatters = []
        for _ in range(1500):
            noise = rng.standard_normal((5, 6))
            for k in range(1, 5):
                noise[k] = correlation * noise[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
            scatters.append(Scatter.of(noise * STD))
        found = window_noise(scatters, 1e-4 * STD**2)
        assert found.correlation == pytest.approx(correlation, abs=0.08)
        # the variance of a stop's mean, directly: 1^T R 1 / m^2
        lags = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
        expected = (correlation**lags).mean() if correlation else 0.25
        assert found.of_mean(4) / STD**2 == pytest.approx(expected, rel=0.2)


def test_the_tail_of_the_test_is_no_lighter_than_stated():
    """Of pure noise: below p no oftener than p says, and of the trimmed sum's part not idle."""
    rng = np.random.default_rng(4)
    for count, freedom in ((6, 10**9), (20, 10**9), (20, 40)):
        found = []
        for _ in range(500):
            known = 1.0 if freedom > 1000 else rng.chisquare(freedom, 6) / freedom
            noise = rng.standard_normal((count, 6))
            found.append(gap_test(noise, np.ones((count, 6)) * known, freedom).probability)
        for stated in (0.5, 0.1, 0.01):
            spread = 3.0 * np.sqrt(stated / len(found))
            assert np.mean(np.array(found) < stated) < stated + spread
        assert np.mean(np.array(found) < 0.5) > 0.15


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_a_healthy_arm_gives_no_alarm(correlation):
    # Without any floor, so that noise alone decides; 0.05 an hour are allowed, an hour is watched.
    watch = GapWatch(GapSettings(floor_n=1e-9, floor_nm=1e-11))
    arm = Arm(watch, 5, correlation)
    while arm.at_ns < 3600 * 10**9:
        arm.stop(int(arm.rng.integers(2, 14)))
    assert len(arm.notices) > 300
    assert GapNotice.GAP not in arm.notices
    assert arm.notices.count(GapNotice.NO_GAP) > 290


def test_a_gap_is_found_named_and_cleared():
    offset = EFFECTS["loose_tool"](shift_m=0.004)
    watch = GapWatch()
    watch.set_tool(TOOL)
    arm = Arm(watch, 6)
    for _ in range(30):
        arm.stop(6)
    assert watch.state.notice is GapNotice.NO_GAP
    before_ns = arm.at_ns
    arm.left = left_by(offset)
    for _ in range(20):
        arm.stop(6)
    state = watch.state
    assert state.notice is GapNotice.GAP
    assert before_ns < state.since_ns < before_ns + 60 * 10**9
    assert set(state.channels) <= {"tx", "ty", "tz"} and state.channels
    found = likely_effects(state, watch.variances(state.stops, state.noise), TOOL)
    assert found[0][0] == "loose_tool"
    assert found[0][1] > 0.9
    assert sum(share for _, share in found) == pytest.approx(1.0)
    said = gap_sentence(state, found)
    assert "loose_tool" in said and "`diagnose`" in said and " mN.m" in said
    arm.left = lambda joints: np.zeros(6)
    for _ in range(40):
        arm.stop(6)
    assert watch.state.notice is GapNotice.NO_GAP
    assert watch.state.since_ns is None


def test_twins_share_the_probability():
    watch = GapWatch()
    watch.set_tool(TOOL)
    arm = Arm(watch, 7, left=left_by(EFFECTS["roll_zero_offset"](offset_rad=0.012)))
    for _ in range(30):
        arm.stop(6)
    state = watch.state
    found = dict(likely_effects(state, watch.variances(state.stops, state.noise), TOOL))
    assert found["roll_zero_offset"] + found["base_inclination"] > 0.9
    assert 0.1 < found["base_inclination"] < found["roll_zero_offset"]


def test_hands_are_no_gap():
    watch = GapWatch()
    arm = Arm(watch, 8)
    for number in range(80):
        push = hand(arm.rng)
        if number % 4 == 1:  # trembles
            arm.stop(8, touch=lambda k, f=push: f, steady=False)
        elif number % 4 == 2:  # comes while the arm stands, holds quite still, and stays
            arm.stop(8, touch=lambda k, f=push: f * (k >= 3))
        elif number % 8 == 3:  # was there already, and holds quite still
            arm.stop(8, touch=lambda k, f=push: f)
        else:
            arm.stop(8)
    assert GapNotice.GAP not in arm.notices
    assert watch.state.notice is GapNotice.NO_GAP
    # ... and the watch isn't blind for it
    arm.left = left_by(EFFECTS["loose_tool"](shift_m=0.006))
    for number in range(40):
        push = hand(arm.rng)
        arm.stop(8, touch=(lambda k, f=push: f * (k >= 3)) if number % 2 else None)
    assert watch.state.notice is GapNotice.GAP


class Probe(Node):
    """Plays an arm's samples and hears the diagnostics."""

    def __init__(self, **options):
        super().__init__("probe", **options)
        self.joints = self.create_publisher(JointState, "joint_states", STREAM)
        self.wrench = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.hear, 100)
        self.status = None

    def hear(self, message):
        for status in message.status:
            if status.hardware_id == "galen_gap_monitor":
                self.status = status
                self.values = {item.key: item.value for item in status.values}

    def stop(self, rng, at_ns, pose, gap):
        """A stop of 2.3 s at 100 Hz; gap (6,) is added to the reading.

        The way there takes 0.3 s, which nobody sees: an arm that leaps is not believed.
        """
        at_ns += 300_000_000
        expected = TOOL.predict(*pose) + gap
        for reading in expected + SENSOR.noise_std * rng.standard_normal((230, 6)):
            at_ns += 10_000_000
            joints = JointState(name=list(JOINT_NAMES), position=[0.0, 0.0, 0.408, *pose])
            wrench = WrenchStamped()
            wrench.header.frame_id = "ft_sensor"
            for message in (joints, wrench):
                message.header.stamp.sec = at_ns // 10**9
                message.header.stamp.nanosec = at_ns % 10**9
            force, torque = wrench.wrench.force, wrench.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = map(float, reading)
            self.joints.publish(joints)
            self.wrench.publish(wrench)
        return at_ns


@pytest.mark.slow
def test_the_node_says_so(tmp_path):
    write_tool(tmp_path / "pointer.json", TOOL)
    rng = np.random.default_rng(9)
    poses = rng.uniform([-1.4, -0.9], [1.4, 0.9], (36, 2)).tolist()
    with Harness() as harness:
        options = parameters(tool="pointer", tools_dir=str(tmp_path), look_s=5.0)
        node = harness.add(
            lambda context: GapMonitorNode(context=context, parameter_overrides=options)
        )
        probe = harness.add(lambda context: Probe(context=context))
        harness.wait_for(
            lambda: probe.wrench.get_subscription_count() and probe.status, 20.0, "the monitor"
        )
        gap = left_by(EFFECTS["tool_com_error"](delta_m=(0.006, 0.0, 0.004)))
        at_ns = 10**9
        for number, pose in enumerate(poses, start=1):
            left = gap(np.array([0.0, 0.0, 0.408, *pose]))
            at_ns = harness.call_in_executor(
                lambda now=at_ns, pose=pose, left=left: probe.stop(rng, now, pose, left)
            )
            # No faster than it is heard: a topic's queue holds 2000 samples.
            harness.wait_for(
                lambda sent=230 * number: node.samples >= sent - 10, 20.0, "the samples"
            )
        harness.wait_for(
            lambda: probe.values["gap"] == "gap" and "tool_com_error" in probe.values["effects"],
            60.0,
            "a gap with its cause",
        )
        assert probe.status.level == b"\x01"
        assert "tool_com_error" in probe.status.message
        assert float(probe.values["probability_without_gap"]) < 1e-4


@pytest.mark.slow
def test_without_a_tool_the_node_says_what_is_missing(tmp_path):
    with Harness() as harness:
        options = parameters(tool="scalpel", tools_dir=str(tmp_path))
        harness.add(lambda context: GapMonitorNode(context=context, parameter_overrides=options))
        probe = harness.add(lambda context: Probe(context=context))
        harness.wait_for(lambda: probe.status, 20.0, "diagnostics")
        assert probe.status.level == b"\x01"
        assert "scalpel.json" in probe.status.message
