# SPDX-License-Identifier: Apache-2.0
"""The 500 Hz streams: heard while somebody watches, and only then; whatever comes on them."""

import math

import numpy as np
from galen_common.cdr import deflection_bytes, joint_state_bytes, wrench_bytes
from galen_model.arm.galen import GALEN
from galen_panel.ros import streams as ros_streams
from galen_ros.messages import STREAM
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from galen_msgs.msg import DeflectionStamped

PERIOD_NS = 2_000_000
JOINTS = (0.01, 0.02, 0.408, 0.3, 0.4)
KINDS = {
    "wrench_raw": WrenchStamped,
    "wrench_compensated": WrenchStamped,
    "deflection": DeflectionStamped,
    "joint_states": JointState,
}


class Source(Node):
    """Publishes all four streams at 500 Hz; each number tells which topic and sample it is of."""

    def __init__(self, context, **_):
        super().__init__("source", context=context)
        self.count = 0
        self.start_ns = 1_000_000_000_000
        self.extra = []
        self.streams = {
            topic: self.create_publisher(kind, topic, STREAM) for topic, kind in KINDS.items()
        }
        wrench, joints = wrench_bytes("ft_sensor"), joint_state_bytes(("other", *GALEN.joint_names))
        deflection = deflection_bytes("base_link")
        self.make = {
            "wrench_raw": lambda t, k: wrench.fill(t, [k, 1, 2, 3, 4, 5]),
            "wrench_compensated": lambda t, k: wrench.fill(t, [k, 0, 0, 0, 0, 0]),
            "deflection": lambda t, k: deflection.fill(t, [k, 1, 2, 3, 4, 5], [7.0] * 36, [True]),
            "joint_states": lambda t, k: joints.fill(t, [9.0, *JOINTS], [0.0] * 6),
        }
        self.create_timer(0.004, self.on_timer)

    def on_timer(self):
        for topic, data in self.extra:
            self.streams[topic].publish(data)
        self.extra.clear()
        for _ in range(2):
            self.count += 1
            for topic, publisher in self.streams.items():
                stamp_ns = self.start_ns + self.count * PERIOD_NS
                publisher.publish(self.make[topic](stamp_ns, float(self.count)))

    @property
    def heard_by(self):
        return sum(publisher.get_subscription_count() for publisher in self.streams.values())


def series(suite):
    history = suite.history
    return {
        "wrench_raw": history.raw,
        "wrench_compensated": history.compensated,
        "deflection": history.deflection,
        "joint_states": history.joints,
    }


def lengths(suite):
    return [len(one.last().stamps_ns) for one in series(suite).values()]


def bad_messages(at_ns):
    """What none of the streams may take, stamped as if it were the next sample."""
    wrench = wrench_bytes("ft_sensor")
    good = wrench.fill(at_ns, [0.0] * 6)
    other_joints = joint_state_bytes(("shoulder", "elbow")).fill(at_ns, [0, 0], [0, 0])
    return [
        ("wrench_raw", b"\x00\x01\x00\x00"),
        ("wrench_raw", good[:-8]),
        ("wrench_raw", b"\xff" * 80),
        ("wrench_raw", wrench.fill(at_ns, [math.nan] * 6)),
        ("wrench_compensated", wrench.fill(at_ns, [math.inf] + [0.0] * 5)),
        ("deflection", good),
        ("joint_states", other_joints),
        ("joint_states", good),
    ]


def test_who_watches_gets_every_sample_of_the_four_streams_and_nothing_bad(world):
    source = world.add(Source)

    def send_bad_ones():
        between_ns = source.start_ns + source.count * PERIOD_NS + PERIOD_NS // 2
        source.extra.extend(bad_messages(between_ns))

    with world.suite.watch():
        world.harness.wait_for(lambda: min(lengths(world.suite)) > 50, 15.0, "samples")
        world.harness.call_in_executor(send_bad_ones)
        world.harness.wait_for(lambda: not source.extra, 10.0, "the bad ones to be sent")
        enough = min(lengths(world.suite)) + 300
        world.harness.wait_for(lambda: min(lengths(world.suite)) > enough, 15.0, "samples")
    found = {topic: one.last() for topic, one in series(world.suite).items()}
    for topic, samples in found.items():
        numbers = (samples.stamps_ns - source.start_ns) // PERIOD_NS
        if topic != "joint_states":
            np.testing.assert_array_equal(samples.values[:, 0], numbers)
        # A machine that stalls may lose some; what is there is whole.
        assert np.count_nonzero(np.diff(numbers) == 1) > 250
    assert np.all(found["joint_states"].values == JOINTS)
    assert np.all(found["wrench_raw"].values[:, 1:] == [1, 2, 3, 4, 5])
    assert np.all(found["wrench_compensated"].values[:, 1:] == 0)
    assert np.all(found["deflection"].values[:, 1:] == [1, 2, 3, 4, 5])


def test_nobody_listens_before_and_after_and_the_last_one_to_leave_ends_it(world, monkeypatch):
    monkeypatch.setattr(ros_streams, "_LINGER_S", 0.3)
    source = world.add(Source)
    world.harness.wait_for(lambda: source.count > 100, 10.0, "samples")
    assert source.heard_by == 0 and not world.suite.streams.listening
    first, second = world.suite.watch(), world.suite.watch()
    first.__enter__()
    second.__enter__()
    world.harness.wait_for(lambda: source.heard_by == 4, 10.0, "four subscriptions")
    first.__exit__(None, None, None)
    count = lengths(world.suite)[0]
    world.harness.wait_for(lambda: lengths(world.suite)[0] > count + 300, 10.0, "more samples")
    assert source.heard_by == 4
    second.__exit__(None, None, None)
    world.harness.wait_for(lambda: source.heard_by == 0, 10.0, "that nobody listens")
    before = lengths(world.suite)
    count = source.count
    world.harness.wait_for(lambda: source.count > count + 200, 10.0, "samples for nobody")
    assert lengths(world.suite) == before
    with world.suite.watch():
        world.harness.wait_for(lambda: lengths(world.suite)[0] > before[0], 10.0, "samples again")
