# SPDX-License-Identifier: Apache-2.0
"""Serialised messages without ROS: where their numbers are, reading and writing them.

Converting a message to Python costs rclpy more than all of the compensation. The layout is that of
CDR (OMG DDSI-RTPS 10.2, "PLAIN_CDR"): four bytes of encapsulation, then each value aligned to its
size, counted from after these four; a string or sequence starts with its length as uint32; a string
ends with a zero byte. Bytes of padding hold anything, and after the last value there may be more of
them: Fast CDR sends up to eight.

Every stamped message starts with its header: stamp (int32 s, uint32 ns), frame_id. Of one
publisher's messages only the stamp and runs of doubles change, and they stay at their places. So
`Layout` names the places of one message, and the bytes that all messages like it share. A message
that looks different is worked out anew.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

from galen_model.arrays import Array
from galen_model.errors import GalenError

NS_PER_S = 1_000_000_000
STAMP_AT = 4
_ENCAPSULATION = 4
_FRAME_AT = 12
_BYTE_ORDER = {b"\x00\x00": ">", b"\x00\x01": "<"}


class UnreadableError(GalenError):
    """Bytes that are no message of their type, as a broken or hostile sender may publish."""


class JointStateError(GalenError):
    """A JointState lacks joints that are needed, or its lists' lengths don't fit."""


@dataclass(frozen=True)
class Layout:
    """Where things are in messages of `length` bytes whose `fixed` runs are these bytes.

    `doubles_at` has the start of each run of doubles, `counts` their numbers. `names` are a
    JointState's.
    """

    order: str
    length: int
    fixed: tuple[tuple[slice, bytes], ...]
    frame_id: str
    names: tuple[str, ...]
    doubles_at: tuple[int, ...]
    counts: tuple[int, ...]

    def fits(self, data: bytes) -> bool:
        """Return whether a message has this layout.

        Args:
            data: the whole serialised message, encapsulation included.

        Returns:
            True where its length and all bytes of the `fixed` runs are the same.

        """
        if len(data) != self.length:
            return False
        for run, expected in self.fixed:  # noqa: SIM110  a generator takes twice as long
            if data[run] != expected:
                return False
        return True

    # Compiled once, because nodes read every message by them.
    @cached_property
    def stamp(self) -> struct.Struct:
        """Seconds and nanoseconds, at STAMP_AT."""
        return struct.Struct(self.order + "iI")

    @cached_property
    def doubles(self) -> tuple[struct.Struct, ...]:
        """Each run of doubles, at `doubles_at`."""
        return tuple(struct.Struct(f"{self.order}{count}d") for count in self.counts)

    def stamp_ns(self, data: bytes) -> int:
        """Return the stamp of a message.

        Args:
            data: a serialised message that fits; this is not checked again.

        Returns:
            The header's stamp, ns.

        """
        sec, nanosec = self.stamp.unpack_from(data, STAMP_AT)
        return int(sec) * NS_PER_S + int(nanosec)


def stamped_layout(data: bytes, doubles: int) -> Layout:
    """Find the layout of a header followed by doubles: WrenchStamped (6), PoseStamped (7).

    Args:
        data: the whole serialised message.
        doubles: how many doubles follow the header, in one run.

    Returns:
        The layout of this message and of those like it; no `names`.

    Raises:
        UnreadableError: the bytes are no such message.

    """
    walk = _Walk(data)
    frame_id = walk.string()
    return walk.layout(frame_id, (), [walk.doubles(doubles)], [doubles])


def joint_state_layout(data: bytes) -> Layout:
    """Find the layout of a sensor_msgs/JointState.

    Args:
        data: the whole serialised message.

    Returns:
        The layout, with three runs of doubles: positions, velocities, efforts. Their numbers may
        differ from the number of names, which `check_joint_counts` checks.

    Raises:
        UnreadableError: the bytes are no such message.

    """
    walk = _Walk(data)
    frame_id = walk.string()
    names = tuple(walk.string() for _ in range(walk.count(smallest=4)))
    starts, counts = [], []
    for _ in range(3):
        counts.append(walk.count(smallest=8))
        starts.append(walk.doubles(counts[-1]))
    return walk.layout(frame_id, names, starts, counts)


def joint_positions(data: bytes) -> dict[str, float]:
    """Return the positions of a serialised JointState by name.

    Args:
        data: the whole serialised message.

    Returns:
        Position by the joint's name, m or rad; names without a position are left out.

    Raises:
        UnreadableError: the bytes are no such message.

    """
    layout = joint_state_layout(data)
    positions = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
    return dict(zip(layout.names, positions, strict=False))


class _Walk:
    """Walks over a message's values and collects the runs of bytes that stay as they are."""

    def __init__(self, data: bytes) -> None:
        self._data = bytes(data)
        order = _BYTE_ORDER.get(self._data[:2])
        if order is None or len(data) < _FRAME_AT:
            raise UnreadableError(f"{len(data)} bytes that don't start as a serialised message")
        self._order = order
        self._at = _FRAME_AT
        self._runs: list[tuple[int, int]] = [(0, 2)]

    def count(self, smallest: int) -> int:
        """Return a sequence's length, of items that take at least `smallest` bytes."""
        start = _aligned(self._at, 4)
        self._take(start, 4)
        (count,) = struct.unpack_from(self._order + "I", self._data, start)
        if count * smallest > len(self._data):
            raise UnreadableError(f"a sequence of {count} in a message of {len(self._data)} bytes")
        return int(count)

    def string(self) -> str:
        size = self.count(smallest=1)
        start = self._at
        self._take(start, size)
        text = self._data[start : start + size]
        try:
            return text.removesuffix(b"\x00").decode()
        except UnicodeDecodeError as error:
            raise UnreadableError(f"a text in it is not UTF-8: {error}") from error

    def doubles(self, count: int) -> int:
        """Step over `count` doubles and return where they start."""
        start = _aligned(self._at, 8) if count else self._at
        self._end(start + 8 * count)
        return start

    def layout(
        self, frame_id: str, names: tuple[str, ...], starts: list[int], counts: list[int]
    ) -> Layout:
        fixed = tuple((slice(*run), self._data[slice(*run)]) for run in self._runs)
        length = len(self._data)
        return Layout(self._order, length, fixed, frame_id, names, tuple(starts), tuple(counts))

    def _take(self, start: int, size: int) -> None:
        self._end(start + size)
        if self._runs[-1][1] == start:
            start = self._runs.pop()[0]
        self._runs.append((start, self._at))

    def _end(self, at: int) -> None:
        self._at = at
        if at > len(self._data):
            raise UnreadableError(f"the message ends after {len(self._data)} bytes, in a value")


