# SPDX-License-Identifier: Apache-2.0
"""Rotations and the Jacobian of one sample, in plain floats.

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
    """Return R_base_sensor: its rows are the base's axes in the sensor's frame.

    Args:
        arm: whose joints they are.
        joints: (n,), m and rad.

    Returns:
        Nine floats, row by row.

    """
    angles = [joints[index] for index in arm.turning]
    cosines, sines = [math.cos(q) for q in angles], [math.sin(q) for q in angles]
    a, b, c = (arm.components_in_sensor(axis, cosines, sines) for axis in _AXES)
    return (*a, *b, *c)


def tip_jacobian(
    arm: Arm, joints: Sequence[float], tip: Sequence[float]
) -> tuple[Matrix, list[Sequence[float]]]:
    """Return R_base_sensor and the columns of `Arm.tip_jacobian`.

    Args:
        arm: whose joints they are.
        joints: (n,), m and rad.
        tip: (3,) in the sensor's frame, m.

    Returns:
        Rotation, nine floats; and n twists (6,) of the tip in the base, over the joints' rates.

    """
    turned: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    at: Vector = (0.0, 0.0, 0.0)
    axes: list[tuple[Vector, Vector | None]] = []
    for joint, q in zip(arm.joints, joints, strict=True):
        at = _onward(at, rotate(turned, joint.origin_m.tolist()))
        if joint.rotation is not None:
            turned = _product(turned, joint.rotation.ravel().tolist())
        own: list[float] = joint.axis.tolist()
        axis = rotate(turned, own)
        axes.append((axis, at if joint.kind == "revolute" else None))
        if joint.kind == "revolute":
            turned = _product(turned, _about(own, q))
        else:
            at = _onward(at, axis, q)
    at = _onward(at, rotate(turned, arm.sensor_origin_m.tolist()))
    turned = _product(turned, arm.sensor_rotation.ravel().tolist())
    at = _onward(at, rotate(turned, tip))
    return turned, [
        (*axis, 0.0, 0.0, 0.0)
        if origin is None
        else (*cross(axis, _onward(at, origin, -1.0)), *axis)
        for axis, origin in axes
    ]


def _onward(a: Vector, b: Sequence[float], size: float = 1.0) -> Vector:
    return (a[0] + size * b[0], a[1] + size * b[1], a[2] + size * b[2])


def _product(left: Matrix, right: Sequence[float]) -> Matrix:
    a, b, c, d, e, f, g, h, i = left
    x, y, z, u, v, w, r, s, t = right
    return (
        a * x + b * u + c * r, a * y + b * v + c * s, a * z + b * w + c * t,
        d * x + e * u + f * r, d * y + e * v + f * s, d * z + e * w + f * t,
        g * x + h * u + i * r, g * y + h * v + i * s, g * z + h * w + i * t,
    )  # fmt: skip


def _about(axis: Sequence[float], angle: float) -> Matrix:
    """Return the turn about a unit axis, by Rodrigues' formula."""
    (x, y, z), cos, sin = axis, math.cos(angle), math.sin(angle)
    rest = 1.0 - cos
    return (
        cos + rest * x * x, rest * x * y - sin * z, rest * x * z + sin * y,
        rest * x * y + sin * z, cos + rest * y * y, rest * y * z - sin * x,
        rest * x * z - sin * y, rest * y * z + sin * x, cos + rest * z * z,
    )  # fmt: skip


def rotate(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """Return R v.

    Args:
        matrix: R, nine floats.
        vector: v (3,).

    Returns:
        (3,).

    """
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def rotate_back(matrix: Matrix, vector: Sequence[float]) -> Vector:
    """Return R^T v.

    Args:
        matrix: R, nine floats.
        vector: v (3,).

    Returns:
        (3,).

    """
    a, b, c, d, e, f, g, h, i = matrix
    x, y, z = vector
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return a x b.

    Args:
        a: (3,); of more only the first three count.
        b: likewise.

    Returns:
        (3,).

    """
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by the rotation a.

    Args:
        a: unit quaternion x, y, z, w.
        b: likewise.

    Returns:
        Unit quaternion x, y, z, w.

    """
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate_by(quaternion: Quaternion, vector: Sequence[float]) -> Vector:
    """Turn a vector by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v).

    Args:
        quaternion: x, y, z, w.
        vector: v (3,).

    Returns:
        (3,).

    """
    w = quaternion[3]
    once = cross(quaternion, vector)
    twice = cross(quaternion, once)
    return (
        vector[0] + 2.0 * (w * once[0] + twice[0]),
        vector[1] + 2.0 * (w * once[1] + twice[1]),
        vector[2] + 2.0 * (w * once[2] + twice[2]),
    )


def from_rotvec(rotvec: Sequence[float]) -> Quaternion:
    """Return the quaternion of a rotation vector.

    Args:
        rotvec: (3,), rad.

    Returns:
        Unit quaternion x, y, z, w.

    """
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a/2)/a = 1/2 - a^2/48 + ..., which is 1/2 to rounding below 1e-8.
    scale = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    return (scale * x, scale * y, scale * z, math.cos(0.5 * angle))


def to_quaternion(matrix: Matrix) -> Quaternion:
    """Return the quaternion of a rotation, from the row of 4 q q^T that has the most digits.

    Args:
        matrix: of the rotation.

    Returns:
        Unit quaternion x, y, z, w.

    """
    a, b, c, d, e, f, g, h, i = matrix
    diagonal = (1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i)
    rows = (
        (diagonal[0], b + d, c + g, h - f),
        (b + d, diagonal[1], f + h, c - g),
        (c + g, f + h, diagonal[2], d - b),
        (h - f, c - g, d - b, diagonal[3]),
    )
    x, y, z, w = rows[diagonal.index(max(diagonal))]
    size = math.hypot(x, y, z, w)
    return (x / size, y / size, z / size, w / size)
