# SPDX-License-Identifier: Apache-2.0
"""The machine: what has to be on it, its ROS 2 Jazzy and Python, one run at a time."""

from __future__ import annotations

import fcntl
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

NEEDED_DISK_BYTES = 2_000_000_000  # the environment and the build take 1.6 GB

_APT = "Debian, Ubuntu: sudo apt install"
_TOOLS = (
    ("C compiler", "CC", ("cc", "gcc", "clang"), "build-essential"),
    ("C++ compiler", "CXX", ("c++", "g++", "clang++"), "build-essential"),
    ("CMake", None, ("cmake",), "cmake"),
    ("make", None, ("make", "gmake"), "make"),
)


class SetupError(Exception):
    """Set-up or build cannot go on; the message says in one line why, and the remedy."""


class Progress:
    """One line on what goes on; on a terminal the seconds are counted in it."""

    def __init__(self, title: str) -> None:
        """Print the line's begin."""
        self._title = title
        self._started = time.monotonic()

    def __enter__(self) -> Progress:
        """Begin the line."""
        print(f"{self._title} ...", end="" if sys.stdout.isatty() else "\n", flush=True)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """End the line with how long it took."""
        start = "\r" if sys.stdout.isatty() else ""
        end = "failed after" if kind else "done in"
        print(f"{start}{self._title}: {end} {time.monotonic() - self._started:.0f} s", flush=True)

    def run(
        self, command: list[str], env: Mapping[str, str], log: Path, folder: Path | None = None
    ) -> tuple[int, str]:
        """Run ``command``; returns its exit code, and its output, which is added to ``log``."""
        with log.open("a+", encoding="utf-8", errors="replace") as file:
            begin = file.seek(0, os.SEEK_END)
            process = subprocess.Popen(command, env=dict(env), cwd=folder, stdout=file, stderr=file)
            try:
                while process.poll() is None:
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(1.0)
                    if sys.stdout.isatty():
                        seconds = time.monotonic() - self._started
                        print(f"\r{self._title} ... {seconds:.0f} s", end="", flush=True)
            finally:
                process.kill()
            file.seek(begin)
            return process.returncode, file.read()


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


DISTRO = "jazzy"


@dataclass(frozen=True)
class Ros:
    """An installed ROS 2: its prefix, and the Python version that its rclpy is built for."""

    prefix: Path
    python_version: str


def find_ros(environ: Mapping[str, str]) -> Ros | None:
    """Return the sourced ROS 2 Jazzy, or None when no ROS is sourced.

    Raises:
        SetupError: another distribution is sourced, or Jazzy is sourced without rclpy.

    """
    distro = environ.get("ROS_DISTRO", "")
    if not distro:
        return None
    if distro != DISTRO:
        raise SetupError(
            f"ROS 2 '{distro}' is sourced, but this workspace needs '{DISTRO}': "
            f"start a new shell without it, or source /opt/ros/{DISTRO}/setup.bash in one"
        )
    for prefix in filter(None, environ.get("AMENT_PREFIX_PATH", "").split(":")):
        for package in sorted(Path(prefix).glob("lib/python3.*/site-packages/rclpy")):
            found = re.fullmatch(r"python(3\.\d+)", package.parents[1].name)
            if found:
                return Ros(Path(prefix), found.group(1))
    raise SetupError(
        f"ROS_DISTRO is '{DISTRO}', but no prefix in AMENT_PREFIX_PATH has rclpy: "
        f"install ros-{DISTRO}-ros-base and source /opt/ros/{DISTRO}/setup.bash again"
    )


SUPPORTED = ("3.12", "3.11")
DEBIAN_PYTHON = "/usr/bin/python3"  # what ROS's Debian packages are built for

_PROBE = """
import importlib.util, json, os, sys, sysconfig
print(json.dumps({
    "path": sys.executable,
    "version": "%d.%d" % sys.version_info[:2],
    "implementation": sys.implementation.name,
    "has_venv": all(importlib.util.find_spec(name) for name in ("venv", "ensurepip")),
    "has_headers": os.path.isfile(os.path.join(sysconfig.get_paths()["include"], "Python.h")),
}))
"""


