"""The templates' bytes are rclpy's bytes, but for padding that CDR leaves open."""

import numpy as np
import pytest
from galen_model.arm import JOINT_NAMES
from galen_ros.conversions import fill_stamp, fill_wrench
from galen_sim_driver.cdr import JointStateBytes, WrenchBytes
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

STAMPS_NS = [0, 1, 1_000_000_000, 1_763_000_000_123_456_789]


def assert_same_bytes(data, message):
    """All bytes are equal; where they aren't, the byte is padding, which no reader looks at."""
    expected = serialize_message(message)
    assert len(data) == len(expected)
    for index in range(len(data)):
        if data[index] != expected[index]:
            changed = bytearray(expected)
            changed[index] ^= 0xFF
            assert deserialize_message(bytes(changed), type(message)) == message, index
    assert deserialize_message(data, type(message)) == message


@pytest.mark.parametrize("frame_id", ["", "a", "base_link", "a frame with a long name"])
def test_joint_states_byte_for_byte(frame_id):
    rng = np.random.default_rng(1)
    template = JointStateBytes(JOINT_NAMES, frame_id)
    for stamp_ns in STAMPS_NS:
        positions, velocities = rng.normal(size=(2, 5)).tolist()
        message = JointState(name=list(JOINT_NAMES), position=positions, velocity=velocities)
        message.header.frame_id = frame_id
        fill_stamp(message.header.stamp, stamp_ns)
        data = template.fill(stamp_ns, positions, velocities)
        assert_same_bytes(data, message)


@pytest.mark.parametrize("frame_id", ["", "ft_sensor", "left_ft_sensor"])
def test_wrenches_byte_for_byte(frame_id):
    rng = np.random.default_rng(2)
    template = WrenchBytes(frame_id)
    for stamp_ns in STAMPS_NS:
        wrench = rng.normal(size=6)
        message = WrenchStamped()
        message.header.frame_id = frame_id
        fill_stamp(message.header.stamp, stamp_ns)
        fill_wrench(message, wrench)
        data = template.fill(stamp_ns, wrench.tolist())
        assert_same_bytes(data, message)


def test_values_of_the_wrong_number_are_refused():
    template = JointStateBytes(JOINT_NAMES, "")
    with pytest.raises(Exception, match="pack"):
        template.fill(0, [0.0] * 4, [0.0] * 5)
