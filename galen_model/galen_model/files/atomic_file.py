# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all.

The new content goes into a temporary file beside the old one, which is synced to the disk and
renamed over the old name, as POSIX does in one step; before that the old file gets a second name,
`<name>.bak`. A process killed at any moment leaves the old file or the new one, and perhaps a
hidden `.<name>.unfinished.<anything>` beside it, which is never read, and which the next writing of
that file removes when it is ten minutes old.

Where the name is a symbolic link, the link is replaced, and `.bak` leads to where it led: what is
written never ends up in another directory, and nothing there changes. A directory that is a link is
followed.
"""

from __future__ import annotations

import errno
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_NO_HARD_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK)
_LEFT_AFTER_S = 600.0
"""No writer is active for so long."""


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file in one step; makes its folder, keeps the old file as `.bak`.

    Args:
        path: file to write.
        content: all of it; text is written as UTF-8.

    Raises:
        OSError: it can't be written; the old file is then untouched.

    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _write_beside(path, content)
    try:
        _keep_backup(path)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sweep(path)
    sync_directory(path.parent)


def write_new(path: Path, content: str | bytes) -> None:
    """Write a file in one step, where there is none.

    Args:
        path: file to write, in a folder that is there.
        content: all of it; text is written as UTF-8.

    Raises:
        FileExistsError: the name is taken; nothing is then written.
        OSError: it can't be written.

    """
    temporary = _write_beside(path, content)
    try:
        rename_to_free(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def rename_to_free(path: Path, free: Path) -> None:
    """Rename a file within its directory to a free name.

    `os.rename` would overwrite; a hard link doesn't, so the file has both names for a moment.

    Args:
        path: file to rename.
        free: its new name.

    Raises:
        FileExistsError: the new name is taken.
        OSError: it can't be renamed, or was replaced meanwhile (EBUSY).

    """
    try:
        os.link(path, free, follow_symlinks=False)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        if os.path.lexists(free):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(free)) from None
        path.rename(free)
        return
    try:
        # What another process put there meanwhile under the old name must not be lost.
        unlink_if(path, lambda there: os.path.samestat(there.lstat(), free.lstat()))
    except OSError:
        free.unlink(missing_ok=True)
        raise


def unlink_if(path: Path, is_it: Callable[[Path], bool]) -> None:
    """Remove a file if it still is what it was, which is asked when no other can be put there.

    It is renamed first, in one step; one that is something else gets its name back, or becomes
    `.bak` where there is yet another by then.

    Args:
        path: file to remove.
        is_it: called with the file's name aside; whether it is the one to remove.

    Raises:
        OSError: it can't be removed, or is something else (EBUSY).

    """
    aside = path.with_name(f".{path.name}.aside.{os.getpid()}")
    path.rename(aside)
    try:
        if not is_it(aside):
            raise OSError(errno.EBUSY, "it is being written; ask again")
        aside.unlink()
    except BaseException:
        if os.path.lexists(path):  # newer still
            aside.replace(path.with_name(path.name + ".bak"))
        else:
            aside.rename(path)
        raise


def exchange(path: Path, other: Path, spare: Path) -> None:
    """Have two files of a directory swap their names; at every moment `path` is a whole file.

    A process killed in between leaves what `path` had under both names, and what `other` had as
    `spare`.

    Args:
        path: a file.
        other: the other one.
        spare: a free name in the same directory.

    Raises:
        FileExistsError: the spare name is taken.
        OSError: they can't be swapped; both then have their names.

    """
    _second_name(other, spare)
    try:
        _keep_as(path, other)
        try:
            os.replace(spare, path)
        except OSError:
            os.replace(spare, other)
            raise
    except OSError:
        spare.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def _write_beside(path: Path, content: str | bytes) -> Path:
    """Write and sync a temporary file in the folder of `path`; removed again on an error."""
    raw = content.encode() if isinstance(content, str) else content
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=_unfinished(path))
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(raw)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.chmod(0o644)  # mkstemp's 0600 would hide it from the lab's others
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def _unfinished(path: Path) -> str:
    """Return what the names of files begin with that stand for `path` while it is written."""
    return f".{path.name}.unfinished."


def _sweep(path: Path) -> None:
    """Remove what killed writers of this file left; what can't be removed does no harm."""
    before_s = time.time() - _LEFT_AFTER_S
    with suppress(OSError), os.scandir(path.parent) as entries:
        for entry in entries:
            if not entry.name.startswith(_unfinished(path)):
                continue
            with suppress(OSError):
                # The inode's own time: a second name of an old file is as young as its link.
                if entry.stat(follow_symlinks=False).st_ctime < before_s:
                    Path(entry.path).unlink()


def _keep_backup(path: Path) -> None:
    """Give the old file its second name."""
    if path.exists():
        _keep_as(path, path.with_name(path.name + ".bak"))


def _keep_as(path: Path, name: Path) -> None:
    """Give a file a second name; what had it before loses it in one step."""
    spare = path.with_name(f"{_unfinished(path)}bak{os.getpid()}")
    spare.unlink(missing_ok=True)
    try:
        _second_name(path, spare)
        os.replace(spare, name)
    except BaseException:
        spare.unlink(missing_ok=True)
        raise


def _second_name(path: Path, free: Path) -> None:
    try:
        os.link(path, free, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        free.write_bytes(path.read_bytes())


def sync_directory(directory: Path) -> None:
    """Have the directory's names on the disk, so that they outlast a loss of power.

    Args:
        directory: whose entries changed.

    Raises:
        OSError: it can't be opened.

    """
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems can't sync a directory; the rename itself is done
    finally:
        os.close(handle)


_DPI = 110


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG in one step, making its folder, and close the figure.

    Args:
        figure: of pyplot.
        path: file to write.

    Returns:
        The path.

    Raises:
        OSError: it can't be written; an old picture is then untouched.

    """
    from matplotlib import pyplot as plt  # slow to import, and there already where a figure is

    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(unfinished, dpi=_DPI, format="png")
        os.replace(unfinished, path)
    finally:
        plt.close(figure)
        if unfinished.exists():  # not where a file stands in the folder's place
            unfinished.unlink()
    return path
