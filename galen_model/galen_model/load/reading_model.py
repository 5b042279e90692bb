# SPDX-License-Identifier: Apache-2.0
"""Readings of still poses as a function of loads and mounting, with the Jacobian.

    h_i = M [G(u_i) x_i - G(u_0) x_adapter],   x_i: what hangs on the sensor at pose i

beside the sensor's bias (see `galen_model.load.mounting` for M and u, `galen_model.load.model` for
G and x = (m, h)). The columns of the Jacobian: M G(u) by x; by a gain the element's own reading e =
M w / (1 + g); by the rotation vector diag(1 + g) [e_f^ ; e_t^] J_r, since S(rho + d)^T w =
exp(-(J_r d)^) S^T w with the right Jacobian J_r of the rotation group (Sola, Deray, Atchuthan, *A
micro Lie theory*, 2018, eq. 143); by angles M [m 1 ; h^] du, with du/dq_k = u x (R^T a_k), a_k the
axis of joint k in the base's frame, and du/da = g R^T dd/da.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.load.model import gravity_regressor
from galen_model.load.mounting import ZEROS, Entity, Mounting
from galen_model.rotation import rot_z, skew

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True)
class JointPoses:
    """Reported angles (n, k) of an arm's turning joints, rad."""

    angles: Array
    arm: Arm

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.angles)

    def gravity(self, mounting: Mounting) -> tuple[Array, Array]:
        """Compute gravity in the sensor, and its change by inclination and zeros.

        Args:
            mounting: of the same arm.

        Returns:
            Gravity (n, 3) along the sensor's axes, m/s^2, and its derivatives (n, 3, 3 + k) by the
            base's angles about x, y, z and the joints' zeros, m/s^2 per rad.

        """
        joints = self.arm.with_angles(self.angles + mounting.joint_zero_rad)
        rotation, _ = self.arm.sensor_pose(joints)
        _, axes = self.arm.joint_axes(joints)
        size = float(np.linalg.norm(self.arm.gravity_m_s2))
        u = np.einsum("nji,j->ni", rotation, mounting.gravity_direction(self.arm)) * size
        change = np.empty((len(self), 3, 3 + len(self.arm.turning)))
        level = np.broadcast_to(self.arm.gravity_m_s2, u.shape)
        change[:, :, :3] = _by_inclination(rotation, mounting, level)
        for column, joint in enumerate(self.arm.turning, start=3):
            axis = np.einsum("nji,nj->ni", rotation, axes[:, joint])
            change[:, :, column] = np.cross(u, axis)
        return u, change


@dataclass(frozen=True)
class OrientedPoses:
    """Gravity (n, 3) in the sensor's frame for a level base, and R_base_sensor (n, 3, 3) or None.

    Without the rotation an inclination of the base has no effect that could be told.
    """

    level_gravity: Array
    rotation: Array | None

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.level_gravity)

    def gravity(self, mounting: Mounting) -> tuple[Array, Array]:
        """Compute gravity in the sensor as `JointPoses.gravity`; joint zeros have no effect.

        Args:
            mounting: of the arm.

        Returns:
            Gravity (n, 3) along the sensor's axes, m/s^2, and its derivatives (n, 3, 3 + k).

        """
        change = np.zeros((len(self), 3, 3 + len(mounting.joints)))
        if self.rotation is None:
            return self.level_gravity, change
        level = np.einsum("nij,nj->ni", self.rotation, self.level_gravity)
        change[:, :, :3] = _by_inclination(self.rotation, mounting, level)
        return mounting.turned_gravity(self.level_gravity, self.rotation), change


Poses = JointPoses | OrientedPoses


def _by_inclination(rotation: Array, mounting: Mounting, level: Array) -> Array:
    """(n, 3, 3) from R_base_sensor (n, 3, 3) and a level base's gravity (n, 3) in the base."""
    # Of M = exp(-c z^) exp(-b y^) exp(-a x^) with Z = exp(-c z^): dM/da = -M x^,
    # dM/db = -(Z y)^ M and dM/dc = -z^ M.
    inclined = level @ mounting.inclination.T
    by_a = np.cross(level, _X) @ mounting.inclination.T
    by_b = np.cross(inclined, rot_z(mounting.base_inclination_rad[2]).T @ _Y)
    by_c = np.cross(inclined, _Z)
    return np.asarray(np.einsum("nji,njk->nik", rotation, np.stack([by_a, by_b, by_c], axis=2)))


@dataclass(frozen=True)
class MountedSweep:
    """Poses with the same on the sensor: which values are its tool and its adapter."""

    poses: Poses
    tool: slice | None
    adapter: slice | None


