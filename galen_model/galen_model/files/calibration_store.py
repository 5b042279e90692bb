# SPDX-License-Identifier: Apache-2.0
"""Calibration files of one directory: listed, read, renamed, reverted, removed, restored.

A tool's name is the only way in: it is checked, and what it names must be a file within the
directory, so that neither a name nor a link leads out of it. Nothing is ever overwritten: a file
gets its new name by a hard link, which fails where the name is taken, and loses its old one after.
Reverting swaps two names (`atomic_file.exchange`). So at every moment, also after a crash, each
calibration is there under at least one name.

    <tool>.json            the calibration file
    <tool>.json.bak        the calibration before it (`galen_model.files.atomic_file`)
    <tool>.json.removed    a tool that was removed; .removed.2 and so on where that is taken
    <tool>.json.bak.removed, without the above: left by a revert that a crash cut short
"""

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path

from galen_model.arm.arm import Arm
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.atomic_file import (
    exchange,
    rename_to_free,
    sync_directory,
    unlink_if,
    write_new,
)
from galen_model.files.calibration_file import (
    MAX_FILE_BYTES,
    CalibrationFile,
    calibration_path,
    check_tool_name,
    parse_calibration,
)
from galen_model.json_fields import FieldError, read_limited

_SUFFIX = ".json"
_BACKUP = ".bak"
_REMOVED = ".removed"
_REMOVED_NAME = re.compile(r"([A-Za-z0-9_-]+\.json)\.removed(?:\.(\d+))?")


class ToolExistsError(GalenError):
    """The name is taken by another tool."""


class CalibrationStoreError(GalenError):
    """The directory of the calibration files can't be read or written."""


class FileState(Enum):
    """What became of a file since it was read."""

    AS_LOADED = "as loaded"
    CHANGED = "changed"
    GONE = "gone"


@dataclass(frozen=True)
class StoredCalibration:
    """A tool as it was read: its file, the content and the SHA-256 of the bytes."""

    path: Path
    tool: CalibrationFile
    sha256: str
    content: str

    @property
    def as_loaded(self) -> bool:
        """Whether its file is there, with the same content."""
        return self.file_state() is FileState.AS_LOADED

    def file_state(self) -> FileState:
        """Return what became of the file since; a file with the same content is as loaded."""
        try:
            same = _digest(_read(self.path)) == self.sha256
        except CalibrationFileError:
            return FileState.GONE
        return FileState.AS_LOADED if same else FileState.CHANGED


@dataclass(frozen=True)
class Entry:
    """A row of the list: a tool, or why the file of this name can't be used."""

    name: str
    stored: StoredCalibration | None
    problem: str = ""


