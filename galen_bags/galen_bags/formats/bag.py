# SPDX-License-Identifier: Apache-2.0
"""Any bag of ROS 2: rosbag2 directories and files, MCAP and SQLite3, compressed or not."""

from __future__ import annotations

import contextlib
import hashlib
import os
import struct
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import apsw
import numpy as np
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import TypesysError

from galen_bags.formats.errors import BagError
from galen_bags.formats.files import (
    STORAGES,
    ZSTD_ENDING,
    listed_files,
    ros1_text,
    storage_files,
    storage_of,
)
from galen_bags.formats.mcap_file import McapFile
from galen_bags.formats.mcap_records import LARGEST_BYTES
from galen_bags.formats.raw_block import Messages, Problems, TopicInfo, packed

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

# What the library raises on a damaged file; the built-in ones come from its parsing of bytes.
_DAMAGE = (
    ReaderError, TypesysError, apsw.Error, struct.error, AssertionError, LookupError, TypeError,
    ValueError, RuntimeError, EOFError, MemoryError, SyntaxError, OSError,
)  # fmt: skip
# SQLite is given the path as a URI, in which these mean something.
_URI_SIGNS = frozenset("?#%")
_FORMS = {"MSG": "ros2msg", "IDL": "ros2idl", "NONE": ""}
# No serialised message starts so: CDR's first byte is zero.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Recordings don't shrink to less; what grows by more is meant to fill the disk.
_MOST_EXPANSION = 1000
_MOST_NAMED = 12


