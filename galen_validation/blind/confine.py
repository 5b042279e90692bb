# SPDX-License-Identifier: Apache-2.0
"""Lock a process out of one directory: no reading of what is in it, nor of other processes' memory.

Linux's Landlock (kernel 5.13 and later; Documentation/userspace-api/landlock.rst) takes from a
process, for good and for all its children, rights that it had. It knows only what is allowed, so
allowed is all but the way down to the directory: on each level everything beside it. What appears
on these levels later can't be read either. A process so confined can't look into the memory of
those that aren't (ptrace, /proc/PID/mem).
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

# The same on all of Linux's architectures since 5.13.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_FLAG = 1
_PATH_BENEATH = 1
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_NO_NEW_PRIVILEGES = 38


def available() -> bool:
    """Whether this system can lock a process out of a directory."""
    if not sys.platform.startswith("linux"):
        return False
    return _libc().syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION_FLAG) > 0


def lock_out(directory: Path) -> None:
    """Take the right to read a directory from this thread and its children, for good.

    Args:
        directory: What can no longer be read, with all in it; links in its path are followed.

    Raises:
        OSError: The system refuses.

    """
    libc = _libc()
    handled = struct.pack("=Q", _READ_FILE | _READ_DIR)  # struct landlock_ruleset_attr
    ruleset = _checked(libc.syscall(_CREATE_RULESET, handled, ctypes.c_size_t(len(handled)), 0))
    try:
        for path in _beside(directory.resolve()):
            _allow(libc, ruleset, path)
        _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
        _checked(libc.syscall(_RESTRICT_SELF, ruleset, 0))
    finally:
        os.close(ruleset)


def _beside(directory: Path) -> Iterator[Path]:
    """Everything on every level of the way down to a directory but the way itself.

    Links are left out: what they lead to is allowed where it lies, and may be the way itself.
    """
    for step in (directory, *directory.parents[:-1]):
        try:
            yield from (
                path for path in step.parent.iterdir() if path != step and not path.is_symlink()
            )
        except PermissionError:
            continue  # what this process can't list it can't open to its children either


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path) -> None:
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # gone meanwhile
    try:
        rights = _READ_FILE | _READ_DIR if path.is_dir() else _READ_FILE
        rule = struct.pack("=Qi", rights, handle)  # struct landlock_path_beneath_attr, packed
        _checked(libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
    finally:
        os.close(handle)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