class CalibrationStore:
    """One directory of calibration files; it need not exist, and then has no tools."""

    def __init__(
        self, tools_dir: str | os.PathLike[str], arm: Arm, *, other_arms: bool = False
    ) -> None:
        """Take a directory; nothing is read yet.

        Args:
            tools_dir: directory of the files; ~ is expanded.
            arm: the one that the tools are used on.
            other_arms: as of `parse_calibration`.

        """
        self.directory = Path(tools_dir).expanduser()
        self.arm = arm
        self._parse = partial(parse_calibration, arm=arm, other_arms=other_arms)

    def read(self, name: str) -> StoredCalibration:
        """Read and check a calibration file, and that it holds the tool of this name.

        Args:
            name: the tool's.

        Returns:
            The tool as it was read.

        Raises:
            ToolNameError: the name is not allowed.
            CalibrationFileError: naming the file; where there is none, its cause is a
                FileNotFoundError.

        """
        return self._stored(self._checked(name), name)

    def previous(self, name: str) -> StoredCalibration:
        """Read and check the calibration before a tool's present one, as `read` does.

        Args:
            name: the tool's.

        Returns:
            The tool as it was read from the backup.

        Raises:
            ToolNameError: the name is not allowed.
            CalibrationFileError: naming the file; where there is none, its cause is a
                FileNotFoundError.

        """
        backup = self._within(_backup(calibration_path(self.directory, name)))
        if not os.path.lexists(backup):
            raise CalibrationFileError(
                f"{backup}: no calibration of '{name}' before its present one is kept"
            ) from FileNotFoundError()
        return self._stored(backup, name)

    def has_previous(self, name: str) -> bool:
        """Check whether `revert` would bring a calibration back.

        Args:
            name: the tool's.

        Returns:
            Whether there is a usable one.

        Raises:
            ToolNameError: the name is not allowed.

        """
        try:
            self.previous(name)
        except CalibrationFileError:
            return False
        return True

    def names(self) -> list[str]:
        """List the names of files *.json.

        Returns:
            Names of tools, sorted, whether their files can be used or not.

        Raises:
            CalibrationStoreError: the directory can't be read.

        """
        return sorted(
            name.removesuffix(_SUFFIX)
            for name in self._files()
            if name.endswith(_SUFFIX) and not name.startswith(".")
        )

    def entries(self, names: list[str] | None = None) -> Iterator[Entry]:
        """Read tools one by one.

        Args:
            names: of the tools; None: all.

        Yields:
            A row of the list, also where the file can't be used.

        Raises:
            CalibrationStoreError: the directory can't be read.

        """
        for name in self.names() if names is None else names:
            try:
                yield Entry(name, self.read(name))
            except (ToolNameError, CalibrationFileError) as error:
                yield Entry(name, None, str(error))

    def rename(self, name: str, new_name: str) -> StoredCalibration:
        """Give a tool another name, in its file and inside; its backup goes with it.

        A rename that a crash cut short is finished by asking for it again. After an error the tool
        has its old name.

        Args:
            name: the tool's.
            new_name: a free name.

        Returns:
            The tool under its new name.

        Raises:
            ToolNameError: a name is not allowed.
            CalibrationFileError: the file can't be read or used.
            ToolExistsError: the new name is taken.
            CalibrationStoreError: it can't be renamed.

        """
        old = self.read(name)
        new_path = calibration_path(self.directory, new_name)
        if new_name == name:
            raise ToolExistsError(f"{new_path}: the tool is named '{name}' already")
        self._check_free(old, new_path)
        backup, new_backup = _backup(old.path), _backup(new_path)
        made: list[Path] = []
        try:
            if not os.path.lexists(new_path):
                write_new(new_path, _named(old.content, new_name))
                made.append(new_path)
            if backup.exists():
                if os.path.lexists(new_backup):
                    _set_aside(new_path, (new_backup,))  # left by a tool that is gone
                write_new(new_backup, self._named_backup(backup, new_name))
                made.append(new_backup)
            # A calibration may have been written meanwhile.
            unlink_if(old.path, lambda path: replace(old, path=path).as_loaded)
        except OSError as error:
            for path in made:
                path.unlink(missing_ok=True)
            if isinstance(error, FileExistsError):
                raise ToolExistsError(f"{new_path}: is there already") from error
            raise CalibrationStoreError(
                f"{old.path}: can't be renamed: {error.strerror}"
            ) from error
        with suppress(OSError):  # the tool has its new name; what is left is a copy
            backup.unlink(missing_ok=True)
            sync_directory(self.directory)
        return self.read(new_name)

    def revert(self, name: str) -> StoredCalibration:
        """Swap a calibration file and the calibration before it; doing it twice changes nothing.

        A broken file is kept as the other one. An error of the swap changes nothing.

        Args:
            name: the tool's.

        Returns:
            The tool with the calibration brought back.

        Raises:
            ToolNameError: the name is not allowed.
            CalibrationFileError: there is no file or no usable calibration before it.
            CalibrationStoreError: they can't be swapped.

        """
        path = self._regular(name)
        self.previous(name)
        backup = _backup(path)
        try:
            exchange(path, backup, _removed(backup, _free_number(path)))
        except OSError as error:
            raise CalibrationStoreError(f"{path}: can't be reverted: {error.strerror}") from error
        return self.read(name)

    def remove(self, name: str) -> Path:
        """Take a tool off the list, broken or not; its file is kept, so that it can come back.

        Args:
            name: the tool's.

        Returns:
            Where the file is kept.

        Raises:
            ToolNameError: the name is not allowed.
            CalibrationFileError: there is no file.
            CalibrationStoreError: it can't be renamed.

        """
        path = self._regular(name)
        try:
            backup = _backup(path)
            files = (path, backup) if backup.exists() else (path,)
            kept = _removed(path, _set_aside(path, files))
            sync_directory(self.directory)
        except OSError as error:
            raise CalibrationStoreError(f"{path}: can't be removed: {error.strerror}") from error
        return kept

    def removed(self) -> list[str]:
        """List the removed tools that can be brought back.

        Returns:
            Names, sorted.

        Raises:
            CalibrationStoreError: the directory can't be read.

        """
        found = {match.group(1) for match in map(_REMOVED_NAME.fullmatch, self._files()) if match}
        gone = (name for name in found if not os.path.lexists(self.directory / name))
        return sorted(name.removesuffix(_SUFFIX) for name in gone)

    def restore(self, name: str) -> Path:
        """Bring back the tool removed last under a name, and its backup.

        Args:
            name: the tool's.

        Returns:
            Path of its file.

        Raises:
            ToolNameError: the name is not allowed.
            ToolExistsError: there is a tool of this name.
            CalibrationFileError: none is kept.
            CalibrationStoreError: it can't be renamed.

        """
        path = calibration_path(self.directory, name)
        if os.path.lexists(path):
            raise ToolExistsError(f"{path}: is there; nothing is to be brought back")
        matches = filter(None, map(_REMOVED_NAME.fullmatch, self._files()))
        numbers = [int(found.group(2) or 1) for found in matches if found.group(1) == path.name]
        if not numbers:
            raise CalibrationFileError(f"{path}{_REMOVED}: no removed tool of this name is kept")
        number = max(numbers)
        backup = _backup(path)
        kept_backup = _removed(backup, number)
        try:
            if kept_backup.exists() and not os.path.lexists(backup):
                rename_to_free(kept_backup, backup)
            rename_to_free(_removed(path, number), path)
            sync_directory(self.directory)
        except FileExistsError as error:
            raise ToolExistsError(f"{path}: is there already") from error
        except OSError as error:
            raise CalibrationStoreError(
                f"{path}: can't be brought back: {error.strerror}"
            ) from error
        return path

    # Inside

    def _stored(self, path: Path, name: str) -> StoredCalibration:
        raw = _read(path)
        tool = self._parse(path, raw)
        if tool.tool != name:
            raise CalibrationFileError(f"{path}: holds the tool '{tool.tool}', not '{name}'")
        return StoredCalibration(path, tool, _digest(raw), _text(raw))

    def _named_backup(self, backup: Path, name: str) -> bytes | str:
        """Return the backup with another name inside; one that can't be read stays as it is."""
        raw = _read(backup)
        try:
            self._parse(backup, raw)
        except CalibrationFileError:
            return raw
        return _named(_text(raw), name)

    def _files(self) -> list[str]:
        try:
            # A name that is no UTF-8 is told with \\xff for a byte, which no tool's name holds.
            return [
                os.fsencode(path.name).decode("utf-8", "backslashreplace")
                for path in self.directory.iterdir()
            ]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise CalibrationStoreError(
                f"{self.directory}: can't be read: {error.strerror}"
            ) from error

    def _checked(self, name: str) -> Path:
        """Path of a name; raises CalibrationFileError where it is a link out of the directory."""
        return self._within(calibration_path(self.directory, name))

    def _within(self, path: Path) -> Path:
        try:
            within = path.resolve().is_relative_to(self.directory.resolve())
        except OSError as error:
            raise CalibrationFileError(f"{path}: can't be read: {error.strerror}") from error
        except RuntimeError:  # links in a circle, up to Python 3.12
            within = False
        if not within:
            raise CalibrationFileError(f"{path}: is a link that leads out of {self.directory}")
        return path

    def _regular(self, name: str) -> Path:
        """Path of a file, broken or not; raises ToolNameError or CalibrationFileError."""
        path = self._checked(name)
        try:
            mode = path.stat().st_mode
        except OSError as error:
            raise CalibrationFileError(f"{path}: can't be read: {error.strerror}") from error
        if not stat.S_ISREG(mode):
            raise CalibrationFileError(f"{path}: is no regular file")
        return path

    def _check_free(self, old: StoredCalibration, new_path: Path) -> None:
        """Raise ToolExistsError unless the new name is free, or left there by a cut-off rename."""
        if not os.path.lexists(new_path):
            return
        try:
            there = _read(new_path)
        except CalibrationFileError:
            there = b""
        if there != _named(old.content, new_path.name.removesuffix(_SUFFIX)).encode():
            raise ToolExistsError(f"{new_path}: is there already; a tool is never overwritten")


