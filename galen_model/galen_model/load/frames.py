# SPDX-License-Identifier: Apache-2.0
"""A load's mass, centre and covariance in other frames of the arm than the sensor's.

A point p in ft_sensor is R p + o in a frame, with R = R_frame_sensor and o the sensor's origin in
it. So mass and centre go by y = A x + b, and their covariance, cross terms with the mass included,
by A C A^T with

    A = [[1, 0], [0, R]]                    (first-order propagation, exact since it is linear)

The tip, the last link and what its fixed joints carry (such as a flange) are rigid to the sensor.
Frames beyond depend on joints, whose own errors are not in the covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import TIP_FRAME
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.model import LoadEstimate
from galen_model.registration import move_wrench

_Fixed = tuple[str, Array, Array]
"""A frame's place: the joint that carries it, R_joint_frame (3, 3), the frame's origin (3,), m."""


def frames(arm: Arm) -> tuple[str, ...]:
    """Name the frames that a load can be given in: sensor, tip, links towards the base.

    Then the description's other frames that are rigid to one of these.

    Args:
        arm: with its description, if it has one.

    Returns:
        Names, each once.

    """
    links = (joint.link for joint in reversed(arm.joints))
    named = (arm.sensor_frame, TIP_FRAME, *links, arm.base_frame)
    placed = placed_frames(arm.urdf)
    carriers = {*arm.joint_names, *(placed[f][0] for f in (arm.base_frame,) if f in placed)}
    others = (name for name, (carrier, *_) in placed.items() if carrier in carriers)
    return tuple(dict.fromkeys((*named, *others)))


class FrameError(GalenError):
    """A frame that the arm doesn't have."""


class FrameNeedsJointsError(GalenError):
    """A frame hangs on joints that are not known."""


@dataclass(frozen=True)
class SensorInFrame:
    """Where ft_sensor is in a frame: R_frame_sensor (3, 3), and its origin (3,) in it, m."""

    frame: str
    rotation: Array
    origin_m: Array

    def load(self, estimate: LoadEstimate) -> LoadEstimate:
        """Express a load in the frame.

        Args:
            estimate: of the load in ft_sensor.

        Returns:
            Mass, and centre and covariance (4, 4) in the frame, kg and m.

        """
        spread = np.eye(4)
        spread[1:, 1:] = self.rotation
        covariance = spread @ np.asarray(estimate.covariance, dtype=float) @ spread.T
        return LoadEstimate(estimate.mass_kg, self.point(estimate.com_m), covariance)

    def point(self, point_m: ArrayLike) -> Array:
        """Express a point in the frame.

        Args:
            point_m: (3,) in ft_sensor.

        Returns:
            Point (3,) in the frame, m.

        """
        return self.rotation @ np.asarray(point_m, dtype=float) + self.origin_m

    def wrench(self, wrench: ArrayLike) -> Array:
        """Express a wrench in the frame and about its origin.

        Args:
            wrench: (..., 6) in ft_sensor, N and N.m.

        Returns:
            Wrench (..., 6) in the frame, N and N.m.

        """
        return move_wrench(wrench, self.rotation, self.origin_m)


def needed_joints(frame: str, arm: Arm) -> tuple[str, ...]:
    """Name the joints between a frame and the sensor.

    Args:
        frame: name of the frame.
        arm: that carries it.

    Returns:
        Names from the frame to the sensor; empty where the frame is rigid to the sensor.

    Raises:
        FrameError: the arm has no such frame.

    """
    return arm.joint_names[_carrier(frame, arm)[0] :]


def joint_vector(values: Sequence[float], arm: Arm) -> Array:
    """Complete joint values that were given for all joints, the turning ones or none.

    Args:
        values: n in the arm's order, or of the turning joints alone, or none; m and rad.
        arm: whose joints they are.

    Returns:
        Joints (n,), NaN where not given.

    Raises:
        FrameNeedsJointsError: there is another number of values, or one isn't finite.

    """
    unknown = np.full(len(arm.joints), np.nan)
    if len(values) not in (0, len(arm.turning), len(unknown)) or not np.all(np.isfinite(values)):
        raise FrameNeedsJointsError(
            f"joints {', '.join(f'{value:g}' for value in values)}: give"
            f" {', '.join(arm.joint_names)}, or {', '.join(arm.turning_names)} alone (m, rad)"
        )
    if not len(values):
        return unknown
    whole = len(values) == len(unknown)
    return np.asarray(values, dtype=float) if whole else arm.with_angles(values, unknown)


