# SPDX-License-Identifier: Apache-2.0
"""Still readings as a set-up reports them, and the load that fits to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.estimation.least_squares import least_squares
from galen_model.load.readings import StillPoses
from galen_model.rotation import skew

FARTHEST_CENTRE_M = 1.0
"""No tool that a wrist carries has its centre further from the sensor."""

_KEPT = 0.85  # share of the poses that a fit keeps, where there are enough: some were touched
_FEWEST_TO_TRIM = 12
_SURE = 3.0  # standard deviations
_LEAST_DEVIATION = 0.02  # of how readings change


@dataclass(frozen=True)
class StillReadings:
    """Readings of n still poses, as reported.

    Attributes:
        wrench: (n, 6), N and N.m, taken to be in the sensor's frame.
        gravity: (n, 3) in the sensor's frame, m/s^2, according to the set-up.
        arm: whose sensor it is.
        rotation: R_base_sensor (n, 3, 3) according to the set-up, or None where only gravity is.
        angles: (n, k) of the arm's turning joints as reported, rad, or None.

    """

    wrench: Array
    gravity: Array
    arm: Arm
    rotation: Array | None = None
    angles: Array | None = None

    @staticmethod
    def of_poses(poses: StillPoses) -> StillReadings:
        """Make the readings of a sweep.

        Args:
            poses: the sweep.

        Returns:
            Its readings, with angles and rotations.

        """
        return at_angles(poses.wrench, poses.angles, poses.arm)

    def turned(self, rotation: Array) -> StillReadings:
        """Change the orientations; gravity in the sensor follows.

        Args:
            rotation: R_base_sensor (n, 3, 3).

        Returns:
            The readings there; the angles stay.

        """
        gravity = np.einsum("nji,j->ni", rotation, self.arm.gravity_m_s2)
        return replace(self, rotation=rotation, gravity=gravity)

    def under(self, gravity_m_s2: Array) -> StillReadings:
        """Change gravity in the base; gravity in the sensor follows.

        Args:
            gravity_m_s2: (3,) in the base's frame.

        Returns:
            The readings under it.

        """
        assert self.rotation is not None
        gravity = np.einsum("nji,j->ni", self.rotation, gravity_m_s2)
        return replace(self, gravity=gravity, arm=replace(self.arm, gravity_m_s2=gravity_m_s2))

    def mapped(self, force: Array, torque: Array) -> StillReadings:
        """Map forces and torques.

        Args:
            force: (3, 3) or (n, 3, 3), applied to forces from the left.
            torque: (3, 3) or (n, 3, 3), applied to torques from the left.

        Returns:
            The readings with other wrenches.

        """
        parts = [
            np.einsum("...ij,...j->...i", matrix, part)
            for matrix, part in ((force, self.wrench[:, :3]), (torque, self.wrench[:, 3:]))
        ]
        return replace(self, wrench=np.concatenate(parts, axis=1))


def at_angles(wrench: Array, angles: Array, arm: Arm) -> StillReadings:
    """Make readings of the turning joints' angles.

    Args:
        wrench: (n, 6), N and N.m.
        angles: (n, k), rad.
        arm: whose joints they are.

    Returns:
        The readings, with gravity and rotation by the arm.

    """
    return StillReadings(wrench, arm.gravity_in_sensor(angles), arm, arm.rotation(angles), angles)


@dataclass(frozen=True)
class LoadFit:
    """One load and a constant bias, fitted to still readings.

    Attributes:
        mass_kg: negative where forces go against gravity.
        mass_std_kg: its standard deviation.
        moment_kgm: (3,) first moment, mass times centre, in the sensor's frame.
        moment_std_kgm: (3,) its standard deviation.
        residual: (2,) root mean square of forces, N, and torques, N.m, by degree of freedom.
        change: (2,) root mean square of the readings' changes about their means.

    """

    mass_kg: float
    mass_std_kg: float
    moment_kgm: Array
    moment_std_kgm: Array
    residual: Array
    change: Array

    @property
    def com_m(self) -> Array:
        """Centre (3,) in the sensor's frame, m."""
        return np.asarray(self.moment_kgm / (self.mass_kg or 1e-12))

    @property
    def fault(self) -> str:
        """Say why no wrist carries this load, beyond doubt; empty where one may."""
        if self.mass_kg <= -_SURE * self.mass_std_kg:
            return f"the load that fits has the mass {self.mass_kg * 1e3:.0f} g"
        at_least = float(
            np.linalg.norm(self.moment_kgm) - _SURE * np.linalg.norm(self.moment_std_kgm)
        )
        if at_least > FARTHEST_CENTRE_M * (abs(self.mass_kg) + _SURE * self.mass_std_kg):
            distance_m = float(np.linalg.norm(self.com_m))
            return f"the centre of the load that fits is {distance_m:.3g} m from the sensor"
        return ""

    @property
    def relative(self) -> Array:
        """(2,): residual over change, 1 where nothing of the change is explained."""
        return self.residual / np.maximum(self.change, 1e-12)


