# SPDX-License-Identifier: Apache-2.0
"""Bags' files: where they are, and what a rosbag2 directory's metadata.yaml states."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
from galen_model.json_fields import read_limited
from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from galen_bags.formats.errors import BagError

STORAGES = (".mcap", ".db3")
ZSTD_ENDING = ".zstd"
_FILES = (*STORAGES, *(f"{storage}{ZSTD_ENDING}" for storage in STORAGES))
METADATA = "metadata.yaml"
# What rosbag2's metadata begins with; other programs have a metadata.yaml, too.
_METADATA_KEY = "rosbag2_bagfile_information"
_METADATA_HEAD_BYTES = 4096
# A topic's entry has some hundred bytes, and a file's as well.
_MOST_BYTES = 1 << 20
# rosbag2 writes half as many levels.
_DEEPEST = 20
_DAMAGE = (
    OSError, ValueError, OverflowError, yaml.YAMLError, LookupError, TypeError, AttributeError,
    RecursionError, ReaderError,
)  # fmt: skip


@dataclass(frozen=True)
class BagMetadata:
    """Log times of the first and the last message, ns; offered QoS and messages by topic."""

    start_ns: int | None = None
    end_ns: int | None = None
    qos: dict[str, list[Qos]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)


def read_metadata(path: Path) -> BagMetadata:
    """Read a bag's metadata.yaml.

    That there is none, or a damaged one, is no error here: `open_bag` reports it, and reads the
    messages all the same.

    Args:
        path: the bag; a file has no metadata.

    Returns:
        What is known: nothing without a usable file, no times without messages.

    """
    try:
        known = _information(path)
        qos, counts = {}, {}
        for entry in known["topics_with_message_count"]:
            topic = entry["topic_metadata"]
            qos[topic["name"]] = parse_qos(topic.get("offered_qos_profiles") or [])
            counts[topic["name"]] = int(entry["message_count"])
        if not known["message_count"]:
            return BagMetadata(qos=qos, counts=counts)
        start_ns = int(known["starting_time"]["nanoseconds_since_epoch"])
        end_ns = start_ns + int(known["duration"]["nanoseconds"])
        return BagMetadata(start_ns, end_ns, qos, counts)
    except _DAMAGE:
        return BagMetadata()


def _information(directory: Path) -> Any:
    raw = read_limited(directory / METADATA, _MOST_BYTES, "a bag's metadata")
    return yaml.load(raw.decode(), Loader=_Loader)[_METADATA_KEY]  # noqa: S506 - a SafeLoader


def storage_files(directory: Path) -> list[Path]:
    """Find a rosbag2 directory's files.

    Args:
        directory: the bag; it is not searched below.

    Returns:
        Files of bags, in the order of the numbers in their names.

    Raises:
        OSError: the directory can't be read.

    """
    found = [
        file
        for file in directory.iterdir()
        if file.is_file() and storage_of(file) in STORAGES and not file.name.startswith(".")
    ]
    return sorted(found, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)] or [0])


def storage_of(path: Path) -> str:
    """Return the ending that names the storage, without that of a compression.

    Args:
        path: a file, which need not be there.

    Returns:
        The ending with its dot, such as ".mcap" of `run.mcap.zstd`; empty where there is none.

    """
    return Path(path.stem).suffix if path.suffix == ZSTD_ENDING else path.suffix


def listed_files(directory: Path) -> tuple[list[Path] | None, list[str]]:
    """Read which files metadata.yaml lists, and what is wrong with it.

    Args:
        directory: a rosbag2 directory.

    Returns:
        Files that are listed, each once, whether there or not (None: unknown); and sentences.

    """
    if not (directory / METADATA).exists():
        return None, [f"{directory.name} has no metadata.yaml: its recording was cut off"]
    try:
        # Only names: a path in it must not lead out of the directory.
        paths = _information(directory)["relative_file_paths"]
        listed = [directory / name for name in dict.fromkeys(PurePath(one).name for one in paths)]
        if not listed:
            raise ValueError("it lists no files")
    except _DAMAGE as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return None, [f"{directory.name}/metadata.yaml can't be used: {reason}"]
    return listed, [
        f"{file.name} is not read: metadata.yaml does not list it"
        for file in storage_files(directory)
        if file not in listed
    ]


# Search


def find_bags(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Find the bags that `paths` are or, if they are folders, hold.

    A bag is a rosbag2 directory (not its files), or a .mcap or .db3 (.zstd, too) file elsewhere. A
    directory without metadata.yaml whose files all have its own name, as in `run/run_0.mcap`, is a
    recording that was cut off: one bag. Names that begin with a dot are left out, links are
    followed.

    Args:
        paths: bags, or folders that are searched with all that is below.

    Returns:
        The bags, sorted, each once.

    Raises:
        BagError: a path is not there, is no bag or holds none, or can't be searched.

    """
    found: dict[tuple[int, int], Path] = {}
    for path in map(Path, paths):
        try:
            if not path.exists():
                raise BagError(f"{path}: is not there")
            if path.is_file() and path.suffix == ".bag":
                raise BagError(ros1_text(path))
            if path.is_file() and not path.name.endswith(_FILES):
                raise BagError(f"{path}: is no bag; files of bags end in {', '.join(_FILES)}")
            bags = list(_below(path, set()))
            for bag in bags:
                found.setdefault(_identity(bag), bag)
        except OSError as error:
            raise BagError(f"{error.filename or path}: can't be read: {error.strerror}") from error
        if not bags:
            raise BagError(f"{path}: no bag in it")
    return sorted(found.values())