@dataclass(frozen=True)
class Interpreter:
    """A Python on this machine, and what it brings."""

    path: str
    version: str
    implementation: str
    has_venv: bool
    has_headers: bool

    def flaw(self) -> str | None:
        """Return what is missing for an environment and for a build, or None."""
        if self.implementation != "cpython":
            return f"{self.path} is {self.implementation}: CPython is needed"
        if not self.has_venv:
            return (
                f"{self.path} has no venv module: install it "
                f"(Debian, Ubuntu: sudo apt install python{self.version}-venv)"
            )
        if not self.has_headers:
            return (
                f"{self.path} has no Python.h, which the messages need to compile: install it "
                f"(Debian, Ubuntu: sudo apt install python{self.version}-dev)"
            )
        return None


def probe(command: str) -> Interpreter | None:
    """Ask the Python ``command`` what it is; None when it does not run."""
    try:
        done = subprocess.run(
            [command, "-I", "-c", _PROBE], capture_output=True, text=True, timeout=30, check=True
        )
        return Interpreter(**json.loads(done.stdout))
    except (OSError, subprocess.SubprocessError, ValueError, TypeError):
        return None


def choose(environ: Mapping[str, str], ros: Ros | None) -> Interpreter:
    """Return the Python for the environment: the one of ``ros``, or else a supported one.

    Raises:
        SetupError: there is none, or the only ones lack a part.

    """
    versions = (ros.python_version,) if ros else SUPPORTED
    forced = environ.get("GALEN_PYTHON")
    if forced:
        return _forced(forced, versions, ros)
    flaws = []
    seen = set()
    for command in _candidates(environ, ros):
        if command in seen:
            continue
        seen.add(command)
        found = probe(command)
        if found is None or found.version not in versions:
            continue
        flaw = found.flaw()
        if flaw is None:
            return found
        flaws.append(flaw)
    if flaws:
        raise SetupError(flaws[0])
    wanted = " or ".join(versions)
    running = f"{sys.version_info[0]}.{sys.version_info[1]}"
    raise SetupError(
        f"no Python {wanted} found (python3 here is {running}): install one "
        f"(Debian, Ubuntu: sudo apt install python3-venv python3-dev), or name it: "
        f"make GALEN_PYTHON=/path/to/python{versions[0]}"
    )


def _forced(command: str, versions: tuple[str, ...], ros: Ros | None) -> Interpreter:
    found = probe(command)
    if found is None:
        raise SetupError(f"GALEN_PYTHON={command} is not a Python that runs")
    if found.version not in versions:
        owner = "the sourced ROS 2 needs" if ros else "this workspace needs"
        wanted = " or ".join(versions)
        raise SetupError(f"GALEN_PYTHON={command} is Python {found.version}; {owner} {wanted}")
    flaw = found.flaw()
    if flaw:
        raise SetupError(flaw)
    return found


def _candidates(environ: Mapping[str, str], ros: Ros | None) -> Iterator[str]:
    """Yield paths of Pythons to ask, the most wanted first."""
    path = environ.get("PATH", os.defpath)
    if ros:
        yield DEBIAN_PYTHON
        yield str(ros.prefix / "bin" / "python3")
        names = [f"python{ros.python_version}", "python3"]
    else:
        # Not an environment's own python: .venv would then hang on that environment.
        running = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        yield str(Path(sys.base_prefix, "bin", running))
        names = [f"python{version}" for version in SUPPORTED] + ["python3"]
    for name in names:
        for folder in path.split(os.pathsep):
            found = shutil.which(name, path=folder)
            if found and not _in_environment(found):
                yield found
    home = Path(environ.get("PYENV_ROOT") or Path(environ.get("HOME", "/"), ".pyenv"))
    for version in (ros.python_version,) if ros else SUPPORTED:
        for found_path in sorted(home.glob(f"versions/{version}.*/bin/python{version}")):
            yield str(found_path)


def _in_environment(python: str) -> bool:
    return Path(python).parent.parent.joinpath("pyvenv.cfg").is_file()