def fit_load(readings: StillReadings, further: int = 0) -> LoadFit:
    """Fit one load and a constant bias by least squares, the poses furthest off left out.

    f = m g + b_f and tau = -[g]x h + b_tau, with g in the sensor's frame and h = m p (see
    `load.model`), each by itself, so that a wrong unit of one does not reach the other.

    Args:
        readings: n still poses.
        further: how many parameters were fitted before (a direction of gravity has 2).

    Returns:
        The load, with residuals of the poses that the fit kept.

    """
    count = len(readings.wrench)
    force, torque = readings.wrench[:, :3], readings.wrench[:, 3:]
    force_design = np.zeros((count, 3, 4))
    force_design[:, :, 0] = readings.gravity
    force_design[:, :, 1:] = np.eye(3)
    torque_design = np.zeros((count, 3, 6))
    torque_design[:, :, :3] = -skew(readings.gravity)
    torque_design[:, :, 3:] = np.eye(3)
    rows = np.ones(count, dtype=bool)
    for _ in range(2 if count >= _FEWEST_TO_TRIM else 1):
        mass = least_squares(force_design[rows], force[rows]).values
        moment = least_squares(torque_design[rows], torque[rows]).values
        force_left, torque_left = force - force_design @ mass, torque - torque_design @ moment
        squares = [np.sum(left**2, axis=1) for left in (force_left, torque_left)]
        sizes = [max(float(np.median(square)), 1e-300) for square in squares]
        distance = squares[0] / sizes[0] + squares[1] / sizes[1]
        kept = rows
        rows = distance <= np.quantile(distance, _KEPT)
    force_residual, force_change, mass_std = _spread(force_design, force, force_left, kept, further)
    torque_residual, torque_change, moment_std = _spread(
        torque_design, torque, torque_left, kept, further
    )
    return LoadFit(
        float(mass[0]),
        float(mass_std[0]),
        moment[:3],
        moment_std[:3],
        np.array([force_residual, torque_residual]),
        np.array([force_change, torque_change]),
    )


def _spread(
    design: Array, values: Array, left: Array, rows: np.ndarray, further: int
) -> tuple[float, float, Array]:
    """Return residual and change, root mean square, and the parameters' deviations (p,)."""
    width = design.shape[-1]
    freedom = max(3 * int(rows.sum()) - width - further, 1)
    residual = float(np.sqrt(np.sum(left[rows] ** 2) / freedom))
    change = float(np.sqrt(np.mean((values[rows] - values[rows].mean(axis=0)) ** 2)))
    used = design[rows].reshape(-1, width)
    # Few poses may fit by chance.
    deviation = max(residual, _LEAST_DEVIATION * change)
    return residual, change, deviation * np.sqrt(np.diag(np.linalg.pinv(used.T @ used)))