def sensor_in_frame(
    frame: str, tip_m: ArrayLike, joints: ArrayLike | None = None, *, arm: Arm
) -> SensorInFrame:
    """Find where the sensor is in a frame.

    Args:
        frame: name of the frame.
        tip_m: the tool's tip (3,) in the sensor's frame.
        joints: (n,) in the arm's order, m and rad, NaN where not known; None: none is known.
        arm: that carries the frame.

    Returns:
        Rotation and origin of ft_sensor in the frame.

    Raises:
        FrameError: the arm has no such frame.
        FrameNeedsJointsError: a joint between frame and sensor is not known.

    """
    if frame == TIP_FRAME:
        return SensorInFrame(frame, np.eye(3), -np.asarray(tip_m, dtype=float))
    if frame == arm.sensor_frame:
        return SensorInFrame(frame, np.eye(3), np.zeros(3))
    first, turn, origin = _carrier(frame, arm)
    q = np.full(len(arm.joints), np.nan) if joints is None else np.asarray(joints, dtype=float)
    lacking = [
        name
        for name, value in zip(arm.joint_names[first:], q[first:], strict=True)
        if not np.isfinite(value)
    ]
    if lacking:
        raise FrameNeedsJointsError(
            f"frame '{frame}' depends on {', '.join(needed_joints(frame, arm))}; unknown:"
            f" {', '.join(lacking)}"
        )
    beyond = replace(arm, joints=arm.joints[first:], delta=None)
    rotation, sensor = beyond.sensor_pose(q[first:])
    return SensorInFrame(frame, turn.T @ rotation, turn.T @ (sensor - origin))


def _carrier(frame: str, arm: Arm) -> tuple[int, Array, Array]:
    """Place of the first joint between a frame and the sensor; the frame in the link before it.

    The frame as R_link_frame (3, 3) and its origin (3,) in the link, m.
    """
    rigid = np.eye(3), np.zeros(3)
    if frame in (arm.sensor_frame, TIP_FRAME):
        return len(arm.joints), *rigid
    if frame == arm.base_frame:
        return 0, *rigid
    for k, joint in enumerate(arm.joints):
        if joint.link == frame:
            return k + 1, *rigid
    placed = placed_frames(arm.urdf)
    if frame in placed:
        carrier, turn, origin = placed[frame]
        if carrier in arm.joint_names:
            return arm.joint_names.index(carrier) + 1, turn, origin
        base_carrier, base_turn, base_origin = placed[arm.base_frame]
        if carrier == base_carrier:
            return 0, base_turn.T @ turn, base_turn.T @ (origin - base_origin)
        raise FrameError(
            f"frame '{frame}' hangs on the joint '{carrier}', which is not between"
            f" {arm.base_frame} and {arm.sensor_frame}"
        )
    raise FrameError(f"no frame '{frame}'; there are {', '.join(frames(arm))}")


@lru_cache(maxsize=4)
def placed_frames(urdf: str) -> Mapping[str, _Fixed]:
    """List the frames of a description, with the joint that carries each and the place on it.

    Args:
        urdf: the description's text; empty: there is none.

    Returns:
        By frame: the joint's name, R (3, 3) and origin (3,), m, in the joint's own frame.

    """
    if not urdf:
        return {}
    import pinocchio  # slow to import, and most frames need none

    model = pinocchio.buildModelFromXML(urdf)
    return {
        frame.name: (
            model.names[frame.parentJoint],
            frame.placement.rotation.copy(),
            frame.placement.translation.copy(),
        )
        for frame in model.frames
        if frame.type == pinocchio.FrameType.BODY
    }
