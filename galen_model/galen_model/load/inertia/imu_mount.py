"""How an IMU sits on the sensor, from still poses.

At rest it reads u = k R^T (-g) + b, with g gravity in ft_sensor, R from its axes to ft_sensor,
scale k and bias b. R and k come from the readings about their mean (Umeyama, *IEEE Trans. Pattern
Analysis and Machine Intelligence* 13(4), 1991), then b. Its lever arm shows in turning only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.rotation import matrix_to_rotvec

_FEWEST = 4
# Singular values of unit gravity about its mean: the third axis is told by those it spans.
_LEAST_SPREAD = 0.05
_LARGEST_RESIDUAL_M_S2 = 1.0


@dataclass(frozen=True)
class ImuMount:
    """How an IMU sits on the sensor, and what it reads wrongly.

    rotvec_rad (3,): rotation from its axes to ft_sensor; lever_m (3,): where it is in ft_sensor;
    bias_m_s2 (3,): what it reads too much, in its axes; scale: reading over true.
    """

    rotvec_rad: Array = field(default_factory=lambda: np.zeros(3))
    lever_m: Array = field(default_factory=lambda: np.zeros(3))
    bias_m_s2: Array = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0


@dataclass(frozen=True)
class ImuFit:
    """The mount, and residuals (n, 3) of the readings in its axes, m/s^2."""

    mount: ImuMount
    residuals: Array

    @property
    def std_m_s2(self) -> Array:
        """Standard deviation (3,) of what the mount does not explain."""
        freedom = max(self.residuals.size - 7, 1) / 3.0
        return np.asarray(np.sqrt(np.sum(self.residuals**2, axis=0) / freedom))


def fit_imu(gravity: Array, specific: Array) -> ImuFit:
    """From gravity (n, 3) in ft_sensor and specific force (n, 3) in the IMU's axes, m/s^2.

    Raises IdentificationError for too few poses or readings that are no rotation of gravity's
    reaction, NotExcitedError for poses that leave the rotation about an axis open.
    """
    if len(gravity) < _FEWEST:
        raise IdentificationError(f"{len(gravity)} still poses are too few to mount an IMU")
    up = -gravity
    about = up - up.mean(axis=0)
    read = specific - specific.mean(axis=0)
    spread = np.linalg.svd(about, compute_uv=False) / np.linalg.norm(gravity)
    if spread[1] < _LEAST_SPREAD:
        raise NotExcitedError("the poses don't tell how the IMU is turned: tilt about two axes")
    left, sizes, right = np.linalg.svd(about.T @ read)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ proper @ right
    scale = float(np.sum(sizes * np.diag(proper)) / np.sum(about**2))
    bias = specific.mean(axis=0) - scale * up.mean(axis=0) @ rotation
    residuals = specific - scale * up @ rotation - bias
    off = float(np.sqrt(np.mean(residuals**2)))
    if not 0.5 < scale < 2.0 or off > _LARGEST_RESIDUAL_M_S2:
        raise IdentificationError(
            f"the IMU reads {scale:.3g} times gravity's reaction, but for {off:.2g} m/s^2: are its"
            " units m/s^2, does it read upwards at rest, and are its axes right-handed?"
        )
    return ImuFit(
        ImuMount(rotvec_rad=matrix_to_rotvec(rotation), bias_m_s2=bias, scale=scale), residuals
    )
