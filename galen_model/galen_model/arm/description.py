"""An arm from the text of a robot description (URDF), read by Pinocchio.

The chain from `base_frame` to `sensor_frame` becomes an `Arm`; other branches, and joints beyond
the sensor, don't enter. A joint of the chain that follows another one (mimic) is rejected.

`PinocchioArm` is the Galen by Pinocchio, the second method that the closed forms are held against.
"""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm, Joint, constant
from galen_model.arm.galen import GALEN, SENSOR_FRAME, TIP_FRAME
from galen_model.arm.urdf import galen_urdf
from galen_model.arrays import Array
from galen_model.errors import GalenError

MAX_URDF_BYTES = 10_000_000


def read_arm(
    text: str,
    *,
    base_frame: str = "",
    sensor_frame: str = "ft_sensor",
    gravity_m_s2: ArrayLike | None = None,
) -> Arm:
    """Return the arm between two frames of a URDF.

    base_frame: empty for the root link. gravity_m_s2: (3,) in base_frame, None for standard gravity
    along its -z. Raises GalenError for text that is no URDF, or is larger than 10 MB, for
    frames that it lacks, and for a chain without a movable joint.
    """
    if len(text) > MAX_URDF_BYTES:
        raise GalenError(
            f"the robot description has {len(text)} characters; at most {MAX_URDF_BYTES} are read"
        )
    try:
        root = ElementTree.fromstring(text)
        model = pinocchio.buildModelFromXML(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise GalenError(f"the robot description is not a URDF: {error}") from error
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
    _check_independent(root, [model.names[index] for index in chain])
    for index in chain:
        placement = before * model.jointPlacements[index]
        before = pinocchio.SE3.Identity()
        joints.append(_joint(model, data, index, placement, links))
    arm = Arm(
        name=root.get("name") or "arm",
        joints=tuple(joints),
        sensor_origin_m=constant(*sensor.placement.translation),
        sensor_rotation=sensor.placement.rotation.copy(),
        base_frame=base_frame,
        sensor_frame=sensor_frame,
    )
    if gravity_m_s2 is None:
        return arm
    return replace(arm, gravity_m_s2=constant(*np.asarray(gravity_m_s2, dtype=float)))


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


def _check_independent(root: ElementTree.Element, names: list[str]) -> None:
    for joint in root.iter("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("name") in names:
            raise GalenError(
                f"joint '{joint.get('name')}' follows {mimic.get('joint')} (mimic), which is not"
                " supported between base and sensor"
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
    if joint.nv != 1:
        raise GalenError(
            f"joint '{name}' has {joint.nv} degrees of freedom; revolute, continuous and prismatic"
            " joints are supported"
        )
    column: Array = data.oMi[index].actInv(pinocchio.Motion(data.J[:, joint.idx_v])).vector
    turns = bool(np.linalg.norm(column[3:]) > 0.5)
    axis = column[3:] if turns else column[:3]
    axis = np.where(np.abs(axis - np.round(axis)) < 1e-12, np.round(axis), axis) + 0.0
    # A continuous joint is written as (cos, sin) and has no limits.
    limited = joint.nq == 1
    lower, upper = (
        (float(model.lowerPositionLimit[joint.idx_q]), float(model.upperPositionLimit[joint.idx_q]))
        if limited
        else (-np.pi, np.pi)
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
    )


class PinocchioArm:
    """Frame poses and Jacobians of the arm with a tip at tip_m (3,) in ft_sensor."""

    def __init__(self, tip_m: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Build the model from the URDF."""
        self.model = pinocchio.buildModelFromXML(galen_urdf(tip_m))
        self._data = self.model.createData()
        assert tuple(self.model.names[1:]) == GALEN.joint_names

    def pose(self, joints: ArrayLike, frame: str = SENSOR_FRAME) -> tuple[Array, Array]:
        """R_base_frame (3, 3) and the frame's origin in base_link (3,), m, at joints (5,)."""
        pinocchio.framesForwardKinematics(self.model, self._data, np.asarray(joints, dtype=float))
        placement = self._data.oMf[self.model.getFrameId(frame)]
        return placement.rotation.copy(), placement.translation.copy()

    def jacobian(self, joints: ArrayLike, frame: str = TIP_FRAME) -> Array:
        """Jacobian (6, 5): linear, then angular velocity of the frame in base_link's axes."""
        return np.asarray(
            pinocchio.computeFrameJacobian(
                self.model,
                self._data,
                np.asarray(joints, dtype=float),
                self.model.getFrameId(frame),
                pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED,
            )
        )
