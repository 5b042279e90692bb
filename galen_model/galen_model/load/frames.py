"""A load's mass, centre and covariance in other frames of the arm than the sensor's.

A point p in ft_sensor is R p + o in a frame, with R = R_frame_sensor and o the sensor's origin in
it. So mass and centre go by y = A x + b, and their covariance, cross terms with the mass included,
by A C A^T with

    A = [[1, 0], [0, R]]                    (first-order propagation, exact since it is linear)

The tip and the tilt link are rigid to the sensor. Frames beyond hang on joints, whose own errors
are not in the covariance. Frames and chain: `galen_model.arm.kinematics`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import (
    BASE_FRAME,
    GALEN,
    JOINT_NAMES,
    SENSOR_FRAME,
    TIP_FRAME,
    ArmParameters,
)
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import LoadEstimate
from galen_model.registration import move_wrench
from galen_model.rotation import rot_x, rot_y

TILT_FRAME, ROLL_FRAME, PLATFORM_FRAME = "tilt_link", "roll_link", "delta_platform"

_NEEDED: dict[str, tuple[int, ...]] = {
    SENSOR_FRAME: (),
    TIP_FRAME: (),
    TILT_FRAME: (),
    ROLL_FRAME: (4,),
    PLATFORM_FRAME: (3, 4),
    BASE_FRAME: (0, 1, 2, 3, 4),
}
FRAMES = tuple(_NEEDED)
"""Frames that a load can be told in."""


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
        """A load known in ft_sensor, with centre and covariance in the frame."""
        spread = np.eye(4)
        spread[1:, 1:] = self.rotation
        covariance = spread @ np.asarray(estimate.covariance, dtype=float) @ spread.T
        return LoadEstimate(estimate.mass_kg, self.point(estimate.com_m), covariance)

    def point(self, point_m: ArrayLike) -> Array:
        """A point (3,) of ft_sensor in the frame, m."""
        return self.rotation @ np.asarray(point_m, dtype=float) + self.origin_m

    def wrench(self, wrench: ArrayLike) -> Array:
        """A wrench (..., 6) of ft_sensor in the frame's axes and about its origin, N and N.m."""
        return move_wrench(wrench, self.rotation, self.origin_m)


def needed_joints(frame: str) -> tuple[str, ...]:
    """Names of the joints that the sensor's place in a frame hangs on; raises FrameError."""
    return tuple(JOINT_NAMES[index] for index in _indices(frame))


def joint_vector(values: Sequence[float]) -> Array:
    """Joints (5,) of five values, of two (roll, tilt) or of none; NaN where none is given.

    Raises FrameNeedsJointsError for another number of them, or values that aren't finite.
    """
    joints = np.full(len(JOINT_NAMES), np.nan)
    if len(values) not in (0, 2, len(JOINT_NAMES)) or not np.all(np.isfinite(values)):
        raise FrameNeedsJointsError(
            f"joints {', '.join(f'{value:g}' for value in values)}: give {', '.join(JOINT_NAMES)},"
            " or roll and tilt alone (m, rad)"
        )
    if len(values):
        joints[-len(values) :] = values
    return joints


def sensor_in_frame(
    frame: str,
    tip_m: ArrayLike,
    joints: ArrayLike | None = None,
    arm: ArmParameters = GALEN,
) -> SensorInFrame:
    """Where ft_sensor is in `frame`.

    tip_m: (3,) in ft_sensor; joints: (5,) in the order of `JOINT_NAMES`, m and rad, NaN where not
    known. Raises FrameError for another name, FrameNeedsJointsError if a joint it hangs on lacks.
    """
    q = np.full(len(JOINT_NAMES), np.nan) if joints is None else np.asarray(joints, dtype=float)
    lacking = [JOINT_NAMES[index] for index in _indices(frame) if not np.isfinite(q[index])]
    if lacking:
        raise FrameNeedsJointsError(
            f"frame '{frame}' hangs on {', '.join(needed_joints(frame))}; unknown:"
            f" {', '.join(lacking)}"
        )
    if frame == SENSOR_FRAME:
        return SensorInFrame(frame, np.eye(3), np.zeros(3))
    if frame == TIP_FRAME:
        return SensorInFrame(frame, np.eye(3), -np.asarray(tip_m, dtype=float))
    rotation, origin = rot_y(np.pi / 2), np.asarray(arm.tilt_to_sensor_m, dtype=float)
    if frame != TILT_FRAME:
        rotation, origin = rot_y(q[4]) @ rotation, arm.roll_to_tilt_m + rot_y(q[4]) @ origin
    if frame in (PLATFORM_FRAME, BASE_FRAME):
        rotation, origin = rot_x(q[3]) @ rotation, arm.platform_to_roll_m + rot_x(q[3]) @ origin
    if frame == BASE_FRAME:
        origin = q[:3] + origin
    return SensorInFrame(frame, rotation, origin)


def _indices(frame: str) -> tuple[int, ...]:
    if frame not in _NEEDED:
        raise FrameError(f"no frame '{frame}'; there are {', '.join(FRAMES)}")
    return _NEEDED[frame]
