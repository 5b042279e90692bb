# SPDX-License-Identifier: Apache-2.0
"""Conversions between messages and arrays."""

import numpy as np
from builtin_interfaces.msg import Time
from galen_common.cdr import JointWire
from galen_ros.messages import (
    fill_stamp,
    fill_wrench,
    stamp_to_ns,
    wrench_to_array,
)
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState


def test_stamps_there_and_back():
    for ns in (0, 1, 999_999_999, 1_000_000_000, 1_763_000_000_123_456_789):
        stamp = Time()
        fill_stamp(stamp, ns)
        assert stamp_to_ns(stamp) == ns
    assert (stamp.sec, stamp.nanosec) == (1_763_000_000, 123_456_789)


def test_wrench_order_is_force_then_torque():
    message = WrenchStamped()
    fill_wrench(message, np.arange(1.0, 7.0))
    assert message.wrench.force.x == 1.0
    assert message.wrench.torque.x == 4.0
    assert wrench_to_array(message).tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_joints_are_found_by_name():
    reader = JointWire(("roll", "tilt"))
    message = JointState(name=["tilt", "other", "roll"], position=[2.0, 9.0, 1.0])
    message.header.stamp.nanosec = 5
    assert reader.read_motion(serialize_message(message)) == (5, (1.0, 2.0), None)
    message.velocity = [0.2, 0.9, 0.1]
    assert reader.read_motion(serialize_message(message)) == (5, (1.0, 2.0), (0.1, 0.2))
    # The same reader follows a publisher that changes its order.
    other = JointState(name=["roll", "tilt"], position=[5.0, 6.0])
    assert reader.read(serialize_message(other)) == (0, (5.0, 6.0))
