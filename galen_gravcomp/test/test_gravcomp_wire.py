# SPDX-License-Identifier: Apache-2.0
"""Reading and writing serialised messages, held against rclpy's own serialisation."""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from galen_common.cdr import (
    ImuWire,
    JointStateError,
    JointWire,
    UnreadableError,
    WrenchWire,
)
from galen_ros.messages import fill_wrench
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState

from galen_common import cdr as wire

RNG = np.random.default_rng(11)
WRENCH, JOINTS = "stamped_layout", "joint_state_layout"


def make_wrench(frame_id: str, sec: int = 5, nanosec: int = 7) -> WrenchStamped:
    message = WrenchStamped()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    fill_wrench(message, RNG.normal(size=6))
    return message


def make_joints(names: list[str], velocity: bool = True, effort: bool = False) -> JointState:
    message = JointState(name=names, position=RNG.normal(size=len(names)).tolist())
    message.header.stamp.sec = int(RNG.integers(1, 2**31 - 1))
    message.header.stamp.nanosec = int(RNG.integers(0, 10**9))
    if velocity:
        message.velocity = RNG.normal(size=len(names)).tolist()
    if effort:
        message.effort = RNG.normal(size=len(names)).tolist()
    return message


def values(message: WrenchStamped) -> tuple[float, ...]:
    force, torque = message.wrench.force, message.wrench.torque
    return (force.x, force.y, force.z, torque.x, torque.y, torque.z)


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which kinds of message had their layout worked out."""
    calls: list[str] = []

    def counting(name: str) -> Callable[..., Any]:
        find = getattr(wire, name)

        def count(*args: Any, **options: Any) -> Any:
            calls.append(name)
            return find(*args, **options)

        return count

    for name in (WRENCH, JOINTS):
        monkeypatch.setattr(wire, name, counting(name))
    return calls


FRAMES = ["", "f", "ab", "abc", "ft_sensor", "left/ft_sensor_link", "x" * 300]


@pytest.mark.parametrize("frame_id", FRAMES)
def test_wrench_is_read_and_written_as_rclpy_does(frame_id: str, learned: list[str]) -> None:
    reader = WrenchWire()
    for sec in (0, 1, 2**31 - 1):
        message = make_wrench(frame_id, sec, 999_999_999)
        raw = reader.read(serialize_message(message))
        assert raw.stamp_ns == sec * 10**9 + 999_999_999
        assert raw.frame_id == frame_id
        assert raw.wrench == values(message)
        other = make_wrench(frame_id, sec, 999_999_999)
        answer = deserialize_message(raw.with_wrench(np.array(values(other))), WrenchStamped)
        assert answer == other
    assert learned == [WRENCH], "only the first message is worked out"


def test_changed_frame_is_noticed(learned: list[str]) -> None:
    reader = WrenchWire()
    for frame_id in ("ft_sensor", "ft_sensoR", "ft_sensor_2", "ft_sensor"):
        message = make_wrench(frame_id)
        raw = reader.read(serialize_message(message))
        assert (raw.frame_id, raw.wrench) == (frame_id, values(message))
    assert len(learned) == 4


def big_endian(message: WrenchStamped) -> bytes:
    """As a machine of the other byte order sends it."""
    stamp, frame = message.header.stamp, message.header.frame_id.encode() + b"\x00"
    body = struct.pack(">iII", stamp.sec, stamp.nanosec, len(frame)) + frame
    body += b"\x00" * (-len(body) % 8) + struct.pack(">6d", *values(message))
    return b"\x00\x00\x00\x00" + body


def test_other_byte_order(learned: list[str]) -> None:
    reader = WrenchWire()
    for _ in range(3):
        message = make_wrench("ft_sensor", 123, 456)
        raw = reader.read(big_endian(message))
        assert (raw.stamp_ns, raw.frame_id) == (123 * 10**9 + 456, "ft_sensor")
        assert raw.wrench == values(message)
        other = make_wrench("ft_sensor", 123, 456)
        assert raw.with_wrench(np.array(values(other))) == big_endian(other)
    assert len(learned) == 1


def test_unreadable_bytes_are_named_and_forgotten(learned: list[str]) -> None:
    reader, joints = WrenchWire(), JointWire(("roll", "tilt"))
    message, state = make_wrench("ft_sensor"), make_joints(["tilt", "roll"])
    good, good_state = serialize_message(message), serialize_message(state)
    for _ in range(2):
        assert reader.read(good).wrench == values(message)
        assert joints.read(good_state)[1] == (state.position[1], state.position[0])
        for data in (b"", b"\x00\x09" + good[2:], good[:-9], good[:13]):
            named = f"^{len(data)} bytes .* not a readable geometry_msgs/msg/WrenchStamped: "
            with pytest.raises(UnreadableError, match=named):
                reader.read(data)
        for data in (b"", b"\x00\x09" + good_state[2:], good_state[:40], good_state[:-12]):
            named = f"^{len(data)} bytes .* not a readable sensor_msgs/msg/JointState: "
            with pytest.raises(UnreadableError, match=named):
                joints.read(data)
    assert learned == [WRENCH, JOINTS] + ([WRENCH] * 4 + [JOINTS] * 4) * 2


ORDERS = [
    ["delta_x", "delta_y", "delta_z", "roll", "tilt"],
    ["tilt", "roll"],
    ["gripper", "tilt", "a" * 77, "roll", "other"],
    ["roll", "b", "tilt"],
]


@pytest.mark.parametrize("names", ORDERS, ids=[str(len(names)) for names in ORDERS])
@pytest.mark.parametrize("velocity", [True, False])
@pytest.mark.parametrize("effort", [True, False])
def test_joints_are_read_as_rclpy_does(
    names: list[str], velocity: bool, effort: bool, learned: list[str]
) -> None:
    reader = JointWire(("roll", "tilt"))
    for _ in range(5):
        message = make_joints(names, velocity, effort)
        stamp_ns, (roll, tilt) = reader.read(serialize_message(message))
        stamp = message.header.stamp
        assert stamp_ns == stamp.sec * 10**9 + stamp.nanosec
        assert roll == message.position[names.index("roll")]
        assert tilt == message.position[names.index("tilt")]
    assert learned == [JOINTS]


def _short_position(message: JointState) -> None:
    message.position = message.position[:-1]


def _short_velocity(message: JointState) -> None:
    message.velocity = message.velocity[:-1]


@pytest.mark.parametrize("spoil", [_short_position, _short_velocity])
def test_lists_that_do_not_fit_are_rejected_also_later(spoil: Callable[[JointState], None]) -> None:
    reader = JointWire(("roll", "tilt"))
    reader.read(serialize_message(make_joints(ORDERS[0])))
    message = make_joints(ORDERS[0])
    spoil(message)
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
