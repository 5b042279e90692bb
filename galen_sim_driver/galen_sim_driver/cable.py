"""A cable that pulls at the tool: from a point on it to an anchor in base_link.

    T(d) = s ln(1 + exp((T_1 + k (d - d_home)) / s)),   s = T_home / 4

is the tension at a distance d from attachment to anchor: a spring of stiffness k where the cable is
taut, nothing where it is slack, with a rounded corner between, as a sagging cord has it; T_1 is
such that T(d_home) = T_home. The cord is bent where it leaves the tool: at home it lies straight,
and where its direction l in ft_sensor is another than n at home, it turns the tool back to it by
M = B n x l. A cable without weight, free to turn at its anchor, passes that moment on as a force
across itself, so that all of it together has no moment about the anchor:

    f = T l + (M x l) / d,    tau = r x f + M     about the sensor's origin, r to the attachment.

Cables on real arms have weight and friction and lie against things as well. None of that is here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from galen_sim_driver.config import CableConfig
from galen_sim_driver.geometry import (
    ArmGeometry,
    Matrix,
    Vector,
    cross,
    rotate_back,
    sensor_matrix,
)

_CORNER = 0.25
"""s over the tension at home."""


class Cable:
    """The wrench of a cable at the tool, for one arm."""

    def __init__(self, config: CableConfig, geometry: ArmGeometry, home: Sequence[float]) -> None:
        """`config` must be on; home (5,): the joints where the tension is `tension_n`."""
        config.validate()
        self._config = config
        self._geometry = geometry
        self._corner = _CORNER * config.tension_n
        self._taut = self._corner * math.log(math.expm1(1.0 / _CORNER))
        self._home_m, self._home_direction = self._line(sensor_matrix(home[3], home[4]), home)

    def wrench(self, matrix: Matrix, joints: Sequence[float]) -> list[float]:
        """Force and torque (6,) about the sensor's origin in ft_sensor, N and N.m.

        joints (5,): m, rad. matrix: R_base_sensor.
        """
        distance_m, direction = self._line(matrix, joints)
        tension = self._tension(distance_m)
        bend = self._config.bending_nm
        moment = [bend * value for value in cross(self._home_direction, direction)]
        shear = cross(moment, direction)
        # Nearer than this the line has no direction any more; the cable is slack there.
        span_m = max(distance_m, 0.01)
        force = [tension * direction[k] + shear[k] / span_m for k in range(3)]
        lever = cross(self._config.attachment_m, force)
        return force + [lever[k] + moment[k] for k in range(3)]

    def _tension(self, distance_m: float) -> float:
        stretch = self._taut + self._config.stiffness_n_m * (distance_m - self._home_m)
        exponent = stretch / self._corner
        # ln(1 + e^x) without overflow.
        return self._corner * (max(exponent, 0.0) + math.log1p(math.exp(-abs(exponent))))

    def _line(self, matrix: Matrix, joints: Sequence[float]) -> tuple[float, Vector]:
        """Distance (m) from attachment to anchor, and the direction there in ft_sensor."""
        at = self._geometry.tip_position(joints, matrix, self._config.attachment_m)
        x, y, z = (a - b for a, b in zip(self._config.anchor_m, at, strict=True))
        distance_m = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / max(distance_m, 1e-9)
        return distance_m, rotate_back(matrix, (x * scale, y * scale, z * scale))
