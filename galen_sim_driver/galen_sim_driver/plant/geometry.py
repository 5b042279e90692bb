"""The arm's geometry for one pose, in plain floats.

numpy takes microseconds for every call on a 3-vector, and the plant makes hundreds of steps a
second of them. The formulas are those of galen_model.arm.kinematics, and a test compares the two.
Matrices are nine floats, row by row; quaternions are x, y, z, w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from galen_model.arm.galen import ArmParameters

Matrix = tuple[float, float, float, float, float, float, float, float, float]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def sensor_matrix(roll: float, tilt: float) -> Matrix:
    """R_base_sensor = Rx(roll) Ry(tilt + pi/2)."""
    sin_roll, cos_roll = math.sin(roll), math.cos(roll)
    sin_tilt, cos_tilt = math.sin(tilt), math.cos(tilt)
    return (
        *(-sin_tilt, 0.0, cos_tilt),
        *(sin_roll * cos_tilt, cos_roll, sin_roll * sin_tilt),
        *(-cos_roll * cos_tilt, sin_roll, -cos_roll * sin_tilt),
    )


def sensor_quaternion(roll: float, tilt: float) -> Quaternion:
    """The same rotation as a quaternion."""
    half_roll, half_turn = 0.5 * roll, 0.5 * tilt + 0.25 * math.pi
    sin_roll, cos_roll = math.sin(half_roll), math.cos(half_roll)
    sin_turn, cos_turn = math.sin(half_turn), math.cos(half_turn)
    return (sin_roll * cos_turn, cos_roll * sin_turn, sin_roll * sin_turn, cos_roll * cos_turn)


def rotate(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """R v."""
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def rotate_back(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """R^T v."""
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """A x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b, then the rotation a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate_by(quaternion: Quaternion, vector: Sequence[float]) -> Vector:
    """Turn a vector by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
    w = quaternion[3]
    once = cross(quaternion, vector)
    twice = cross(quaternion, once)
    return (
        vector[0] + 2.0 * (w * once[0] + twice[0]),
        vector[1] + 2.0 * (w * once[1] + twice[1]),
        vector[2] + 2.0 * (w * once[2] + twice[2]),
    )


def from_rotvec(rotvec: Sequence[float]) -> Quaternion:
    """Quaternion of a rotation vector (rad)."""
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a/2)/a = 1/2 - a^2/48 + ..., which is 1/2 to rounding below 1e-8.
    scale = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    return (scale * x, scale * y, scale * z, math.cos(0.5 * angle))


class ArmGeometry:
    """Where roll axis, tilt axis and tip are, for one arm."""

    def __init__(self, arm: ArmParameters) -> None:
        self._platform_to_roll = arm.platform_to_roll_m.tolist()
        self._roll_to_tilt = arm.roll_to_tilt_m.tolist()
        self._tilt_to_sensor = arm.tilt_to_sensor_m.tolist()

    def arms_to_tip(
        self, joints: Sequence[float], matrix: Matrix, tip: Sequence[float]
    ) -> tuple[Vector, Vector]:
        """The vectors from roll axis to tip, and from tilt axis to tip, in base_link (m).

        `tip` is in ft_sensor; `matrix` is `sensor_matrix` of the joints' roll and tilt.
        """
        sin_roll, cos_roll = math.sin(joints[3]), math.cos(joints[3])
        sin_tilt, cos_tilt = math.sin(joints[4]), math.cos(joints[4])
        # In the roll link: Ry(tilt) (tilt axis -> sensor), then Rx(roll) of it.
        sx, sy, sz = self._tilt_to_sensor
        x, y, z = cos_tilt * sx + sin_tilt * sz, sy, -sin_tilt * sx + cos_tilt * sz
        tx, ty, tz = rotate(matrix, tip)
        from_tilt = (x + tx, cos_roll * y - sin_roll * z + ty, sin_roll * y + cos_roll * z + tz)
        ax, ay, az = self._roll_to_tilt
        from_roll = (
            from_tilt[0] + ax,
            from_tilt[1] + cos_roll * ay - sin_roll * az,
            from_tilt[2] + sin_roll * ay + cos_roll * az,
        )
        return from_roll, from_tilt

    def tip_position(self, joints: Sequence[float], matrix: Matrix, tip: Sequence[float]) -> Vector:
        """The tip in base_link (m)."""
        from_roll, _ = self.arms_to_tip(joints, matrix, tip)
        offset = self._platform_to_roll
        return (
            joints[0] + offset[0] + from_roll[0],
            joints[1] + offset[1] + from_roll[1],
            joints[2] + offset[2] + from_roll[2],
        )