@dataclass(frozen=True)
class ReadingModel:
    """Sweeps, where the sensor was zeroed, and the mounting's directions after the loads' moments.

    loads: how many moments, 4 or 8.
    """

    sweeps: Sequence[MountedSweep]
    zero: JointPoses
    entities: Sequence[Entity]
    loads: int

    @property
    def _joints(self) -> tuple[str, ...]:
        return self.zero.arm.turning_names

    @property
    def basis(self) -> Array:
        """Directions (12 + k, q) of the mounting's values among its parameters."""
        count = ZEROS + len(self._joints)
        return np.array([entity.direction for entity in self.entities]).reshape(-1, count).T

    def mounting(
        self, values: Array, estimated: tuple[str, ...] = (), covariance: Array | None = None
    ) -> Mounting:
        """Make the mounting of the model's values.

        Args:
            values: (p,) loads' moments, then the mounting's values; further entries are ignored.
            estimated: names of the groups that were estimated.
            covariance: of the values, (p, p); further rows and columns are ignored; None: zero.

        Returns:
            The mounting.

        """
        basis = self.basis
        mounted = slice(self.loads, self.loads + len(self.entities))
        if covariance is not None:
            covariance = basis @ covariance[mounted, mounted] @ basis.T
        return Mounting.from_vector(
            basis @ values[mounted], estimated, covariance, joints=self._joints
        )

    def evaluate(self, values: Array) -> tuple[Array, Array]:
        """Compute the readings of all sweeps and their Jacobian.

        Args:
            values: (p,) the loads' moments, then the mounting's along `entities`.

        Returns:
            Readings (n, 6) without offsets, N and N.m, and their derivatives (n, 6, p) by the
            values.

        """
        parts = [self._sweep(sweep, values) for sweep in self.sweeps]
        return np.concatenate([h for h, _ in parts]), np.concatenate([jac for _, jac in parts])

    def _sweep(self, sweep: MountedSweep, values: Array) -> tuple[Array, Array]:
        mounting = self.mounting(values)
        u, du = sweep.poses.gravity(mounting)
        by_wrench = mounting.reading_from_wrench
        jacobian = np.zeros((len(u), 6, len(values)))
        regressor = gravity_regressor(u)
        moments = np.zeros(4)
        wrench = np.zeros((len(u), 6))
        by_angles = np.zeros((len(u), 6, du.shape[2]))
        if sweep.tool is not None:
            moments = moments + values[sweep.tool]
            jacobian[:, :, sweep.tool] = by_wrench @ regressor
        if sweep.adapter is not None:
            adapter = values[sweep.adapter]
            moments = moments + adapter
            u_zero, du_zero = self.zero.gravity(mounting)
            at_zero = gravity_regressor(u_zero)
            jacobian[:, :, sweep.adapter] = by_wrench @ (regressor - at_zero)
            wrench -= at_zero @ adapter
            by_angles -= _by_gravity(adapter) @ du_zero
        wrench += regressor @ moments
        by_angles += _by_gravity(moments) @ du
        if self.entities:
            by_mounting = _by_mounting(mounting, wrench @ by_wrench.T, by_wrench @ by_angles)
            jacobian[:, :, self.loads :] = by_mounting @ self.basis
        return wrench @ by_wrench.T, jacobian


def _by_gravity(moments: Array) -> Array:
    """(6, 3): the wrench's change by gravity, f = m u and tau = h x u."""
    return np.concatenate([moments[0] * np.eye(3), skew(moments[1:])])


def _by_mounting(mounting: Mounting, reading: Array, by_angles: Array) -> Array:
    """(n, 6, 12 + k) from readings (n, 6) without offset and their change by the angles."""
    gain = 1.0 + mounting.axis_gain
    element = reading / gain
    jacobian = np.zeros((len(reading), 6, 9 + by_angles.shape[2]))
    right = _right_jacobian(mounting.sensor_rotvec_rad)
    jacobian[:, :3, :3] = skew(element[:, :3]) @ right
    jacobian[:, 3:, :3] = skew(element[:, 3:]) @ right
    jacobian[:, :, :3] *= gain[None, :, None]
    jacobian[:, np.arange(6), 3 + np.arange(6)] = element
    jacobian[:, :, 9:] = by_angles
    return jacobian


def _right_jacobian(rotvec: Array) -> Array:
    angle, cross = float(np.linalg.norm(rotvec)), skew(rotvec)
    if angle < 1e-4:  # its series: the closed form loses all digits
        return np.eye(3) - cross / 2.0 + cross @ cross / 6.0
    square = angle * angle
    return np.asarray(
        np.eye(3)
        - (1.0 - np.cos(angle)) / square * cross
        + (angle - np.sin(angle)) / (square * angle) * cross @ cross
    )
