# SPDX-License-Identifier: Apache-2.0
"""One MCAP file, read in whole chunks: messages come as arrays of places, not one by one.

Where the chunks are, their times and where the file breaks off is found by stepping over the
records from header to header, so a file without summary or footer is read as far as it goes.
Checksums of chunks are checked where they have one; the one over the whole file is not, since it
would take a second pass.

What a file may cost, whatever it claims: mcap_records.LARGEST_BYTES a chunk,
raw_block.MOST_HELD_BYTES of chunks that overlap in time, _MOST_DEFINITION_BYTES of types, and time
in proportion to the number of records.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from galen_bags.formats.errors import BagError
from galen_bags.formats.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    FOOTER,
    LARGEST_BYTES,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    STATISTICS,
    Body,
    DamagedError,
    Walk,
    indexed_starts,
    unpack_chunk,
    walk,
)
from galen_bags.formats.raw_block import (
    MOST_HELD_BYTES,
    Messages,
    Problems,
    TimeOrder,
    TopicInfo,
)

_WINDOW_BYTES = 1 << 16
# Messages outside of chunks are read in pieces of this size.
_PIECE_BYTES = 1 << 20
_MOST_DEFINITION_BYTES = 1 << 26
_LONGEST_NAME = 1 << 12
_CHANNELS = 1 << 16
_UNWANTED, _UNKNOWN = -1, -2


@dataclass(frozen=True)
class _Extent:
    """A chunk's content and the message indexes after it, or records outside of chunks.

    The content is from `start` to `stop`, the indexes from there to `index_stop`.
    """

    start: int
    stop: int
    index_stop: int
    first_ns: int
    chunk: bool
    cut: bool = False


class McapFile:
    """An MCAP file. `topics` by name; `problems` are sentences and grow while reading."""

    def __init__(self, path: Path) -> None:
        """Find chunks and topics. Raises BagError if it is no MCAP file, or can't be read."""
        self.path = path
        self.problems = Problems()
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[str, int, str]] = {}
        self._definition_bytes = 0
        # By channel: what the summary says, and what is found without one.
        self._stated: dict[int, int] = {}
        self._found = np.zeros(_CHANNELS, dtype=np.int64)
        self._extents: list[_Extent] = []
        try:
            with path.open("rb") as file:
                complete = self._scan(file)
                if not (complete and self._stated and self._stated.keys() <= self._channels.keys()):
                    self._stated = {}
                    self._count_messages(file)
        except OSError as error:
            raise BagError(f"{path}: can't be read: {error.strerror}") from error

    def close(self) -> None:
        """Do nothing: no file is kept open."""

    @property
    def topics(self) -> list[TopicInfo]:
        """What the channels carry; a topic may have several."""
        found = []
        for number, (topic, schema, encoding) in self._channels.items():
            name, form, text = self._schemas.get(schema, ("", "", ""))
            count = self._stated.get(number, 0) if self._stated else int(self._found[number])
            found.append(TopicInfo(topic, name, count, encoding, form, text))
        return found

    def messages(self, wanted: dict[str, int]) -> Iterator[Messages]:
        """Yield messages in order of log time.

        Chunks may overlap in time; what is later than the next one's start waits for it.

        Args:
            wanted: numbers that the blocks have for the topics, by the topics' names.

        Yields:
            Blocks of messages; what is damaged is left out, and in `problems`.

        Raises:
            OSError: the file can't be read any more.

        """
        order = sorted(self._extents, key=lambda extent: (extent.first_ns, extent.start))
        following = [(extent.first_ns, extent.start) for extent in order[1:]] + [(None, 0)]
        held = TimeOrder()
        read = np.zeros(_CHANNELS, dtype=np.int64)
        with self.path.open("rb") as file:
            for extent, (next_ns, next_place) in zip(order, following, strict=False):
                content, records = self._records(file, extent)
                if len(records.start):
                    held.add(extent.start, self._wanted(content, records, wanted))
                    self._check_first(extent, records)
                    _count(read, records)
                yield from held.ready(next_ns, next_place)
        if held.overfull:
            self.problems.add(
                f"{self.path.name}: more than {MOST_HELD_BYTES >> 20} MB of its chunks overlap in"
                " time; its messages come out of order"
            )
        for channel, stated in self._stated.items():
            topic = self._channels.get(channel, ("",))[0]
            if topic in wanted and stated != read[channel]:
                self.problems.add(
                    f"{self.path.name}: {topic} has {read[channel]} readable messages, but"
                    f" {stated} by the file's own summary"
                )

    # --- the file's records -----------------------------------------------------------------

    def _scan(self, file: BinaryIO) -> bool:
        """Step over the file's records, from header to header; says whether it has an end."""
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            if MAGIC.startswith(magic):
                raise BagError(f"{self.path}: is empty: its recording was cut off at once")
            raise BagError(f"{self.path}: is no MCAP file (its first bytes are others)")
        at = len(MAGIC)
        window, window_at = b"", 0
        while at + RECORD.size <= size:
            if not window_at <= at <= window_at + len(window) - RECORD.size:
                file.seek(at)
                window, window_at = file.read(_WINDOW_BYTES), at
                if len(window) < RECORD.size:
                    break  # it got shorter
            opcode, length = RECORD.unpack_from(window, at - window_at)
            if opcode == 0:
                break
            stop = at + RECORD.size + length
            if opcode == CHUNK:
                self._add_chunk(file, at + RECORD.size, min(stop, size), cut=stop > size)
            if stop > size:
                break
            if opcode == FOOTER:
                return True
            if opcode == MESSAGE:
                stop = self._add_piece(file, at, stop)
            elif opcode in (SCHEMA, CHANNEL, STATISTICS):
                self._learn_from(file, at, opcode, length)
            elif opcode == MESSAGE_INDEX and self._extents and self._extents[-1].index_stop == at:
                self._extents[-1] = replace(self._extents[-1], index_stop=stop)
            at = stop
        file.seek(max(0, size - len(MAGIC)))
        if file.read() == MAGIC and size > len(MAGIC):
            self.problems.add(
                f"{self.path.name} is damaged at byte {at}; what comes after is not read"
            )
        else:
            self.problems.add(
                f"{self.path.name} was cut off: it has no end; it is read as far as it goes"
            )
        return False

    def _add_chunk(self, file: BinaryIO, start: int, stop: int, *, cut: bool) -> None:
        file.seek(start)
        head = file.read(min(CHUNK_HEAD.size, stop - start))
        if len(head) == CHUNK_HEAD.size:
            first_ns = CHUNK_HEAD.unpack(head)[0]
            self._extents.append(_Extent(start, stop, stop, first_ns, chunk=True, cut=cut))
        elif not cut:
            self.problems.add(f"{self.path.name}: the chunk at byte {start} is too short")

    def _add_piece(self, file: BinaryIO, start: int, first_stop: int) -> int:
        """Take the messages outside of chunks that begin at `start`; returns where they end."""
        if first_stop - start > LARGEST_BYTES:
            self.problems.add(
                f"{self.path.name}: the message at byte {start} claims {first_stop - start} bytes;"
                " it is left out"
            )
            return first_stop
        file.seek(start)
        content = file.read(max(_PIECE_BYTES, first_stop - start))
        records = walk(content)
        if not len(records.start):
            self.problems.add(f"{self.path.name}: the message at byte {start} is too short")
            return first_stop
        self._learn(content, records, start)
        stop = start + records.end
        first_ns = int(records.heads["log_time"].min())
        self._extents.append(_Extent(start, stop, stop, first_ns, chunk=False))
        _count(self._found, records)
        return stop

    def _count_messages(self, file: BinaryIO) -> None:
        """Find topics and counts in the chunks themselves, for want of a summary."""
        for extent in self._extents:
            if extent.chunk:
                _count(self._found, self._records(file, extent)[1])

    def _records(self, file: BinaryIO, extent: _Extent) -> tuple[bytes, Walk]:
        """Read an extent's content and its records; none and a problem where they can't be had."""
        where = f"{self.path.name}: the chunk at byte {extent.start}"
        size = extent.stop - extent.start
        if size > LARGEST_BYTES:
            self.problems.add(f"{where} claims {size} bytes; it is left out")
            return b"", walk(b"")
        file.seek(extent.start)
        stored = file.read(size)
        if not extent.chunk:
            records = walk(stored)
            self._learn(stored, records, extent.start)
            return stored, records
        index = file.read(min(extent.index_stop - extent.stop, LARGEST_BYTES))
        try:
            content = unpack_chunk(stored, cut=extent.cut)
        except DamagedError as damage:
            self.problems.add(f"{where} is damaged and left out: {damage}")
            return b"", walk(b"")
        records = walk(content, indexed_starts(index))
        if records.end != len(content) and not extent.cut:
            self.problems.add(
                f"{where} is damaged: it is read up to byte {records.end} of its {len(content)}"
            )
        self._learn(content, records, extent.start)
        return content, records

    def _check_first(self, extent: _Extent, records: Walk) -> None:
        if records.heads["log_time"].min() < extent.first_ns:
            self.problems.add(
                f"{self.path.name}: the chunk at byte {extent.start} begins earlier than it says;"
                " its messages may come out of order"
            )

    def _wanted(self, content: bytes, records: Walk, wanted: dict[str, int]) -> Messages:
        numbers = np.full(_CHANNELS, _UNKNOWN, dtype=np.int32)
        for channel, (topic, _, _) in self._channels.items():
            numbers[channel] = wanted.get(topic, _UNWANTED)
        topic = numbers[records.heads["channel"]]
        if (topic == _UNKNOWN).any():
            channel = records.heads["channel"][np.argmax(topic == _UNKNOWN)]
            self.problems.add(
                f"{self.path.name}: no topic is given for channel {channel}; its messages are left"
                " out"
            )
        head = MESSAGE_HEAD.itemsize
        size = records.heads["length"].astype(np.int64) - (head - RECORD.size)
        start, log_time_ns = records.start + head, records.heads["log_time"]
        kept = topic >= 0
        found = Messages(
            topic, log_time_ns.astype(np.int64), np.frombuffer(content, np.uint8), start, size
        )
        return found if kept.all() else found.rows(kept)

    # --- schemas, channels, statistics --------------------------------------------------------

    def _learn(self, content: bytes, records: Walk, place: int) -> None:
        for opcode, at in records.others:
            _, length = RECORD.unpack_from(content, at)
            self._take(opcode, content[at + RECORD.size : at + RECORD.size + length], place)

    def _learn_from(self, file: BinaryIO, at: int, opcode: int, length: int) -> None:
        if length > _MOST_DEFINITION_BYTES:
            self.problems.add(
                f"{self.path.name}: the record at byte {at} claims {length} bytes; it is left out"
            )
            return
        file.seek(at + RECORD.size)
        self._take(opcode, file.read(length), at)

    def _take(self, opcode: int, content: bytes, place: int) -> None:
        body = Body(content)
        try:
            if opcode == SCHEMA:
                number = body.number("<H")
                self._take_schema(number, (body.text(), body.text(), body.text()))
            elif opcode == CHANNEL:
                number, schema = body.number("<H"), body.number("<H")
                topic, encoding = body.text(), body.text()
                if len(topic) + len(encoding) > _LONGEST_NAME:
                    raise struct.error("a name is too long")
                self._channels[number] = (topic, schema, encoding)
            else:
                body.skip(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
                pairs = body.number("<I") // 10
                self._stated = {body.number("<H"): body.number("<Q") for _ in range(pairs)}
        except (struct.error, UnicodeDecodeError) as error:
            self.problems.add(
                f"{self.path.name}: a description at byte {place} is damaged: {error}"
            )

    def _take_schema(self, number: int, schema: tuple[str, str, str]) -> None:
        if len(schema[0]) + len(schema[1]) > _LONGEST_NAME:
            raise struct.error("a name is too long")
        self._definition_bytes += len(schema[2]) - len(self._schemas.get(number, ("", "", ""))[2])
        if self._definition_bytes > _MOST_DEFINITION_BYTES:
            self._definition_bytes -= len(schema[2])
            schema = (schema[0], schema[1], "")
            self.problems.add(f"{self.path.name}: its types' texts are too long; some are left out")
        self._schemas[number] = schema


def _count(counts: np.ndarray, records: Walk) -> None:
    """Add the numbers of messages, by channel."""
    found = np.bincount(records.heads["channel"])
    counts[: len(found)] += found
