"""The linear delta: three vertical carriages carry a platform on three pairs of rods.

With u_i = (cos theta_i, sin theta_i), R = rail radius - platform radius and L the rods' length,
carriage i stands at  c_i = z - sqrt(L^2 - |p_xy - R u_i|^2)  above the base plane; the carriage
coordinate is q_i = c_i - c_i(home). The rods' directions are n_i = (p - (R u_i, c_i)) / L.
The two rods of a leg hold the platform at B = r u_i +- h (-sin theta_i, cos theta_i, 0).
"""

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import GALEN, HOME, ArmParameters
from galen_model.arrays import Array
from galen_model.errors import KinematicsError


def ball_joints(arm: ArmParameters = GALEN) -> Array:
    """B (6, 3), m: where rods hold the platform, from its centre; rows 2 i and 2 i + 1 are leg i's.

    They lie in the platform's plane, whose axes are those of base_link.
    """
    angles = np.repeat(arm.leg_angles_rad, 2)
    side = np.tile([1.0, -1.0], len(arm.leg_angles_rad))[:, None]
    radial = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    along = np.stack([-np.sin(angles), np.cos(angles), 0.0 * angles], axis=1)
    return np.asarray(arm.platform_radius_m * radial + side * arm.rod_half_spacing_m * along)


class LinearDelta:
    """Inverse and forward kinematics and Jacobian; positions in base_link, m."""

    def __init__(self, arm: ArmParameters = GALEN) -> None:
        """Take the geometry from `arm`; the carriages' zero is at home."""
        self._arm = arm
        angles = np.asarray(arm.leg_angles_rad)
        self._feet = arm.delta_radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self._home_height = self._carriage_height(HOME[:3])

    def carriages(self, platform_m: ArrayLike, *, check_travel: bool = True) -> Array:
        """Carriage coordinates (3,), m, of a platform position (3,).

        Raises KinematicsError where the rods don't reach, or a carriage leaves its travel.
        """
        q = self._carriage_height(np.asarray(platform_m, dtype=float)) - self._home_height
        if check_travel and np.any(np.abs(q) > self._arm.carriage_travel_m):
            worst = int(np.argmax(np.abs(q)))
            raise KinematicsError(
                f"carriage {worst + 1} would stand at {q[worst]:+.4f} m, outside its travel of "
                f"+-{self._arm.carriage_travel_m} m"
            )
        return q

    def platform(self, carriages_m: ArrayLike) -> Array:
        """Platform position (3,), m, above the carriages, from carriage coordinates (3,).

        The platform lies on three spheres of radius L about (R u_i, c_i). Differences of the
        spheres' equations are linear in p and leave a quadratic along one line.

        Raises KinematicsError where the spheres don't meet.
        """
        heights = np.asarray(carriages_m, dtype=float) + self._home_height
        centres = np.column_stack([self._feet, heights])
        # 2 (s_i - s_0) . p = |s_i|^2 - |s_0|^2: p_xy = a + b z
        matrix = 2.0 * (centres[1:, :2] - centres[0, :2])
        right = np.sum(centres[1:] ** 2, axis=1) - np.sum(centres[0] ** 2)
        slope = np.linalg.solve(matrix, -2.0 * (centres[1:, 2] - centres[0, 2]))
        offset = np.linalg.solve(matrix, right) - centres[0, :2]
        a = slope @ slope + 1.0
        b = slope @ offset - centres[0, 2]
        c = offset @ offset + centres[0, 2] ** 2 - self._arm.rod_length_m**2
        root = b * b - a * c
        if root < 0.0:
            raise KinematicsError(
                f"no platform position belongs to carriages at {np.asarray(carriages_m)} m"
            )
        z = (-b + np.sqrt(root)) / a
        return np.append(offset + centres[0, :2] + slope * z, z)

    def jacobian(self, platform_m: ArrayLike) -> Array:
        """dq/dp (3, 3): row i is n_i / n_iz, since the rods keep their length."""
        directions = self.rod_directions(platform_m)
        return directions / directions[:, 2:]

    def rod_directions(self, platform_m: ArrayLike) -> Array:
        """Unit vectors n_i (3, 3; a row a leg) from carriage to platform."""
        p = np.asarray(platform_m, dtype=float)
        carriage = np.column_stack([self._feet, self._carriage_height(p)])
        return (p - carriage) / self._arm.rod_length_m

    def rod_rows(self, platform_m: ArrayLike) -> Array:
        """A (6, 6): a rod a row, [n, B x n]; lengthening of the rods over the platform's twist.

        The twist is that of the platform's centre, (m, rad) in base_link; rods as in `ball_joints`.
        """
        directions = np.repeat(self.rod_directions(platform_m), 2, axis=0)
        return np.hstack([directions, np.cross(ball_joints(self._arm), directions)])

    def _carriage_height(self, platform: Array) -> Array:
        squared = self._arm.rod_length_m**2 - np.sum((platform[:2] - self._feet) ** 2, axis=1)
        if np.any(squared <= 0.0):
            leg = int(np.argmin(squared))
            raise KinematicsError(
                f"rod {leg + 1} does not reach a platform at "
                f"({platform[0]:.4f}, {platform[1]:.4f}, {platform[2]:.4f}) m"
            )
        return np.asarray(platform[2] - np.sqrt(squared))
