"""Rotations of many samples at once."""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array


def turned_about(axis: Array, angle_rad: Array) -> Array:
    """Rotations (n, 3, 3) by angles (n,) about one unit vector (3,): Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, versine = np.sin(angle_rad), 1.0 - np.cos(angle_rad)
    return np.asarray(
        np.eye(3) + sine[:, None, None] * cross + versine[:, None, None] * (cross @ cross)
    )


def turned_by(rotvec_rad: Array) -> Array:
    """Rotations (n, 3, 3) by rotation vectors (n, 3), by exp's series for small angles too."""
    angle = np.linalg.norm(rotvec_rad, axis=1)
    square = angle**2
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(safe)) / safe**2)
    cross = np.zeros((len(rotvec_rad), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2] = -rotvec_rad[:, 2], rotvec_rad[:, 1]
    cross[:, 1, 0], cross[:, 1, 2] = rotvec_rad[:, 2], -rotvec_rad[:, 0]
    cross[:, 2, 0], cross[:, 2, 1] = -rotvec_rad[:, 1], rotvec_rad[:, 0]
    return np.asarray(
        np.eye(3) + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)
    )


def unit(vector: Array) -> Array:
    """The vector (..., 3) at length one."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def any_direction(rng: np.random.Generator, count: int = 3) -> Array:
    """A unit vector (count,), every direction as likely."""
    drawn = rng.standard_normal(count)
    return np.asarray(drawn / np.linalg.norm(drawn))


def back(rotation: Array, vector: Array) -> Array:
    """R^T v, (n, 3), for rotations (n, 3, 3) and vectors (3,) or (n, 3)."""
    if vector.ndim == 1:
        return np.asarray(np.einsum("nji,j->ni", rotation, vector))
    return np.asarray(np.einsum("nji,nj->ni", rotation, vector))


def forth(rotation: Array, vector: Array) -> Array:
    """R v, (n, 3), for rotations (n, 3, 3) and vectors (3,) or (n, 3)."""
    if vector.ndim == 1:
        return np.asarray(rotation @ vector)
    return np.asarray(np.einsum("nij,nj->ni", rotation, vector))


def cross(first: Array, second: Array) -> Array:
    """The product a x b of (n, 3) or (3,), either; numpy's own takes several times as long."""
    a, b, c = np.asarray(first).T
    x, y, z = np.asarray(second).T
    return np.stack(np.broadcast_arrays(b * z - c * y, c * x - a * z, a * y - b * x), axis=-1)
