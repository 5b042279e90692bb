# SPDX-License-Identifier: Apache-2.0
"""Which arm a node or a command works with: a robot description's, or the Galen. No rclpy."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_model.arm.arm import (
    GRAVITY_RANGE_M_S2,
    MAX_URDF_BYTES,
    STANDARD_GRAVITY_M_S2,
    Arm,
    constant,
)
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.json_fields import FieldError, read_limited

from galen_common.parameters import ParameterError, param


@dataclass(frozen=True)
class ArmParameters:
    """The arm, by parameters that every node has."""

    urdf_file: str = param(
        "",
        "file of the robot description (URDF); `~` is expanded; empty: the Galen, or what"
        " `use_robot_description` says",
    )
    use_robot_description: bool = param(
        False,
        "whether the arm is the one on the topic `robot_description`; the node waits for it",
    )
    base_frame: str = param(
        "", "frame of gravity, poses and deflection; empty: the description's root link"
    )
    sensor_frame: str = param("ft_sensor", "frame that wrenches are written in, and their frame_id")
    gravity_m_s2: tuple[float, ...] = param(
        (0.0, 0.0, -STANDARD_GRAVITY_M_S2),
        "gravity in `base_frame`, m/s^2; an arm on a wall has another",
        -GRAVITY_RANGE_M_S2[1],
        GRAVITY_RANGE_M_S2[1],
    )

    def validate(self) -> None:
        """Check what no single range can.

        Raises:
            ParameterError: gravity is no vector of three within the range, two sources of the arm
                are given, or the sensor's frame has no name.

        """
        lowest, highest = GRAVITY_RANGE_M_S2
        size = np.linalg.norm(self.gravity_m_s2)
        if len(self.gravity_m_s2) != 3 or not lowest <= size <= highest:
            raise ParameterError(
                f"parameter 'gravity_m_s2' is {list(self.gravity_m_s2)}, but must be three numbers"
                f" and {lowest} to {highest} m/s^2 long"
            )
        if self.urdf_file and self.use_robot_description:
            raise ParameterError(
                "parameters 'urdf_file' and 'use_robot_description' both name an arm: set one"
            )
        if not self.sensor_frame:
            raise ParameterError("parameter 'sensor_frame' is empty, but must name a frame")

    def arm(self, description: str = "") -> Arm:
        """Return the arm of the file, else of a description's text, else the Galen.

        Args:
            description: URDF as text, such as the topic `robot_description` brings; unused where
                `urdf_file` is set; empty: none.

        Returns:
            The arm, with this base frame, sensor frame and gravity (3,), m/s^2.

        Raises:
            GalenError: naming file or topic, and what is wrong.

        """
        source, text = "robot_description", description
        if self.urdf_file:
            path = Path(self.urdf_file).expanduser()
            source = str(path)
            try:
                text = read_limited(path, MAX_URDF_BYTES, "a robot description").decode()
            except (OSError, UnicodeDecodeError, FieldError) as error:
                why = getattr(error, "strerror", None) or error
                raise GalenError(f"{path}: can't be read: {why}") from error
        if not text:
            return replace(
                GALEN,
                base_frame=self.base_frame or GALEN.base_frame,
                sensor_frame=self.sensor_frame,
                gravity_m_s2=constant(*self.gravity_m_s2),
            )
        # Pinocchio is slow to import, and the Galen needs none.
        from galen_model.arm.description import read_arm

        try:
            return read_arm(
                text,
                base_frame=self.base_frame,
                sensor_frame=self.sensor_frame,
                gravity_m_s2=self.gravity_m_s2,
            )
        except GalenError as error:
            raise GalenError(f"{source}: {error}") from error


def names_of_joints(given: Sequence[str], arm: Arm) -> tuple[str, ...]:
    """Return the joints' names in `joint_states`: those given, or else the arm's own.

    Args:
        given: the parameter or option `joint_names`; empty: the arm's own names.
        arm: its n joints give order and number.

    Returns:
        n names, in the order of the arm's joints.

    Raises:
        ParameterError: the number of names is not n, or one occurs twice.

    """
    names, count = tuple(given) or arm.joint_names, len(arm.joints)
    if len(names) != count or len(set(names)) != count:
        raise ParameterError(
            f"parameter 'joint_names' is {list(names)}, but must name {count} joints:"
            f" {', '.join(arm.joint_names)}, or what they are called here"
        )
    return names


def other_arm(arm: Arm) -> str:
    """Return the remedy for joint states that lack an arm's joints, to end a sentence.

    Args:
        arm: that is configured now; it is named in the text.

    Returns:
        The remedy, which starts with "; ".

    """
    return (
        f"; for another arm than '{arm.name}' set use_robot_description or urdf_file, for other"
        " names of its joints joint_names where there is that parameter"
    )


def add_arm(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add `--urdf`, `--base-frame`, `--sensor-frame` and `--gravity`, for `chosen_arm`.

    Args:
        parser: that gets the group "arm".

    """
    group = parser.add_argument_group("arm", "the Galen, unless a description is given")
    for option, metavar, count, text in (
        ("--urdf", "FILE", None, "robot description (URDF) of the arm"),
        ("--base-frame", "FRAME", None, "frame of gravity and poses (default: the root link)"),
        ("--sensor-frame", "FRAME", None, "frame of the wrenches (default: ft_sensor)"),
        ("--gravity", "M_S2", 3, "gravity in the base frame (default: 0 0 -9.80665)"),
    ):
        kind = str if count is None else float
        group.add_argument(option, metavar=metavar, nargs=count, type=kind, help=text)


def arm_parameters(arguments: argparse.Namespace) -> ArmParameters:
    """Return the arm's parameters from the options of `add_arm`.

    Args:
        arguments: parsed; an option that is None or empty has the parameter's default.

    Returns:
        Validated parameters.

    Raises:
        ParameterError: as `ArmParameters.validate` does.

    """
    given = {
        "urdf_file": arguments.urdf,
        "base_frame": arguments.base_frame,
        "sensor_frame": arguments.sensor_frame,
        "gravity_m_s2": None if arguments.gravity is None else tuple(arguments.gravity),
    }
    parameters = ArmParameters(**{name: value for name, value in given.items() if value})
    parameters.validate()
    return parameters


def chosen_arm(arguments: argparse.Namespace, description: str = "") -> Arm:
    """Return the arm of the options of `add_arm`.

    Args:
        arguments: parsed.
        description: URDF as text, such as a recording holds, for where no file is given; empty: the
            Galen.

    Returns:
        The arm, with the options' frames and gravity.

    Raises:
        GalenError: naming the file or the option.

    """
    return arm_parameters(arguments).arm(description)
