"""The arm as springs in series, for many samples at once.

Contract section 2. The platform stands on six rods with the square matrix A (6, 6) of their rows,
so that rod forces f = A^-T w hold a wrench w at its centre, and the rods' lengthening e moves the
centre by the twist A^-1 e. Rod j deflects by f_j / k_rod, and all rods of a carriage by the
carriage's (G^T f)_i / k_q times n_z: e = f / k_rod + G G^T f / k_q. Since A is square,

    C_p = K_p^-1 = A^-1 (I / k_rod + G G^T / k_q) A^-T

is linear in the compliances 1/k_rod and 1/k_q, where K_p = A^T (...)^-1 A is not. Taken to the
tip, and with roll and tilt beside it, this is a sum over eleven springs,

    deflection = sum_s J_s d_s,   d_s = c_s l_s,   l_s = J_s^T w_tip,

where J_s (6,) is what the tip does when the spring s deflects by one unit, and by virtual work also
what the wrench at the tip loads it with: moments about roll and tilt (N.m; d in rad), and forces of
carriages and rods (N; d in m).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from galen_model.arm.galen import GALEN, ArmParameters
from galen_model.arm.kinematics import sensor_rotation
from galen_model.arrays import Array
from galen_model.rotation import rot_y, skew
from galen_model.wrench import adjoint

from galen_deflection.springs.single_pose import SpringsAt, tip_wrench_at, vector

SPRINGS = (
    "roll", "tilt", "carriage_1", "carriage_2", "carriage_3",
    "rod_1", "rod_2", "rod_3", "rod_4", "rod_5", "rod_6",
)  # fmt: skip
"""The springs' order everywhere."""

# An arm that stands while it is pushed reports a few joint vectors again and again, since its
# encoders have steps. Only a vector that is equal to the last bit gets what was calculated before.
_KEPT_POSES = 64


class Kind(NamedTuple):
    """Springs that share their parameters; `springs` (k,) are columns, `compliance` the nominal."""

    name: str
    springs: slice
    compliance: float
    load_unit: str
    compliance_unit: str


def kinds(arm: ArmParameters = GALEN) -> tuple[Kind, ...]:
    """Roll, tilt, carriages and rods; nominal compliances 1/k in rad/(N.m) and m/N."""
    return (
        Kind("roll", slice(0, 1), 1.0 / arm.roll_stiffness_nm_rad, "N.m", "rad/(N.m)"),
        Kind("tilt", slice(1, 2), 1.0 / arm.tilt_stiffness_nm_rad, "N.m", "rad/(N.m)"),
        Kind("carriage", slice(2, 5), 1.0 / arm.carriage_stiffness_n_m, "N", "m/N"),
        Kind("rod", slice(5, 11), 1.0 / arm.rod_stiffness_n_m, "N", "m/N"),
    )


class TipWrench:
    """Takes wrenches from the sensor to the tip, in base_link."""

    def __init__(self, tip_m: Array) -> None:
        """tip_m (3,): in ft_sensor."""
        tip_in_sensor = np.eye(4)  # tool_tip is turned as ft_sensor is
        tip_in_sensor[:3, 3] = tip_m
        self._move = adjoint(tip_in_sensor).T
        self._tip_m = vector(tip_m)

    def __call__(self, joints: Array, wrench: Array) -> Array:
        """Wrenches (n, 6) at the tip in base_link, from joints (n, 5) and ft_sensor's (n, 6)."""
        if len(joints) == 1:
            return tip_wrench_at(joints[0].tolist(), wrench[0].tolist(), self._tip_m)
        return np.asarray(np.matmul(self._matrices(joints), wrench[:, :, None])[:, :, 0])

    def _matrices(self, joints: Array) -> Array:
        """(n, 6, 6): from ft_sensor to the tip, then turned into base_link."""
        rotation = sensor_rotation(joints[:, 3], joints[:, 4])
        matrices = np.empty((len(joints), 6, 6))
        matrices[:, :3] = rotation @ self._move[:3]
        matrices[:, 3:] = rotation @ self._move[3:]
        return matrices


class Geometry(NamedTuple):
    """J (n, 6, 11), and the lever (n, 3) from the platform's centre to the tip; base_link."""

    jacobian: Array
    lever: Array


