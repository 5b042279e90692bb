"""Rigid transforms, many at once, and their mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from galen_model.arrays import Array
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix

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
        """Some of many."""
        return Transform(self.rotation[rows], self.translation[rows])

    def __len__(self) -> int:
        """How many there are."""
        return len(self.translation)

    def inverse(self) -> Transform:
        """T_b_a."""
        back = np.swapaxes(self.rotation, -1, -2)
        return Transform(back, -np.einsum("...ij,...j->...i", back, self.translation))

    def displacement_from(self, other: Transform) -> Array:
        """What takes `other` to this one, (..., 6), both seen in the same frame.

        Translation (m) of the origin and rotation vector (rad) of R R_other^T, along the axes of
        that frame: a deflection, if `other` is the pose without load.
        """
        turned = self.rotation @ np.swapaxes(other.rotation, -1, -2)
        return np.concatenate(
            [self.translation - other.translation, matrix_to_rotvec(turned)], axis=-1
        )

    def displaced(self, by: Array) -> Transform:
        """Displaced by (..., 6): `displaced(d).displacement_from(self)` is d."""
        turn = rotvec_to_matrix(np.array(by[..., 3:]))  # SciPy wants them writable
        return Transform(turn @ self.rotation, self.translation + by[..., :3])


IDENTITY = Transform(np.eye(3), np.zeros(3))


class MeanPose(NamedTuple):
    """Mean of many poses, standard deviation (6,) of one (m, rad), and which went into the mean."""

    pose: Transform
    std: Array
    used: np.ndarray


def mean_pose(poses: Transform) -> MeanPose:
    """The mean of poses (n) that scatter closely about one, and a few that lie far off.

    From the medians and median absolute deviations of the six displacements, those beyond four
    standard deviations are left out; the mean is that of the others' displacements. Rotations
    start from the chordal mean (Moakher, *SIAM J. Matrix Anal. Appl.* 24, 2002, section 3.1).
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
    return MeanPose(mean, std, used)


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix in Frobenius norm, by its singular vectors.

    Umeyama, *IEEE Trans. PAMI* 13(4), 1991, lemma.
    """
    left, _, right = np.linalg.svd(matrix)
    flip = np.array([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
    return np.asarray(left * flip @ right)
