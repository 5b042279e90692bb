"""Any bag: rosbag2 directories and files, MCAP and SQLite3, compressed or not, and ROS 1 bags.

MCAP is read by `mcap_file`, in chunks, into arrays. The other storages come from the library
rosbags, message by message.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path, PurePath
from types import TracebackType
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import ReaderError as Rosbag2Error
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from galen_bags.errors import BagError
from galen_bags.mcap_file import McapFile
from galen_bags.raw_block import Messages, TopicInfo, pack

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STORAGES = (".mcap", ".db3")
_ZSTD = ".zstd"
# No serialised message starts so: CDR's first byte is zero.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BATCH = 8192
# What the libraries below raise on a file that is damaged.
_DAMAGE = (
    Rosbag2Error, Ros1Error, SerdeError, TypesysError, zstd.ZstdError,
    AssertionError, KeyError, IndexError, ValueError, RuntimeError, EOFError,
)  # fmt: skip


class Bag:
    """An open bag; a context manager. `problems` are sentences; reading may add to them."""

    def __init__(self, path: Path, files: Sequence[Path], problems: Sequence[str]) -> None:
        """Use `open_bag` instead."""
        self.path = path
        self._stack = contextlib.ExitStack()
        self._problems = list(problems)
        self._files: list[McapFile | _LibraryFile] = []
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            for file in files:
                self._files.append(self._open(file))
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
            found += [text for text in opened.problems if text not in found]
        return found

    def blocks(self, topics: Sequence[str]) -> Iterator[Messages]:
        """Messages of `topics` in order of log time; `Messages.topic` counts in `topics`.

        Raises BagError for a topic that the bag lacks, or that is not CDR.
        """
        for name in topics:
            if name not in self.topics:
                there = ", ".join(sorted(self.topics)) or "none"
                raise BagError(f"{self.path}: has no topic {name}; it has {there}")
            if self.topics[name].encoding != "cdr":
                raise BagError(
                    f"{self.path}: {name} is serialised as {self.topics[name].encoding!r}, not cdr"
                )
        wanted = {name: number for number, name in enumerate(topics)}
        for opened in self._files:
            try:
                yield from map(_inflated, opened.messages(wanted))
            except OSError as error:
                raise BagError(f"{opened.path}: can't be read: {error}") from error

    def _open(self, path: Path) -> McapFile | _LibraryFile:
        if path.suffix == _ZSTD:
            path = self._decompressed(path)
        opened = McapFile(path) if path.suffix == ".mcap" else _LibraryFile(path)
        self._stack.callback(opened.close)
        return opened

    def _decompressed(self, path: Path) -> Path:
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="galen_bag_")))
        target = folder / path.stem
        try:
            with zstd.open(path, "rb") as packed, target.open("wb") as out:
                shutil.copyfileobj(packed, out, 1 << 20)
        except (EOFError, zstd.ZstdError) as error:
            self._problems.append(f"{path.name}: its compression breaks off: {error}")
        except OSError as error:
            raise BagError(f"{path}: can't be read: {error}") from error
        return target

    def _merged(self, topic: TopicInfo) -> TopicInfo:
        other = self.topics.get(topic.name)
        if other is None:
            return topic
        if other.type_name != topic.type_name:
            raise BagError(
                f"{self.path}: {topic.name} is of two types, {other.type_name} and"
                f" {topic.type_name}"
            )
        return TopicInfo(
            topic.name, topic.type_name, (other.count or 0) + (topic.count or 0), topic.encoding,
            other.definition_form, other.definition,
        )  # fmt: skip


def open_bag(path: str | os.PathLike[str]) -> Bag:
    """Open a rosbag2 directory (with metadata.yaml or without), a .mcap, .db3 or ROS 1 .bag.

    Raises BagError, naming the file.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: is not there")
    if not path.is_dir():
        return Bag(path, [path], [])
    listed, problems = _listed_files(path)
    if listed is None:
        listed = storage_files(path)
    if not listed:
        raise BagError(f"{path}: holds no bag (no .mcap or .db3)")
    there = [file for file in listed if file.is_file()]
    if not there:
        raise BagError(f"{path}: its file {listed[0].name} is missing")
    problems += [f"{file.name} is missing" for file in listed if file not in there]
    return Bag(path, there, problems)


