# SPDX-License-Identifier: Apache-2.0
"""What a load at the wrist reads: the nominal measurement model.

A load of mass m with its centre at p (ft_sensor) reads, about the sensor's origin,

    f = m R^T g,   tau = p x f,

which is linear in (m, h) with the first moment h = m p:  tau = h x (R^T g) = -(R^T g)^ h.

    reading = W(q; tool) + W(q; adapter) - W(q_zero; adapter) + applied + noise

Source: the 2019 report's section 2.3 as corrected for its eqs. (3) and (7): the zeroing happened
at q_zero, so its term holds R(q_zero) on both sides.

The simulator starts with the two tools and the adapter at the end.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.rotation import skew


@dataclass(frozen=True)
class Load:
    """A rigid load: mass (kg) and centre of mass (3,) in ft_sensor (m)."""

    mass_kg: float
    com_m: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def moments(self) -> Array:
        """(4,): mass (kg) and first moment m p (kg.m), in which the model is linear."""
        return np.concatenate([[self.mass_kg], self.mass_kg * np.asarray(self.com_m, dtype=float)])


@dataclass(frozen=True)
class LoadEstimate:
    """A load and the covariance (4, 4) of (mass, centre): kg and m."""

    mass_kg: float
    com_m: Array
    covariance: Array

    @property
    def load(self) -> Load:
        """The load without its uncertainty."""
        return Load(self.mass_kg, self.com_m)

    @property
    def mass_std_kg(self) -> float:
        """Standard deviation of the mass."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def com_std_m(self) -> Array:
        """Standard deviations (3,) of the centre."""
        return np.sqrt(np.diag(self.covariance)[1:])


def gravity_regressor(gravity_sensor: ArrayLike) -> Array:
    """Compute G with W = G (m, h).

    Args:
        gravity_sensor: (..., 3) along ft_sensor's axes, m/s^2.

    Returns:
        G (..., 6, 4), which takes kg and kg.m to N and N.m in ft_sensor.

    """
    gravity = np.asarray(gravity_sensor, dtype=float)
    regressor = np.zeros((*gravity.shape[:-1], 6, 4))
    regressor[..., :3, 0] = gravity
    regressor[..., 3:, 1:] = -skew(gravity)
    return regressor


def gravity_wrench(gravity_sensor: ArrayLike, load: Load) -> Array:
    """Compute the wrench of a load's weight about the sensor's origin.

    Args:
        gravity_sensor: (..., 3) along ft_sensor's axes, m/s^2.
        load: mass and centre in ft_sensor.

    Returns:
        W (..., 6), N and N.m in ft_sensor.

    """
    gravity = np.asarray(gravity_sensor, dtype=float)
    force = load.mass_kg * gravity
    return np.concatenate([force, np.cross(np.asarray(load.com_m, dtype=float), force)], axis=-1)


def nominal_reading(
    angles: ArrayLike,
    tool: Load,
    adapter: Load,
    zero_angles: ArrayLike | None = None,
    *,
    arm: Arm,
) -> Array:
    """Compute the reading without contact and noise.

    Args:
        angles: (..., k) of the arm's turning joints, rad.
        tool: what is mounted after zeroing.
        adapter: what was on the sensor when it was zeroed, and stays.
        zero_angles: (k,) of the pose in which the sensor was zeroed, rad; None: home.
        arm: whose joints they are.

    Returns:
        Reading (..., 6), N and N.m in the sensor's frame.

    """
    gravity = arm.gravity_in_sensor(angles)
    at_zero = gravity_wrench(arm.gravity_in_sensor(zero_angles), adapter)
    return gravity_wrench(gravity, tool) + gravity_wrench(gravity, adapter) - at_zero


@dataclass(frozen=True)
class ToolGeometry:
    """A tool's load and its tip (3,) in ft_sensor, m."""

    load: Load
    tip_m: Array


ADAPTER = Load(0.100, np.array([0.0, 0.0, 0.020]))
"""The bias load: what stays on the sensor when no tool is on."""

TOOLS = {
    "pointer": ToolGeometry(
        Load(0.060, np.array([0.055, 0.002, 0.045])), np.array([0.150, 0.0, 0.050])
    ),
    "retractor": ToolGeometry(
        Load(0.200, np.array([0.070, -0.010, 0.055])), np.array([0.180, 0.010, 0.050])
    ),
}