class Bag:
    """An open bag; a context manager. `problems` are sentences; reading may add to them."""

    def __init__(self, path: Path, files: Sequence[Path], problems: Sequence[str]) -> None:
        """Use `open_bag` instead."""
        self.path = path
        self._stack = contextlib.ExitStack()
        self._problems = Problems()
        for text in problems:
            self._problems.add(text)
        self._files: list[McapFile | SqliteFile] = []
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self._open_all(files)
            undo.pop_all()
        self.topics: dict[str, TopicInfo] = {}
        for opened in self._files:
            for topic in opened.topics:
                self.topics[topic.name] = self._merged(topic)

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close its files."""
        self._stack.close()

    @property
    def problems(self) -> list[str]:
        """What is wrong with the bag, as far as it has been read."""
        found = list(self._problems)
        for opened in self._files:
            found += opened.problems
        return found

    def blocks(self, topics: Sequence[str]) -> Iterator[Messages]:
        """Yield messages in order of log time.

        Args:
            topics: full names of the topics to read; `Messages.topic` counts in them.

        Yields:
            Blocks of messages, none empty. Where a file begins before the one before it ends, they
            follow each other all the same, and `problems` has it.

        Raises:
            BagError: the bag lacks a topic, it is not CDR, or a file can't be read.

        """
        for name in topics:
            if name not in self.topics:
                raise BagError(f"{self.path}: has no topic {name}; it has {listing(self.topics)}")
            if self.topics[name].encoding != "cdr":
                raise BagError(
                    f"{self.path}: {name} is serialised as {self.topics[name].encoding!r}, not cdr"
                )
        wanted = {name: number for number, name in enumerate(topics)}
        last_ns: int | None = None
        for opened in self._files:
            before_ns = last_ns
            try:
                for block in opened.messages(wanted):
                    if before_ns is not None and block.log_time_ns[0] < before_ns:
                        self._problems.add(
                            f"{opened.path.name}: begins before the file before it ends; their"
                            " messages are not sorted into each other"
                        )
                    last_ns = int(block.log_time_ns[-1])
                    yield from self._inflated(block)
            except OSError as error:
                raise BagError(f"{opened.path}: can't be read: {error}") from error

    def _open_all(self, files: Sequence[Path]) -> None:
        """Open what can be opened; a recording that was cut off may end with an empty file."""
        for file in files:
            try:
                self._files.append(self._open(file))
            except BagError as error:
                if file == files[-1] and not self._files:
                    raise
                self._problems.add(str(error))

    def _open(self, path: Path) -> McapFile | SqliteFile:
        if path.suffix == ".bag":
            raise BagError(ros1_text(path))
        if storage_of(path) not in STORAGES:
            raise BagError(f"{path}: is no bag (.mcap, .db3 or a directory of them)")
        if path.suffix == ZSTD_ENDING:
            unpacked = self._decompressed(path)
            try:
                return self._open(unpacked)
            except BagError as error:
                raise BagError(str(error).replace(str(unpacked), str(path))) from error
        if path.suffix == ".mcap":
            return McapFile(path)
        opened = SqliteFile(path, self._folder)
        self._stack.callback(opened.close)
        return opened

    def _folder(self) -> Path:
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="galen_bag_")))

    def _decompressed(self, path: Path) -> Path:
        target = self._folder() / path.stem
        most = _MOST_EXPANSION * path.stat().st_size
        try:
            with zstd.open(path, "rb") as packed_file, target.open("wb") as out:
                while piece := packed_file.read1(1 << 20):  # read() would lose the last one
                    out.write(piece)
                    if out.tell() > most:
                        raise BagError(
                            f"{path}: grows to more than {_MOST_EXPANSION} times its size"
                        )
        except (EOFError, zstd.ZstdError) as error:
            self._problems.add(f"{path.name}: its compression breaks off: {error}")
        except OSError as error:
            raise BagError(f"{path}: can't be read: {error}") from error
        return target

    def _inflated(self, block: Messages) -> Iterator[Messages]:
        """Decompress those messages of the block that were compressed one by one (zstd)."""
        if np.any(block.data[block.start[block.size > 0]] == _ZSTD_MAGIC[0]):
            yield from packed(self._decompress_each(block))
        else:
            yield block

    def _decompress_each(self, block: Messages) -> Iterator[tuple[int, int, bytes]]:
        for index in range(len(block)):
            data = block.message(index)
            if data.startswith(_ZSTD_MAGIC):
                try:
                    data = _decompress(data)
                except zstd.ZstdError as error:
                    self._problems.add(f"{self.path.name}: some messages can't be read: {error}")
                    continue
            yield int(block.topic[index]), int(block.log_time_ns[index]), data

    def _merged(self, topic: TopicInfo) -> TopicInfo:
        other = self.topics.get(topic.name)
        if other is None:
            return topic
        return TopicInfo(
            topic.name,
            _either(other.type_name, topic.type_name),
            (other.count or 0) + (topic.count or 0),
            _either(other.encoding, topic.encoding),
            other.definition_form,
            other.definition,
        )


def open_bag(path: str | os.PathLike[str]) -> Bag:
    """Open a bag.

    Args:
        path: a rosbag2 directory (with metadata.yaml or without), a .mcap or a .db3.

    Returns:
        The open bag, to be closed by the caller.

    Raises:
        BagError: there is no bag, or it can't be read; the message names the file.

    """
    path = Path(path)
    try:
        if path.is_dir():
            listed, problems = listed_files(path)
            if listed is None:
                listed = storage_files(path)
        elif path.is_file():
            listed, problems = [path], []
        elif path.exists():
            raise BagError(f"{path}: is neither a file nor a directory")
        else:
            raise BagError(f"{path}: is not there")
    except OSError as error:
        raise BagError(f"{path}: can't be read: {error.strerror}") from error
    if not listed:
        raise BagError(f"{path}: holds no bag (no .mcap or .db3)")
    there = [file for file in listed if file.is_file()]
    if not there:
        raise BagError(f"{path}: its file {listed[0].name} is missing")
    problems += [f"{file.name} is missing" for file in listed if file not in there]
    return Bag(path, there, problems)


def robot_description(bag: Bag) -> str:
    """Return the first text of the bag's topic `robot_description`.

    Args:
        bag: an open bag.

    Returns:
        The robot's description (URDF); empty where the bag has none.

    Raises:
        BagError: the topic's message is no std_msgs/String.

    """
    names = [name for name in bag.topics if name.rpartition("/")[2] == "robot_description"]
    for block in bag.blocks(names[:1]):
        data = block.message(0)  # CDR: the encoding's four bytes, the length, the text, a zero
        order = "<" if data[1:2] == b"\x01" else ">"
        (size,) = struct.unpack(order + "I", data[4:8]) if len(data) >= 8 else (0,)
        if not 0 < size == len(data[8 : 8 + size]):
            raise BagError(f"{bag.path}: {names[0]} holds no std_msgs/msg/String")
        return data[8 : 7 + size].decode("utf-8", errors="replace")
    return ""


def content_sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 over every message of a bag in order of log time.

    Of each message: topic name and type, each ended by a zero byte, log time (int64, ns), length
    of the payload (uint64), both little-endian, the payload itself. Messages of one log time are
    taken in the bag's order.

    Args:
        path: a bag: rosbag2 directory, .mcap or .db3.

    Returns:
        The checksum, in hexadecimal.

    Raises:
        BagError: the bag can't be read, or not to its end.

    """
    digest = hashlib.sha256()
    with open_bag(path) as bag:
        names = sorted(bag.topics)
        heads = [f"{name}\0{bag.topics[name].type_name}\0".encode() for name in names]
        for block in bag.blocks(names):
            for index, topic in enumerate(block.topic.tolist()):
                data = block.message(index)
                digest.update(heads[topic])
                digest.update(struct.pack("<qQ", int(block.log_time_ns[index]), len(data)))
                digest.update(data)
        if bag.problems:
            raise BagError(f"{Path(path)}: {bag.problems[0]}")
    return digest.hexdigest()


