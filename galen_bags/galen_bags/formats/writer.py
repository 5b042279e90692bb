# SPDX-License-Identifier: Apache-2.0
"""Write rosbag2 directories (MCAP): whole or not at all, or growing while recorded."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from galen_bags.formats.errors import BagError

# The version that rosbag2 of Jazzy writes.
_METADATA_VERSION = 9


class BagWriter:
    """A new bag; a context manager.

        with BagWriter(path) as bag:
            wrenches = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
            bag.write(wrenches, log_time_ns, data)

    It grows in a hidden directory beside `path` and gets its name at the end; an exception, Ctrl-C
    too, removes it. Topic names get the leading slash that bags have.
    """

    def __init__(self, path: str | os.PathLike[str], *, compressed: bool = True) -> None:
        """`compressed`: zstd on each chunk. Raises BagError if `path` is there already."""
        self.path = Path(path)
        self._compressed = compressed
        self._reject_existing()
        self._writer: Writer | None = None
        self._temporary: Path | None = None
        self._types = get_typestore(Stores.ROS2_JAZZY)

    def __enter__(self) -> BagWriter:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary = Path(
                tempfile.mkdtemp(dir=self.path.parent, prefix=f".{self.path.name}.")
            )
            # Named as the bag will be, since the file in it is named after it.
            writer = self._new_writer(self._temporary / self.path.name)
            writer.open()
        except (OSError, WriterError) as error:
            self._remove()
            raise BagError(f"{self.path}: can't be written: {error}") from error
        self._writer = writer
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._writer is not None and self._temporary is not None
        try:
            if kind is not None:
                self._writer.abort()
                return
            self._writer.close()
            self._reject_existing()  # one that came meanwhile is not written over
            os.replace(self._temporary / self.path.name, self.path)
        except (OSError, WriterError) as problem:
            raise BagError(f"{self.path}: can't be written: {problem}") from problem
        finally:
            self._writer = None
            self._remove()

    def add_topic(
        self, name: str, type_name: str, definition: str | None = None, qos: tuple[Qos, ...] = ()
    ) -> Any:
        """Add a topic to the bag.

        Args:
            name: with a leading slash or without.
            type_name: as in "sensor_msgs/msg/JointState".
            definition: .msg text, its dependencies after lines of =; needed for types that ROS 2
                itself does not bring, see `knows`.
            qos: QoS that the topic's publishers offered, for the bag's metadata.

        Returns:
            What `write` wants for this topic.

        Raises:
            BagError: the type is not known, its definition is wrong, or the topic can't be added.

        """
        assert self._writer is not None
        try:
            if not self.knows(type_name):
                if definition is None:
                    raise BagError(f"{self.path}: {name}: the type {type_name} is not known")
                self._types.register(
                    {
                        key: value
                        for key, value in get_types_from_msg(definition, type_name).items()
                        if key not in self._types.fielddefs
                    }
                )
            return self._writer.add_connection(
                "/" + name.lstrip("/"),
                type_name,
                typestore=self._types,
                offered_qos_profiles=list(qos),
            )
        except (TypesysError, WriterError, ValueError, RecursionError) as error:
            # The last two: of a made-up definition, with a size of 5000 digits or itself in it.
            raise BagError(f"{self.path}: {name}: can't be added: {error}") from error

    def knows(self, type_name: str) -> bool:
        """Return whether `add_topic` takes this type without a definition.

        Args:
            type_name: as in "sensor_msgs/msg/JointState".

        Returns:
            True for types of ROS 2 itself, and those that were added.

        """
        return type_name in self._types.fielddefs

    def write(self, topic: Any, log_time_ns: int, data: bytes | memoryview) -> None:
        """Append a serialised message.

        Args:
            topic: from `add_topic`.
            log_time_ns: when it was received, ns.
            data: the message as CDR.

        Raises:
            BagError: the bag can't be written.

        """
        assert self._writer is not None
        try:
            self._writer.write(topic, log_time_ns, data)
        except (OSError, WriterError, OverflowError) as error:
            raise BagError(f"{self.path}: can't be written: {error}") from error

    def _new_writer(self, path: Path) -> Writer:
        writer = Writer(path, version=_METADATA_VERSION, storage_plugin=StoragePlugin.MCAP)
        if self._compressed:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        return writer

    def _reject_existing(self) -> None:
        if self.path.exists() or self.path.is_symlink():
            raise BagError(f"{self.path}: is there already, and is not written over")

    def _remove(self) -> None:
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
            self._temporary = None


class GrowingBagWriter(BagWriter):
    """A new bag that grows under its own name, for recordings; a context manager.

    As with rosbag2's recorder, metadata.yaml comes at the end: a bag without one was cut off, and
    holds what was written until the last `flush`. The end, an exception too, closes the bag. If
    that or a write fails (a full disk), the file is cut back to the last `flush`.
    """

    def __enter__(self) -> GrowingBagWriter:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._new_writer(self.path)
            self._writer.open()
            self._flushed_bytes = 0
            self._storage().bio.flush()
        except (OSError, WriterError) as error:
            with contextlib.suppress(OSError):
                if self._writer is not None and self._writer.storage is not None:
                    self._give_up()
                    self._file.unlink()
                self.path.rmdir()  # if it is empty
            raise BagError(f"{self.path}: can't be written: {error}") from error
        self._flushed_bytes = self._storage().bio.tell()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._writer is None:
            return
        try:
            self._writer.close()
        except (OSError, WriterError) as problem:
            raise self._broken_off(problem) from problem
        self._flushed_bytes = self._file.stat().st_size
        self._writer = None

    @property
    def is_open(self) -> bool:
        """Whether it can be written; not after a write that failed."""
        return self._writer is not None

    @property
    def size_bytes(self) -> int:
        """Size of the file; without what is still in memory."""
        return self._flushed_bytes if self._writer is None else int(self._storage().bio.tell())

    def write(self, topic: Any, log_time_ns: int, data: bytes | memoryview) -> None:
        """Append a serialised message; a write that fails closes the bag.

        Args:
            topic: from `add_topic`.
            log_time_ns: when it was received, ns.
            data: the message as CDR.

        Raises:
            BagError: the bag can't be written any more.

        """
        assert self._writer is not None
        try:
            self._writer.write(topic, log_time_ns, data)
        except (OSError, WriterError, OverflowError) as error:
            raise self._broken_off(error) from error

    def flush(self) -> None:
        """Hand all messages to the operating system: nothing of them is lost by a `kill -9`.

        This ends an MCAP chunk, so call it about once a second. Raises BagError.
        """
        storage = self._storage()
        try:
            # Chunks without messages have no times; the library would write nonsense.
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
        except OSError as error:
            raise self._broken_off(error) from error
        self._flushed_bytes = storage.bio.tell()

    def _storage(self) -> Any:
        assert self._writer is not None
        return self._writer.storage

    @property
    def _file(self) -> Path:
        return self.path / f"{self.path.name}.mcap"

    def _broken_off(self, error: Exception) -> BagError:
        self._give_up()
        why = error.strerror if isinstance(error, OSError) else error
        return BagError(f"{self.path}: can't be written any more: {why}; what it holds can be read")

    def _give_up(self) -> None:
        """Close the file and cut the part of a record at its end."""
        assert self._writer is not None
        with contextlib.suppress(OSError):
            self._writer.abort()
        self._writer = None
        with contextlib.suppress(OSError):
            os.truncate(self._file, self._flushed_bytes)
            (self.path / "metadata.yaml.tmp").unlink(missing_ok=True)
