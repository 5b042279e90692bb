"""URDF of the arm, for viewers and for Pinocchio; visuals are primitive shapes.

The delta is written as three sliding joints of the platform, which is the joint vector that the
suite uses; the rods are not links.
"""

from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import (
    BASE_FRAME,
    GALEN,
    JOINT_NAMES,
    LIMITS,
    SENSOR_FRAME,
    TIP_FRAME,
    ArmParameters,
    JointLimits,
)


def galen_urdf(
    tip_m: ArrayLike = (0.0, 0.0, 0.0),
    arm: ArmParameters = GALEN,
    limits: JointLimits = LIMITS,
    max_velocity: ArrayLike = (0.2, 0.2, 0.2, 1.5, 1.5),
) -> str:
    """Return the arm as URDF text; tip_m (3,) in ft_sensor, max_velocity (5,) in m/s and rad/s."""
    robot = ElementTree.Element("robot", name="galen")
    speed = np.asarray(max_velocity, dtype=float)
    reach = float(arm.roll_to_tilt_m[0])
    _link(robot, BASE_FRAME, _cylinder(arm.rail_radius_m, 0.02, "0 0 0", "0 0 0"))
    _link(robot, "delta_x_link")
    _link(robot, "delta_y_link")
    _link(robot, "delta_platform", _cylinder(arm.platform_radius_m, 0.02, "0 0 0", "0 0 0"))
    _link(
        robot,
        "roll_link",
        _cylinder(0.02, reach, f"{reach / 2} 0 0", f"0 {np.pi / 2} 0"),
    )
    _link(robot, "tilt_link", _cylinder(0.02, 0.04, "0 0 0", f"{np.pi / 2} 0 0"))
    _link(robot, SENSOR_FRAME, _cylinder(0.0125, 0.02, "0 0 0", "0 0 0"))
    tip = np.asarray(tip_m, dtype=float)
    _link(robot, TIP_FRAME, _sphere(0.004))

    chain = (BASE_FRAME, "delta_x_link", "delta_y_link", "delta_platform")
    axes = ("1 0 0", "0 1 0", "0 0 1")
    for index in range(3):
        _joint(
            robot, index, "prismatic", chain[index], chain[index + 1], "0 0 0", axes[index],
            limits, speed,
        )  # fmt: skip
    _joint(
        robot, 3, "revolute", "delta_platform", "roll_link", _text(arm.platform_to_roll_m), "1 0 0",
        limits, speed,
    )  # fmt: skip
    _joint(
        robot, 4, "revolute", "roll_link", "tilt_link", _text(arm.roll_to_tilt_m), "0 1 0",
        limits, speed,
    )  # fmt: skip
    _fixed(robot, "tilt_link", SENSOR_FRAME, _text(arm.tilt_to_sensor_m), f"0 {np.pi / 2} 0")
    _fixed(robot, SENSOR_FRAME, TIP_FRAME, _text(tip), "0 0 0")
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _text(vector: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(vector, dtype=float))


def _cylinder(
    radius_m: float, length_m: float, xyz: str, rpy: str
) -> tuple[str, dict[str, str], str, str]:
    return "cylinder", {"radius": str(radius_m), "length": str(length_m)}, xyz, rpy


def _sphere(radius_m: float) -> tuple[str, dict[str, str], str, str]:
    return "sphere", {"radius": str(radius_m)}, "0 0 0", "0 0 0"


def _link(
    robot: ElementTree.Element,
    name: str,
    shape: tuple[str, dict[str, str], str, str] | None = None,
) -> None:
    link = ElementTree.SubElement(robot, "link", name=name)
    if shape is None:
        return
    kind, size, xyz, rpy = shape
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=xyz, rpy=rpy)
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), kind, size)


def _joint(
    robot: ElementTree.Element,
    index: int,
    kind: str,
    parent: str,
    child: str,
    xyz: str,
    axis: str,
    limits: JointLimits,
    speed: np.ndarray,
) -> None:
    joint = ElementTree.SubElement(robot, "joint", name=JOINT_NAMES[index], type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy="0 0 0")
    ElementTree.SubElement(joint, "axis", xyz=axis)
    ElementTree.SubElement(
        joint,
        "limit",
        lower=repr(float(limits.lower[index])),
        upper=repr(float(limits.upper[index])),
        effort="0",
        velocity=repr(float(speed[index])),
    )


def _fixed(robot: ElementTree.Element, parent: str, child: str, xyz: str, rpy: str) -> None:
    joint = ElementTree.SubElement(robot, "joint", name=f"{child}_mount", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