def listing(names: Iterable[str]) -> str:
    """Join names for a sentence.

    Args:
        names: such as a bag's topics, in any order.

    Returns:
        "/a, /b", sorted, at most 12 and how many more there are, or "none".

    """
    there = sorted(names)
    more = [f"{len(there) - _MOST_NAMED} more"] if len(there) > _MOST_NAMED else []
    return ", ".join([*there[:_MOST_NAMED], *more]) or "none"


def _decompress(data: bytes) -> bytes:
    """One message; ZstdError if it is damaged, or larger than any is."""
    content = zstd.ZstdDecompressor().decompress(data, max_length=LARGEST_BYTES + 1)
    if len(content) > LARGEST_BYTES:
        raise zstd.ZstdError(f"a message of more than {LARGEST_BYTES} bytes")
    return content


def _either(one: str, other: str) -> str:
    """Two types or encodings in one topic make one that is no type."""
    return one if other == one else f"{one} and {other}"


# SQLite3 storage, which the library rosbags reads, message by message


class SqliteFile:
    """A .db3 file. `problems` are sentences and grow while reading."""

    def __init__(self, path: Path, folder: Callable[[], Path]) -> None:
        """Open the file; `folder` makes a temporary directory. Raises BagError."""
        self.path = path
        self.problems = Problems()
        try:
            self._reader: Any = Reader(_plain(path, folder))
            self._reader.open()
        except _DAMAGE as error:
            raise BagError(f"{path}: can't be read: {_reason(error)}") from error
        # A row may be computed, and claim to be of any size.
        self._reader.storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, LARGEST_BYTES)
        for ending in ("-wal", "-journal"):
            log = path.with_name(path.name + ending)
            if log.is_file() and log.stat().st_size:
                self.problems.add(
                    f"{path.name}: its recording was cut off; what is in {log.name} is not read"
                )

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    @property
    def topics(self) -> list[TopicInfo]:
        """What the connections carry; a topic may have several."""
        return [
            TopicInfo(
                c.topic,
                c.msgtype,
                c.msgcount,
                c.ext.serialization_format,
                _FORMS[c.msgdef.format.name],
                c.msgdef.data,
            )
            for c in self._reader.connections
        ]

    def messages(self, wanted: dict[str, int]) -> Iterator[Messages]:
        """Yield messages in order of log time.

        Args:
            wanted: numbers that the blocks have for the topics, by the topics' names.

        Yields:
            Blocks of messages; what is damaged is left out, and in `problems`.

        """
        connections = [c for c in self._reader.connections if c.topic in wanted]
        if connections:
            yield from packed(self._rows(connections, wanted))

    def _rows(
        self, connections: list[Any], wanted: dict[str, int]
    ) -> Iterator[tuple[int, int, bytes]]:
        try:
            for connection, time_ns, data in self._reader.messages(connections):
                if isinstance(data, bytes) and isinstance(time_ns, int):
                    yield wanted[connection.topic], time_ns, data
                else:
                    self.problems.add(
                        f"{self.path.name}: some messages of {connection.topic} are left out:"
                        " a row that holds no bytes, or no time"
                    )
        except _DAMAGE as error:
            self.problems.add(
                f"{self.path.name} is damaged; it is read as far as it goes: {_reason(error)}"
            )


def _plain(path: Path, folder: Callable[[], Path]) -> Path:
    """Return a path to the same file that is its own URI."""
    if not _URI_SIGNS & set(str(path)):
        return path
    link = folder() / "bag.db3"
    link.symlink_to(path.absolute())
    return link


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
