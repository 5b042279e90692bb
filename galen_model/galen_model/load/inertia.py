# SPDX-License-Identifier: Apache-2.0
"""What a rigid load in motion reads: Newton's and Euler's equations about the sensor's origin.

In the axes of ft_sensor, with g gravity, a the acceleration of the sensor's origin, w and al the
angular velocity and acceleration, m the mass, h = m p the first moment, I the inertia about the
sensor's origin, s = g - a:

    f   = m s - al x h - w x (w x h),
    tau = h x s - I al - w x (I w),

which is linear in the ten numbers (m, h, I). Source: Atkeson, An, Hollerbach, *Estimation of
Inertial Parameters of Manipulator Loads and Links*, Int. J. Robotics Research 5(3), 1986, eqs. (3)
to (9), with the sign of this suite's wrench (a push reads positive in its direction). At rest it is
`galen_model.load.model`.

`InertiaEstimate` is that of tool and adapter together, as a calibration file may hold it: they move
as one, so that no motion distinguishes their inertias.

`fit_imu` finds how an IMU sits on the sensor from still poses. At rest it reads u = k R^T (-g) + b,
with g gravity in ft_sensor, R from its axes to ft_sensor, scale k and bias b. R and k come from the
readings about their mean (Umeyama, *IEEE Trans. Pattern Analysis and Machine Intelligence* 13(4),
1991), then b. Its lever arm shows in turning only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.json_fields import FieldError, array, get, mapping, numbers
from galen_model.load.model import Load, gravity_regressor
from galen_model.rotation import matrix_to_rotvec, skew

INERTIA_NAMES = ("xx", "yy", "zz", "xy", "xz", "yz")
"""Order of the six numbers of an inertia; those off the diagonal as they stand in the matrix."""


def inertial_regressor(
    specific_m_s2: ArrayLike, velocity_rad_s: ArrayLike, acceleration_rad_s2: ArrayLike
) -> Array:
    """Compute Y with the wrench Y (m, h, I). All vectors are in ft_sensor.

    Args:
        specific_m_s2: s = g - a (..., 3); -a alone for the inertial forces without the weight.
        velocity_rad_s: angular velocity (..., 3).
        acceleration_rad_s2: angular acceleration (..., 3).

    Returns:
        Y (..., 6, 10), which takes kg, kg.m and kg m^2 to N and N.m in ft_sensor.

    """
    specific, omega, alpha = np.broadcast_arrays(
        np.asarray(specific_m_s2, dtype=float),
        np.asarray(velocity_rad_s, dtype=float),
        np.asarray(acceleration_rad_s2, dtype=float),
    )
    spin = skew(omega)
    regressor = np.zeros((*specific.shape[:-1], 6, 10))
    regressor[..., :4] = gravity_regressor(specific)
    regressor[..., :3, 1:4] = -skew(alpha) - spin @ spin
    regressor[..., 3:, 4:] = -_times_inertia(alpha) - spin @ _times_inertia(omega)
    return regressor


def inertial_wrench(
    specific_m_s2: ArrayLike,
    velocity_rad_s: ArrayLike,
    acceleration_rad_s2: ArrayLike,
    moments: ArrayLike,
    about_sensor_kg_m2: ArrayLike,
) -> Array:
    """Compute the wrench of a load in motion. All vectors are in ft_sensor.

    Args:
        specific_m_s2: s = g - a (..., 3); -a alone for the inertial forces without the weight.
        velocity_rad_s: angular velocity (..., 3).
        acceleration_rad_s2: angular acceleration (..., 3).
        moments: (4,) as `Load.moments`, kg and kg.m.
        about_sensor_kg_m2: inertia (6,) about the sensor's origin, as INERTIA_NAMES.

    Returns:
        Wrench (..., 6), N and N.m in ft_sensor.

    """
    numbers = np.concatenate([np.asarray(moments, float), np.asarray(about_sensor_kg_m2, float)])
    regressor = inertial_regressor(specific_m_s2, velocity_rad_s, acceleration_rad_s2)
    return np.asarray(regressor @ numbers)


def point_mass_inertia(*loads: Load) -> Array:
    """Compute the inertia of loads as points: m (p.p 1 - p p^T).

    The least that the loads can have: their own inertia about their centres comes on top.

    Args:
        *loads: with their centres in ft_sensor.

    Returns:
        Inertia (6,) of all about the sensor's origin, kg m^2, as INERTIA_NAMES.

    """
    total = np.zeros((3, 3))
    for load in loads:
        p = np.asarray(load.com_m, dtype=float)
        total += load.mass_kg * (p @ p * np.eye(3) - np.outer(p, p))
    return inertia_numbers(total)


def inertia_numbers(matrix: ArrayLike) -> Array:
    """Take the six numbers out of a symmetric matrix.

    Args:
        matrix: (3, 3), kg m^2.

    Returns:
        (6,), in the order of `INERTIA_NAMES`.

    """
    i = np.asarray(matrix, dtype=float)
    return np.array([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]])


def inertia_matrix(numbers: ArrayLike) -> Array:
    """Make the symmetric matrix of six numbers.

    Args:
        numbers: (6,), in the order of `INERTIA_NAMES`, kg m^2.

    Returns:
        (3, 3).

    """
    xx, yy, zz, xy, xz, yz = np.asarray(numbers, dtype=float)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _times_inertia(vector: Array) -> Array:
    """L (..., 3, 6) with L (xx yy zz xy xz yz) = I v."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = np.zeros_like(x)
    rows = [(x, zero, zero, y, z, zero), (zero, y, zero, x, zero, z), (zero, zero, z, zero, x, y)]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


