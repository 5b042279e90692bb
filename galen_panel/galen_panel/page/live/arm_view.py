"""The arm as shapes at poses, and how it bends. No ROS, no page.

Shapes and frames come from the arm's URDF (`galen_model.arm.urdf`); the delta's rods, which are no
links there, from `galen_model.arm.delta`.

The predicted deflection is one rigid displacement of the tip. How platform, roll and tilt share it
is that of the nominal springs (`galen_model.arm.stiffness`): with C = C_p + C_roll + C_tilt the
tip's nominal compliance, the load that would displace the tip by d is C^-1 d, and each spring's
share is its own C_k C^-1 d. The shares add up to d whatever model has predicted it, and of all
ways to share it this one strains the springs least. Beyond the tilt axis, where there are no
springs, all moves as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from galen_model.arm.galen import BASE_FRAME, GALEN, JOINT_NAMES, ArmParameters
from galen_model.arm.kinematics import sensor_rotation, tip_jacobian, tip_pose
from galen_model.arm.stiffness import tip_compliance
from galen_model.arrays import Array
from galen_model.errors import KinematicsError
from galen_model.rotation import rot_x, rot_y, rot_z, rotvec_to_matrix, skew
from galen_model.wrench import move_twist

PLATFORM_FRAME = "delta_platform"


@dataclass(frozen=True)
class ArmPose:
    """Of a frame in another: rotation (3, 3) and origin (3,), m."""

    rotation: Array
    origin_m: Array

    def then(self, pose: ArmPose) -> ArmPose:
        """A pose in this frame, seen from where this one is."""
        return ArmPose(self.rotation @ pose.rotation, self.origin_m + self.rotation @ pose.origin_m)


_EYE = np.eye(3)
HERE = ArmPose(_EYE, np.zeros(3))


@dataclass(frozen=True)
class ArmShape:
    """A link's visual. kind: cylinder (radius, length along z), sphere (radius), box (x, y, z)."""

    link: str
    kind: str
    sizes_m: tuple[float, ...]
    pose: ArmPose


@dataclass(frozen=True)
class Joint:
    """pose: of the joint's frame in its parent's.

    direction_m (3,): what it moves along, in the parent's frame; across (3, 3): the skew matrix of
    the unit vector that it turns about, in its own.
    """

    name: str
    kind: str
    parent: str
    child: str
    pose: ArmPose
    direction_m: Array
    across: Array


@dataclass(frozen=True)
class Model:
    """Joints from the base on: each after the one that carries it."""

    shapes: tuple[ArmShape, ...]
    joints: tuple[Joint, ...]


def read_urdf(text: str) -> Model:
    """Links with primitive visuals and joints of a URDF that the suite itself has made."""
    robot = ElementTree.fromstring(text)
    shapes = [
        _shape(str(link.get("name")), visual)
        for link in robot.iter("link")
        for visual in link.iter("visual")
    ]
    return Model(tuple(shapes), tuple(_joint(element) for element in robot.findall("joint")))


def frames(model: Model, joints: Array) -> dict[str, ArmPose]:
    """Each link's pose in base_link; joints (5,) in the order of `JOINT_NAMES`, m and rad."""
    values = dict(zip(JOINT_NAMES, np.asarray(joints, dtype=float).tolist(), strict=True))
    poses = {BASE_FRAME: HERE}
    for joint in model.joints:
        poses[joint.child] = poses[joint.parent].then(_moved(joint, values.get(joint.name, 0.0)))
    return poses


@dataclass(frozen=True)
class Bend:
    """Each spring's share: platform (6,) twist of its centre in base_link (m, rad); rad."""

    platform: Array
    roll_rad: float
    tilt_rad: float

    def times(self, factor: float) -> Bend:
        """The bend, exaggerated."""
        return Bend(factor * self.platform, factor * self.roll_rad, factor * self.tilt_rad)


def share(joints: Array, deflection: Array, tip_m: Array, arm: ArmParameters = GALEN) -> Bend:
    """How the springs share a deflection (6,) of the tip (m, rad; base_link); tip_m in ft_sensor.

    Raises KinematicsError where the delta's rods don't reach the platform.
    """
    _, tip = tip_pose(joints, tip_m, arm)
    load = np.linalg.solve(tip_compliance(joints, tip_m, arm), deflection)
    columns = tip_jacobian(joints, tip_m, arm)[:, 3:]
    stiffness = (arm.roll_stiffness_nm_rad, arm.tilt_stiffness_nm_rad)
    angles = columns.T @ load / np.array(stiffness)
    # C_p C^-1 d is what the other two leave.
    platform = move_twist(deflection - columns @ angles, tip, np.asarray(joints[:3], dtype=float))
    return Bend(platform, float(angles[0]), float(angles[1]))


