# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file: where they are in a stretch of bytes, and what is in them.

Records are (opcode uint8, length uint64, content), little-endian (MCAP format specification,
version 0). In a chunk there are schemas, channels and messages, one after the other.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
from lz4.frame import LZ4FrameDecompressor

from galen_bags.formats.raw_block import windows

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
STATISTICS = 0x0B
# Private and later kinds of records have opcodes from here on, and may be skipped.
_FIRST_PRIVATE = 0x80
# The largest chunk, or message outside of one, that is read: more than any recorder makes of one,
# and what a file that claims more may cost.
LARGEST_BYTES = 1 << 28
_MOST_FRAMES = 16

RECORD = struct.Struct("<BQ")
# First and last log time (signed, as in rosbag2), size, checksum.
CHUNK_HEAD = struct.Struct("<qqQI")
_INDEX_HEAD = struct.Struct("<BQHI")
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"), ("length", "<u8"),
        ("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<i8"), ("publish_time", "<u8"),
    ]
)  # fmt: skip
_LEAST_LENGTH = MESSAGE_HEAD.itemsize - RECORD.size


class DamagedError(Exception):
    """A part of a file that can't be read; the rest may be."""


@dataclass(frozen=True)
class Walk:
    """The records of a stretch of bytes.

    heads (n,) of MESSAGE_HEAD and start (n,): the messages' heads, and where their records start;
    `others`: (opcode, start) of schemas and channels; `end`: how far the records go.
    """

    heads: np.ndarray
    start: np.ndarray
    others: list[tuple[int, int]]
    end: int


def walk(content: bytes, message_starts: np.ndarray | None = None) -> Walk:
    """Step from record to record, up to one that doesn't belong into a chunk, or is cut.

    Args:
        content: a chunk's content, uncompressed, or messages outside of chunks.
        message_starts: where a message index has the messages, in bytes from the beginning, sorted.
            It is believed only if stepping would find the same: a record starts where another one
            stops. None: there is no index.

    Returns:
        The records found, in the order of the bytes.

    """
    if message_starts is not None and len(message_starts):
        found = _check_index(content, message_starts)
        if found is not None:
            return found
    messages: list[int] = []
    others: list[tuple[int, int]] = []
    end = _step(content, 0, len(content), messages, others)
    start = np.array(messages, dtype=np.int64)
    return Walk(_heads(content, start), start, others, end)


def _step(
    content: bytes, at: int, end: int, messages: list[int], others: list[tuple[int, int]]
) -> int:
    """Step over the records from `at`, collect where they start; returns where they end."""
    add, unpack = messages.append, RECORD.unpack_from
    while at + 9 <= end:
        opcode, length = unpack(content, at)
        stop = at + 9 + length
        if stop > end:
            break
        if opcode == MESSAGE:
            if length < _LEAST_LENGTH:
                break
            add(at)
        elif opcode in (SCHEMA, CHANNEL):
            others.append((opcode, at))
        elif opcode < _FIRST_PRIVATE:
            break
        at = stop
    return at


def _check_index(content: bytes, start: np.ndarray) -> Walk | None:
    """Return the walk, if the messages at `start` and what is between them fill the content."""
    if start[0] < 0 or start[-1] + MESSAGE_HEAD.itemsize > len(content):
        return None
    heads = _heads(content, start)
    if not (heads["opcode"] == MESSAGE).all():
        return None
    length = heads["length"]
    if int(length.max()) > len(content) or int(length.min()) < _LEAST_LENGTH:
        return None
    stop = start + RECORD.size + length.astype(np.int64)
    gaps = np.flatnonzero(start[1:] != stop[:-1]) + 1
    messages: list[int] = []
    others: list[tuple[int, int]] = []
    for index in [0, *gaps.tolist()]:
        before = int(stop[index - 1]) if index else 0
        if _step(content, before, int(start[index]), messages, others) != start[index]:
            return None
    end = int(stop[-1])
    if end > len(content):
        return None
    end = _step(content, end, len(content), messages, others)
    return None if messages else Walk(heads, start, others, end)


def _heads(content: bytes, start: np.ndarray) -> np.ndarray:
    if not len(start):
        return np.zeros(0, MESSAGE_HEAD)
    data = np.frombuffer(content, np.uint8)
    return windows(data, MESSAGE_HEAD.itemsize)[start].view(MESSAGE_HEAD)[:, 0]


