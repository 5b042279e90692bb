"""The two 500 Hz messages, serialised from a template.

rclpy takes 10 us or so to convert a message, as much as the whole plant takes for the sample, and
its publishers take serialised bytes as well. Only stamp and numbers change from sample to sample,
and they are always at the same place; so a serialised message is kept and these places are
written over. Tests hold the bytes against rclpy's own.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

_NS_PER_S = 1_000_000_000
# The encapsulation's four bytes come first, then the header's stamp.
_STAMP_OFFSET = 4


class _Template:
    """A serialised message whose stamp and groups of doubles can be written over."""

    def __init__(self, message: Any, groups: Sequence[Sequence[float]]) -> None:
        """`groups` are runs of numbers that occur in `message` once each, to find their places."""
        self._bytes = bytearray(serialize_message(message))
        # CDR says in its second byte whether it is little-endian.
        order = "<" if self._bytes[1] & 1 else ">"
        self._stamp = struct.Struct(order + "iI")
        self._groups = []
        for group in groups:
            layout = struct.Struct(f"{order}{len(group)}d")
            pattern = layout.pack(*group)
            if self._bytes.count(pattern) != 1:
                raise ValueError(f"can't tell where {group} is in a {type(message).__name__}")
            self._groups.append((layout, self._bytes.index(pattern)))

    def fill(self, stamp_ns: int, *groups: Sequence[float]) -> bytes:
        self._stamp.pack_into(self._bytes, _STAMP_OFFSET, *divmod(stamp_ns, _NS_PER_S))
        for (layout, offset), values in zip(self._groups, groups, strict=True):
            layout.pack_into(self._bytes, offset, *values)
        return bytes(self._bytes)


class JointStateBytes:
    """Serialised sensor_msgs/JointState with positions and velocities, no efforts."""

    def __init__(self, joint_names: Sequence[str], frame_id: str) -> None:
        count = len(joint_names)
        positions = [1.0 + index for index in range(count)]
        velocities = [-1.0 - index for index in range(count)]
        message = JointState(name=list(joint_names), position=positions, velocity=velocities)
        message.header.frame_id = frame_id
        self._template = _Template(message, [positions, velocities])

    def fill(self, stamp_ns: int, positions: Sequence[float], velocities: Sequence[float]) -> bytes:
        """Return the message's bytes."""
        return self._template.fill(stamp_ns, positions, velocities)


class WrenchBytes:
    """Serialised geometry_msgs/WrenchStamped."""

    def __init__(self, frame_id: str) -> None:
        message = WrenchStamped()
        message.header.frame_id = frame_id
        force, torque = message.wrench.force, message.wrench.torque
        force.x, force.y, force.z = 1.0, 2.0, 3.0
        torque.x, torque.y, torque.z = 4.0, 5.0, 6.0
        self._template = _Template(message, [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])

    def fill(self, stamp_ns: int, wrench: Sequence[float]) -> bytes:
        """Return the message's bytes for a wrench (6,), force then torque."""
        return self._template.fill(stamp_ns, wrench)
