# SPDX-License-Identifier: Apache-2.0
"""An arm from the text of a robot description (URDF), read by Pinocchio.

The chain from `base_frame` to `sensor_frame` becomes an `Arm`; other branches, and joints beyond
the sensor, don't enter. A joint of the chain that follows another one (mimic) is rejected.
"""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio
from numpy.typing import ArrayLike

from galen_model.arm.arm import MAX_URDF_BYTES, Arm, Joint, constant
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError

MAX_LINKS = 1000
"""Pinocchio's parser recurses over links: a chain of some thousands overflows the stack."""


def read_arm(
    text: str,
    *,
    base_frame: str = "",
    sensor_frame: str = "ft_sensor",
    gravity_m_s2: ArrayLike | None = None,
) -> Arm:
    """Read the arm between two frames of a URDF.

    Args:
        text: the URDF.
        base_frame: empty: the root link.
        sensor_frame: a link that the base carries.
        gravity_m_s2: (3,) in base_frame; None: standard gravity along its -z.

    Returns:
        The arm; with the Galen's delta, home and stiffness where the description is of a Galen.

    Raises:
        GalenError: the text is no URDF, is larger than 10 MB or has more than MAX_LINKS links,
            lacks a frame, a joint of the chain has no axis or limits or is of another kind, or the
            chain has no revolute joint.

    """
    try:
        return _read(text, base_frame, sensor_frame, gravity_m_s2)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise GalenError(f"the robot description can't be read: {error}") from error