def storage_files(directory: Path) -> list[Path]:
    """A rosbag2 directory's files, in the order of the numbers in their names."""
    found = [
        file
        for file in directory.iterdir()
        if file.is_file() and _storage(file) in STORAGES and not file.name.startswith(".")
    ]
    return sorted(found, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)] or [0])


def _storage(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == _ZSTD else path.suffix


def _listed_files(directory: Path) -> tuple[list[Path] | None, list[str]]:
    """The files that metadata.yaml lists (None: it does not say), and what is wrong with it."""
    metadata = directory / "metadata.yaml"
    if not metadata.exists():
        return None, [f"{directory.name} has no metadata.yaml: its recording was cut off"]
    try:
        content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        # Only names: a path in it must not lead out of the directory.
        listed = content["rosbag2_bagfile_information"]["relative_file_paths"]
        names = [PurePath(name).name for name in listed]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0]
        return None, [f"{directory.name}/metadata.yaml can't be used: {reason}"]
    return [directory / name for name in names], []


def _inflated(block: Messages) -> Messages:
    """The block with those messages decompressed that were compressed one by one (zstd)."""
    if not np.any(block.data[block.start[block.size > 0]] == _ZSTD_MAGIC[0]):
        return block
    messages = [block.message(index) for index in range(len(block))]
    messages = [zstd.decompress(m) if m.startswith(_ZSTD_MAGIC) else m for m in messages]
    return pack(block.topic.tolist(), block.log_time_ns.tolist(), messages)


class _LibraryFile:
    """A file that the library rosbags reads: SQLite3, or a ROS 1 bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        ros1 = path.suffix == ".bag"
        if not ros1 and path.suffix != ".db3":
            raise BagError(f"{path}: is no bag (.mcap, .db3, .bag or a directory of them)")
        try:
            self._reader: Any = Ros1Reader(path) if ros1 else Rosbag2Reader(path)
            self._reader.open()
        except (*_DAMAGE, OSError) as error:
            hint = "; `rosbag reindex` mends a ROS 1 bag that was cut off" if ros1 else ""
            raise BagError(f"{path}: can't be read: {error}{hint}") from error
        self._convert = _ros1_converter(self._reader) if ros1 else None
        self.topics = [
            TopicInfo(c.topic, c.msgtype, c.msgcount)
            if ros1
            else TopicInfo(
                c.topic,
                c.msgtype,
                c.msgcount,
                c.ext.serialization_format,
                c.msgdef.format.name.lower().replace("msg", "ros2msg").replace("none", ""),
                c.msgdef.data,
            )
            for c in self._reader.connections
        ]

    def close(self) -> None:
        self._reader.close()

    def messages(self, wanted: dict[str, int]) -> Iterator[Messages]:
        connections = [c for c in self._reader.connections if c.topic in wanted]
        if not connections:
            return
        source = self._reader.messages(connections)
        while True:
            batch: list[tuple[int, int, bytes]] = []
            try:
                for connection, time_ns, data in islice(source, _BATCH):
                    if self._convert is not None:
                        data = self._convert(data, connection.msgtype)
                    batch.append((wanted[connection.topic], time_ns, data))
            except _DAMAGE as error:
                self.problems.append(f"{self.path.name} breaks off: {error}")
                source = iter(())
            if not batch:
                return
            topics, times, messages = zip(*batch, strict=True)
            yield pack(topics, times, messages)


def _ros1_converter(reader: Ros1Reader) -> Callable[[bytes, str], bytes]:
    types = get_typestore(Stores.EMPTY)
    for connection in reader.connections:
        types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return lambda data, type_name: bytes(types.ros1_to_cdr(data, type_name))
