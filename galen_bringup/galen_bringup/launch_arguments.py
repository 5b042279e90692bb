"""The arguments that both launch files have, with their defaults."""

from __future__ import annotations

from typing import Any

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration

COMMON = {
    "namespace": ("", "of all nodes"),
    "enclaves": ("/galen", "where SROS 2 has the nodes' enclaves"),
    "tool": ("", "tool whose calibration gravcomp loads, and on a simulated arm; empty: none"),
    "tools_dir": ("~/.ros/galen/tools", "the calibration files"),
    "deflection_model": ("", "the deflection model's file; empty: its node is not started"),
    "panel": ("false", "start the operator's panel, too"),
    "panel_host": ("127.0.0.1", "where the panel listens; beyond this machine it prints a token"),
    "panel_port": ("8080", "the panel's port"),
    "bags_dir": (".", "where the panel looks for recordings"),
}
"""Default and description by name; `config`, of both as well, has another default in each."""


def declare(arguments: dict[str, tuple[Any, str]]) -> list[Any]:
    """Make the actions that declare arguments, given default and description by name."""
    return [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in arguments.items()
    ]


def enclave(node: str) -> list[Any]:
    """Make a node's ROS arguments with its enclave; it counts if ROS_SECURITY_ENABLE is true."""
    return ["--enclave", [LaunchConfiguration("enclaves"), f"/{node}"]]
