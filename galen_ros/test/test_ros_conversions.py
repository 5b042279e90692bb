"""Conversions between messages and arrays."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from galen_ros.cdr import JointStateError
from galen_ros.messages import (
    JointStateReader,
    fill_stamp,
    fill_wrench,
    stamp_to_ns,
    wrench_to_array,
)
from geometry_msgs.msg import WrenchStamped
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
    reader = JointStateReader(("roll", "tilt"))
    message = JointState(name=["tilt", "other", "roll"], position=[2.0, 9.0, 1.0])
    positions, velocities = reader.read(message)
    assert positions.tolist() == [1.0, 2.0] and velocities is None
    message.velocity = [0.2, 0.9, 0.1]
    positions, velocities = reader.read(message)
    assert velocities.tolist() == [0.1, 0.2]
    # The same reader follows a publisher that changes its order.
    positions, _ = reader.read(JointState(name=["roll", "tilt"], position=[5.0, 6.0]))
    assert positions.tolist() == [5.0, 6.0]


def test_bad_joint_states_are_rejected():
    reader = JointStateReader(("roll", "tilt"))
    with pytest.raises(JointStateError, match="lacks tilt; it has roll, wrist"):
        reader.read(JointState(name=["roll", "wrist"], position=[0.0, 0.0]))
    with pytest.raises(JointStateError, match="no joints"):
        reader.read(JointState())
    with pytest.raises(JointStateError, match="2 names but 1 positions"):
        reader.read(JointState(name=["roll", "tilt"], position=[0.0]))
    with pytest.raises(JointStateError, match="2 names but 3 velocities"):
        reader.read(
            JointState(name=["roll", "tilt"], position=[0.0, 0.0], velocity=[0.0, 0.0, 0.0])
        )
