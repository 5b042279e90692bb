"""Serialised messages without ROS: where things are in them, and writing them from numbers.

The layout is that of CDR (OMG DDSI-RTPS 10.2, "PLAIN_CDR"): four bytes of encapsulation, then each
value aligned to its size, counted from after these four; a string or sequence starts with its
length as uint32; a string ends with a zero byte. Bytes of padding hold anything, and after the last
value there may be more of them: Fast CDR sends up to eight.

Every stamped message starts with its header: stamp (int32 s, uint32 ns), frame_id. Of one
publisher's messages only the stamp and runs of doubles change, and they stay at their places. So
`Layout` names the places of one message, and the bytes that all messages like it share.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from galen_model.errors import GalenError

NS_PER_S = 1_000_000_000
ENCAPSULATION = 4
STAMP_AT = 4
_FRAME_AT = 12
_BYTE_ORDER = {b"\x00\x00": ">", b"\x00\x01": "<"}


class UnreadableError(GalenError):
    """Bytes that are no message of their type, as a broken or hostile sender may publish."""


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
        """Whether `data` is laid out so."""
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
        """Return the stamp of a message that fits, ns."""
        sec, nanosec = self.stamp.unpack_from(data, STAMP_AT)
        return int(sec) * NS_PER_S + int(nanosec)


def stamped_layout(data: bytes, doubles: int) -> Layout:
    """Layout of a header followed by `doubles`, as in WrenchStamped (6) and PoseStamped (7).

    Raises UnreadableError.
    """
    walk = _Walk(data)
    frame_id = walk.string()
    return walk.layout(frame_id, (), [walk.doubles(doubles)], [doubles])


def joint_state_layout(data: bytes) -> Layout:
    """Layout of a sensor_msgs/JointState: runs of positions, velocities, efforts.

    Raises UnreadableError.
    """
    walk = _Walk(data)
    frame_id = walk.string()
    names = tuple(walk.string() for _ in range(walk.count(smallest=4)))
    starts, counts = [], []
    for _ in range(3):
        counts.append(walk.count(smallest=8))
        starts.append(walk.doubles(counts[-1]))
    return walk.layout(frame_id, names, starts, counts)


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
    return at + (ENCAPSULATION - at) % size


class _Template:
    """A little-endian message with a header, whose stamp and runs of doubles are written over."""

    def __init__(self, frame_id: str) -> None:
        self._data = bytearray(b"\x00\x01\x00\x00" + bytes(8))
        self._runs: list[tuple[struct.Struct, int]] = []
        self.add_string(frame_id)

    def add_count(self, count: int) -> None:
        self._pad(4)
        self._data += struct.pack("<I", count)

    def add_string(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.add_count(len(encoded))
        self._data += encoded

    def add_doubles(self, count: int) -> None:
        self._pad(8)
        self._runs.append((struct.Struct(f"<{count}d"), len(self._data)))
        self._data += bytes(8 * count)

    def add_bool(self) -> None:
        self._runs.append((struct.Struct("<?"), len(self._data)))
        self._data += b"\x00"

    def fill(self, stamp_ns: int, *runs: Sequence[float]) -> bytes:
        """Write the message; a run of another length than the message's is a struct.error."""
        struct.pack_into("<iI", self._data, STAMP_AT, *divmod(stamp_ns, NS_PER_S))
        for (layout, start), values in zip(self._runs, runs, strict=True):
            layout.pack_into(self._data, start, *values)
        return bytes(self._data)

    def _pad(self, size: int) -> None:
        self._data += bytes((ENCAPSULATION - len(self._data)) % size)


class WrenchBytes:
    """Serialised geometry_msgs/WrenchStamped."""

    def __init__(self, frame_id: str) -> None:
        self._template = _Template(frame_id)
        self._template.add_doubles(6)

    def fill(self, stamp_ns: int, wrench: Sequence[float]) -> bytes:
        """Return the message's bytes for a wrench (6,), force then torque, N and N.m."""
        return self._template.fill(stamp_ns, wrench)


class PoseBytes:
    """Serialised geometry_msgs/PoseStamped."""

    def __init__(self, frame_id: str) -> None:
        self._template = _Template(frame_id)
        self._template.add_doubles(7)

    def fill(
        self, stamp_ns: int, position_m: Sequence[float], quaternion_xyzw: Sequence[float]
    ) -> bytes:
        """Return the message's bytes for a position (3,) and a quaternion (4,)."""
        return self._template.fill(stamp_ns, [*position_m, *quaternion_xyzw])


class DeflectionBytes:
    """Serialised galen_msgs/DeflectionStamped."""

    def __init__(self, frame_id: str) -> None:
        self._template = _Template(frame_id)
        self._template.add_doubles(42)
        self._template.add_bool()

    def fill(
        self,
        stamp_ns: int,
        deflection: Sequence[float],
        covariance: Sequence[float],
        extrapolated: bool,
    ) -> bytes:
        """Return the message's bytes: translation and rotation (6,), m, rad; covariance (36,)."""
        return self._template.fill(stamp_ns, [*deflection, *covariance], [extrapolated])


class JointStateBytes:
    """Serialised sensor_msgs/JointState with positions and velocities, no efforts."""

    def __init__(self, joint_names: Sequence[str], frame_id: str = "") -> None:
        count = len(joint_names)
        self._template = _Template(frame_id)
        self._template.add_count(count)
        for name in joint_names:
            self._template.add_string(name)
        for _ in ("positions", "velocities"):
            self._template.add_count(count)
            self._template.add_doubles(count)
        # Fast CDR would pad four bytes more here, which readers of bags trip over.
        self._template.add_count(0)

    def fill(self, stamp_ns: int, positions: Sequence[float], velocities: Sequence[float]) -> bytes:
        """Return the message's bytes; positions and velocities (n,)."""
        return self._template.fill(stamp_ns, positions, velocities)