def _read(text: str, base_frame: str, sensor_frame: str, gravity_m_s2: ArrayLike | None) -> Arm:
    if len(text) > MAX_URDF_BYTES:
        raise GalenError(
            f"the robot description has {len(text)} characters; at most {MAX_URDF_BYTES} are read"
        )
    try:
        root = ElementTree.fromstring(text)
        if remedy := _xacro(text):
            raise GalenError(f"the robot description is no URDF yet{remedy}")
        _check_description(root)
        model = pinocchio.buildModelFromXML(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise GalenError(f"the robot description is not a URDF: {error}{_xacro(text)}") from error
    base_frame = base_frame or _root_link(root)
    base, sensor = (_frame(model, name) for name in (base_frame, sensor_frame))
    chain = _chain(model, base.parentJoint, sensor.parentJoint)
    if chain is None:
        raise GalenError(
            f"the frame '{sensor_frame}' is not carried by '{base_frame}': it hangs on another"
            " branch of the robot"
        )
    if not chain:
        raise GalenError(f"no movable joint lies between '{base_frame}' and '{sensor_frame}'")
    before = base.placement.inverse()
    joints = []
    data = model.createData()
    pinocchio.computeJointJacobians(model, data, pinocchio.neutral(model))
    links = _child_links(root)
    _check_joints(root, [model.names[index] for index in chain])
    for index in chain:
        placement = before * model.jointPlacements[index]
        before = pinocchio.SE3.Identity()
        joints.append(_joint(model, data, index, placement, links))
    if all(joint.kind == "prismatic" for joint in joints):
        raise GalenError(
            f"no revolute joint lies between '{base_frame}' and '{sensor_frame}': a sensor that"
            " doesn't turn can't distinguish a load from its own offsets; name another base_frame"
            " or sensor_frame"
        )
    arm = Arm(
        name=root.get("name") or "arm",
        joints=tuple(joints),
        sensor_origin_m=constant(*sensor.placement.translation),
        sensor_rotation=sensor.placement.rotation.copy(),
        urdf=text,
        base_frame=base_frame,
        sensor_frame=sensor_frame,
    )
    if gravity_m_s2 is not None:
        arm = replace(arm, gravity_m_s2=constant(*np.asarray(gravity_m_s2, dtype=float)))
    # The rods and home of the Galen can't be in its description.
    galen = replace(GALEN, gravity_m_s2=arm.gravity_m_s2, urdf=text)
    if arm.joint_names != galen.joint_names:
        return arm
    pairs = list(zip(galen.joints, arm.joints, strict=True))
    if not galen.difference(arm):
        return replace(
            galen, joints=tuple(replace(own, max_velocity=read.max_velocity) for own, read in pairs)
        )
    # A description that was corrected has other zeros and axes of roll and tilt on the same rods.
    if galen.difference(replace(arm, joints=(*arm.joints[:3], *galen.joints[3:]))):
        return arm
    corrected = (replace(read, home=own.home, stiffness=own.stiffness) for own, read in pairs)
    return replace(arm, joints=tuple(corrected), delta=galen.delta)


def _xacro(text: str) -> str:
    """Return the remedy where the text is a xacro, to end a sentence."""
    if "ros.org/wiki/xacro" not in text and "<xacro:" not in text:
        return ""
    return "; it is a xacro: run `xacro FILE > robot.urdf` and name the result"


def _root_link(root: ElementTree.Element) -> str:
    children = {child.get("link") for joint in root.iter("joint") for child in joint.iter("child")}
    for link in root.iter("link"):
        if link.get("name") not in children:
            return str(link.get("name"))
    raise GalenError("the robot description has no root link")


def _child_links(root: ElementTree.Element) -> dict[str, str]:
    """Name of the link that each joint moves."""
    return {
        str(joint.get("name")): str(child.get("link"))
        for joint in root.iter("joint")
        for child in joint.iter("child")
    }


def _check_description(root: ElementTree.Element) -> None:
    """Reject what Pinocchio would crash on, or reject without a name."""
    links = len(root.findall("link"))
    if links > MAX_LINKS:
        raise GalenError(
            f"the robot description has {links} links; at most {MAX_LINKS} are read: leave out"
            " what doesn't carry the sensor"
        )
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        lacking = [name for name in ("effort", "velocity") if limit is None or not limit.get(name)]
        if joint.get("type") in ("revolute", "prismatic") and lacking:
            raise GalenError(
                f"joint '{joint.get('name')}' is {joint.get('type')} and has no <limit> with"
                f" {' and '.join(lacking)}: add it"
            )


def _check_joints(root: ElementTree.Element, names: list[str]) -> None:
    """Reject joints of the chain that follow another one, or lack an axis or a range."""
    for joint in root.findall("joint"):
        name, axis, limit = joint.get("name"), joint.find("axis"), joint.find("limit")
        if name not in names:
            continue
        mimic = joint.find("mimic")
        if mimic is not None:
            raise GalenError(
                f"joint '{name}' follows {mimic.get('joint')} (mimic), which is not"
                " supported between base and sensor"
            )
        direction = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
        if not 1e-6 < np.linalg.norm([float(part) for part in direction.split()]) < 1e6:
            raise GalenError(
                f"joint '{name}' has the axis \"{direction}\", which is no direction: give it one,"
                ' as "0 0 1"'
            )
        if joint.get("type") == "continuous" or limit is None:
            continue
        lower, upper = limit.get("lower"), limit.get("upper")
        if lower is None and upper is None:
            raise GalenError(
                f"joint '{name}' has a <limit> without lower and upper, which means 0 to 0: add"
                " them, or make the joint continuous"
            )
        if float(lower or 0.0) > float(upper or 0.0):
            raise GalenError(
                f"joint '{name}' has the limits {lower or 0} to {upper or 0}: lower is above upper,"
                " exchange them"
            )


def _frame(model: pinocchio.Model, name: str) -> pinocchio.Frame:
    if not model.existFrame(name, pinocchio.FrameType.BODY):
        known = [frame.name for frame in model.frames if frame.type == pinocchio.FrameType.BODY]
        listed = ", ".join(known[:40]) + (" ..." if len(known) > 40 else "")
        raise GalenError(f"the robot has no frame '{name}'; its frames are {listed}")
    return model.frames[model.getFrameId(name, pinocchio.FrameType.BODY)]


def _chain(model: pinocchio.Model, first: int, last: int) -> list[int] | None:
    """Joints after `first` up to `last`; None where `last` doesn't hang on `first`."""
    chain: list[int] = []
    while last != first:
        if last == 0:
            return None
        chain.insert(0, last)
        last = model.parents[last]
    return chain


def _joint(
    model: pinocchio.Model,
    data: pinocchio.Data,
    index: int,
    placement: pinocchio.SE3,
    links: dict[str, str],
) -> Joint:
    name, joint = model.names[index], model.joints[index]
    # Of a robot with one degree of freedom it has one dimension.
    jacobian = np.reshape(data.J, (6, model.nv))
    if joint.nv != 1:
        raise GalenError(
            f"joint '{name}' has {joint.nv} degrees of freedom; revolute, continuous and prismatic"
            " joints are supported"
        )
    column: Array = data.oMi[index].actInv(pinocchio.Motion(jacobian[:, joint.idx_v])).vector
    turns = bool(np.linalg.norm(column[3:]) > 0.5)
    axis = column[3:] if turns else column[:3]
    axis = np.where(np.abs(axis - np.round(axis)) < 1e-12, np.round(axis), axis) + 0.0
    # A continuous joint is written as (cos, sin) and has no limits.
    limited = joint.nq == 1
    lower, upper = (
        (float(model.lowerPositionLimit[joint.idx_q]), float(model.upperPositionLimit[joint.idx_q]))
        if limited
        else (-np.inf, np.inf)
    )
    rotation = placement.rotation.copy()
    home = float(np.clip(0.0, lower, upper))
    return Joint(
        name=name,
        kind="revolute" if turns else "prismatic",
        axis=constant(*axis),
        origin_m=constant(*placement.translation),
        lower=lower,
        upper=upper,
        home=home,
        rotation=None if np.allclose(rotation, np.eye(3), rtol=0.0, atol=1e-15) else rotation,
        link=links.get(name, ""),
        # A limit of zero is how descriptions leave it out.
        max_velocity=float(model.velocityLimit[joint.idx_v]) or np.inf,
    )
