"""Measured wrenches through the node: a KUKA with an ATI Gamma, its tool from still poses."""

from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_bags.convert import main as convert
from galen_bags.formats.bag import open_bag
from galen_gravcomp.compensator import Compensator, PairedWrench
from galen_gravcomp.evaluate.command import main as evaluate
from galen_gravcomp.node import GravcompNode
from galen_model.files.calibration_file import read_calibration
from galen_ros.messages import STREAM, stamp_to_ns, wrench_to_array
from galen_ros.node.testing import Harness, parameters
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

KUKA = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "kuka_ati_gamma"
pytestmark = pytest.mark.skipif(
    not KUKA.is_dir(), reason="measured data is not beside the checkout"
)
_AT_ONCE = 200  # far fewer than a queue holds


@pytest.fixture(scope="module")
def baseline(tmp_path_factory):
    """The run as a bag, and the folder with the tool's file from the still poses."""
    folder = tmp_path_factory.mktemp("kuka")
    bag, file = folder / "baseline", folder / "kuka.json"
    files = [
        "--wrench", str(KUKA / "1-baseline_wrench.csv"),
        "--orientations", str(KUKA / "1-baseline_orientations.csv"),
    ]  # fmt: skip
    assert convert([*files, "--time-unit", "us", "-o", str(bag)]) == 0
    table = KUKA / "0-calibration_fts-accel.csv"
    assert evaluate([str(table), "--write-tool", str(file), "--json"]) == 0
    return bag, file


def offline(bag, file):
    """What the compensator makes of the recording: stamps, wrenches, and how many of them there
    are after each message.
    """
    compensator = Compensator()
    compensator.set_tool(read_calibration(file))
    recording = read_arm(bag)
    samples = [
        *((log, 0, k) for k, log in enumerate(recording.joint_log_ns.tolist())),
        *((log, 1, k) for k, log in enumerate(recording.wrench_log_ns.tolist())),
    ]
    done, counts = [], []
    for _, is_wrench, k in sorted(samples):
        if is_wrench:
            stamp_ns = int(recording.wrench_stamp_ns[k])
            results = compensator.push_wrench(stamp_ns, recording.wrenches[k], "ft_sensor")
        else:
            stamp_ns = int(recording.joint_stamp_ns[k])
            results = compensator.push_joints(stamp_ns, tuple(recording.joints[k, 3:].tolist()))
        done += [result for result in results if isinstance(result, PairedWrench)]
        counts.append(len(done))
    return [result.stamp_ns for result in done], np.array([r.wrench for r in done]), counts


def through_the_node(bag, file, counts):
    """What `gravcomp_node` publishes when the recording is: stamps and wrenches."""
    heard = []
    with Harness() as harness:
        values = parameters(tools_dir=str(file.parent), tool=file.stem)
        harness.add(lambda context: GravcompNode(context=context, parameter_overrides=values))
        player = harness.add(lambda context: Node("player", context=context))
        publishers = [
            player.create_publisher(JointState, "joint_states", STREAM),
            player.create_publisher(WrenchStamped, "wrench_raw", STREAM),
        ]
        player.create_subscription(WrenchStamped, "wrench_compensated", heard.append, STREAM)
        harness.wait_for(
            lambda: (
                all(publisher.get_subscription_count() for publisher in publishers)
                and player.count_publishers("wrench_compensated")
            ),
            10.0,
            "the node's topics",
        )
        with open_bag(bag) as opened:
            (block,) = opened.blocks(["/joint_states", "/wrench_raw"])
        for row, topic in enumerate(block.topic.tolist()):
            publishers[topic].publish(block.message(row))
            if row % _AT_ONCE == 0 or row == len(block) - 1:
                due = counts[row]
                harness.wait_for(
                    lambda due=due: len(heard) >= due, 10.0, f"{due} compensated wrenches"
                )
    stamps = [stamp_to_ns(message.header.stamp) for message in heard]
    return stamps, np.array([wrench_to_array(message) for message in heard])


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


def test_the_static_model_leaves_the_forces_of_acceleration(baseline):
    bag, file = baseline
    stamps, wrenches, _ = offline(bag, file)
    raw = read_arm(bag)
    assert len(stamps) == 4370  # the last orientation is 7 ms older than the last wrench
    assert rms(raw.wrenches)[0] == pytest.approx(12.84, abs=0.02)
    # 1.2 N along x is known of this run, from elsewhere
    assert rms(wrenches)[0] == pytest.approx(1.22, abs=0.02)
    assert np.all(rms(wrenches)[1:3] < 0.6)
    assert np.all(rms(wrenches)[3:] < 0.08)


def test_the_node_does_as_the_compensator_does_offline(baseline):
    bag, file = baseline
    expected_stamps, expected, counts = offline(bag, file)
    stamps, wrenches = through_the_node(bag, file, counts)
    assert stamps == expected_stamps
    assert wrenches == pytest.approx(expected, abs=1e-12)