class LoadInMotion:
    """`inertial_wrench` of one load, for one moment at a time and some ten times as fast."""

    def __init__(self, moments: ArrayLike, about_sensor_kg_m2: ArrayLike) -> None:
        """Take a load.

        Args:
            moments: (4,) as `Load.moments`, kg and kg.m.
            about_sensor_kg_m2: inertia (6,) about the sensor's origin, as INERTIA_NAMES.

        """
        self._moments = tuple(float(v) for v in np.asarray(moments, dtype=float))
        self._inertia = tuple(float(v) for v in np.asarray(about_sensor_kg_m2, dtype=float))

    def wrench(
        self, specific: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]
    ) -> tuple[float, float, float, float, float, float]:
        """Compute the wrench at one moment. All vectors are in ft_sensor.

        Args:
            specific: s = g - a, or -a alone, (3,), m/s^2.
            velocity: w (3,), rad/s.
            acceleration: al (3,), rad/s^2.

        Returns:
            fx, fy, fz, tx, ty, tz, N and N.m.

        """
        m, hx, hy, hz = self._moments
        xx, yy, zz, xy, xz, yz = self._inertia
        sx, sy, sz = specific
        wx, wy, wz = velocity
        ax, ay, az = acceleration
        # w x h, then al x h + w x (w x h)
        ux, uy, uz = wy * hz - wz * hy, wz * hx - wx * hz, wx * hy - wy * hx
        # I w, then I al + w x (I w)
        lx = xx * wx + xy * wy + xz * wz
        ly = xy * wx + yy * wy + yz * wz
        lz = xz * wx + yz * wy + zz * wz
        return (
            m * sx - (ay * hz - az * hy + wy * uz - wz * uy),
            m * sy - (az * hx - ax * hz + wz * ux - wx * uz),
            m * sz - (ax * hy - ay * hx + wx * uy - wy * ux),
            hy * sz - hz * sy - (xx * ax + xy * ay + xz * az + wy * lz - wz * ly),
            hz * sx - hx * sz - (xy * ax + yy * ay + yz * az + wz * lx - wx * lz),
            hx * sy - hy * sx - (xz * ax + yz * ay + zz * az + wx * ly - wy * lx),
        )


_LARGEST_KG_M2 = 10.0
"""A tool of 1 kg would be metres long."""
_MOST_UNKNOWN = 0.5
"""Of the largest principal inertia: below minus it no other may be, whatever the covariance."""


@dataclass(frozen=True)
class InertiaEstimate:
    """Inertia (6,) about the sensor's origin in ft_sensor, kg m^2, and its covariance (6, 6).

    Order: `galen_model.load.inertia.INERTIA_NAMES`, xx yy zz xy xz yz.
    """

    about_sensor_kg_m2: Array
    covariance: Array

    @property
    def std_kg_m2(self) -> Array:
        """Standard deviations (6,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_json(self) -> dict[str, Any]:
        """Return the content of the key `inertia`."""
        return {
            "about_sensor_kg_m2": numbers(self.about_sensor_kg_m2),
            "order": list(INERTIA_NAMES),
            "covariance": [numbers(row) for row in self.covariance],
        }

    @classmethod
    def from_json(cls, value: Any, name: str) -> InertiaEstimate:
        """Read the content of the key `inertia`.

        Args:
            value: the content as parsed.
            name: the key's name in errors.

        Returns:
            Inertia and covariance.

        Raises:
            FieldError: a field is missing or wrong, or the inertia is no possible one; the message
                names it.

        """
        whole = mapping(value, name)
        inertia = array(
            get(whole, "about_sensor_kg_m2"), f"{name}.about_sensor_kg_m2", (len(INERTIA_NAMES),)
        )
        order = whole.get("order", list(INERTIA_NAMES))
        if order != list(INERTIA_NAMES):
            raise FieldError(f"{name}.order is not {' '.join(INERTIA_NAMES)}")
        covariance = array(get(whole, "covariance"), f"{name}.covariance", (6, 6))
        if np.any(np.diag(covariance) < 0.0):
            raise FieldError(f"{name}.covariance has a negative variance")
        if np.any(np.abs(inertia) > _LARGEST_KG_M2):
            raise FieldError(f"{name}.about_sensor_kg_m2 holds more than {_LARGEST_KG_M2:g} kg m^2")
        lowest, _, largest = np.linalg.eigvalsh(inertia_matrix(inertia)).tolist()
        # An estimate's noise may make the least principal one a little negative.
        noise = min(5.0 * float(np.sqrt(np.trace(covariance))), _MOST_UNKNOWN * largest)
        if lowest < -noise - 1e-12:
            raise FieldError(
                f"{name}.about_sensor_kg_m2 has a principal inertia of {lowest:.3g} kg m^2;"
                " they are positive"
            )
        return cls(inertia, covariance)


_FEWEST = 4
# Singular values of unit gravity about its mean: the third axis follows from those it spans.
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
    """Find how an IMU sits on the sensor, and its scale and bias, from still poses.

    Args:
        gravity: (n, 3) in ft_sensor, m/s^2.
        specific: averaged specific force (n, 3) in the IMU's axes, m/s^2, at the same poses.

    Returns:
        The mount, its lever arm zero, and residuals.

    Raises:
        NotExcitedError: the poses leave the rotation about an axis open.
        IdentificationError: there are too few poses, or the readings are no rotation of gravity's
            reaction.

    """
    if len(gravity) < _FEWEST:
        raise IdentificationError(f"{len(gravity)} still poses are too few to mount an IMU")
    up = -gravity
    about = up - up.mean(axis=0)
    read = specific - specific.mean(axis=0)
    spread = np.linalg.svd(about, compute_uv=False) / np.linalg.norm(gravity)
    if spread[1] < _LEAST_SPREAD:
        raise NotExcitedError("the poses don't tell how the IMU is turned: turn about two axes")
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
