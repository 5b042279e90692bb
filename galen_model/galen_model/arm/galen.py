# SPDX-License-Identifier: Apache-2.0
"""The Galen's numbers: geometry, limits, stiffness, sensor and tracker.

Source: the 2019 report and public Galen/REMS material; what is not published is estimated.
Units are SI; angles in rad.

The description (URDF) is for viewers and for Pinocchio, with primitive shapes. The delta is written
as three sliding joints of the platform, as in the joint vector; the rods are not links.
"""

from dataclasses import dataclass, field, replace
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm, Joint
from galen_model.arm.arm import constant as _vector
from galen_model.arm.delta import LinearDelta
from galen_model.arrays import Array

GRAVITY_M_S2 = np.array([0.0, 0.0, -9.80665])
GRAVITY_M_S2.setflags(write=False)
"""Gravity in base_link."""

TIP_FRAME = "tool_tip"
TRACKER_FRAME = "tracker"

WRENCH_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
"""Order of a wrench everywhere: force (N), then torque about the sensor's origin (N.m)."""


def galen_urdf(
    arm: Arm,
    tip_m: ArrayLike = (0.0, 0.0, 0.0),
    max_velocity: ArrayLike = (0.2, 0.2, 0.2, 1.5, 1.5),
) -> str:
    """Write an arm on a delta as URDF text.

    Args:
        arm: with five joints and a delta.
        tip_m: (3,) in the sensor's frame.
        max_velocity: (5,), m/s and rad/s.

    Returns:
        The URDF, with visual shapes and no collision shapes.

    """
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


_X, _Y, _Z, _HERE = _vector(1, 0, 0), _vector(0, 1, 0), _vector(0, 0, 1), _vector(0, 0, 0)

# The platform's box is the usable volume published for the arm. At home's height the carriages
# stay within their travel all over it; in its upper part they don't (`LinearDelta.carriages`
# raises): the highest z is 0.658 m on the axis, but 0.503 m at the worst corner, less than the
# box's 0.618 m.
GALEN = Arm(
    name="galen",
    joints=(
        Joint("delta_x", "prismatic", _X, _HERE, -0.14, 0.14, link="delta_x_link"),
        Joint("delta_y", "prismatic", _Y, _HERE, -0.14, 0.14, link="delta_y_link"),
        Joint(
            "delta_z",
            "prismatic",
            _Z,
            _HERE,
            0.408 - 0.21,
            0.408 + 0.21,
            home=0.408,
            link="delta_platform",
        ),
        Joint(
            "roll",
            "revolute",
            _X,
            _vector(0, 0, 0.07614),
            -1.57,
            1.57,
            stiffness=2000.0,
            link="roll_link",
        ),
        Joint(
            "tilt",
            "revolute",
            _Y,
            _vector(0.6085, 0, 0.013),
            -1.04,
            0.96,
            stiffness=1500.0,
            link="tilt_link",
        ),
    ),
    sensor_origin_m=_vector(0.031248, 0.0, 0.025),
    sensor_rotation=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),  # Ry(pi/2)
    delta=LinearDelta(
        rod_length_m=0.440,
        rail_radius_m=0.215,
        platform_radius_m=0.050,
        rod_half_spacing_m=0.0552,
        leg_angles_rad=(-np.pi / 3, np.pi / 3, np.pi),
        carriage_travel_m=0.25,
        carriage_stiffness=3e5,
        rod_stiffness=2e6,
        home_m=(0.0, 0.0, 0.408),
    ),
)
GALEN = replace(GALEN, urdf=galen_urdf(GALEN))
"""The nominal arm: a linear delta carries a roll joint, then a tilt joint, then the sensor."""


@dataclass(frozen=True)
class SensorParameters:
    """Noise (one sample), quantum and range of the six axes, shape (6,), N and N.m."""

    noise_std: Array = field(
        default_factory=lambda: _vector(0.02, 0.02, 0.03, 0.4e-3, 0.4e-3, 0.4e-3)
    )
    quantum: Array = field(default_factory=lambda: _vector(*[0.005] * 3, *[0.1e-3] * 3))
    range: Array = field(default_factory=lambda: _vector(125.0, 125.0, 500.0, 3.0, 3.0, 3.0))


SENSOR = SensorParameters()

ENCODER_QUANTUM = _vector(5e-6, 5e-6, 5e-6, 5e-5, 5e-5)
"""Step of each joint's encoder, shape (5,), m and rad."""

TRACKER_POSITION_NOISE_M = 0.03e-3
TRACKER_ROTATION_NOISE_RAD = 0.1e-3
