"""Robot-world and hand-eye calibration in closed form: a start for the least squares.

Of poses i = 1 .. n of an arm, F_i is the tool in the base by the joints, M_i the tool's marker in
the base's marker by the tracker. With W the base's marker in the base and Y the marker in the tool,

    W M_i = F_i Y.
"""

from __future__ import annotations

import numpy as np

from galen_model.arrays import Array
from galen_model.registration.rigid import IDENTITY, Transform, nearest_rotation
from galen_model.rotation import matrix_to_rotvec


def solve_base(marker: Transform, tool: Transform, offset: Transform = IDENTITY) -> Transform:
    """W for a known Y; marker M (n), tool F (n). One pose is enough.

    Rotation: the one nearest to the sum of R_F R_Y R_M^T (Umeyama 1991; Moakher 2002, section 3.1:
    the chordal mean). Translation: the mean of t_FY - R_W t_M.
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
    """W and Y; marker M (n), tool F (n), n >= 3 with rotations about two axes (`turns`).

    Shah, *J. Mechanisms Robotics* 5(3), 2013, 031007, sections 3 and 4. From R_F R_Y = R_W R_M,

        vec R_Y = (R_M^T kron R_F^T) vec R_W,   so   K vec R_Y = n vec R_W

    with K the sum of R_M kron R_F: vec R_Y and vec R_W are K's first right and left singular
    vectors, up to a scale that the determinants tell. Then t_W - R_F t_Y = t_F - R_W t_M is linear.
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
    """The rotation nearest to a matrix told column by column, up to a factor."""
    matrix = vector.reshape(3, 3).T
    return nearest_rotation(matrix * np.sign(np.linalg.det(matrix)))


def turns(rotations: Array) -> Array:
    """How far poses (n, 3, 3) turn from their mean: root mean square (3,) rad, largest first.

    About the principal axes of their rotation vectors. Y can be told from W only where the second
    is not small: of a turn about one axis alone, a shift of the marker along that axis, and a turn
    about it, look the same as one of the base.
    """
    mean = nearest_rotation(rotations.mean(axis=0))
    vectors = matrix_to_rotvec(np.swapaxes(rotations, -1, -2) @ mean)
    return np.asarray(np.linalg.svd(vectors / np.sqrt(len(vectors)), compute_uv=False))