def bent_frames(model: Model, joints: Array, bend: Bend) -> dict[str, ArmPose]:
    """Each link's pose in base_link on the bent arm; from the platform on."""
    bent = np.array(joints, dtype=float)
    bent[3:] += bend.roll_rad, bend.tilt_rad
    poses = frames(model, bent)
    centre = poses[PLATFORM_FRAME].origin_m
    turn = rotvec_to_matrix(bend.platform[3:])
    return {
        link: ArmPose(
            turn @ pose.rotation,
            centre + bend.platform[:3] + turn @ (pose.origin_m - centre),
        )
        for link, pose in poses.items()
        if link not in (BASE_FRAME, "delta_x_link", "delta_y_link")
    }


@dataclass(frozen=True)
class Delta:
    """The delta's moving parts in base_link, m: rods from `start_m` to `end_m` (6, 3), carriages.

    carriages_m (3, 3): where each carriage's middle is, between the ends of its two rods.
    """

    start_m: Array
    end_m: Array
    carriages_m: Array


def delta_parts(platform_m: Array, arm: ArmParameters = GALEN) -> Delta | None:
    """Rods and carriages of a platform's position (3,); None where the rods don't reach it."""
    platform = np.asarray(platform_m, dtype=float)
    try:
        directions = arm.delta.rod_directions(platform)
    except KinematicsError:
        return None
    ends = platform + arm.delta.ball_joints_m
    starts = ends - arm.rod_length_m * np.repeat(directions, 2, axis=0)
    return Delta(starts, ends, (starts[::2] + starts[1::2]) / 2.0)


def force_in_base(joints: Array, wrench: Array) -> Array:
    """The force (3,), N, of a wrench (6,) in ft_sensor, in base_link."""
    rotation = sensor_rotation(joints[3], joints[4])
    return np.asarray(rotation @ np.asarray(wrench, dtype=float)[:3])


def _moved(joint: Joint, value: float) -> ArmPose:
    """The child's pose in the parent; m or rad."""
    if joint.kind == "prismatic":
        return ArmPose(joint.pose.rotation, joint.pose.origin_m + value * joint.direction_m)
    if joint.kind == "revolute":
        return ArmPose(joint.pose.rotation @ _turned(joint.across, value), joint.pose.origin_m)
    return joint.pose


def _turned(across: Array, angle_rad: float) -> Array:
    """Rodrigues' formula; across (3, 3): the skew matrix of a unit vector. SciPy's takes longer."""
    sine, versine = math.sin(angle_rad), 1.0 - math.cos(angle_rad)
    return _EYE + sine * across + versine * (across @ across)


def _shape(link: str, visual: ElementTree.Element) -> ArmShape:
    geometry = visual.find("geometry")
    assert geometry is not None
    solid = geometry[0]
    sizes: tuple[float, ...]
    if solid.tag == "cylinder":
        sizes = (float(solid.get("radius", "")), float(solid.get("length", "")))
    elif solid.tag == "sphere":
        sizes = (float(solid.get("radius", "")),)
    else:
        sizes = tuple(_numbers(solid.get("size", "")))
    return ArmShape(link, solid.tag, sizes, _origin(visual))


def _joint(element: ElementTree.Element) -> Joint:
    parent, child, axis = (element.find(name) for name in ("parent", "child", "axis"))
    assert parent is not None
    assert child is not None
    pose = _origin(element)
    along = np.array(_numbers("1 0 0" if axis is None else axis.get("xyz", "")))
    return Joint(
        name=str(element.get("name")),
        kind=str(element.get("type")),
        parent=str(parent.get("link")),
        child=str(child.get("link")),
        pose=pose,
        direction_m=pose.rotation @ along,
        across=skew(along),
    )


def _origin(element: ElementTree.Element) -> ArmPose:
    origin = element.find("origin")
    if origin is None:
        return HERE
    roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"))
    rotation = rot_z(yaw) @ rot_y(pitch) @ rot_x(roll)
    return ArmPose(rotation, np.array(_numbers(origin.get("xyz", "0 0 0"))))


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
