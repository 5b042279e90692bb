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
    """Compute rotations about x.

    Args:
        angle_rad: angles (...).

    Returns:
        Matrices (..., 3, 3).

    """
    return _about(angle_rad, 1, 2)


def rot_y(angle_rad: ArrayLike) -> Array:
    """Compute rotations about y.

    Args:
        angle_rad: angles (...).

    Returns:
        Matrices (..., 3, 3).

    """
    return _about(angle_rad, 2, 0)


def rot_z(angle_rad: ArrayLike) -> Array:
    """Compute rotations about z.

    Args:
        angle_rad: angles (...).

    Returns:
        Matrices (..., 3, 3).

    """
    return _about(angle_rad, 0, 1)


def about(axis: Array, angle_rad: ArrayLike) -> Array:
    """Compute rotations about an axis: 1 + sin K + (1 - cos) K^2.

    Args:
        axis: unit vector (3,).
        angle_rad: angles (...).

    Returns:
        Matrices (..., 3, 3).

    """
    angle = np.asarray(angle_rad, dtype=float)[..., None, None]
    turned = skew(axis)
    return np.eye(3) + np.sin(angle) * turned + (1.0 - np.cos(angle)) * (turned @ turned)


def skew(vector: ArrayLike) -> Array:
    """Compute the matrix v^ with v^ w = v x w.

    Args:
        vector: v (..., 3).

    Returns:
        Matrices (..., 3, 3), in v's unit.

    """
    v = np.asarray(vector, dtype=float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def rotvec_to_matrix(rotvec_rad: ArrayLike) -> Array:
    """Convert rotation vectors to matrices.

    Args:
        rotvec_rad: (..., 3), axis times angle.

    Returns:
        Matrices (..., 3, 3).

    """
    return np.asarray(Rotation.from_rotvec(np.asarray(rotvec_rad, dtype=float)).as_matrix())


def matrix_to_rotvec(matrix: ArrayLike) -> Array:
    """Convert matrices to rotation vectors.

    Args:
        matrix: rotations (..., 3, 3).

    Returns:
        Axis times angle (..., 3), rad, of angles up to pi.

    """
    return np.asarray(Rotation.from_matrix(np.asarray(matrix, dtype=float)).as_rotvec())


def matrix_to_quaternion(matrix: ArrayLike) -> Array:
    """Convert matrices to quaternions in ROS' order.

    Args:
        matrix: rotations (..., 3, 3).

    Returns:
        Unit quaternions (..., 4): x, y, z, w.

    """
    return np.asarray(Rotation.from_matrix(np.asarray(matrix, dtype=float)).as_quat())


def quaternion_to_matrix(quaternion_xyzw: ArrayLike) -> Array:
    """Convert quaternions in ROS' order to matrices.

    Args:
        quaternion_xyzw: (..., 4), of any length but zero.

    Returns:
        Matrices (..., 3, 3).

    Raises:
        ValueError: a quaternion's length is zero (from SciPy).

    """
    return np.asarray(Rotation.from_quat(np.asarray(quaternion_xyzw, dtype=float)).as_matrix())
