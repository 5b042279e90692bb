"""Where the tip is under load: where the joints say, displaced by the deflection."""

from __future__ import annotations

import math
from typing import NamedTuple

from galen_model.arrays import Array
from galen_model.kinematics import tip_pose
from galen_model.rotation import matrix_to_quaternion

from galen_deflection.recent_poses import RecentPoses


class TipPose(NamedTuple):
    """A pose of tool_tip in base_link: position (3,), m, and quaternion (4,) in the order xyzw."""

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


class CorrectedTip:
    """Displaces the tip's pose; for one sample at a time, at the rate of the wrench.

    A deflection is a rigid displacement: its translation adds to the tip's position, its rotation
    vector, along the axes of base_link, turns the tip after the joints have, R' = exp(r^) R.
    """

    def __init__(self, tip_m: Array) -> None:
        """tip_m (3,): in ft_sensor."""
        self._tip_m = tip_m
        self._unloaded = RecentPoses(self._calculate)

    def __call__(self, joints: Array, deflection: tuple[float, ...]) -> TipPose:
        """Of joints (5,) and a deflection (6,), m and rad."""
        (px, py, pz), (x, y, z, w) = self._unloaded(joints[None])
        dx, dy, dz, rx, ry, rz = deflection
        angle = math.sqrt(rx * rx + ry * ry + rz * rz)
        # sin(angle / 2) / angle; below, the next term of its series is lost in rounding
        scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
        a, b, c, d = scale * rx, scale * ry, scale * rz, math.cos(0.5 * angle)
        return TipPose(
            (px + dx, py + dy, pz + dz),
            (
                d * x + a * w + b * z - c * y,
                d * y + b * w + c * x - a * z,
                d * z + c * w + a * y - b * x,
                d * w - a * x - b * y - c * z,
            ),
        )

    def _calculate(self, joints: Array) -> tuple[list[float], list[float]]:
        rotation, position = tip_pose(joints[0], self._tip_m)
        return position.tolist(), matrix_to_quaternion(rotation).tolist()