class Springs:
    """J of the tip, for many joint vectors."""

    def __init__(self, tip_m: Array, arm: ArmParameters = GALEN) -> None:
        """tip_m (3,): in ft_sensor."""
        self._arm = arm
        self._delta = arm.delta
        angles = np.asarray(arm.leg_angles_rad)
        self._feet = arm.delta_radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        # the row [n, B x n] of each rod, from its leg's n: (6 rods, 6, 3)
        self._rows = np.concatenate(
            [np.broadcast_to(np.eye(3), (6, 3, 3)), skew(arm.delta.ball_joints_m)], axis=1
        )
        self._leg = np.repeat(np.arange(3), 2)
        self._beyond_tilt = arm.tilt_to_sensor_m + rot_y(np.pi / 2) @ tip_m
        self._at = SpringsAt(self._beyond_tilt, arm)
        self._single = lru_cache(maxsize=_KEPT_POSES)(self._calculate_single)

    def jacobian(self, joints: Array) -> Array:
        """J (n, 6, 11), base_link; as `geometry`."""
        return self.geometry(joints).jacobian

    def geometry(self, joints: Array) -> Geometry:
        """Of joints (n, 5); one calculation for equal joints that follow each other.

        Don't change it: it may be given again. Raises KinematicsError where the rods don't reach.
        """
        if len(joints) == 1:
            return self._single(joints.tobytes())
        new = np.ones(len(joints), dtype=bool)
        new[1:] = np.any(joints[1:] != joints[:-1], axis=1)
        jacobian, lever = self._calculate(joints[new])
        which = np.cumsum(new) - 1
        return Geometry(jacobian[which], lever[which])

    def _calculate_single(self, joints: bytes) -> Geometry:
        """As `_calculate`, of one joint vector's bytes: the same in a sixth of the time."""
        jacobian, lever = self._at(np.frombuffer(joints).tolist())
        return Geometry(jacobian[None], lever[None])

    def _calculate(self, joints: Array) -> Geometry:
        count = len(joints)
        cos_r, sin_r = np.cos(joints[:, 3]), np.sin(joints[:, 3])
        cos_t, sin_t = np.cos(joints[:, 4]), np.sin(joints[:, 4])
        # tilt axis -> tip and roll axis -> tip, both in base_link
        a = self._beyond_tilt
        beyond = np.empty((2, count, 3))  # from tilt, from roll
        beyond[:, :, 0] = cos_t * a[0] + sin_t * a[2]
        beyond[:, :, 1] = a[1]
        beyond[:, :, 2] = cos_t * a[2] - sin_t * a[0]
        beyond[1] += self._arm.roll_to_tilt_m
        from_tilt, from_roll = _turned_x(cos_r, sin_r, beyond)
        jacobian = np.zeros((count, 6, 11))
        # roll about x: x cross r; tilt about (0, cos, sin)
        jacobian[:, 1, 0], jacobian[:, 2, 0] = -from_roll[:, 2], from_roll[:, 1]
        jacobian[:, 3, 0] = 1.0
        jacobian[:, 0, 1] = cos_r * from_tilt[:, 2] - sin_r * from_tilt[:, 1]
        jacobian[:, 1, 1] = sin_r * from_tilt[:, 0]
        jacobian[:, 2, 1] = -cos_r * from_tilt[:, 0]
        jacobian[:, 4, 1], jacobian[:, 5, 1] = cos_r, sin_r
        directions = self._rod_directions(joints[:, :3])
        rows = np.matmul(self._rows, directions[:, self._leg, :, None])[..., 0]
        rods = np.linalg.inv(rows)  # a column a rod: the centre's twist for a unit of lengthening
        from_centre = from_roll + self._arm.platform_to_roll_m
        rods[:, :3] -= skew(from_centre) @ rods[:, 3:]
        jacobian[:, :, 5:] = rods
        upward = directions[:, :, 2]
        jacobian[:, :, 2:5] = (rods[:, :, 0::2] + rods[:, :, 1::2]) * upward[:, None, :]
        return Geometry(jacobian, from_centre)

    def _rod_directions(self, platform: Array) -> Array:
        """n_i (n, 3, 3) from carriage to platform."""
        across = platform[:, None, :2] - self._feet
        squared = self._arm.rod_length_m**2 - np.sum(across**2, axis=2)
        if (squared <= 0.0).any():
            row = np.flatnonzero((squared <= 0.0).any(axis=1))[0]
            self._delta.rod_directions(platform[row])  # says which rod does not reach
        directions = np.empty((len(platform), 3, 3))
        directions[:, :, :2] = across
        directions[:, :, 2] = np.sqrt(squared)
        directions /= self._arm.rod_length_m
        return directions


def _turned_x(cos: Array, sin: Array, vectors: Array) -> Array:
    """Vectors (..., n, 3), turned about x."""
    turned = np.empty_like(vectors)
    y, z = vectors[..., 1], vectors[..., 2]
    turned[..., 0] = vectors[..., 0]
    turned[..., 1] = cos * y - sin * z
    turned[..., 2] = sin * y + cos * z
    return turned
