"""Writes a rosbag2 directory (MCAP) that can be read up to where it was cut off."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.rosbag2 import WriterError

from galen_bags.errors import BagError
from galen_bags.formats.writer import BagWriter


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
        except OSError as problem:
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
        """Append a serialised message (CDR); `log_time_ns` is when it was received."""
        assert self._writer is not None
        try:
            self._writer.write(topic, log_time_ns, data)
        except OSError as error:
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

    def _broken_off(self, error: OSError) -> BagError:
        self._give_up()
        return BagError(
            f"{self.path}: can't be written any more: {error.strerror}; what it holds can be read"
        )

    def _give_up(self) -> None:
        """Close the file and take off the part of a record at its end."""
        assert self._writer is not None
        with contextlib.suppress(OSError):
            self._writer.abort()
        self._writer = None
        with contextlib.suppress(OSError):
            os.truncate(self._file, self._flushed_bytes)
            (self.path / "metadata.yaml.tmp").unlink(missing_ok=True)
