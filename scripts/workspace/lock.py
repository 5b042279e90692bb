"""Who may work in the workspace beside whom."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path


def exclusive(path: Path) -> AbstractContextManager[None]:
    """Hold the lock file ``path``; wait for the process that holds it, and say so.

    The system frees the lock when its holder ends, however it ends.
    """
    return _held(path, fcntl.LOCK_EX)


def shared(path: Path) -> AbstractContextManager[None]:
    """Hold the lock file ``path`` together with others that share it; wait as `exclusive` does."""
    return _held(path, fcntl.LOCK_SH)


@contextmanager
def _held(path: Path, kind: int) -> Iterator[None]:
    with path.open("a") as file:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except OSError:
            print("Waiting for another set-up or build of this workspace ...", flush=True)
            fcntl.flock(file, kind)
        yield
