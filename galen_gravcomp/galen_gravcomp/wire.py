"""Reads wrenches and joint angles from serialised messages, and writes a wrench into one.

Converting a message to Python costs rclpy more than all of the compensation. Of a publisher's
serialised messages only stamp and numbers change, and they stay at their places. So the places are
worked out for the first message, checked against what rclpy reads there, and then read directly
as long as everything before the numbers stays the same. Whatever looks different goes through
rclpy.

The layout is that of CDR (OMG DDSI-RTPS 10.2, "PLAIN_CDR"): four bytes of encapsulation, then each
value aligned to its size, counted from after these four; a string or sequence starts with its
length as uint32; a string ends with a zero byte. Bytes of padding hold anything.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_ros.conversions import JointStateReader, stamp_to_ns
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

_NS_PER_S = 1_000_000_000
_ENCAPSULATION = 4
_BYTE_ORDER = {b"\x00\x00": ">", b"\x00\x01": "<"}
_STAMP_AT = 4
_FRAME_AT = 12


class UnreadableError(GalenError):
    """Bytes that are no message of their type, as a broken or hostile sender may publish."""


def _deserialize(data: bytes, message_type: Any) -> Any:
    try:
        return deserialize_message(data, message_type)
    except (RuntimeError, MemoryError) as error:  # rclpy's RMWError is a RuntimeError
        package = message_type.__module__.split(".")[0]
        raise UnreadableError(
            f"{len(data)} bytes came that are not a readable {package}/msg/{message_type.__name__}"
        ) from error


def _aligned(at: int, size: int) -> int:
    return at + (_ENCAPSULATION - at) % size


class _Fixed:
    """Collects the runs of bytes before the numbers that must stay as they are."""

    def __init__(self) -> None:
        self.at = _FRAME_AT
        self.runs: list[tuple[int, int]] = [(0, 2)]

    def add(self, size: int) -> None:
        """`size` bytes that start with a uint32."""
        start = _aligned(self.at, 4)
        self.at = start + size
        if self.runs[-1][1] == start:
            start = self.runs.pop()[0]
        self.runs.append((start, self.at))

    def add_string(self, text: str) -> None:
        self.add(4 + len(text.encode()) + 1)


class _Layout(NamedTuple):
    """Where things are in a publisher's messages."""

    length: int
    fixed: tuple[tuple[slice, bytes], ...]
    stamp: struct.Struct
    numbers: struct.Struct
    numbers_at: int

    def fits(self, data: bytes) -> bool:
        if len(data) != self.length:
            return False
        return all(data[run] == expected for run, expected in self.fixed)

    def stamp_ns(self, data: bytes) -> int:
        sec, nanosec = self.stamp.unpack_from(data, _STAMP_AT)
        return int(sec) * _NS_PER_S + int(nanosec)


def _find_layout(data: bytes, fixed: _Fixed, numbers: Sequence[float]) -> _Layout | None:
    """The layout of `data`, in which `numbers` follow what is fixed; None if it is another."""
    order = _BYTE_ORDER.get(data[:2])
    if order is None:
        return None
    layout = _Layout(
        length=len(data),
        fixed=tuple((slice(*run), data[slice(*run)]) for run in fixed.runs),
        stamp=struct.Struct(order + "iI"),
        numbers=struct.Struct(f"{order}{len(numbers)}d"),
        numbers_at=_aligned(fixed.at, 8),
    )
    found = data[layout.numbers_at : layout.numbers_at + layout.numbers.size]
    # Packed and not as numbers, because a NaN differs from itself.
    return layout if found == layout.numbers.pack(*numbers) else None


class RawWrench:
    """One received wrench: `stamp_ns`, `frame_id` and `wrench` (6,), N and N.m."""

    __slots__ = ("_data", "_layout", "frame_id", "stamp_ns", "wrench")

    def __init__(
        self,
        data: bytes,
        layout: _Layout | None,
        stamp_ns: int,
        frame_id: str,
        wrench: tuple[float, ...],
    ) -> None:
        self._data = data
        self._layout = layout
        self.stamp_ns = stamp_ns
        self.frame_id = frame_id
        self.wrench = wrench

    def with_wrench(self, wrench: Array) -> bytes:
        """The same message, serialised, with another wrench (6,)."""
        values = wrench.tolist()
        if self._layout is not None:
            out = bytearray(self._data)
            self._layout.numbers.pack_into(out, self._layout.numbers_at, *values)
            return bytes(out)
        message = deserialize_message(self._data, WrenchStamped)
        _fill(message, values)
        return bytes(serialize_message(message))


def _fill(message: WrenchStamped, values: Sequence[float]) -> None:
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = values


class WrenchWire:
    """Reads serialised geometry_msgs/WrenchStamped."""

    def __init__(self) -> None:
        self._layout: _Layout | None = None
        self._frame_id = ""

    def read(self, data: bytes) -> RawWrench:
        """Stamp, frame and wrench of a message; raises UnreadableError."""
        layout = self._layout
        if layout is not None and layout.fits(data):
            numbers = layout.numbers.unpack_from(data, layout.numbers_at)
            return RawWrench(data, layout, layout.stamp_ns(data), self._frame_id, numbers)
        return self._learn(data)

    def _learn(self, data: bytes) -> RawWrench:
        message = _deserialize(data, WrenchStamped)
        force, torque = message.wrench.force, message.wrench.torque
        wrench = (force.x, force.y, force.z, torque.x, torque.y, torque.z)
        self._frame_id = message.header.frame_id
        fixed = _Fixed()
        fixed.add_string(self._frame_id)
        self._layout = _find_layout(data, fixed, wrench)
        stamp_ns = stamp_to_ns(message.header.stamp)
        return RawWrench(data, self._layout, stamp_ns, self._frame_id, wrench)


class JointWire:
    """Reads the roll and tilt angles from serialised sensor_msgs/JointState."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        """`joint_names`: of the roll and of the tilt joint."""
        self._names = tuple(joint_names)
        self._reader = JointStateReader(joint_names)
        self._layout: _Layout | None = None
        self._roll = 0
        self._tilt = 0

    def read(self, data: bytes) -> tuple[int, float, float]:
        """Stamp (ns), roll and tilt (rad) of a message; raises JointStateError, UnreadableError."""
        layout = self._layout
        if layout is not None and layout.fits(data):
            numbers = layout.numbers.unpack_from(data, layout.numbers_at)
            return layout.stamp_ns(data), numbers[self._roll], numbers[self._tilt]
        return self._learn(data)

    def _learn(self, data: bytes) -> tuple[int, float, float]:
        message = _deserialize(data, JointState)
        (roll, tilt), _ = self._reader.read(message)
        fixed = _Fixed()
        fixed.add_string(message.header.frame_id)
        fixed.add(4)
        for name in message.name:
            fixed.add_string(name)
        fixed.add(4)
        self._layout = _find_layout(data, fixed, message.position)
        self._roll, self._tilt = (message.name.index(name) for name in self._names)
        return stamp_to_ns(message.header.stamp), float(roll), float(tilt)
