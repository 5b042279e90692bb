"""Who may work in the workspace beside whom."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def exclusive(path: Path) -> Iterator[IO[str]]:
    """Hold the lock file ``path``; wait for the process that holds it, and say so.

    The system frees the lock when its holder ends, however it ends.
    """
    with path.open("a") as file:
        _take(file, fcntl.LOCK_EX)
        yield file


@contextmanager
def shared(path: Path) -> Iterator[IO[str]]:
    """Hold the lock file ``path`` together with others that share it; wait as `exclusive` does."""
    with path.open("a") as file:
        _take(file, fcntl.LOCK_SH)
        yield file


def _take(file: IO[str], kind: int) -> None:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError:
        print("Waiting for another set-up or build of this workspace ...", flush=True)
        fcntl.flock(file, kind)
