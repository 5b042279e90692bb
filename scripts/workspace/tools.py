"""Checks for what has to be on the machine before anything is made."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from .errors import SetupError

NEEDED_DISK_BYTES = 2_000_000_000  # the environment and the build take 1.3 GB

_APT = "Debian, Ubuntu: sudo apt install"
_TOOLS = (
    ("C compiler", "CC", ("cc", "gcc", "clang"), "build-essential"),
    ("C++ compiler", "CXX", ("c++", "g++", "clang++"), "build-essential"),
    ("CMake", None, ("cmake",), "cmake"),
    ("make", None, ("make", "gmake"), "make"),
)


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
