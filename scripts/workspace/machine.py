"""The machine: what has to be on it, one run at a time in a workspace, how a run fails."""

from __future__ import annotations

import fcntl
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

NEEDED_DISK_BYTES = 2_000_000_000  # the environment and the build take 1.3 GB

_APT = "Debian, Ubuntu: sudo apt install"
_TOOLS = (
    ("C compiler", "CC", ("cc", "gcc", "clang"), "build-essential"),
    ("C++ compiler", "CXX", ("c++", "g++", "clang++"), "build-essential"),
    ("CMake", None, ("cmake",), "cmake"),
    ("make", None, ("make", "gmake"), "make"),
)


class SetupError(Exception):
    """Set-up or build cannot go on; the message says in one line why, and the remedy."""


def check_tools(environ: Mapping[str, str]) -> None:
    """Raise SetupError for the first build tool that is not on PATH."""
    path = environ.get("PATH", "")
    for title, variable, names, package in _TOOLS:
        chosen = environ.get(variable, "") if variable else ""
        if chosen:
            if not shutil.which(chosen.split()[0], path=path):
                raise SetupError(f"{variable}={chosen} is not on PATH: correct it, or unset it")
        elif not any(shutil.which(name, path=path) for name in names):
            raise SetupError(
                f"no {title} found, and the messages have to be compiled: install one "
                f"({_APT} {package})"
            )


def check_platform() -> None:
    """Raise SetupError where there are no wheels of ROS 2."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SetupError(
            f"ROS 2 wheels exist for Linux on x86_64, and this is {sys.platform} on "
            f"{platform.machine()}: install ROS 2 Jazzy and source its setup.bash instead"
        )


def check_disk(folder: Path, needed_bytes: int = NEEDED_DISK_BYTES) -> None:
    """Raise SetupError when ``folder`` is on a disk with too little room."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise SetupError(
            f"{free / 1e9:.1f} GB free in {folder}, and {needed_bytes / 1e9:.1f} GB are needed: "
            "free some space, then run it again"
        )


def exclusive(path: Path) -> AbstractContextManager[None]:
    """Hold the lock file ``path``; wait for its holder, and print that.

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
