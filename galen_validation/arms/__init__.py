# SPDX-License-Identifier: Apache-2.0
"""Arms that others described, simulated or measured, and their kinematics by two methods."""

from __future__ import annotations

import os
from functools import cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio
from galen_model.arm.arm import Arm
from galen_model.arm.description import read_arm
from galen_model.arrays import Array
from galen_model.errors import GalenError

_POSES = 1000


class Robot(NamedTuple):
    """A URDF of example-robot-data, frames of base and sensor in it, and how it stands, rad."""

    name: str
    urdf: str
    base_frame: str
    sensor_frame: str
    standing: tuple[float, ...]

    @property
    def path(self) -> Path:
        """Where the URDF is installed; raises GalenError where it is not."""
        return _installed()[self.urdf]

    @property
    def arm(self) -> Arm:
        """The arm between the two frames."""
        text = self.path.read_text(encoding="utf-8")
        return read_arm(text, base_frame=self.base_frame, sensor_frame=self.sensor_frame)

    @property
    def options(self) -> list[str]:
        """Options that name the arm for the suite's commands."""
        frames = ["--base-frame", self.base_frame, "--sensor-frame", self.sensor_frame]
        return ["--urdf", str(self.path), *frames]


_ELBOW_UP = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
_READY = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
_REACHING = (0.15, 1.5, 0.2, -1.0, 1.2, 0.0, 0.0, 0.0)
_NEUTRAL = (0.0, -0.55, 0.0, 0.75, 0.0, 1.26, 0.0)
UR5 = Robot("UR5", "ur5_robot.urdf", "base_link", "tool0", _ELBOW_UP)
ROBOTS = (
    Robot("UR3", "ur3_robot.urdf", "base_link", "tool0", _ELBOW_UP),
    UR5,
    Robot("UR10", "ur10_robot.urdf", "base_link", "tool0", _ELBOW_UP),
    Robot("Panda", "panda.urdf", "panda_link0", "panda_link8", _READY),
    Robot("TIAGo", "tiago.urdf", "torso_fixed_link", "wrist_ft_link", _REACHING),
    Robot("Z1", "z1.urdf", "link00", "link06", (0.0, 1.5, -1.0, -0.5, 0.0, 0.0)),
    Robot("Baxter, right arm", "baxter.urdf", "base", "right_hand_link", _NEUTRAL),
    Robot("SO-101", "so101.urdf", "base_link", "gripper_link", (0.0, -0.5, 0.5, 0.5, 0.0)),
)


@cache
def _installed() -> dict[str, Path]:
    try:
        found = files("example-robot-data") or []
    except PackageNotFoundError as error:
        raise GalenError("no descriptions of robots are installed: run `make arms`") from error
    paths = {file.name: Path(str(file.locate())) for file in found if file.suffix == ".urdf"}
    # Shapes, for self-collision, are package://example-robot-data/robots/ROBOT/...
    os.environ["ROS_PACKAGE_PATH"] = str(paths["ur5_robot.urdf"].parents[4])
    return paths


def kinematics() -> str:
    """Compare each arm with Pinocchio on random poses: the section's Markdown."""
    lines = [
        f"Largest difference to Pinocchio on {_POSES} random poses within each arm's limits.",
        "",
        "| arm | from | to | joints | position, m | rotation | gravity, m/s² | Jacobian |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for robot in ROBOTS:
        worst = " | ".join(f"{value:.0e}" for value in differences(robot, _POSES))
        frames = f"`{robot.base_frame}` | `{robot.sensor_frame}`"
        lines.append(f"| {robot.name} | {frames} | {len(robot.standing)} | {worst} |")
    return "\n".join(lines)


def differences(robot: Robot, poses: int) -> Array:
    """Return an arm's largest differences to Pinocchio on random poses within its limits.

    Args:
        robot: The arm and its frames.
        poses: Number of poses.

    Returns:
        Largest absolute difference (4,) of position (m), rotation matrix, gravity in the sensor
        (m/s²), and Jacobian of the sensor's origin (m, or 1).

    Raises:
        GalenError: The descriptions of robots aren't installed.

    """
    arm, model = robot.arm, pinocchio.buildModelFromXML(robot.path.read_text(encoding="utf-8"))
    data = model.createData()
    base, sensor = (model.getFrameId(name) for name in (robot.base_frame, robot.sensor_frame))
    own = [model.joints[model.getJointId(name)] for name in arm.joint_names]
    world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    q, worst = pinocchio.neutral(model), np.zeros(4)
    for joints in np.random.default_rng(1).uniform(arm.lower, arm.upper, (poses, len(own))):
        q[[joint.idx_q for joint in own]] = joints
        whole = pinocchio.computeFrameJacobian(model, data, q, sensor, world)
        pinocchio.updateFramePlacements(model, data)
        pose, in_base = data.oMf[base].actInv(data.oMf[sensor]), data.oMf[base].rotation.T
        columns = whole[:, [joint.idx_v for joint in own]].reshape(2, 3, -1)
        rotation, origin = arm.sensor_pose(joints)
        found = (
            origin - pose.translation,
            rotation - pose.rotation,
            arm.gravity_in_sensor(arm.angles(joints)) - pose.rotation.T @ arm.gravity_m_s2,
            arm.tip_jacobian(joints, np.zeros(3)).reshape(2, 3, -1) - in_base @ columns,
        )
        worst = np.maximum(worst, [float(np.abs(part).max()) for part in found])
    return worst
