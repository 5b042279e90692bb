"""Moving wrenches and twists between frames.

A wrench is (force, torque about the frame's origin), a twist (linear velocity of the frame's
origin, angular velocity), both as arrays (..., 6). Source: Murray, Li, Sastry, *A Mathematical
Introduction to Robotic Manipulation* (1994), sections 2.4 and 2.5, eq. (2.58) and (2.65).
"""

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.rotation import skew


def adjoint(transform_a_b: ArrayLike) -> Array:
    """Ad of a homogeneous transform, shape (4, 4) -> (6, 6).

    It takes a twist (v, w) from frame b to frame a:  Ad = [[R, p^ R], [0, R]],
    where p is the origin of b in a, and so belongs to R: for a point that is fixed in b, p
    changes as R does (the 2019 report's eqs. 9-11 keep it constant, which only holds for pure
    translations). A wrench goes the other way: F_b = Ad^T F_a.
    """
    transform = np.asarray(transform_a_b, dtype=float)
    rotation, translation = transform[:3, :3], transform[:3, 3]
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[:3, 3:] = skew(translation) @ rotation
    return matrix


def move_wrench(wrench_b: ArrayLike, rotation_a_b: ArrayLike, origin_b_in_a_m: ArrayLike) -> Array:
    """The same wrench, known in frame b, in frame a and about a's origin.

    f_a = R f_b,  tau_a = R tau_b + p x (R f_b), with p the origin of b in a.

    Shapes: wrench (..., 6), rotation (..., 3, 3), origin (..., 3); they broadcast.
    """
    wrench = np.asarray(wrench_b, dtype=float)
    rotation = np.asarray(rotation_a_b, dtype=float)
    force = np.einsum("...ij,...j->...i", rotation, wrench[..., :3])
    torque = np.einsum("...ij,...j->...i", rotation, wrench[..., 3:])
    torque = torque + np.cross(np.asarray(origin_b_in_a_m, dtype=float), force)
    return np.concatenate(np.broadcast_arrays(force, torque), axis=-1)


def move_twist(twist: ArrayLike, from_m: ArrayLike, to_m: ArrayLike) -> Array:
    """The twist (..., 6) of a rigid body at another of its points, axes unchanged.

    v_to = v_from + w x (to - from). Both points (..., 3) in the frame the twist is written in.
    """
    moved = np.array(twist, dtype=float)
    arm = np.asarray(to_m, dtype=float) - np.asarray(from_m, dtype=float)
    moved[..., :3] += np.cross(moved[..., 3:], arm)
    return moved
