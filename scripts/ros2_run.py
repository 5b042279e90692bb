# SPDX-License-Identifier: Apache-2.0
"""Stand in for `ros2 run` where ROS 2 comes from PyPI, which has no `ros2` command."""

from __future__ import annotations

import os
import sys
from pathlib import Path

USAGE = """usage: ros2 run <package> <executable> [arguments ...]

Stand-in for `ros2` in an environment that was made from PyPI: it knows `run` alone.
It starts lib/<package>/<executable> of the first prefix in AMENT_PREFIX_PATH that has it.
Other sub-commands need a full ROS 2 Jazzy: source /opt/ros/jazzy/setup.bash first."""


class NotFoundError(Exception):
    """A package or an executable that no prefix holds."""


def executables(prefixes: list[str], package: str) -> dict[str, Path]:
    """Return the executables of ``package`` by name; an earlier prefix hides a later one."""
    found: dict[str, Path] = {}
    known = False
    for prefix in prefixes:
        marker = Path(prefix, "share", "ament_index", "resource_index", "packages", package)
        known = known or marker.is_file()
        folder = Path(prefix, "lib", package)
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if path.is_file() and os.access(path, os.X_OK):
                found.setdefault(path.name, path)
    if not known:
        raise NotFoundError(f"package '{package}' not found; was the workspace built and sourced?")
    return found


def find_executable(prefixes: list[str], package: str, name: str) -> Path:
    """Return the path of the executable ``name`` of ``package``.

    Raises:
        NotFoundError: there is no such package or executable; the message lists what there is.

    """
    found = executables(prefixes, package)
    if name not in found:
        names = ", ".join(found) or "none"
        raise NotFoundError(f"package '{package}' has no executable '{name}'; it has: {names}")
    return found[name]


def main(arguments: list[str]) -> int:
    """Replace this process by the executable that ``arguments`` name."""
    helps = ("-h", "--help")
    if not arguments or arguments[0] in helps:
        print(USAGE)
        return 0
    command, *rest = arguments
    if command != "run":
        return _fail(f"'ros2 {command}' needs a full ROS 2 Jazzy; here only 'ros2 run' works")
    if not rest or rest[0] in helps:
        print(USAGE)
        return 0
    package, *rest = rest
    if not rest:
        return _fail("name an executable too: ros2 run <package> <executable>")
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    try:
        path = find_executable(prefixes, package, rest[0])
    except NotFoundError as error:
        return _fail(str(error))
    os.execv(path, [str(path), *rest[1:]])


def _fail(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
