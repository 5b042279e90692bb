"""SQLite3 storage, which the library rosbags reads, message by message."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import apsw
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import TypesysError

from galen_bags import BagError
from galen_bags.formats.mcap_records import LARGEST_BYTES
from galen_bags.formats.raw_block import Messages, Problems, TopicInfo, packed

# What the library raises on a damaged file; the built-in ones come from its parsing of bytes.
_DAMAGE = (
    ReaderError, TypesysError, apsw.Error, struct.error, AssertionError, LookupError, TypeError,
    ValueError, RuntimeError, EOFError, MemoryError, SyntaxError, OSError,
)  # fmt: skip
# SQLite is given the path as a URI, in which these mean something.
_URI_SIGNS = frozenset("?#%")
_FORMS = {"MSG": "ros2msg", "IDL": "ros2idl", "NONE": ""}


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
        """Return messages of the `wanted` topics ({name: number}) in order of log time."""
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
