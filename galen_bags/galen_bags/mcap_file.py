"""One MCAP file, read in whole chunks: messages come as arrays of places, not one by one.

Records are (opcode uint8, length uint64, content), little-endian; a chunk holds records,
compressed. The order of the records, the chunks' times and where the file breaks off are found by
stepping from header to header, so a file without summary or footer is read as far as it goes
(MCAP format specification, version 0).
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

import numpy as np
from lz4.frame import LZ4FrameDecompressor

from galen_bags.errors import BagError
from galen_bags.raw_block import Messages, TopicInfo

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS, _DATA_END = 0x0B, 0x0F
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_LARGEST_CHUNK_BYTES = 1 << 30
_WINDOW_BYTES = 1 << 16
# Messages outside of chunks are read in pieces of this size.
_PIECE_BYTES = 1 << 20
_MESSAGE_HEAD = np.dtype(
    [("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")]
)
_HEAD_BYTES = 9 + _MESSAGE_HEAD.itemsize


class _DamagedError(Exception):
    """A part of the file that can't be read; the rest may be."""


@dataclass(frozen=True)
class _Extent:
    """A chunk's content, or a run of messages outside of chunks, in the file."""

    start: int
    length: int
    first_ns: int
    last_ns: int
    chunk: bool
    cut: bool = False


@dataclass
class _Records:
    """Where a stretch's message records start and stop."""

    messages: list[int] = field(default_factory=list)
    stops: list[int] = field(default_factory=list)


