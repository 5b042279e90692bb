# SPDX-License-Identifier: Apache-2.0
"""A bag through the node and through `evaluate`: the same wrenches come out."""

import time

import numpy as np
from galen_bags.formats.bag import open_bag
from galen_common.cdr import WrenchWire
from galen_gravcomp.evaluate.bag import evaluate_bag
from galen_gravcomp.ros.node import GravcompNode
from galen_model.files.calibration_file import write_calibration
from galen_ros.messages import STREAM, stamp_to_ns, wrench_to_array
from galen_ros.node.testing import Harness, parameters
from geometry_msgs.msg import WrenchStamped
from gravcomp_bags import Recording, tool_file
from rclpy.node import Node
from sensor_msgs.msg import JointState


def faulty_recording(tool):
    """After a sound start: a gap, a duplicate, one out of order, a NaN, a restart."""
    recording = Recording(tool, poses=5, hold_s=0.6, move_s=0.4)
    recording.kept[100:109] = False
    recording.stamp_ns[150] = recording.stamp_ns[149]
    order = [*range(200), 201, 200, *range(202, len(recording.angles))]
    recording.stamp_ns = recording.stamp_ns[order]
    recording.wrench[250, 3] = np.nan
    recording.stamp_ns[300:] += 5_000_000_000
    return recording


def wait_until_seen(node, sent):
    """One message after the other, since two topics have no order between them."""
    deadline = time.monotonic() + 10.0
    while node._monitor._joints_seen + node._compensator.pairing.received < sent:
        assert time.monotonic() < deadline, f"the node did not see message {sent}"
        time.sleep(0.0)


def test_the_node_and_the_evaluation_give_the_same_wrenches(tmp_path):
    tool = tool_file()
    write_calibration(tmp_path / "retractor.json", tool)
    path = faulty_recording(tool).write(tmp_path / "bag")
    result = evaluate_bag(path, tool, write_to=tmp_path / "out")
    wire = WrenchWire()
    with open_bag(tmp_path / "out") as bag:
        blocks = list(bag.blocks(["/wrench_compensated"]))
    written = [wire.read(block.message(k)) for block in blocks for k in range(len(block))]
    offline = [(one.stamp_ns, np.array(one.wrench)) for one in written]

    live, sent = [], 0
    with Harness() as harness:
        values = parameters(tools_dir=str(tmp_path), tool="retractor")
        node = harness.add(
            lambda context: GravcompNode(context=context, parameter_overrides=values)
        )
        player = harness.add(lambda context: Node("player", context=context))
        player.create_subscription(
            WrenchStamped,
            "wrench_compensated",
            lambda m: live.append((stamp_to_ns(m.header.stamp), wrench_to_array(m))),
            STREAM,
        )
        publishers = [
            player.create_publisher(JointState, "joint_states", STREAM),
            player.create_publisher(WrenchStamped, "wrench_raw", STREAM),
        ]
        for publisher in publishers:
            harness.wait_for(publisher.get_subscription_count, 10.0, "the node's subscriptions")
        harness.wait_for(
            lambda: node.count_subscribers("wrench_compensated"), 10.0, "the player's subscription"
        )
        with open_bag(path) as bag:
            for block in bag.blocks(["/joint_states", "/wrench_raw"]):
                for row in range(len(block)):
                    publishers[block.topic[row]].publish(block.message(row))
                    sent += 1
                    wait_until_seen(node, sent)
        harness.wait_for(lambda: len(live) >= len(offline), 10.0, "the last wrench")
        answered = node._compensator.pairing.received
    assert answered == result.received
    assert [stamp for stamp, _ in live] == [stamp for stamp, _ in offline]
    np.testing.assert_allclose(
        np.array([wrench for _, wrench in live]),
        np.array([wrench for _, wrench in offline]),
        rtol=0.0,
        atol=1e-12,
    )
    rejected = {reason.value: n for reason, n in node._compensator.pairing.rejections.items()}
    assert rejected == result.rejected
    notices = {notice.value: n for notice, n in node._compensator.pairing.notices.items()}
    assert notices == result.notices
    assert {"duplicate_stamp", "nonfinite_wrench"} == set(rejected)
    assert {"restarts", "out_of_order_wrench"} <= set(notices)