def _aligned(at: int, size: int) -> int:
    return at + (_ENCAPSULATION - at) % size


# Joints by name


def joint_indices(wanted: Sequence[str], names: Sequence[str]) -> tuple[int, ...]:
    """Return each wanted joint's place among the names of a joint state.

    Args:
        wanted: names of joints that must be there.
        names: of the joint state, in its order.

    Returns:
        The places, from 0, in the order of `wanted`.

    Raises:
        JointStateError: naming the joints that are lacking.

    """
    missing = [name for name in wanted if name not in names]
    if missing:
        raise JointStateError(
            f"joint state lacks {', '.join(missing)}; it has {', '.join(names) or 'no joints'}"
        )
    return tuple(names.index(name) for name in wanted)


def check_joint_counts(names: int, positions: int, velocities: int) -> None:
    """Check that every name of a joint state has a position, and all or none a velocity.

    Args:
        names: number of names.
        positions: number of positions.
        velocities: number of velocities; 0 where the message has none.

    Raises:
        JointStateError: a number differs.

    """
    if positions != names:
        raise JointStateError(f"joint state has {names} names but {positions} positions")
    if velocities not in (0, names):
        raise JointStateError(f"joint state has {names} names but {velocities} velocities")


# Reading


def _learn_stamped(data: bytes, message_type: str, doubles: int) -> Layout:
    try:
        return stamped_layout(data, doubles)
    except UnreadableError as error:
        raise _unreadable(data, message_type, error) from error


def _unreadable(data: bytes, message_type: str, why: UnreadableError) -> UnreadableError:
    return UnreadableError(f"{len(data)} bytes came that are not a readable {message_type}: {why}")


