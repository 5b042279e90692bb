# SPDX-License-Identifier: Apache-2.0
"""The node over real rclpy: what goes out, what does not, and what /diagnostics says."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_made_model import made_model, offline
from deflection_synthetic import TIP_M
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from galen_deflection.models.file import write_model
from galen_deflection.ros.node import DeflectionNode
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import calibration_path, write_calibration
from galen_model.load.model import TOOLS
from galen_model.registration import Transform
from galen_model.rotation import quaternion_to_matrix
from galen_ros.messages import STREAM, fill_stamp, fill_wrench, stamp_to_ns
from galen_ros.node.diagnostics import Level
from galen_ros.node.testing import Harness, parameters
from geometry_msgs.msg import PoseStamped, WrenchStamped
from push_bag import TOOL
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from galen_msgs.msg import DeflectionStamped
from galen_msgs.srv import SetTool

MS = 1_000_000
START = 100_000 * MS
HOME = (0.0, 0.0, 0.408, 0.1, -0.2)
PUSH = np.array([4.0, -3.0, 2.0, 0.3, -0.2, 0.1])
NAMES = ("tilt", "gripper", "delta_x", "roll", "delta_y", "delta_z")
MODEL = made_model()


@pytest.fixture
def folder(tmp_path):
    write_model(tmp_path / "good.json", MODEL)
    write_model(tmp_path / "softer.json", made_model(softer=1.5))
    write_model(tmp_path / "pointer.json", made_model(tip_m=TOOLS["pointer"].tip_m))
    (tmp_path / "torn.json").write_text((tmp_path / "good.json").read_text()[:700])
    return tmp_path


class Arm(Node):
    """Publishes what a driver and a compensation would, and collects what the node says."""

    def __init__(self, wrench_topic="wrench_compensated", **options):
        super().__init__("arm", **options)
        self.joints_publisher = self.create_publisher(JointState, "joint_states", STREAM)
        self.wrench_publisher = self.create_publisher(WrenchStamped, wrench_topic, STREAM)
        self.said_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.deflections, self.poses, self.reports = [], [], []
        self.inputs = [
            self.create_subscription(
                DeflectionStamped, "deflection", self.deflections.append, 2000
            ),
            self.create_subscription(PoseStamped, "tip_pose_corrected", self.poses.append, 2000),
        ]
        self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 100)

    def on_diagnostics(self, message):
        self.reports += [s for s in message.status if s.hardware_id == "galen_deflection"]

    def say(self, **values):
        """As gravcomp would."""
        status = DiagnosticStatus(name="gravcomp", hardware_id="galen_gravcomp")
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        self.said_publisher.publish(DiagnosticArray(status=[status]))


class Bench:
    """One deflection node, and one arm."""

    def __init__(self, harness, model_file, arm_options=None, **values):
        self.harness = harness
        # The stamps here are slower than time.
        values = {"model_file": str(model_file), "late_s": 0.0} | values
        self.node = harness.add(
            lambda context: DeflectionNode(
                context=context, parameter_overrides=parameters(**values)
            )
        )
        self.arm = harness.add(lambda context: Arm(context=context, **(arm_options or {})))
        self.stamp = START
        for publisher in (self.arm.joints_publisher, self.arm.wrench_publisher):
            harness.wait_for(publisher.get_subscription_count, 10.0, "the node's subscriptions")
        harness.wait_for(self.arm.inputs[0].get_publisher_count, 10.0, "the node's publisher")

    def step(self, wrench=PUSH, joints=HOME, names=NAMES, frame="ft_sensor"):
        """One sample; returns its stamp."""
        self.stamp += 2 * MS
        message = JointState(name=list(names))
        fill_stamp(message.header.stamp, self.stamp)
        values = dict(zip(("delta_x", "delta_y", "delta_z", "roll", "tilt"), joints, strict=True))
        message.position = [float(values.get(name, 9.0)) for name in names]
        self.arm.joints_publisher.publish(message)
        message = WrenchStamped()
        fill_stamp(message.header.stamp, self.stamp)
        message.header.frame_id = frame
        fill_wrench(message, np.asarray(wrench, dtype=float))
        self.arm.wrench_publisher.publish(message)
        return self.stamp

    def outputs(self, count):
        """Wait for so many deflections, and return them as (stamp, frame, mean, cov, flag)."""
        self.harness.wait_for(
            lambda: len(self.arm.deflections) >= count, 8.0, f"{count} deflections"
        )
        return [unpacked(message) for message in self.arm.deflections]

    def state(self, name, level, words="", feed=None):
        """Wait for a report of this state; returns its values, with the message."""

        def found():
            if feed is not None:
                feed()
            for status in self.arm.reports[-3:][::-1]:
                values = {item.key: item.value for item in status.values}
                right = values["state"] == name and status.level == bytes([level])
                if right and words in status.message:
                    return values | {"message": status.message}
            return None

        return self.harness.wait_for(found, 8.0, f"the state {name} with {words!r}")

    def set_model(self, file):
        client = self.arm.create_client(SetParameters, "/deflection/set_parameters")
        parameter = Parameter("model_file", value=str(file)).to_parameter_msg()
        return self.harness.call(client, SetParameters.Request(parameters=[parameter])).results[0]

    def reset(self):
        client = self.arm.create_client(Trigger, "/deflection/reset")
        return self.harness.call(client, Trigger.Request())


def unpacked(message):
    move, turn = message.translation, message.rotation
    mean = np.array([move.x, move.y, move.z, turn.x, turn.y, turn.z])
    stamp_ns = stamp_to_ns(message.header.stamp)
    covariance = np.reshape(message.covariance, (6, 6))
    return stamp_ns, message.header.frame_id, mean, covariance, message.extrapolated


@pytest.fixture
def harness():
    with Harness() as harness:
        yield harness


def test_publishes_what_predict_gives_with_stamps_and_the_tip(harness, folder):
    bench = Bench(harness, folder / "good.json")
    rng = np.random.default_rng(2)
    wrenches = np.cumsum(rng.normal(size=(150, 6)), axis=0) * [0.8, 0.8, 0.8, 0.1, 0.1, 0.1]
    wrenches[80:90, 0] += 40.0
    joints = np.array(HOME) + np.repeat(rng.normal(size=(30, 5)) * 1e-3, 5, axis=0)
    stamps = [bench.step(w, q) for w, q in zip(wrenches, joints, strict=True)]
    got = bench.outputs(150)
    expected = offline(MODEL, wrenches, joints)
    assert [g[0] for g in got] == stamps and {g[1] for g in got} == {"base_link"}
    for column, theirs in zip((2, 3), expected[:2], strict=True):
        np.testing.assert_allclose([g[column] for g in got], theirs, rtol=1e-12, atol=1e-15)
    assert [g[4] for g in got] == expected.extrapolated.tolist()
    assert 0 < expected.extrapolated.sum() < 150
    harness.wait_for(lambda: len(bench.arm.poses) == 150, 5.0, "the tip's poses")
    for row, message in enumerate(bench.arm.poses):
        tip = Transform(*GALEN.tip_pose(joints[row], TIP_M)).displaced(expected.mean[row])
        at, turned = message.pose.position, message.pose.orientation
        assert stamp_to_ns(message.header.stamp) == stamps[row]
        assert message.header.frame_id == "base_link"
        np.testing.assert_allclose([at.x, at.y, at.z], tip.translation, atol=1e-14)
        matrix = quaternion_to_matrix([turned.x, turned.y, turned.z, turned.w])
        np.testing.assert_allclose(matrix, tip.rotation, atol=1e-14)


def test_torques_in_another_unit_are_no_deflection_until_they_are_plausible(harness, folder):
    bench = Bench(harness, folder / "good.json")
    bench.step()
    bench.outputs(1)
    torques = [1.0, -2.0, 3.0, 500.0, -200.0, 300.0]
    values = bench.state(
        "implausible_units",
        Level.ERROR,
        "are they in N.mm?",
        feed=lambda: bench.step(wrench=torques),
    )
    assert "nothing is published" in values["message"]
    assert len(bench.arm.deflections) == 1
    harness.wait_for(
        lambda: bench.step() and len(bench.arm.deflections) > 1, 8.0, "a deflection after it"
    )


@pytest.mark.parametrize(
    ("file", "state", "level", "words"),
    [
        ("", "no_model", Level.WARN, "set model_file"),
        ("torn.json", "bad_model_file", Level.ERROR, "torn.json"),
        ("absent.json", "bad_model_file", Level.ERROR, "absent.json: can't be read"),
    ],
)
def test_without_a_usable_model_it_is_silent_and_says_why(
    harness, folder, file, state, level, words
):
    bench = Bench(harness, folder / file if file else "")
    for _ in range(5):
        bench.step()
    bench.state(state, level, words)
    answer = bench.reset()
    assert not answer.success and "no model" in answer.message
    assert bench.arm.deflections == []
    assert bench.set_model(folder / "good.json").successful
    bench.state("start_unknown", Level.OK, feed=bench.step)
    assert bench.arm.deflections


def test_another_model_at_run_time_and_a_bad_one_that_is_rejected(harness, folder):
    bench = Bench(harness, folder / "good.json")
    bench.step()
    bench.outputs(1)
    answer = bench.set_model(folder / "torn.json")
    assert not answer.successful and "torn.json" in answer.reason
    bench.state("predicting", Level.WARN, "the old one stays", feed=bench.step)
    values = bench.state("predicting", Level.WARN)
    assert values["model_file"].endswith("good.json")
    held = bench.node.get_parameter("model_file").value
    assert held.endswith("good.json")
    count = len(bench.arm.deflections)
    assert bench.set_model(folder / "softer.json").successful
    stamp = bench.step()
    bench.outputs(count + 1)
    harness.wait_for(lambda: unpacked(bench.arm.deflections[-1])[0] == stamp, 5.0, "the last one")
    got = unpacked(bench.arm.deflections[-1])
    expected = offline(made_model(softer=1.5), [PUSH], [HOME])
    np.testing.assert_allclose(got[2], expected.mean[0], rtol=1e-12)
    np.testing.assert_allclose(got[3], expected.covariance[0], rtol=1e-12, atol=1e-20)
    assert bench.set_model("").successful
    bench.state("no_model", Level.WARN, feed=bench.step)


def test_reset_forgets_the_loads_and_says_what_is_assumed(harness, folder):
    bench = Bench(harness, folder / "good.json")
    for size in (*np.linspace(0, 4, 30), *np.linspace(4, 0, 30)):
        bench.step(size * PUSH)
    left = bench.outputs(60)[-1]
    assert np.linalg.norm(left[2][:3]) > 1e-5
    answer = bench.reset()
    assert answer.success and "as if the arm had never been loaded" in answer.message
    bench.step(0 * PUSH)
    fresh = bench.outputs(61)[-1]
    np.testing.assert_array_equal(fresh[2], 0.0)
    assert np.all(np.diag(fresh[3]) > np.diag(left[3]))
    values = bench.state("predicting", Level.WARN, "forgotten: ~/reset was called", bench.step)
    assert values["forgotten"] == "1" and values["last_forgotten"] == "~/reset was called"


def test_another_publisher_of_the_wrench_is_another_driver(harness, folder):
    bench = Bench(harness, folder / "good.json")
    for size in (*np.linspace(0, 4, 30), *np.linspace(4, 0, 30)):
        bench.step(size * PUSH)
    bench.outputs(60)
    other = harness.add(lambda context: Arm(context=context))

    def both():
        """The other one repeats each sample."""
        bench.step()
        first, bench.arm = bench.arm, other
        bench.stamp -= 2 * MS
        bench.step()
        bench.arm = first

    words = "wrench_compensated has 2 publishers (/arm 2 times)"
    values = bench.state("several_publishers", Level.ERROR, words, both)
    assert "is new" in values["last_restart"]
    assert int(values["restarts"]) >= 1 and int(values["forgotten"]) >= 1
    assert values["wrench_compensated_publishers"] == "2"
    harness.remove(other)


def test_with_gravcomp_itself(harness, folder):
    """Through the real compensation: a tool that the model is not for stops the deflection."""
    for name in ("pointer", "retractor"):
        tool = replace(TOOL, tool=name, tip_m=TOOLS[name].tip_m)
        write_calibration(calibration_path(folder / "tools", name), tool)
    values = parameters(tools_dir=str(folder / "tools"), tool="retractor", late_s=0.0)
    harness.add(lambda context: GravcompNode(context=context, parameter_overrides=values))
    bench = Bench(harness, folder / "good.json", {"wrench_topic": "wrench_raw"})
    for _ in range(20):
        stamp = bench.step()
    got = bench.outputs(20)[-1]
    assert got[0] == stamp and got[2][:3].any()
    bench.state("start_unknown", Level.OK, feed=bench.step)
    client = bench.arm.create_client(SetTool, "/gravcomp/set_tool")
    assert harness.call(client, SetTool.Request(tool="pointer")).success
    bench.state("other_tip", Level.ERROR, "'pointer'", feed=bench.step)
    assert harness.call(client, SetTool.Request(tool="retractor")).success
    bench.state("predicting", Level.WARN, "forgotten: gravcomp", feed=bench.step)


def test_wrong_parameters_are_named(harness, folder):
    with pytest.raises(Exception, match=r"joint_names.*5 joints"):
        Bench(harness, folder / "good.json", joint_names=["roll", "tilt"])
    with pytest.raises(Exception, match=r"memory_gap_s"):
        Bench(harness, folder / "good.json", memory_gap_s=0.0)
