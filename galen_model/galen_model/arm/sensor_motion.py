"""How ft_sensor moves: the arm's kinematics, twice differentiated in closed form.

With r, t roll and tilt, u = c1 + Ry(t) c2 the sensor's origin in the roll link (c1 roll to tilt
axis, c2 tilt axis to sensor) and w1 = r' e_x, in the axes of the roll link

    a_roll = Rx(r)^T d'' + u'' + 2 w1 x u' + w1' x u + w1 x (w1 x u),

d the platform's position; Ry(t + pi/2)^T turns it into ft_sensor (Craig, *Introduction to
Robotics*, 3rd ed. 2005, section 6.2). In the axes of ft_sensor

    w = (-r' sin t, t', r' cos t),   al = dw/dt,

because a vector's own rate and its rate in the frame that turns with it agree for w itself.
Finite differences of `Arm.sensor_pose` and of Pinocchio give the same; a test compares.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.load.inertia import Vector


class SensorMotion(NamedTuple):
    """Angular velocity, angular acceleration, acceleration of the origin: (..., 3), ft_sensor."""

    velocity_rad_s: Array
    acceleration_rad_s2: Array
    acceleration_m_s2: Array


def sensor_motion(
    joints: ArrayLike,
    velocities: ArrayLike,
    accelerations: ArrayLike,
    arm: Arm = GALEN,
) -> SensorMotion:
    """Motion of ft_sensor; all (..., 5) in the order of `Arm.joints`, m, rad and their rates."""
    q, v, a = np.broadcast_arrays(
        *(np.asarray(part, dtype=float) for part in (joints, velocities, accelerations))
    )
    roll, tilt = q[..., 3], q[..., 4]
    trigonometry = (np.cos(roll), np.sin(roll), np.cos(tilt), np.sin(tilt))
    platform = (a[..., 0], a[..., 1], a[..., 2])
    turning = (v[..., 3], v[..., 4], a[..., 3], a[..., 4])
    parts = _motion(_lengths(arm), trigonometry, platform, turning)
    return SensorMotion(*(np.stack(np.broadcast_arrays(*part), axis=-1) for part in parts))


class MotionOfSensor:
    """`sensor_motion` for one moment at a time, in plain floats."""

    def __init__(self, arm: Arm = GALEN) -> None:
        self._lengths = _lengths(arm)

    def at(
        self,
        roll_rad: float,
        tilt_rad: float,
        velocities: tuple[float, ...],
        accelerations: tuple[float, ...],
    ) -> tuple[Vector, Vector, Vector]:
        """As `SensorMotion`, at roll and tilt with all five joints' rates and accelerations."""
        trigonometry = (
            math.cos(roll_rad), math.sin(roll_rad), math.cos(tilt_rad), math.sin(tilt_rad)
        )  # fmt: skip
        turning = (*velocities[3:], *accelerations[3:])
        found: tuple[Vector, Vector, Vector] = _motion(
            self._lengths, trigonometry, accelerations[:3], turning
        )
        return found


def _lengths(arm: Arm) -> tuple[float, ...]:
    c1, c2 = arm.joints[4].origin_m, arm.sensor_origin_m
    return (*(float(v) for v in c1), *(float(v) for v in c2))


def _motion(lengths: Any, trigonometry: Any, platform: Any, turning: Any) -> Any:
    """Return the formulas, for floats and for arrays alike: (w, al, a), each three components."""
    _, c1y, c1z, c2x, c2y, c2z = lengths
    cr, sr, ct, st = trigonometry
    dx, dy, dz = platform
    rv, tv, ra, ta = turning
    velocity = (-st * rv, tv + 0.0 * rv, ct * rv)
    acceleration = (-st * ra - ct * tv * rv, ta + 0.0 * ra, ct * ra - st * tv * rv)
    # u in the roll link's axes; its parts that turn with tilt are ex, ez.
    ex, ez = ct * c2x + st * c2z, ct * c2z - st * c2x
    uy, uz = c1y + c2y, c1z + ez  # u_x is along the roll axis and turns with nothing
    # u' = t' (ez, 0, -ex); u'' = t'' (ez, 0, -ex) - t'^2 (ex, 0, ez)
    vz = -tv * ex
    ax = ta * ez - tv * tv * ex + dx
    # 2 w1 x u' = 2 r' (0, -u'_z, 0); w1' x u = r'' (0, -u_z, u_y); w1 x (w1 x u) = -r'^2 (0, ...)
    ay = -2.0 * rv * vz - ra * uz - rv * rv * uy + cr * dy + sr * dz
    az = -ta * ex - tv * tv * ez + ra * uy - rv * rv * uz + cr * dz - sr * dy
    # Ry(t + pi/2)^T = [[-sin t, 0, -cos t], [0, 1, 0], [cos t, 0, -sin t]]
    return velocity, acceleration, (-st * ax - ct * az, ay, ct * ax - st * az)