class RawWrench:
    """One received wrench: `stamp_ns`, `frame_id` and `wrench` (6,), N and N.m."""

    __slots__ = ("_data", "_layout", "frame_id", "stamp_ns", "wrench")

    def __init__(self, data: bytes, layout: Layout) -> None:
        """Read stamp, frame and wrench of a message.

        Args:
            data: a serialised WrenchStamped that fits `layout`.
            layout: with one run of six doubles.

        """
        self._data = data
        self._layout = layout
        self.stamp_ns = layout.stamp_ns(data)
        self.frame_id = layout.frame_id
        self.wrench: tuple[float, ...] = layout.doubles[0].unpack_from(data, layout.doubles_at[0])

    def with_wrench(self, wrench: Array) -> bytes:
        """Return the same message, serialised, with another wrench; every other byte stays.

        Args:
            wrench: (6,), N and N.m, in the message's frame.

        Returns:
            The serialised WrenchStamped, as long as the received one.

        """
        out = bytearray(self._data)
        layout = self._layout
        layout.doubles[0].pack_into(out, layout.doubles_at[0], *wrench.tolist())
        return bytes(out)


class WrenchWire:
    """Reads serialised geometry_msgs/WrenchStamped."""

    def __init__(self) -> None:
        self._layout: Layout | None = None

    def read(self, data: bytes) -> RawWrench:
        """Read a message; its layout is worked out anew only where it differs from the last one's.

        Args:
            data: a serialised geometry_msgs/WrenchStamped.

        Returns:
            Stamp, frame and wrench.

        Raises:
            UnreadableError: the bytes are no such message.

        """
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = _learn_stamped(data, "geometry_msgs/msg/WrenchStamped", 6)
        return RawWrench(data, layout)


class ImuWire:
    """Reads serialised sensor_msgs/Imu.

    After the header come doubles alone: orientation (4) and its covariance (9), angular velocity
    (3) and its covariance (9), linear acceleration (3) and its covariance (9).
    """

    _DOUBLES, _ANGULAR, _LINEAR = 37, slice(13, 16), slice(25, 28)

    def __init__(self) -> None:
        self._layout: Layout | None = None

    def read(self, data: bytes) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
        """Read a message; its layout is worked out anew only where it differs from the last one's.

        Args:
            data: a serialised sensor_msgs/Imu.

        Returns:
            Stamp, ns; angular velocity (3,), rad/s; linear acceleration (3,), m/s^2; both in the
            message's frame.

        Raises:
            UnreadableError: the bytes are no such message.

        """
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = _learn_stamped(data, "sensor_msgs/msg/Imu", self._DOUBLES)
        values = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
        return layout.stamp_ns(data), values[self._ANGULAR], values[self._LINEAR]


def _picker(indices: Sequence[int]) -> Callable[[Any], tuple[float, ...]]:
    """Return what picks these places as a tuple; itemgetter gives one alone as a number."""
    if len(indices) == 1:
        return itemgetter(slice(indices[0], indices[0] + 1))
    return itemgetter(*indices)


