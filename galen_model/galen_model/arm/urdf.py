"""URDF of the arm, for viewers and for Pinocchio; visuals are primitive shapes.

The delta is written as three sliding joints of the platform, which is the joint vector that the
suite uses; the rods are not links.
"""

from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm, Joint
from galen_model.arm.galen import GALEN, TIP_FRAME


def galen_urdf(
    tip_m: ArrayLike = (0.0, 0.0, 0.0),
    arm: Arm = GALEN,
    max_velocity: ArrayLike = (0.2, 0.2, 0.2, 1.5, 1.5),
) -> str:
    """Return the arm as URDF text; tip_m (3,) in ft_sensor, max_velocity (5,) in m/s and rad/s."""
    assert arm.delta is not None
    robot = ElementTree.Element("robot", name=arm.name)
    reach = float(arm.joints[4].origin_m[0])
    shapes = {
        arm.base_frame: _cylinder(arm.delta.rail_radius_m, 0.02, "0 0 0", "0 0 0"),
        "delta_platform": _cylinder(arm.delta.platform_radius_m, 0.02, "0 0 0", "0 0 0"),
        "roll_link": _cylinder(0.02, reach, f"{reach / 2} 0 0", f"0 {np.pi / 2} 0"),
        "tilt_link": _cylinder(0.02, 0.04, "0 0 0", f"{np.pi / 2} 0 0"),
        arm.sensor_frame: _cylinder(0.0125, 0.02, "0 0 0", "0 0 0"),
        TIP_FRAME: _sphere(0.004),
    }
    links = [arm.base_frame, *(joint.link for joint in arm.joints)]
    for name in (*links, arm.sensor_frame, TIP_FRAME):
        _link(robot, name, shapes.get(name))
    speeds = np.asarray(max_velocity, dtype=float)
    for parent, joint, speed in zip(links[:-1], arm.joints, speeds, strict=True):
        _joint(robot, parent, joint, float(speed))
    _fixed(robot, links[-1], arm.sensor_frame, _text(arm.sensor_origin_m), f"0 {np.pi / 2} 0")
    _fixed(robot, arm.sensor_frame, TIP_FRAME, _text(tip_m), "0 0 0")
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


def _joint(robot: ElementTree.Element, parent: str, joint: Joint, speed: float) -> None:
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=joint.link)
    xyz = _text(joint.origin_m) if joint.origin_m.any() else "0 0 0"
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy="0 0 0")
    axis = " ".join(f"{value:g}" for value in joint.axis)
    ElementTree.SubElement(element, "axis", xyz=axis)
    ElementTree.SubElement(
        element,
        "limit",
        lower=repr(joint.lower),
        upper=repr(joint.upper),
        effort="0",
        velocity=repr(speed),
    )


def _fixed(robot: ElementTree.Element, parent: str, child: str, xyz: str, rpy: str) -> None:
    joint = ElementTree.SubElement(robot, "joint", name=f"{child}_mount", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
