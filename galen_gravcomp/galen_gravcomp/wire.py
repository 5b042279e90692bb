"""Reads wrenches and joint angles from serialised messages, and writes a wrench into one.

Converting a message to Python and back costs rclpy more than all of the compensation. Of a
publisher's serialised messages only stamp and numbers change, and they stay at their places. So
these places are found once, with the help of rclpy's own serialisation, and are read directly as
long as the bytes around them stay the same. Whatever looks different goes through rclpy.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from galen_model.arrays import Array
from galen_ros.conversions import JointStateReader, stamp_to_ns
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

_NS_PER_S = 1_000_000_000
# The encapsulation's four bytes, then the header's stamp, then what hardly ever changes.
_STAMP_AT = 4
_AFTER_STAMP = 12


class _Layout(NamedTuple):
    """Where things are in a publisher's messages."""

    length: int
    encapsulation: bytes
    fixed: bytes  # from after the stamp to the numbers
    numbers_at: int
    stamp: struct.Struct
    numbers: struct.Struct

    def fits(self, data: bytes) -> bool:
        return (
            len(data) == self.length
            and data[_AFTER_STAMP : self.numbers_at] == self.fixed
            and data[:_STAMP_AT] == self.encapsulation
        )

    def stamp_ns(self, data: bytes) -> int:
        sec, nanosec = self.stamp.unpack_from(data, _STAMP_AT)
        return int(sec) * _NS_PER_S + int(nanosec)


def _find_layout(data: bytes, marked: Any, markers: Sequence[float]) -> _Layout | None:
    """The layout of `data`, if it is that of `marked`: the same message with other numbers.

    `markers` are the numbers in `marked` that stand in one run and nowhere else.
    """
    template = serialize_message(marked)
    order = "<" if template[1] & 1 else ">"  # the second byte of CDR says which end comes first
    numbers = struct.Struct(f"{order}{len(markers)}d")
    pattern = numbers.pack(*markers)
    if template.count(pattern) != 1:
        return None
    numbers_at = template.index(pattern)
    layout = _Layout(
        length=len(template),
        encapsulation=template[:_STAMP_AT],
        fixed=template[_AFTER_STAMP:numbers_at],
        numbers_at=numbers_at,
        stamp=struct.Struct(order + "iI"),
        numbers=numbers,
    )
    return layout if layout.fits(data) else None


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
        """Stamp, frame and wrench of a message."""
        layout = self._layout
        if layout is not None and layout.fits(data):
            numbers = layout.numbers.unpack_from(data, layout.numbers_at)
            return RawWrench(data, layout, layout.stamp_ns(data), self._frame_id, numbers)
        return self._learn(data)

    def _learn(self, data: bytes) -> RawWrench:
        message = deserialize_message(data, WrenchStamped)
        force, torque = message.wrench.force, message.wrench.torque
        wrench = (force.x, force.y, force.z, torque.x, torque.y, torque.z)
        stamp_ns, frame_id = stamp_to_ns(message.header.stamp), message.header.frame_id
        markers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
        _fill(message, markers)
        self._layout = _find_layout(data, message, markers)
        self._frame_id = frame_id
        return RawWrench(data, self._layout, stamp_ns, frame_id, wrench)


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
        """Stamp (ns), roll and tilt (rad) of a message; raises JointStateError."""
        layout = self._layout
        if layout is not None and layout.fits(data):
            numbers = layout.numbers.unpack_from(data, layout.numbers_at)
            return layout.stamp_ns(data), numbers[self._roll], numbers[self._tilt]
        return self._learn(data)

    def _learn(self, data: bytes) -> tuple[int, float, float]:
        message = deserialize_message(data, JointState)
        (roll, tilt), _ = self._reader.read(message)
        stamp_ns = stamp_to_ns(message.header.stamp)
        markers = [1.0 + index for index in range(len(message.name))]
        message.position = markers
        message.velocity = [0.0] * len(message.velocity)
        message.effort = [0.0] * len(message.effort)
        self._layout = _find_layout(data, message, markers)
        self._roll, self._tilt = (message.name.index(name) for name in self._names)
        return stamp_ns, float(roll), float(tilt)
