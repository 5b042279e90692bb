"""The bags at or below given paths."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from galen_bags.errors import BagError
from galen_bags.formats.metadata import STORAGES, storage_files

_FILES = (*STORAGES, *(f"{storage}.zstd" for storage in STORAGES), ".bag")
_METADATA = "metadata.yaml"
# What rosbag2's metadata begins with; other programs have a metadata.yaml, too.
_METADATA_KEY = b"rosbag2_bagfile_information"
_METADATA_HEAD_BYTES = 4096


def find_bags(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the bags that `paths` are or, if they are folders, hold; sorted, each once.

    A bag is a rosbag2 directory (not its files), or a .mcap, .db3 (.zstd, too) or ROS 1 .bag file
    elsewhere. A directory without metadata.yaml whose files all have its own name, as in
    `run/run_0.mcap`, is a recording that was cut off: one bag. Names that begin with a dot are
    left out, links are followed. Raises BagError for a path that is not there, is no bag or holds
    none, or can't be searched.
    """
    found: dict[tuple[int, int], Path] = {}
    for path in map(Path, paths):
        try:
            if not path.exists():
                raise BagError(f"{path}: is not there")
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


def is_bag(path: Path) -> bool:
    """Whether the path itself is a bag, by names and metadata; raises OSError."""
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
    files = storage_files(directory)
    metadata = directory / _METADATA
    if metadata.is_file():
        if files:
            return True
        with metadata.open("rb") as stream:
            return _METADATA_KEY in stream.read(_METADATA_HEAD_BYTES)
    # A folder of recordings has no metadata.yaml either, but they have names of their own.
    own = re.compile(re.escape(directory.resolve().name) + r"(_\d+)?\.")
    return bool(files) and all(own.match(file.name) for file in files)


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino
