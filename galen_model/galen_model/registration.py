# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms, wrenches and twists between frames, and the registration of a tracker.

A wrench is (force, torque about the frame's origin), a twist (linear velocity of the frame's
origin, angular velocity), both as arrays (..., 6). Source: Murray, Li, Sastry, *A Mathematical
Introduction to Robotic Manipulation* (1994), sections 2.4 and 2.5, eq. (2.58) and (2.65).

**Registration**, a start for the least squares. Of poses i = 1 .. n of an arm, F_i is the tool in
the base by the joints, M_i the tool's marker in the base's marker by the tracker. With W the base's
marker in the base and Y the marker in the tool,

    W M_i = F_i Y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix


def move_wrench(wrench_b: ArrayLike, rotation_a_b: ArrayLike, origin_b_in_a_m: ArrayLike) -> Array:
    """Express a wrench, known in frame b, in frame a and about a's origin.

    f_a = R f_b,  tau_a = R tau_b + p x (R f_b), with p the origin of b in a. The shapes broadcast.

    Args:
        wrench_b: (..., 6), along b's axes and about b's origin, N and N.m.
        rotation_a_b: R (..., 3, 3).
        origin_b_in_a_m: p (..., 3).

    Returns:
        Wrench (..., 6) along a's axes and about a's origin, N and N.m.

    """
    wrench = np.asarray(wrench_b, dtype=float)
    rotation = np.asarray(rotation_a_b, dtype=float)
    force = np.einsum("...ij,...j->...i", rotation, wrench[..., :3])
    torque = np.einsum("...ij,...j->...i", rotation, wrench[..., 3:])
    torque = torque + np.cross(np.asarray(origin_b_in_a_m, dtype=float), force)
    return np.concatenate(np.broadcast_arrays(force, torque), axis=-1)


def move_twist(twist: ArrayLike, from_m: ArrayLike, to_m: ArrayLike) -> Array:
    """Compute a rigid body's twist at another of its points, axes unchanged.

    v_to = v_from + w x (to - from).

    Args:
        twist: (..., 6) at the first point, m/s and rad/s.
        from_m: the first point (..., 3), in the frame that the twist is written in.
        to_m: the other point (..., 3), in the same frame.

    Returns:
        Twist (..., 6) at the other point, along the same axes.

    """
    moved = np.array(twist, dtype=float)
    arm = np.asarray(to_m, dtype=float) - np.asarray(from_m, dtype=float)
    moved[..., :3] += np.cross(moved[..., 3:], arm)
    return moved


_MAD_TO_STD = 1.4826
_TRIM_SIGMAS = 4.0


@dataclass(frozen=True)
class Transform:
    """T_a_b: takes points from frame b to frame a. rotation (..., 3, 3), translation (..., 3) m."""

    rotation: Array
    translation: Array

    def __matmul__(self, other: Transform) -> Transform:
        """T_a_c of T_a_b and T_b_c."""
        moved = np.einsum("...ij,...j->...i", self.rotation, other.translation)
        return Transform(self.rotation @ other.rotation, moved + self.translation)

    def __getitem__(self, rows: np.ndarray | slice | int) -> Transform:
        """Return some of many."""
        return Transform(self.rotation[rows], self.translation[rows])

    def __len__(self) -> int:
        """How many there are."""
        return len(self.translation)

    def inverse(self) -> Transform:
        """Invert the transform.

        Returns:
            T_b_a.

        """
        back = np.swapaxes(self.rotation, -1, -2)
        return Transform(back, -np.einsum("...ij,...j->...i", back, self.translation))

    def displacement_from(self, other: Transform) -> Array:
        """Compute what takes `other` to this pose, both seen in the same frame.

        It is a deflection, if `other` is the pose without load.

        Args:
            other: poses that broadcast against these.

        Returns:
            Translation (m) of the origin and rotation vector (rad) of R R_other^T, along the axes
            of that frame, (..., 6).

        """
        turned = self.rotation @ np.swapaxes(other.rotation, -1, -2)
        return np.concatenate(
            [self.translation - other.translation, matrix_to_rotvec(turned)], axis=-1
        )

    def displaced(self, by: Array) -> Transform:
        """Displace the pose: `displaced(d).displacement_from(self)` is d.

        Args:
            by: translation (m) and rotation vector (rad) along the outer frame's axes, (..., 6).

        Returns:
            The displaced poses.

        """
        turn = rotvec_to_matrix(np.array(by[..., 3:]))  # SciPy wants them writable
        return Transform(turn @ self.rotation, self.translation + by[..., :3])


IDENTITY = Transform(np.eye(3), np.zeros(3))