class JointWire:
    """Reads wanted joints from serialised sensor_msgs/JointState, in any order, among others."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        """Read these joints.

        Args:
            joint_names: at least one, in the order in which `read` gives them.

        """
        self._names = tuple(joint_names)
        self._layout: Layout | None = None
        self._pick = _picker(range(len(self._names)))

    def read(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        """Read stamp and positions of the wanted joints.

        Args:
            data: a serialised sensor_msgs/JointState.

        Returns:
            Stamp, ns; positions, m or rad, in the order of the wanted names.

        Raises:
            JointStateError: a joint is lacking, or the lists' lengths don't fit.
            UnreadableError: the bytes are no such message.

        """
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = self._learn(data)
        positions = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
        return layout.stamp_ns(data), self._pick(positions)

    def read_motion(self, data: bytes) -> tuple[int, tuple[float, ...], tuple[float, ...] | None]:
        """Read stamp, positions and velocities of the wanted joints.

        Args:
            data: a serialised sensor_msgs/JointState.

        Returns:
            Stamp, ns; positions, m or rad; velocities, m/s or rad/s, or None where the message has
            none.

        Raises:
            JointStateError: a joint is lacking, or the lists' lengths don't fit.
            UnreadableError: the bytes are no such message.

        """
        stamp_ns, positions = self.read(data)
        layout = self._layout
        assert layout is not None
        if not layout.counts[1]:
            return stamp_ns, positions, None
        velocities = layout.doubles[1].unpack_from(data, layout.doubles_at[1])
        return stamp_ns, positions, self._pick(velocities)

    def _learn(self, data: bytes) -> Layout:
        try:
            layout = joint_state_layout(data)
        except UnreadableError as error:
            raise _unreadable(data, "sensor_msgs/msg/JointState", error) from error
        indices = joint_indices(self._names, layout.names)
        positions, velocities, _ = layout.counts
        check_joint_counts(len(layout.names), positions, velocities)
        self._pick = _picker(indices)
        return layout


# Writing


class MessageBytes:
    """A little-endian message with a header, whose stamp and runs of numbers are written over."""

    def __init__(self, frame_id: str, *doubles: int) -> None:
        """Lay out a message whose numbers are all zero.

        Args:
            frame_id: of its header.
            *doubles: how many doubles each run has, of those that follow the header.

        """
        self._data = bytearray(b"\x00\x01\x00\x00" + bytes(8))
        self._runs: list[tuple[struct.Struct, int]] = []
        self._add_string(frame_id)
        for count in doubles:
            self._add_doubles(count)

    def fill(self, stamp_ns: int, *runs: Sequence[float]) -> bytes:
        """Write stamp and numbers into the message.

        Args:
            stamp_ns: the header's stamp, ns.
            *runs: the values of each run, in the message's order, as many as it was laid out for.

        Returns:
            A copy of the serialised message.

        Raises:
            struct.error: a run has another length.
            ValueError: the number of runs is another one.

        """
        struct.pack_into("<iI", self._data, STAMP_AT, *divmod(stamp_ns, NS_PER_S))
        for (layout, start), values in zip(self._runs, runs, strict=True):
            layout.pack_into(self._data, start, *values)
        return bytes(self._data)

    def _add_count(self, count: int) -> None:
        self._pad(4)
        self._data += struct.pack("<I", count)

    def _add_string(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self._add_count(len(encoded))
        self._data += encoded

    def _add_doubles(self, count: int) -> None:
        self._pad(8)
        self._runs.append((struct.Struct(f"<{count}d"), len(self._data)))
        self._data += bytes(8 * count)

    def _add_bool(self) -> None:
        self._runs.append((struct.Struct("<?"), len(self._data)))
        self._data += b"\x00"

    def _pad(self, size: int) -> None:
        self._data += bytes((_ENCAPSULATION - len(self._data)) % size)


def wrench_bytes(frame_id: str) -> MessageBytes:
    """Make a geometry_msgs/WrenchStamped.

    Args:
        frame_id: frame that the wrench is written in.

    Returns:
        The message; its `fill` takes a wrench (6,), force then torque, N and N.m.

    """
    return MessageBytes(frame_id, 6)


def pose_bytes(frame_id: str) -> MessageBytes:
    """Make a geometry_msgs/PoseStamped.

    Args:
        frame_id: frame that the pose is relative to.

    Returns:
        The message; its `fill` takes position (3,), m, and quaternion (4,), xyzw.

    """
    return MessageBytes(frame_id, 3, 4)


def deflection_bytes(frame_id: str) -> MessageBytes:
    """Make a galen_msgs/DeflectionStamped.

    Args:
        frame_id: frame that the deflection is written in.

    Returns:
        The message; its `fill` takes translation and rotation (6,), m and rad; their covariance
        (36,), row by row; and (1,) whether it is extrapolated.

    """
    made = MessageBytes(frame_id, 6, 36)
    made._add_bool()
    return made


def joint_state_bytes(joint_names: Sequence[str], frame_id: str = "") -> MessageBytes:
    """Make a sensor_msgs/JointState without efforts.

    Args:
        joint_names: n names.
        frame_id: of the header; drivers leave it empty.

    Returns:
        The message; its `fill` takes positions (n,), m or rad, and velocities (n,), m/s or rad/s.

    """
    made = MessageBytes(frame_id)
    count = len(joint_names)
    made._add_count(count)
    for name in joint_names:
        made._add_string(name)
    for _ in ("positions", "velocities"):
        made._add_count(count)
        made._add_doubles(count)
    # Fast CDR would pad four bytes more here, which readers of bags trip over.
    made._add_count(0)
    return made
