# SPDX-License-Identifier: Apache-2.0
"""The 500 Hz streams: heard while somebody watches, and only then; whatever comes on them."""

import math

import numpy as np
import pytest
from galen_common.cdr import deflection_bytes, joint_state_bytes, wrench_bytes
from galen_model.arm.galen import GALEN
from galen_panel.ros import streams as ros_streams
from galen_ros.messages import STREAM
from geometry_msgs.msg import WrenchStamped
from panel_ros_world import panel_world
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


@pytest.fixture
def world(monkeypatch):
    with panel_world(monkeypatch) as world:
        yield world


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


def test_who_watches_gets_every_sample_of_the_four_streams(world):
    source = world.add(Source)
    with world.suite.watch():
        world.harness.wait_for(lambda: min(lengths(world.suite)) > 300, 15.0, "samples")
    for topic, one in series(world.suite).items():
        samples = one.last()
        numbers = (samples.stamps_ns - source.start_ns) // PERIOD_NS
        if topic == "joint_states":
            assert np.all(samples.values == JOINTS)
        else:
            np.testing.assert_array_equal(samples.values[:, 0], numbers)
        # A machine that stalls may lose some; what is there is whole.
        assert np.count_nonzero(np.diff(numbers) == 1) > 250
    assert np.all(world.suite.history.raw.last().values[:, 1:] == [1, 2, 3, 4, 5])
    assert np.all(world.suite.history.deflection.last().values[:, 1:] == [1, 2, 3, 4, 5])


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


def test_bad_messages_are_left_out(world):
    source = world.add(Source)
    suite = world.suite
    with suite.watch():
        world.harness.wait_for(lambda: min(lengths(suite)) > 50, 15.0, "samples")
        good = wrench_bytes("ft_sensor").fill(5, [0.0] * 6)
        at_ns = source.start_ns
        bad = [
            ("wrench_raw", b"\x00\x01\x00\x00"),
            ("wrench_raw", good[:-8]),
            ("wrench_raw", b"\xff" * 80),
            ("wrench_raw", wrench_bytes("ft_sensor").fill(at_ns, [math.nan] * 6)),
            ("wrench_compensated", wrench_bytes("ft_sensor").fill(at_ns, [math.inf] + [0.0] * 5)),
            ("deflection", good),
            ("joint_states", joint_state_bytes(("shoulder", "elbow")).fill(at_ns, [0, 0], [0, 0])),
            ("joint_states", good),
        ]
        world.harness.call_in_executor(lambda: source.extra.extend(bad))
        world.harness.wait_for(lambda: not source.extra, 10.0, "the bad ones to be sent")
        before = lengths(suite)
        world.harness.wait_for(
            lambda: all(np.array(lengths(suite)) > np.array(before) + 100), 10.0, "more samples"
        )
    for one in series(suite).values():
        assert np.isfinite(one.last().values).all()
    raw = suite.history.raw.last()
    assert 5 not in raw.stamps_ns and np.all(raw.values[:, 1:] == [1, 2, 3, 4, 5])
    assert np.all(suite.history.joints.last().values == JOINTS)
