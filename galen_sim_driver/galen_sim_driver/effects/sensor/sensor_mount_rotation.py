"""The sensing element is turned in its housing; the tool isn't (contract, section 6).

With E = exp(r) the element's axes in ft_sensor it tells f and tau along its own axes, E^T f and
E^T tau, about the same origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_model.rotation import rotvec_to_matrix
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants


@dataclass(frozen=True)
class SensorMountRotation(Effect):
    """reading = exp(`rotvec_rad`)^T of force and of torque."""

    name: ClassVar[str] = "sensor_mount_rotation"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("rotvec_rad", "rad", 0.01, -0.5, 0.5, 3),)
    order: ClassVar[int] = 0

    rotvec_rad: tuple[float, ...] = param(
        (0.0,) * 3,
        "the sensing element is turned so in `ft_sensor`, rotation vector, rad",
        -0.5,
        0.5,
    )

    def read(self, when: Instants, wrench: Array) -> Array:
        """Along the element's axes: rows times E are E^T v."""
        return _turned(wrench, _matrix(tuple(self.rotvec_rad)))

    def unread(self, when: Instants, reading: Array) -> Array:
        """Back to ft_sensor's axes."""
        return _turned(reading, _matrix(tuple(self.rotvec_rad)).T)


@lru_cache(maxsize=256)
def _matrix(rotvec_rad: tuple[float, ...]) -> Array:
    return rotvec_to_matrix(rotvec_rad)


def _turned(wrench: Array, matrix: Array) -> Array:
    return np.concatenate([wrench[:, :3] @ matrix, wrench[:, 3:] @ matrix], axis=1)
