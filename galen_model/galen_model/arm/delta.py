# SPDX-License-Identifier: Apache-2.0
"""The linear delta: three vertical carriages carry a platform on three pairs of rods.

With u_i = (cos theta_i, sin theta_i), R = rail radius - platform radius and L the rods' length,
carriage i stands at  c_i = z - sqrt(L^2 - |p_xy - R u_i|^2)  above the base plane; the carriage
coordinate is q_i = c_i - c_i(home). The rods' directions are n_i = (p - (R u_i, c_i)) / L.
The two rods of a leg hold the platform at B = r u_i +- h (-sin theta_i, cos theta_i, 0).

Rod (i, +-) has the row a = [n_i, B x n_i]. With G the 6 x 3 matrix that holds n_iz of each rod in
its carriage's column, K_p = A^T (I / k_rod + G G^T / k_q)^-1 A is the stiffness at the platform's
centre (contract, section 2).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.errors import KinematicsError


@dataclass(frozen=True)
class LinearDelta:
    """Kinematics and stiffness of a linear delta; positions in the base's frame.

    Lengths in m, angles in rad, stiffness in N/m; the carriages are at zero where the platform is
    at `home_m` (3,).
    """

    rod_length_m: float
    rail_radius_m: float
    platform_radius_m: float
    rod_half_spacing_m: float
    leg_angles_rad: tuple[float, float, float]
    carriage_travel_m: float
    carriage_stiffness: float
    rod_stiffness: float
    home_m: tuple[float, float, float]

    @property
    def radius_m(self) -> float:
        """R: rail radius less platform radius."""
        return self.rail_radius_m - self.platform_radius_m

    @cached_property
    def feet_m(self) -> Array:
        """R u_i (3, 2): where the rails stand, moved in by the platform's radius."""
        angles = np.asarray(self.leg_angles_rad)
        return self.radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    @cached_property
    def ball_joints_m(self) -> Array:
        """B (6, 3): where rods hold the platform, from its centre; rows 2 i, 2 i + 1 of leg i.

        They lie in the platform's plane, whose axes are those of the base's frame.
        """
        angles = np.repeat(self.leg_angles_rad, 2)
        side = np.tile([1.0, -1.0], len(self.leg_angles_rad))[:, None]
        radial = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        along = np.stack([-np.sin(angles), np.cos(angles), 0.0 * angles], axis=1)
        return np.asarray(self.platform_radius_m * radial + side * self.rod_half_spacing_m * along)

    @cached_property
    def _home_height_m(self) -> Array:
        return self._carriage_height(np.asarray(self.home_m))

    def carriages(self, platform_m: ArrayLike, *, check_travel: bool = True) -> Array:
        """Compute the carriages of a platform position.

        Args:
            platform_m: (3,) in the base's frame.
            check_travel: reject carriages outside their travel.

        Returns:
            Carriage coordinates (3,), m, zero at home.

        Raises:
            KinematicsError: the rods don't reach, or a carriage leaves its travel.

        """
        q = self._carriage_height(np.asarray(platform_m, dtype=float)) - self._home_height_m
        if check_travel and np.any(np.abs(q) > self.carriage_travel_m):
            worst = int(np.argmax(np.abs(q)))
            raise KinematicsError(
                f"carriage {worst + 1} would stand at {q[worst]:+.4f} m, outside its travel of "
                f"+-{self.carriage_travel_m} m"
            )
        return q

    def platform(self, carriages_m: ArrayLike) -> Array:
        """Compute the platform position above the carriages.

        The platform lies on three spheres of radius L about (R u_i, c_i). Differences of the
        spheres' equations are linear in p and leave a quadratic along one line.

        Args:
            carriages_m: carriage coordinates (3,), zero at home.

        Returns:
            Position (3,), m, in the base's frame.

        Raises:
            KinematicsError: the spheres don't meet.

        """
        heights = np.asarray(carriages_m, dtype=float) + self._home_height_m
        centres = np.column_stack([self.feet_m, heights])
        # 2 (s_i - s_0) . p = |s_i|^2 - |s_0|^2: p_xy = a + b z
        matrix = 2.0 * (centres[1:, :2] - centres[0, :2])
        right = np.sum(centres[1:] ** 2, axis=1) - np.sum(centres[0] ** 2)
        slope = np.linalg.solve(matrix, -2.0 * (centres[1:, 2] - centres[0, 2]))
        offset = np.linalg.solve(matrix, right) - centres[0, :2]
        a = slope @ slope + 1.0
        b = slope @ offset - centres[0, 2]
        c = offset @ offset + centres[0, 2] ** 2 - self.rod_length_m**2
        root = b * b - a * c
        if root < 0.0:
            raise KinematicsError(
                f"no platform position belongs to carriages at {np.asarray(carriages_m)} m"
            )
        z = (-b + np.sqrt(root)) / a
        return np.append(offset + centres[0, :2] + slope * z, z)

    def jacobian(self, platform_m: ArrayLike) -> Array:
        """Compute dq/dp: row i is n_i / n_iz, since the rods keep their length.

        Args:
            platform_m: p (3,) in the base's frame.

        Returns:
            (3, 3): carriage by platform velocities.

        Raises:
            KinematicsError: the rods don't reach.

        """
        directions = self.rod_directions(platform_m)
        return directions / directions[:, 2:]

    def rod_directions(self, platform_m: ArrayLike) -> Array:
        """Compute the rods' unit vectors n_i from carriage to platform.

        Args:
            platform_m: p (3,) in the base's frame.

        Returns:
            (3, 3), a row a leg, in the base's frame.

        Raises:
            KinematicsError: the rods don't reach.

        """
        p = np.asarray(platform_m, dtype=float)
        carriage = np.column_stack([self.feet_m, self._carriage_height(p)])
        return (p - carriage) / self.rod_length_m

    def rod_rows(self, platform_m: ArrayLike) -> Array:
        """Compute A, a row [n, B x n] a rod: its lengthening over the platform's twist.

        Args:
            platform_m: p (3,) in the base's frame.

        Returns:
            (6, 6), rods in the order of `ball_joints_m`; the twist is the platform centre's, (m,
            rad), in the base's frame.

        Raises:
            KinematicsError: the rods don't reach.

        """
        directions = np.repeat(self.rod_directions(platform_m), 2, axis=0)
        return np.hstack([directions, np.cross(self.ball_joints_m, directions)])

    def platform_stiffness(self, platform_m: ArrayLike) -> Array:
        """Compute K_p, the stiffness at the platform's centre.

        Args:
            platform_m: p (3,) in the base's frame.

        Returns:
            (6, 6): wrench (N, N.m) over twist (m, rad), in the base's frame.

        Raises:
            KinematicsError: the rods don't reach.

        """
        rows = self.rod_rows(platform_m)
        carriage = np.zeros((6, 3))
        carriage[np.arange(6), np.repeat(np.arange(3), 2)] = rows[:, 2]
        flexibility = (
            np.eye(6) / self.rod_stiffness + carriage @ carriage.T / self.carriage_stiffness
        )
        return np.asarray(rows.T @ np.linalg.solve(flexibility, rows))

    def _carriage_height(self, platform: Array) -> Array:
        squared = self.rod_length_m**2 - np.sum((platform[:2] - self.feet_m) ** 2, axis=1)
        if np.any(squared <= 0.0):
            leg = int(np.argmin(squared))
            raise KinematicsError(
                f"rod {leg + 1} does not reach a platform at "
                f"({platform[0]:.4f}, {platform[1]:.4f}, {platform[2]:.4f}) m"
            )
        return np.asarray(platform[2] - np.sqrt(squared))