def ros1_text(path: Path) -> str:
    """Return the sentence for a bag of ROS 1: what it is, and the remedy.

    Args:
        path: the .bag file.

    Returns:
        Text of an error.

    """
    return f"{path}: is a bag of ROS 1; convert it: rosbags-convert --src {path} --dst NEW"


def is_bag(path: Path) -> bool:
    """Return whether the path itself is a bag, by names and metadata.

    Args:
        path: a file or directory, or one that is not there.

    Returns:
        False for a folder that only holds bags.

    Raises:
        OSError: the directory can't be read.

    """
    return path.name.endswith(_FILES) if path.is_file() else path.is_dir() and _is_rosbag2(path)


def _below(path: Path, seen: set[tuple[int, int]]) -> Iterator[Path]:
    """Return the bags at `path` or below; `seen` holds the directories searched, against loops."""
    if path.is_file():
        if is_bag(path):
            yield path
        return
    if not path.is_dir() or _identity(path) in seen:  # such as a link to nowhere, a pipe
        return
    seen.add(_identity(path))
    if is_bag(path):
        yield path
        return
    for entry in sorted(path.iterdir()):
        if not entry.name.startswith("."):
            yield from _below(entry, seen)


def _is_rosbag2(directory: Path) -> bool:
    files = [file.name for file in storage_files(directory)]
    metadata = directory / METADATA
    if metadata.is_file() and not files:
        with metadata.open("rb") as stream:
            return _METADATA_KEY.encode() in stream.read(_METADATA_HEAD_BYTES)
    return is_rosbag2(directory.resolve().name, files, described=metadata.is_file())


def is_rosbag2(directory: str, files: Sequence[str], *, described: bool) -> bool:
    """Return whether a directory with these files of bags is one bag.

    Args:
        directory: its name.
        files: names of its files of bags.
        described: whether it has a metadata.yaml.

    """
    # A folder of recordings has no metadata.yaml either, but they have names of their own.
    own = re.compile(re.escape(directory) + r"(_\d+)?\.")
    return bool(files) and (described or all(own.match(file) for file in files))


def is_storage(name: str) -> bool:
    """Return whether a file of this name is one of a bag.

    Args:
        name: of a file, without its directory.

    Returns:
        True for .mcap and .db3, compressed ones too; False for hidden files.

    """
    return name.endswith(_FILES) and not name.startswith(".")


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


# YAML


class _Loader(yaml.SafeLoader):
    """Without what rosbag2 never writes and what makes a small file long to read.

    A few lines of aliases stand for gigabytes; a few thousand levels take a minute.
    """

    def fetch_flow_collection_start(self, token_class: Any) -> None:
        """As the base's, for each `[` and `{`."""
        if self.flow_level >= _DEEPEST:
            raise yaml.YAMLError("too deep")
        super().fetch_flow_collection_start(token_class)

    def add_indent(self, column: int) -> bool:
        """As the base's, for each list or mapping without brackets."""
        if len(self.indents) >= _DEEPEST:
            raise yaml.YAMLError("too deep")
        return bool(super().add_indent(column))

    def compose_node(self, parent: Any, index: Any) -> Any:
        """As the base's, which would follow an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)
