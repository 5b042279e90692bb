"""Files that are written whole or not at all.

The new content goes into a temporary file beside the old one, which is synced to the disk and
renamed over the old name, as POSIX does in one step; before that the old file gets a second name,
`<name>.bak`. A process killed at any moment leaves the old file or the new one.
"""

import os
import tempfile
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file in one step; makes its folder, keeps the old file as `.bak`. Text is UTF-8.

    Raises OSError; the old file is then untouched.
    """
    raw = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(raw)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(0o644)  # mkstemp's 0600 would hide it from the lab's others
        _keep_backup(path)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    _sync_directory(path.parent)


def _keep_backup(path: Path) -> None:
    """Give the old file its second name; the backup, too, changes in one step."""
    if not path.exists():
        return
    backup = path.with_name(path.name + ".bak")
    spare = path.with_name(f".{path.name}.bak.{os.getpid()}")
    spare.unlink(missing_ok=True)
    try:
        os.link(path, spare)
    except OSError:  # a file system without hard links
        spare.write_bytes(path.read_bytes())
    os.replace(spare, backup)


def _sync_directory(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems can't sync a directory; the rename itself is done
    finally:
        os.close(handle)
