"""Rotations of one sample, in plain floats.

numpy takes microseconds for every call on a 3-vector, and the plant makes hundreds of steps a
second of them. Matrices are nine floats, row by row; quaternions are x, y, z, w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from galen_model.arm.arm import Arm

Matrix = tuple[float, float, float, float, float, float, float, float, float]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

_AXES: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def sensor_matrix(arm: Arm, joints: Sequence[float]) -> Matrix:
    """Return R_base_sensor at joints (n,): its rows are the base's axes in the sensor's frame."""
    angles = [joints[index] for index in arm.turning]
    cosines, sines = [math.cos(q) for q in angles], [math.sin(q) for q in angles]
    a, b, c = (arm.components_in_sensor(axis, cosines, sines) for axis in _AXES)
    return (*a, *b, *c)


def rotate(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """Return R v."""
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def rotate_back(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """Return R^T v."""
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by the rotation a."""
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
    """Return the quaternion of a rotation vector (rad)."""
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a/2)/a = 1/2 - a^2/48 + ..., which is 1/2 to rounding below 1e-8.
    scale = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    return (scale * x, scale * y, scale * z, math.cos(0.5 * angle))
