# SPDX-License-Identifier: Apache-2.0
"""Rotations: matrices are active, `R_a_b` takes vectors from frame b to frame a.

Elementary rotations and the skew matrix accept arrays of any shape; conversions are SciPy's.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from galen_model.arrays import Array


def _about(angle_rad: ArrayLike, first: int, second: int) -> Array:
    angle = np.asarray(angle_rad, dtype=float)
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., 3 - first - second, 3 - first - second] = 1.0
    cos, sin = np.cos(angle), np.sin(angle)
    matrix[..., first, first] = cos
    matrix[..., second, second] = cos
    matrix[..., first, second] = -sin
    matrix[..., second, first] = sin
    return matrix


def rot_x(angle_rad: ArrayLike) -> Array:
    """Rotation about x; angles of shape (...) give matrices of shape (..., 3, 3)."""
    return _about(angle_rad, 1, 2)


def rot_y(angle_rad: ArrayLike) -> Array:
    """Rotation about y; angles of shape (...) give matrices of shape (..., 3, 3)."""
    return _about(angle_rad, 2, 0)


def rot_z(angle_rad: ArrayLike) -> Array:
    """Rotation about z; angles of shape (...) give matrices of shape (..., 3, 3)."""
    return _about(angle_rad, 0, 1)


def about(axis: Array, angle_rad: ArrayLike) -> Array:
    """Rotation (..., 3, 3) about a unit axis (3,), angles (...): 1 + sin K + (1 - cos) K^2."""
    angle = np.asarray(angle_rad, dtype=float)[..., None, None]
    turned = skew(axis)
    return np.eye(3) + np.sin(angle) * turned + (1.0 - np.cos(angle)) * (turned @ turned)


def skew(vector: ArrayLike) -> Array:
    """Return the matrix v^ with v^ w = v x w; vectors (..., 3) give matrices (..., 3, 3)."""
    v = np.asarray(vector, dtype=float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def rotvec_to_matrix(rotvec_rad: ArrayLike) -> Array:
    """Rotation matrix (..., 3, 3) of a rotation vector (..., 3) in rad."""
    return np.asarray(Rotation.from_rotvec(np.asarray(rotvec_rad, dtype=float)).as_matrix())


def matrix_to_rotvec(matrix: ArrayLike) -> Array:
    """Rotation vector (..., 3) in rad of a rotation matrix (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(np.asarray(matrix, dtype=float)).as_rotvec())


def matrix_to_quaternion(matrix: ArrayLike) -> Array:
    """Return unit quaternion (..., 4) in the order x, y, z, w, as ROS writes it."""
    return np.asarray(Rotation.from_matrix(np.asarray(matrix, dtype=float)).as_quat())


def quaternion_to_matrix(quaternion_xyzw: ArrayLike) -> Array:
    """Rotation matrix (..., 3, 3) of a quaternion (..., 4) in the order x, y, z, w."""
    return np.asarray(Rotation.from_quat(np.asarray(quaternion_xyzw, dtype=float)).as_matrix())
