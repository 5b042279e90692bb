# SPDX-License-Identifier: Apache-2.0
"""The arguments that both launch files have, with their defaults."""

from __future__ import annotations

from typing import Any, List  # noqa: UP035

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

_ARM = {
    "urdf": ("urdf_file", str, "", "the arm's robot description, a file; empty: the Galen"),
    "base_frame": ("base_frame", str, "", "of gravity and poses; empty: the root link"),
    "sensor_frame": ("sensor_frame", str, "ft_sensor", "that wrenches are written in"),
    "gravity": (
        "gravity_m_s2",
        List[float],  # noqa: UP006 - launch knows no `list[float]`
        "[0.0, 0.0, -9.80665]",
        "in base_frame, m/s^2, each with a decimal point",
    ),
}
"""Parameter, type, default and description by argument."""

COMMON = {
    "namespace": ("", "of all nodes"),
    **{argument: fields[2:] for argument, fields in _ARM.items()},
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
    """Make the actions that declare a launch file's arguments.

    Args:
        arguments: default, a text or a substitution, and description, by the argument's name.

    Returns:
        One action an argument.

    """
    return [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in arguments.items()
    ]


def arm_parameters() -> dict[str, Any]:
    """Make a node's parameters of which arm it is.

    Returns:
        Substitutions of the launch arguments, with their types, by the parameter's name.

    """
    return {
        parameter: ParameterValue(LaunchConfiguration(argument), value_type=kind)
        for argument, (parameter, kind, *_) in _ARM.items()
    }


def enclave(node: str) -> list[Any]:
    """Make a node's ROS arguments with its enclave; it counts if ROS_SECURITY_ENABLE is true.

    Args:
        node: the enclave's name below `enclaves`, that of the node.

    Returns:
        The option, and the enclave's path as substitutions.

    """
    return ["--enclave", [LaunchConfiguration("enclaves"), f"/{node}"]]
