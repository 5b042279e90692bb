"""SQLite3 storage and ROS 1 bags, which the library rosbags reads, message by message."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import apsw
from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import ReaderError as Rosbag2Error
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from galen_bags.errors import BagError
from galen_bags.formats.mcap_records import LARGEST_BYTES
from galen_bags.formats.raw_block import Messages, Problems, TopicInfo, packed

# What the library raises on a damaged file. The built-in ones come from its parsing of bytes; a
# RuntimeError is also one for recursion, in a type's definition, a SyntaxError one for lists within
# lists: of a definition the library makes a program.
_DAMAGE = (
    Rosbag2Error, Ros1Error, SerdeError, TypesysError, apsw.Error, struct.error,
    AssertionError, LookupError, TypeError, ValueError, RuntimeError, EOFError, MemoryError,
    SyntaxError,
)  # fmt: skip
# SQLite is given the path as a URI, in which these mean something.
_URI_SIGNS = frozenset("?#%")
_HEADER = "std_msgs/msg/Header"
_MOST_FIELDS, _DEEPEST = 2000, 20
_FORMS = {"MSG": "ros2msg", "IDL": "ros2idl", "NONE": ""}


class LibraryFile:
    """A .db3 file or a ROS 1 bag. `problems` are sentences and grow while reading."""

    def __init__(self, path: Path, folder: Callable[[], Path]) -> None:
        """Open the file; `folder` makes a temporary directory. Raises BagError."""
        self.path = path
        self.problems = Problems()
        self._ros1 = path.suffix == ".bag"
        try:
            self._reader: Any = (
                Ros1Reader(path) if self._ros1 else Rosbag2Reader(_plain(path, folder))
            )
            self._reader.open()
        except (*_DAMAGE, OSError) as error:
            hint = "; `rosbag reindex` of ROS 1 fixes a bag that was cut off" if self._ros1 else ""
            raise BagError(f"{path}: can't be read: {_reason(error)}{hint}") from error
        if self._ros1:
            _limit_chunks(self._reader)
        else:
            # A row may be computed, and claim to be of any size.
            self._reader.storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, LARGEST_BYTES)
        for ending in ("-wal", "-journal"):
            log = path.with_name(path.name + ending)
            if not self._ros1 and log.is_file() and log.stat().st_size:
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
            TopicInfo(c.topic, c.msgtype, c.msgcount)
            if self._ros1
            else TopicInfo(
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
        """Messages of the `wanted` topics ({name: number}) in order of log time."""
        connections = [c for c in self._reader.connections if c.topic in wanted]
        if connections:
            yield from packed(self._converted(self._raw(connections), wanted))

    def _raw(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        try:
            yield from self._reader.messages(connections)
        except (*_DAMAGE, OSError) as error:
            self.problems.add(
                f"{self.path.name} is damaged; it is read as far as it goes: {_reason(error)}"
            )

    def _converted(
        self, source: Iterator[tuple[Any, int, bytes]], wanted: dict[str, int]
    ) -> Iterator[tuple[int, int, bytes]]:
        converters: dict[int, Callable[[bytes], bytes]] = {}
        for connection, time_ns, data in source:
            try:
                if self._ros1:
                    if connection.id not in converters:
                        converters[connection.id] = _to_cdr(connection)
                    data = converters[connection.id](data)
                elif not isinstance(data, bytes) or not isinstance(time_ns, int):
                    raise TypeError("a row that holds no bytes, or no time")
            except _DAMAGE as error:
                self.problems.add(
                    f"{self.path.name}: some messages of {connection.topic} are left out:"
                    f" {_reason(error)}"
                )
                continue
            yield wanted[connection.topic], time_ns, data


def _plain(path: Path, folder: Callable[[], Path]) -> Path:
    """Return a path to the same file that is its own URI."""
    if not _URI_SIGNS & set(str(path)):
        return path
    link = folder() / "bag.db3"
    link.symlink_to(path.absolute())
    return link


def _to_cdr(connection: Any) -> Callable[[bytes], bytes]:
    """Make the converter of a ROS 1 connection's messages, by the bag's own definition."""
    defined = get_types_from_msg(connection.msgdef.data, connection.msgtype)
    if _HEADER in defined:
        # The library steps over the number that only ROS 1's headers have, if it is not a field.
        constants, fields = defined[_HEADER]
        defined[_HEADER] = (constants, [field for field in fields if field[0] != "seq"])
    _check_size(defined)
    types = get_typestore(Stores.EMPTY)
    types.register(defined)
    return lambda data: bytes(types.ros1_to_cdr(data, connection.msgtype))


def _check_size(defined: Typesdict) -> None:
    """Raise TypesysError for types that hold themselves, many levels or thousands of fields.

    The library writes out a program for every single one of them, also of `string[2000000000]`.
    """
    sizes: dict[str, int] = {}

    def of_type(name: str, above: tuple[str, ...]) -> int:
        if name in above or len(above) > _DEEPEST:
            raise TypesysError(f"{name} holds itself, or types within types")
        if name not in defined:
            return 1  # time, or one that is missing, as the library will say
        if name not in sizes:
            sizes[name] = sum(of_field(what, (*above, name)) for _, what in defined[name][1])
        if sizes[name] > _MOST_FIELDS:
            raise TypesysError(f"{name} has more than {_MOST_FIELDS} fields")
        return sizes[name]

    def of_field(what: Any, above: tuple[str, ...]) -> int:
        kind, inside = what
        if kind == Nodetype.BASE:
            return 1
        if kind == Nodetype.NAME:
            return of_type(inside, above)
        each, count = inside
        numbers = each[0] == Nodetype.BASE and each[1][0] != "string"
        return of_field(each, above) * (count if kind == Nodetype.ARRAY and not numbers else 1)

    for name in defined:
        of_type(name, ())


def _limit_chunks(reader: Ros1Reader) -> None:
    """Let no chunk of a ROS 1 bag grow over LARGEST_BYTES; the library sets no limit."""
    limited = {decompressors["bz2"]: _bz2, decompressors["lz4"]: _lz4}
    for place, chunk in reader.chunks.items():
        known = limited.get(chunk.decompressor, chunk.decompressor)
        reader.chunks[place] = chunk._replace(decompressor=known)


def _bz2(packed: bytes) -> bytes:
    return _limited(bz2.BZ2Decompressor(), packed)


def _lz4(packed: bytes) -> bytes:
    return _limited(LZ4FrameDecompressor(), packed)


def _limited(decompressor: Any, packed: bytes) -> bytes:
    content: bytes = decompressor.decompress(packed, max_length=LARGEST_BYTES + 1)
    if len(content) > LARGEST_BYTES:
        raise ValueError(f"a chunk holds more than {LARGEST_BYTES} bytes")
    return content


def _reason(error: BaseException) -> str:
    """One line of what a library said, which may be nothing."""
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