def _named(content: str, name: str) -> str:
    """Return a file's content with another name inside; unknown fields stay."""
    whole = json.loads(content)
    whole["tool"] = check_tool_name(name)
    return json.dumps(whole, indent=2) + "\n"


def _backup(path: Path) -> Path:
    return path.with_name(path.name + _BACKUP)


def _set_aside(path: Path, files: tuple[Path, ...]) -> int:
    """Rename the files of a tool (`path`: its own) to *.removed, with the first number free."""
    number = _free_number(path)
    for file in files:
        rename_to_free(file, _removed(file, number))
    return number


def _free_number(path: Path) -> int:
    """Return the first under which neither a calibration file nor its backup was removed."""
    number = 1
    while any(os.path.lexists(_removed(file, number)) for file in (path, _backup(path))):
        number += 1
    return number


def _removed(path: Path, number: int) -> Path:
    return path.with_name(path.name + _REMOVED + ("" if number == 1 else f".{number}"))


def _read(path: Path) -> bytes:
    """Return the bytes of a calibration file; raises CalibrationFileError."""
    try:
        return read_limited(path, MAX_FILE_BYTES, "a calibration file")
    except OSError as error:
        raise CalibrationFileError(f"{path}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise CalibrationFileError(f"{path}: {error}") from error


def _text(raw: bytes) -> str:
    """As JSON finds its encoding; half of a surrogate pair, which no message takes, becomes '?'."""
    text = raw.decode(json.detect_encoding(raw), "surrogatepass")
    return text.encode("utf-8", "replace").decode()


def _digest(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()
