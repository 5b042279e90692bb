"""Where the tip is under load: where the joints say, displaced by the deflection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from galen_model.arm.galen import GALEN, ArmParameters
from galen_model.arrays import Array
from galen_model.rotation import rot_y

from galen_deflection.springs.single_pose import vector


class TipPose(NamedTuple):
    """A pose of tool_tip in base_link: position (3,), m, and quaternion (4,) in the order xyzw."""

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


class CorrectedTip:
    """Displaces the tip's pose; for one sample at a time, at the rate of the wrench.

    A deflection is a rigid displacement: its translation adds to the tip's position, its rotation
    vector, along the axes of base_link, turns the tip after the joints have, R' = exp(r^) R.
    """

    def __init__(self, tip_m: Array, arm: ArmParameters = GALEN) -> None:
        """tip_m (3,): in ft_sensor."""
        self._from_platform = vector(arm.platform_to_roll_m)
        self._to_tilt = vector(arm.roll_to_tilt_m)
        self._beyond_tilt = vector(arm.tilt_to_sensor_m + rot_y(np.pi / 2) @ tip_m)

    def __call__(self, joints: Sequence[float], deflection: Sequence[float]) -> TipPose:
        """Of joints (5,) and a deflection (6,), m and rad."""
        (px, py, pz), (x, y, z, w) = self._unloaded(joints)
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

    def _unloaded(
        self, joints: Sequence[float]
    ) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
        """`galen_model.arm.kinematics.tip_pose` in plain floats; q = q_x(roll) q_y(tilt + pi/2)."""
        px, py, pz, roll, tilt = joints
        (ux, uy, uz), (vx, vy, vz), (ax, ay, az) = (
            self._from_platform,
            self._to_tilt,
            self._beyond_tilt,
        )
        cos_r, sin_r, cos_t, sin_t = math.cos(roll), math.sin(roll), math.cos(tilt), math.sin(tilt)
        x, y, z = vx + cos_t * ax + sin_t * az, vy + ay, vz + cos_t * az - sin_t * ax
        position = (px + ux + x, py + uy + cos_r * y - sin_r * z, pz + uz + sin_r * y + cos_r * z)
        half_roll, half_tilt = 0.5 * roll, 0.5 * tilt + 0.25 * math.pi
        a, b = math.sin(half_roll), math.cos(half_roll)
        c, d = math.sin(half_tilt), math.cos(half_tilt)
        return position, (a * d, b * c, a * c, b * d)
