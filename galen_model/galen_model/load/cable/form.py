"""In which form a cable's pull is learned: what a few smooth functions of the pose stand for.

The reading (6,) is y = B(q) g(q), with smooth g and B known. Three forms:

    free              g: three forces and three torques along ft_sensor, nothing presumed
    point             g: a force F along base_link that acts at one point r of the tool
    point_and_couple  and a couple M along base_link, as of a cord that is bent at the tool

With R = R_base_sensor: f = R^T F, tau = r x R^T F + R^T M. Along base_link the pull of a cable
hardly turns with the wrist (it points at where the cable is held), so that g is nearly constant
there; and a torque, which the sensor knows to a few thousandths of a newton over r, tells of the
force. Where a cable is caught at two places of the tool neither holds, and `free` remains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.kinematics import sensor_rotation
from galen_model.arrays import Array
from galen_model.rotation import skew

FORMS = ("point", "point_and_couple", "free")


def groups(form: str) -> int:
    """How many vectors g has: of forces (1), or of forces and of torques (2)."""
    return 1 if form == "point" else 2


def form_matrices(form: str, joints: ArrayLike, attachment_m: ArrayLike) -> Array:
    """B (groups, n, 6, 3) at joints (n, 5), m and rad; attachment (3,) in ft_sensor, m."""
    q = np.asarray(joints, dtype=float)
    matrices = np.zeros((groups(form), len(q), 6, 3))
    if form == "free":
        matrices[0, :, :3] = matrices[1, :, 3:] = np.eye(3)
        return matrices
    turned = np.swapaxes(sensor_rotation(q[:, 3], q[:, 4]), -1, -2)
    matrices[0, :, :3] = turned
    matrices[0, :, 3:] = skew(np.asarray(attachment_m, dtype=float)) @ turned
    if form == "point_and_couple":
        matrices[1, :, 3:] = turned
    return matrices


def attachment_derivatives(form: str, joints: Array) -> Array:
    """Derivatives of B[0] by the attachment (3, n, 6, 3), 1/m; zeros for `free`."""
    derivatives = np.zeros((3, len(joints), 6, 3))
    if form != "free":
        turned = np.swapaxes(sensor_rotation(joints[:, 3], joints[:, 4]), -1, -2)
        derivatives[:, :, 3:] = skew(np.eye(3))[:, None] @ turned
    return derivatives
