"""Reads wrenches, joint angles and IMUs from serialised messages, and writes a wrench into one.

Converting a message to Python costs rclpy more than all of the compensation. Of a publisher's
serialised messages only stamp and numbers change, and they stay at their places. So the places are
worked out for the first message (`galen_ros.cdr.layout`), and read directly as long as everything
before the numbers stays the same. A message that looks different is worked out anew.
"""

from collections.abc import Sequence
from operator import itemgetter

from galen_model.arrays import Array

from galen_ros.cdr.layout import Layout, UnreadableError, joint_state_layout, stamped_layout
from galen_ros.joint_names import check_joint_counts, joint_indices


def _unreadable(data: bytes, message_type: str, why: UnreadableError) -> UnreadableError:
    return UnreadableError(f"{len(data)} bytes came that are not a readable {message_type}: {why}")


class RawWrench:
    """One received wrench: `stamp_ns`, `frame_id` and `wrench` (6,), N and N.m."""

    __slots__ = ("_data", "_layout", "frame_id", "stamp_ns", "wrench")

    def __init__(self, data: bytes, layout: Layout) -> None:
        """Take `data`: a message that fits `layout`."""
        self._data = data
        self._layout = layout
        self.stamp_ns = layout.stamp_ns(data)
        self.frame_id = layout.frame_id
        self.wrench: tuple[float, ...] = layout.doubles[0].unpack_from(data, layout.doubles_at[0])

    def with_wrench(self, wrench: Array) -> bytes:
        """Return the same message, serialised, with another wrench (6,); every other byte stays."""
        out = bytearray(self._data)
        layout = self._layout
        layout.doubles[0].pack_into(out, layout.doubles_at[0], *wrench.tolist())
        return bytes(out)


class WrenchWire:
    """Reads serialised geometry_msgs/WrenchStamped."""

    def __init__(self) -> None:
        self._layout: Layout | None = None

    def read(self, data: bytes) -> RawWrench:
        """Stamp, frame and wrench of a message; raises UnreadableError."""
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = self._learn(data)
        return RawWrench(data, layout)

    def _learn(self, data: bytes) -> Layout:
        try:
            return stamped_layout(data, doubles=6)
        except UnreadableError as error:
            raise _unreadable(data, "geometry_msgs/msg/WrenchStamped", error) from error


class ImuWire:
    """Reads serialised sensor_msgs/Imu.

    After the header come doubles alone: orientation (4) and its covariance (9), angular velocity
    (3) and its covariance (9), linear acceleration (3) and its covariance (9).
    """

    _DOUBLES, _ANGULAR, _LINEAR = 37, slice(13, 16), slice(25, 28)

    def __init__(self) -> None:
        self._layout: Layout | None = None

    def read(self, data: bytes) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
        """Stamp (ns), angular velocity (3,), linear acceleration (3,); raises UnreadableError."""
        layout = self._layout
        if layout is None or not layout.fits(data):
            try:
                layout = self._layout = stamped_layout(data, doubles=self._DOUBLES)
            except UnreadableError as error:
                raise _unreadable(data, "sensor_msgs/msg/Imu", error) from error
        values = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
        return layout.stamp_ns(data), values[self._ANGULAR], values[self._LINEAR]


class JointWire:
    """Reads wanted joints from serialised sensor_msgs/JointState."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        """`joint_names`: at least two, in the order in which `read` gives them."""
        self._names = tuple(joint_names)
        self._layout: Layout | None = None
        self._pick = itemgetter(*range(len(self._names)))

    def read(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        """Stamp (ns) and positions; raises JointStateError, UnreadableError."""
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = self._learn(data)
        positions = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
        return layout.stamp_ns(data), self._pick(positions)

    def _learn(self, data: bytes) -> Layout:
        try:
            layout = joint_state_layout(data)
        except UnreadableError as error:
            raise _unreadable(data, "sensor_msgs/msg/JointState", error) from error
        indices = joint_indices(self._names, layout.names)
        positions, velocities, _ = layout.counts
        check_joint_counts(len(layout.names), positions, velocities)
        self._pick = itemgetter(*indices)
        return layout