class McapFile:
    """An open MCAP file. `topics` by name; `problems` are sentences and grow while reading."""

    def __init__(self, path: Path) -> None:
        """Find chunks and topics. Raises BagError if it is no MCAP file, or can't be read."""
        self.path = path
        self.problems: list[str] = []
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[str, int, str]] = {}
        self._counts: dict[int, int] = {}
        self._extents: list[_Extent] = []
        self._summary = False
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise BagError(f"{path}: can't be read: {error.strerror}") from error
        try:
            self._scan()
            if not (self._summary and self._channels and self._counts):
                self._count_messages()
        except OSError as error:
            self.close()
            raise BagError(f"{path}: can't be read: {error.strerror}") from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def topics(self) -> list[TopicInfo]:
        """What the channels carry; a topic may have several."""
        found = []
        for number, (topic, schema, encoding) in self._channels.items():
            name, form, text = self._schemas.get(schema, ("", "", ""))
            count = self._counts.get(number, 0)
            found.append(TopicInfo(topic, name, count, encoding, form, text))
        return found

    def messages(self, wanted: dict[str, int]) -> Iterator[Messages]:
        """Messages of the `wanted` topics ({name: number}) in order of log time.

        Chunks may overlap in time; what is later than the next one's start waits for it.
        """
        numbers = np.full(1 << 16, -1, dtype=np.int32)
        order = sorted(self._extents, key=lambda extent: (extent.first_ns, extent.start))
        waiting: Messages | None = None
        for index, extent in enumerate(order):
            content = self._content(extent)
            if content is None:
                continue
            records = self._walk(content)
            for channel, (topic, _, _) in self._channels.items():
                numbers[channel] = wanted.get(topic, -1)
            found = _gather(content, records, numbers)
            if waiting is not None:
                found = waiting.joined(found)
            found = found.sorted()
            upto = order[index + 1].first_ns if index + 1 < len(order) else None
            ready, waiting = found.split(upto)
            if len(ready):
                yield ready
        if waiting is not None and len(waiting):
            yield waiting

    # --- the file's records -----------------------------------------------------------------

    def _scan(self) -> None:
        """Step over the file's records, from header to header."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise BagError(f"{self.path}: is no MCAP file (its first bytes are others)")
        size = self.path.stat().st_size
        at = len(_MAGIC)
        window, window_at = b"", 0
        piece: list[int] = []
        while at + _RECORD.size <= size:
            if not window_at <= at <= window_at + len(window) - 64:
                self._file.seek(at)
                window, window_at = self._file.read(_WINDOW_BYTES), at
            opcode, length = _RECORD.unpack_from(window, at - window_at)
            stop = at + _RECORD.size + length
            if opcode == _MESSAGE and stop <= size:
                if piece and stop - piece[0] > _PIECE_BYTES:
                    self._add_piece(piece)
                    piece = []
                piece = [piece[0] if piece else at, stop]
            elif piece:
                self._add_piece(piece)
                piece = []
            if opcode == _CHUNK:
                self._add_chunk(at + _RECORD.size, min(stop, size), cut=stop > size)
            if stop > size:
                break
            if opcode == _FOOTER:
                self._summary = True
                at = stop
                break
            if opcode in (_SCHEMA, _CHANNEL, _STATISTICS):
                self._file.seek(at)
                self._learn(self._file.read(stop - at), 0, opcode, length)
                window = b""
            at = stop
        if piece:
            self._add_piece(piece)
        if not self._summary:
            self.problems.append(
                f"{self.path.name} was cut off: it has no end; it is read as far as it goes"
            )

    def _add_piece(self, piece: list[int]) -> None:
        start, stop = piece
        self._file.seek(start)
        content = self._file.read(stop - start)
        records = self._walk(content)
        times = _heads(np.frombuffer(content, np.uint8), np.array(records.messages))["log_time"]
        first, last = int(times.min()), int(times.max())
        if self._extents and not self._extents[-1].chunk and first < self._extents[-1].last_ns:
            # Sorting over the whole file would need all of it in memory.
            self.problems.append(f"{self.path.name}: messages without chunks are out of order")
        self._extents.append(_Extent(start, stop - start, first, last, chunk=False))

    def _add_chunk(self, start: int, stop: int, *, cut: bool) -> None:
        self._file.seek(start)
        head = self._file.read(_CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return
        first, last, _, _ = _CHUNK_HEAD.unpack(head)
        self._extents.append(_Extent(start, stop - start, first, last, chunk=True, cut=cut))

    def _content(self, extent: _Extent) -> bytes | None:
        """The records of an extent; None and a problem where they can't be had."""
        self._file.seek(extent.start)
        stored = self._file.read(extent.length)
        if not extent.chunk:
            return stored
        try:
            return _unpack_chunk(stored, extent.cut)
        except _DamagedError as damage:
            span_s = max(0, extent.last_ns - extent.first_ns) * 1e-9
            self._problem(
                f"{self.path.name}: the chunk at byte {extent.start} is damaged ({damage}); its"
                f" {span_s:.3f} s are missing"
            )
            return None

    def _problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    def _count_messages(self) -> None:
        """Find topics and counts in the chunks themselves, for want of a summary."""
        counts = np.zeros(1 << 16, dtype=np.int64)
        for extent in self._extents:
            content = self._content(extent)
            if content is None:
                continue
            records = self._walk(content)
            if records.messages:
                heads = _heads(np.frombuffer(content, np.uint8), np.array(records.messages))
                counts += np.bincount(heads["channel"], minlength=1 << 16)
        self._counts = {int(channel): int(counts[channel]) for channel in np.flatnonzero(counts)}

    def _walk(self, content: bytes) -> _Records:
        """Step over the records in `content`; learn schemas and channels on the way."""
        records = _Records()
        add, add_stop = records.messages.append, records.stops.append
        unpack, head = _RECORD.unpack_from, _RECORD.size
        at, end = 0, len(content)
        while at + head <= end:
            opcode, length = unpack(content, at)
            stop = at + head + length
            if stop > end:
                break
            if opcode == _MESSAGE:
                if stop - at >= _HEAD_BYTES:
                    add(at)
                    add_stop(stop)
            elif opcode in (_SCHEMA, _CHANNEL):
                self._learn(content, at, opcode, length)
            at = stop
        return records

    def _learn(self, content: bytes, at: int, opcode: int, length: int) -> None:
        """Take note of a schema, a channel or the statistics."""
        body = _Body(content[at + _RECORD.size : at + _RECORD.size + length])
        try:
            if opcode == _SCHEMA:
                number = body.number("<H")
                self._schemas[number] = (body.text(), body.text(), body.text())
            elif opcode == _CHANNEL:
                number, schema = body.number("<H"), body.number("<H")
                self._channels[number] = (body.text(), schema, body.text())
            else:
                body.skip(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
                pairs = body.number("<I") // 10
                self._counts = {body.number("<H"): body.number("<Q") for _ in range(pairs)}
        except (struct.error, UnicodeDecodeError) as error:
            self._problem(f"{self.path.name}: a record at byte {at} is damaged ({error})")


class _Body:
    """Reads a record's content from its beginning."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def number(self, form: str) -> int:
        (value,) = struct.unpack_from(form, self._content, self._at)
        self._at += struct.calcsize(form)
        return int(value)

    def text(self) -> str:
        size = self.number("<I")
        text = self._content[self._at : self._at + size]
        if len(text) != size:
            raise struct.error("a text ends outside its record")
        self._at += size
        return text.decode()

    def skip(self, size: int) -> None:
        self._at += size


def _unpack_chunk(stored: bytes, cut: bool) -> bytes:
    """The records of a chunk's content; raises _DamagedError. A cut chunk gives what is there."""
    body = _Body(stored)
    try:
        body.skip(16)
        size, checksum = body.number("<Q"), body.number("<I")
        compression = body.text()
        packed_size = body.number("<Q")
    except (struct.error, UnicodeDecodeError) as error:
        if cut:
            return b""
        raise _DamagedError(str(error)) from error
    if size > _LARGEST_CHUNK_BYTES:
        raise _DamagedError(f"it claims {size} bytes")
    start = _CHUNK_HEAD.size + 4 + len(compression.encode()) + 8
    packed = stored[start : start + packed_size]
    content = _decompress(packed, compression, size)
    if cut:
        return content
    if len(content) != size:
        raise _DamagedError(f"{len(content)} bytes instead of {size}")
    if checksum and crc32(content) != checksum:
        raise _DamagedError("its checksum is another")
    return content


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    if not compression:
        return packed
    decompressor: Any
    if compression == "zstd":
        decompressor = zstd.ZstdDecompressor()
    elif compression == "lz4":
        decompressor = LZ4FrameDecompressor()
    else:
        raise _DamagedError(f"compression {compression!r} is not known")
    try:
        # One byte more than announced, to see that there is no more.
        content: bytes = decompressor.decompress(packed, max_length=size + 1)
    except (zstd.ZstdError, RuntimeError, EOFError) as error:
        raise _DamagedError(str(error)) from error
    return content


def _heads(data: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The heads (channel, times) of the message records that start at `at`."""
    size = _MESSAGE_HEAD.itemsize
    if not len(at):
        return np.zeros(0, _MESSAGE_HEAD)
    windows = np.lib.stride_tricks.sliding_window_view(data, size)[at + _RECORD.size]
    return windows.view(_MESSAGE_HEAD)[:, 0]


def _gather(content: bytes, records: _Records, numbers: np.ndarray) -> Messages:
    """The wanted messages of a stretch of records; `numbers`: of the topic, by channel."""
    data = np.frombuffer(content, np.uint8)
    at = np.array(records.messages, dtype=np.int64)
    heads = _heads(data, at)
    stop = np.array(records.stops, dtype=np.int64)
    topic = numbers[heads["channel"]]
    kept = np.flatnonzero(topic >= 0)
    start = at[kept] + _HEAD_BYTES
    return Messages(
        topic=topic[kept],
        log_time_ns=heads["log_time"][kept].astype(np.int64),
        data=data,
        start=start,
        size=stop[kept] - start,
    )