def indexed_starts(index: bytes) -> np.ndarray:
    """Return where the message indexes after a chunk place its messages.

    Args:
        index: the index records, one after the other, each with opcode and length; may be cut off.

    Returns:
        Starts (n,), bytes from the beginning of the chunk's content, sorted; as the file has them,
        unchecked.

    """
    parts = []
    at = 0
    while at + _INDEX_HEAD.size <= len(index):
        _, length, _, size = _INDEX_HEAD.unpack_from(index, at)
        first = at + _INDEX_HEAD.size
        size = min(size, len(index) - first) // 16 * 16
        parts.append(np.frombuffer(index, "<i8", size // 8, first)[1::2])
        at += RECORD.size + length
    return np.sort(np.concatenate(parts)) if parts else np.zeros(0, np.int64)


class Body:
    """Reads a record's content from its beginning; struct.error where it ends too early."""

    def __init__(self, content: bytes) -> None:
        """Take the content, without opcode and length."""
        self._content = content
        self._at = 0

    def number(self, form: str) -> int:
        """Read the next number.

        Args:
            form: its struct format, such as "<H".

        Returns:
            The number.

        Raises:
            struct.error: the content ends before.

        """
        (value,) = struct.unpack_from(form, self._content, self._at)
        self._at += struct.calcsize(form)
        return int(value)

    def text(self) -> str:
        """Return the next text, after its length."""
        text = self.rest(self.number("<I"))
        return text.decode()

    def rest(self, size: int) -> bytes:
        """Read the next bytes, all of them.

        Args:
            size: how many, in bytes.

        Returns:
            So many bytes.

        Raises:
            struct.error: the content ends before.

        """
        found = self._content[self._at : self._at + size]
        if len(found) != size:
            raise struct.error(f"{size} bytes are announced and {len(found)} are there")
        self._at += size
        return found

    def upto(self, size: int) -> bytes:
        """Return the next bytes, or those that are there, without stepping over them.

        Args:
            size: how many, in bytes.

        Returns:
            At most so many bytes.

        """
        return self._content[self._at : self._at + size]

    def skip(self, size: int) -> None:
        """Step over bytes.

        Args:
            size: how many, in bytes; what comes next fails if they aren't there.

        """
        self._at += size


def unpack_chunk(stored: bytes, *, cut: bool) -> bytes:
    """Return the records of a chunk.

    Args:
        stored: the chunk record's content: times, size, checksum, compression, the records packed.
        cut: the file breaks off in this chunk: give the records up to there, unchecked.

    Returns:
        The records, one after the other, uncompressed.

    Raises:
        DamagedError: size, checksum or compression is wrong.

    """
    body = Body(stored)
    try:
        body.skip(16)
        size, checksum = body.number("<Q"), body.number("<I")
        compression = body.text()
        packed_size = body.number("<Q")
        packed = body.upto(packed_size) if cut else body.rest(packed_size)
    except (struct.error, UnicodeDecodeError) as error:
        if cut:
            return b""
        raise DamagedError(str(error)) from error
    if size > LARGEST_BYTES:
        raise DamagedError(f"it claims to hold {size} bytes, more than {LARGEST_BYTES}")
    content = _decompress(packed, compression, size)
    if cut:
        return content
    if len(content) != size:
        raise DamagedError(f"it holds {len(content)} bytes instead of {size}")
    if checksum and crc32(content) != checksum:
        raise DamagedError("its checksum is another")
    return content


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    """At most `size` + 1 bytes, so that it shows if there are more."""
    if not compression:
        return packed
    decompressor: Any
    content = b""
    try:
        # It may be compressed as several frames, one after the other.
        for _ in range(_MOST_FRAMES):
            if compression == "zstd":
                decompressor = zstd.ZstdDecompressor()
            elif compression == "lz4":
                decompressor = LZ4FrameDecompressor()
            else:
                raise DamagedError(f"its compression {compression!r} is not known")
            content += decompressor.decompress(packed, max_length=size + 1 - len(content))
            packed = decompressor.unused_data
            if not packed or len(content) > size:
                break
    except (zstd.ZstdError, RuntimeError, EOFError) as error:
        raise DamagedError(f"{compression}: {error}") from error
    return content
