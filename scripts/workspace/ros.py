"""Finds a ROS 2 Jazzy that this shell has sourced."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .machine import SetupError

DISTRO = "jazzy"
DEBIAN_PREFIX = Path("/opt/ros") / DISTRO


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


def unused_ros_note(debian_prefix: Path = DEBIAN_PREFIX) -> str | None:
    """Return a hint when ROS 2 Jazzy is installed on this machine, but not sourced."""
    if not (debian_prefix / "setup.bash").is_file():
        return None
    return f"note: {debian_prefix} exists but is not sourced; taking ROS 2 from PyPI instead"
