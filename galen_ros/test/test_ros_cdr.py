# SPDX-License-Identifier: Apache-2.0
"""The templates' bytes are rclpy's bytes, but for padding that CDR leaves open."""

import numpy as np
import pytest
from galen_common.cdr import (
    JointWire,
    UnreadableError,
    joint_positions,
    joint_state_bytes,
    joint_state_layout,
    pose_bytes,
    stamped_layout,
    wrench_bytes,
)
from galen_model.arm.galen import GALEN
from galen_ros.messages import fill_stamp, fill_wrench, stamp_to_ns, wrench_to_array
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

ROSBAGS_TYPES = get_typestore(Stores.ROS2_JAZZY)


def assert_same_bytes(data, message):
    """All bytes are equal; where they aren't, the byte is padding, which no reader looks at."""
    expected = serialize_message(message)
    # Fast CDR aligns for doubles even behind the last value, where an empty sequence ends.
    assert len(expected) - len(data) in (0, 4)
    for index in range(len(data)):
        if data[index] != expected[index]:
            changed = bytearray(expected)
            changed[index] ^= 0xFF
            assert deserialize_message(bytes(changed), type(message)) == message, index
    assert deserialize_message(data, type(message)) == message


def joint_state(frame_id, rng):
    """The numbers of a made-up message, the message, and the template for it."""
    positions, velocities = rng.normal(size=(2, 5)).tolist()
    message = JointState(name=list(GALEN.joint_names), position=positions, velocity=velocities)
    return (positions, velocities), message, joint_state_bytes(GALEN.joint_names, frame_id)


def wrench(frame_id, rng):
    numbers, message = rng.normal(size=6), WrenchStamped()
    fill_wrench(message, numbers)
    assert wrench_to_array(message).tolist() == numbers.tolist()
    return (numbers.tolist(),), message, wrench_bytes(frame_id)


def pose(frame_id, rng):
    position, quaternion = rng.normal(size=3).tolist(), rng.normal(size=4).tolist()
    message = PoseStamped()
    at, turned = message.pose.position, message.pose.orientation
    at.x, at.y, at.z = position
    turned.x, turned.y, turned.z, turned.w = quaternion
    return (position, quaternion), message, pose_bytes(frame_id)


@pytest.mark.parametrize("frame_id", ["", "a", "base_link", "a frame with a long name"])
@pytest.mark.parametrize("make", [joint_state, wrench, pose])
def test_messages_byte_for_byte(make, frame_id):
    rng = np.random.default_rng(1)
    for stamp_ns in [0, 1, 1_000_000_000, 1_763_000_000_123_456_789]:
        numbers, message, template = make(frame_id, rng)
        message.header.frame_id = frame_id
        fill_stamp(message.header.stamp, stamp_ns)
        assert stamp_to_ns(message.header.stamp) == stamp_ns
        data = template.fill(stamp_ns, *numbers)
        assert_same_bytes(data, message)
        if make is joint_state:
            # The library rosbags rejects the four bytes that rclpy has at the end.
            read = ROSBAGS_TYPES.deserialize_cdr(data, "sensor_msgs/msg/JointState")
            assert read.name == list(GALEN.joint_names)


@pytest.mark.parametrize("frame_id", ["", "a", "base_link", "ümlaut"])
@pytest.mark.parametrize("counts", [(5, 5, 0), (5, 0, 0), (5, 5, 5), (5, 0, 5), (0, 0, 0)])
def test_the_layout_finds_the_numbers_of_any_joint_state(frame_id, counts):
    rng = np.random.default_rng(4)
    runs = [rng.normal(size=count).tolist() for count in counts]
    names = ["a", "roll", "tilt_joint", "", "x"]
    message = JointState(name=names, position=runs[0], velocity=runs[1], effort=runs[2])
    message.header.frame_id = frame_id
    data = bytes(serialize_message(message))
    layout = joint_state_layout(data)
    assert (layout.frame_id, layout.names, layout.counts) == (frame_id, tuple(names), counts)
    assert layout.fits(data)
    for start, run in zip(layout.doubles_at, runs, strict=True):
        assert np.frombuffer(data, layout.order + "f8", len(run), start).tolist() == run
    for at in (5, 9):  # the stamp's bytes may be anything, a name's may not
        assert layout.fits(data[:at] + b"\x7f" + data[at + 1 :])
    at = data.index(b"roll")
    assert not layout.fits(data[:at] + b"R" + data[at + 1 :])
    assert not layout.fits(data + bytes(4))


@pytest.mark.parametrize("cut", range(0, 76, 5))
def test_a_cut_off_message_is_unreadable(cut):
    data = wrench_bytes("ft_sensor").fill(0, [0.0] * 6)
    with pytest.raises(UnreadableError):
        stamped_layout(data[:cut], 6)


def test_what_is_not_cdr_is_unreadable():
    data = wrench_bytes("ft_sensor").fill(0, [0.0] * 6)
    assert stamped_layout(data, 6).frame_id == "ft_sensor"
    with pytest.raises(UnreadableError, match="start"):
        stamped_layout(b"\x00\x09" + data[2:], 6)
    with pytest.raises(UnreadableError, match="sequence of 4294967295"):
        joint_state_layout(data[:12] + b"\xff\xff\xff\xff" + data[16:])
    with pytest.raises(UnreadableError, match="UTF-8"):
        stamped_layout(data.replace(b"ft_sensor", b"ft_\xff\xfe\xfa\xfb\xfc\xfd"), 6)


@pytest.mark.parametrize("wanted", [["tilt"], ["tilt", "roll"]])
def test_joints_are_found_by_name_and_come_as_tuples_even_one(wanted):
    wire = JointWire(wanted)
    message = JointState(name=["roll", "other", "tilt"], position=[1.0, 9.0, 2.0])
    message.header.stamp.nanosec = 5
    read = wire.read_motion(serialize_message(message))
    assert read == (5, (2.0, 1.0)[: len(wanted)], None)
    message.velocity = [3.0, 9.0, 4.0]
    _, _, velocities = wire.read_motion(serialize_message(message))
    assert velocities == (4.0, 3.0)[: len(wanted)]
    # The same reader follows a publisher that changes its order.
    message = JointState(name=["tilt", "roll"], position=[5.0, 6.0])
    assert wire.read(serialize_message(message)) == (0, (5.0, 6.0)[: len(wanted)])
    assert joint_positions(bytes(serialize_message(message))) == {"tilt": 5.0, "roll": 6.0}
