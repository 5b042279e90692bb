# SPDX-License-Identifier: Apache-2.0
"""Reading and writing serialised messages, held against rclpy's own serialisation."""

import struct
from collections.abc import Callable

import numpy as np
import pytest
from galen_common.cdr import ImuWire, JointStateError, JointWire, UnreadableError, WrenchWire
from galen_ros.messages import fill_wrench, stamp_to_ns, wrench_to_array
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState

from galen_common import cdr as wire

RNG = np.random.default_rng(11)
STAMPS = (0, 1, 2**31 - 1)


def make_wrench(frame_id: str, sec: int = 5) -> WrenchStamped:
    message = WrenchStamped()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = sec, 999_999_999
    fill_wrench(message, RNG.normal(size=6))
    return message


def make_joints() -> JointState:
    message = JointState(name=["tilt", "gripper", "roll"])
    message.position, message.velocity = RNG.normal(size=(2, 3)).tolist()
    return message


def little_endian(message: WrenchStamped) -> bytes:
    return serialize_message(message)


def big_endian(message: WrenchStamped) -> bytes:
    """As a machine of the other byte order sends it."""
    stamp, frame = message.header.stamp, message.header.frame_id.encode() + b"\x00"
    body = struct.pack(">iII", stamp.sec, stamp.nanosec, len(frame)) + frame
    body += b"\x00" * (-len(body) % 8) + struct.pack(">6d", *wrench_to_array(message))
    return b"\x00\x00\x00\x00" + body


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The wrenches whose layout was worked out."""
    calls: list[bytes] = []
    find = wire.stamped_layout

    def counted(data: bytes, count: int) -> wire.Layout:
        calls.append(data)
        return find(data, count)

    monkeypatch.setattr(wire, "stamped_layout", counted)
    return calls


@pytest.mark.parametrize("serialize", [little_endian, big_endian])
@pytest.mark.parametrize(
    "frame_id", ["", "f", "ab", "abc", "ft_sensor", "left/ft_sensor_link", "x" * 300]
)
def test_wrench_is_read_and_written_as_rclpy_does(
    frame_id: str, serialize: Callable[[WrenchStamped], bytes], learned: list[bytes]
) -> None:
    reader = WrenchWire()
    for sec in STAMPS:
        message, other = make_wrench(frame_id, sec), make_wrench(frame_id, sec)
        raw = reader.read(serialize(message))
        assert (raw.stamp_ns, raw.frame_id) == (stamp_to_ns(message.header.stamp), frame_id)
        np.testing.assert_array_equal(raw.wrench, wrench_to_array(message))
        answer = raw.with_wrench(wrench_to_array(other))
        if serialize is big_endian:
            assert answer == big_endian(other)
        else:
            assert deserialize_message(answer, WrenchStamped) == other
    assert len(learned) == 1, "only the first message is worked out"


def test_changed_frame_is_noticed() -> None:
    reader = WrenchWire()
    for frame_id in ("ft_sensor", "ft_sensoR", "ft_sensor_2", "ft_sensor"):
        message = make_wrench(frame_id)
        raw = reader.read(serialize_message(message))
        assert raw.frame_id == frame_id
        np.testing.assert_array_equal(raw.wrench, wrench_to_array(message))


def test_unreadable_bytes_are_named_and_forgotten() -> None:
    reader, joints = WrenchWire(), JointWire(("roll", "tilt"))
    message, state = make_wrench("ft_sensor"), make_joints()
    good, good_state = serialize_message(message), serialize_message(state)
    for _ in range(2):
        np.testing.assert_array_equal(reader.read(good).wrench, wrench_to_array(message))
        assert joints.read(good_state)[1] == (state.position[2], state.position[0])
        for data in (b"", b"\x00\x09" + good[2:], good[:-9], good[:13]):
            named = f"^{len(data)} bytes .* not a readable geometry_msgs/msg/WrenchStamped: "
            with pytest.raises(UnreadableError, match=named):
                reader.read(data)
        for data in (b"", b"\x00\x09" + good_state[2:], good_state[:40], good_state[:-12]):
            named = f"^{len(data)} bytes .* not a readable sensor_msgs/msg/JointState: "
            with pytest.raises(UnreadableError, match=named):
                joints.read(data)


@pytest.mark.parametrize("name", ["position", "velocity"])
def test_lists_that_do_not_fit_are_rejected_also_later(name: str) -> None:
    reader, message = JointWire(("roll", "tilt")), make_joints()
    reader.read(serialize_message(message))
    setattr(message, name, getattr(message, name)[:-1])
    with pytest.raises(JointStateError, match="names but"):
        reader.read(serialize_message(message))


def test_an_imu_is_read_as_rclpy_reads_it() -> None:
    message = Imu()
    message.header.frame_id = "imu_link"
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 34
    reader = ImuWire()
    for scale in (1.0, -2.0):  # the second by the layout of the first
        message.orientation.w = scale
        message.orientation_covariance = np.arange(9.0)
        angular, linear = message.angular_velocity, message.linear_acceleration
        angular.x, angular.y, angular.z = 0.1 * scale, 0.2, 0.3
        message.angular_velocity_covariance = np.arange(9.0) + 10.0
        linear.x, linear.y, linear.z = 1.0 * scale, 2.0, 3.0
        message.linear_acceleration_covariance = np.arange(9.0) + 20.0
        stamp_ns, velocity, acceleration = reader.read(serialize_message(message))
        assert stamp_ns == 12_000_000_034
        assert velocity == (0.1 * scale, 0.2, 0.3) and acceleration == (scale, 2.0, 3.0)
    with pytest.raises(UnreadableError, match="sensor_msgs/msg/Imu"):
        reader.read(b"\x00\x01\x00\x00 too short")