def mean_pose(poses: Transform) -> tuple[Transform, Array, np.ndarray]:
    """Average poses that scatter closely about one, but for a few that lie far off.

    From the medians and median absolute deviations of the six displacements, those beyond four
    standard deviations are left out; the mean is that of the others' displacements. Rotations
    start from the chordal mean (Moakher, *SIAM J. Matrix Anal. Appl.* 24, 2002, section 3.1).

    Args:
        poses: n of them.

    Returns:
        The mean; the standard deviation (6,) of one pose, m and rad, along the outer frame's axes;
        and the mask (n,) of those that went into the mean.

    """
    mean = Transform(nearest_rotation(poses.rotation.mean(axis=0)), poses.translation.mean(axis=0))
    for _ in range(3):  # far ones have drawn the start towards them
        mean = mean.displaced(np.median(poses.displacement_from(mean), axis=0))
    off = poses.displacement_from(mean)
    scale = _MAD_TO_STD * np.median(np.abs(off), axis=0)
    used = np.all(np.abs(off) <= _TRIM_SIGMAS * np.maximum(scale, 1e-12), axis=1)
    if not used.any():  # more than half alike to the last bit, and none like it in all six
        used[:] = True
    mean = mean.displaced(off[used].mean(axis=0))
    freedom = max(int(used.sum()) - 1, 1)
    std = np.sqrt(np.sum(poses[used].displacement_from(mean) ** 2, axis=0) / freedom)
    return mean, std, used


def nearest_rotation(matrix: Array) -> Array:
    """Find the rotation nearest to a matrix in Frobenius norm, by its singular vectors.

    Umeyama, *IEEE Trans. PAMI* 13(4), 1991, lemma.

    Args:
        matrix: any (3, 3).

    Returns:
        A rotation (3, 3).

    """
    left, _, right = np.linalg.svd(matrix)
    flip = np.array([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
    return np.asarray(left * flip @ right)


def solve_base(marker: Transform, tool: Transform, offset: Transform = IDENTITY) -> Transform:
    """Solve for W, the base's marker in the base, with Y known; one pose is enough.

    Rotation: the one nearest to the sum of R_F R_Y R_M^T (Umeyama 1991; Moakher 2002, section 3.1:
    the chordal mean). Translation: the mean of t_FY - R_W t_M.

    Args:
        marker: M, n poses of the tool's marker in the base's marker.
        tool: F, n poses of the tool in the base.
        offset: Y, the marker in the tool.

    Returns:
        W.

    """
    there = tool @ Transform(
        np.broadcast_to(offset.rotation, tool.rotation.shape),
        np.broadcast_to(offset.translation, tool.translation.shape),
    )
    products = there.rotation @ np.swapaxes(marker.rotation, -1, -2)
    rotation = nearest_rotation(products.sum(axis=0))
    translations = there.translation - marker.translation @ rotation.T
    return Transform(rotation, np.asarray(np.mean(translations, axis=0)))


def solve_base_and_offset(marker: Transform, tool: Transform) -> tuple[Transform, Transform]:
    """Solve for W and Y, with rotations about two axes (`turns`).

    Shah, *J. Mechanisms Robotics* 5(3), 2013, 031007, sections 3 and 4. From R_F R_Y = R_W R_M,

        vec R_Y = (R_M^T kron R_F^T) vec R_W,   so   K vec R_Y = n vec R_W

    with K the sum of R_M kron R_F: vec R_Y and vec R_W are K's first right and left singular
    vectors, up to a scale that the determinants give. Then t_W - R_F t_Y = t_F - R_W t_M is linear.

    Args:
        marker: M, n >= 3 poses of the tool's marker in the base's marker.
        tool: F, n poses of the tool in the base.

    Returns:
        W, the base's marker in the base, and Y, the marker in the tool.

    """
    kron = np.einsum("nij,nkl->ikjl", marker.rotation, tool.rotation).reshape(9, 9)
    left, _, right = np.linalg.svd(kron)
    base, offset = _rotation_of(left[:, 0]), _rotation_of(right[0])
    count = len(marker)
    rows = np.zeros((count, 3, 6))
    rows[:, :, :3], rows[:, :, 3:] = np.eye(3), -tool.rotation
    wanted = tool.translation - marker.translation @ base.T
    solution, *_ = np.linalg.lstsq(rows.reshape(-1, 6), wanted.reshape(-1), rcond=None)
    return Transform(base, np.asarray(solution[:3])), Transform(offset, np.asarray(solution[3:]))


def _rotation_of(vector: Array) -> Array:
    """Return the rotation nearest to a matrix given column by column, up to a factor."""
    matrix = vector.reshape(3, 3).T
    return nearest_rotation(matrix * np.sign(np.linalg.det(matrix)))


def turns(rotations: Array) -> Array:
    """Compute how far poses turn from their mean, about their rotation vectors' principal axes.

    Y is identifiable beside W only where the second is not small: of a turn about one axis alone, a
    shift of the marker along that axis, and a turn about it, look the same as one of the base.

    Args:
        rotations: (n, 3, 3).

    Returns:
        Root mean square angles (3,), rad, largest first.

    """
    mean = nearest_rotation(rotations.mean(axis=0))
    vectors = matrix_to_rotvec(np.swapaxes(rotations, -1, -2) @ mean)
    return np.asarray(np.linalg.svd(vectors / np.sqrt(len(vectors)), compute_uv=False))
