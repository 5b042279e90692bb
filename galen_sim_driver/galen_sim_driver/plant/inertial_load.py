"""Forces of acceleration: what a load that moves with the wrist reads beside its weight.

Newton and Euler for a rigid load of mass m, first moment h = m c and inertia I_O about the
sensor's origin O, all in ft_sensor, which turns at w and al and whose origin accelerates by a
(e.g. Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 7.3):

    f   = m (g - a) - al x h - w x (w x h)
    tau = h x (g - a) - I_O al - w x (I_O w)

about O, positive as the sensor reads a weight. The plant adds the part without g.

The sensor's motion, in base_link: the platform's acceleration, then the roll link that turns about
x, then the tilt link whose axis y' = Rx(roll) y is carried along:

    w1 = roll' x,  al1 = roll'' x          w = w1 + tilt' y',  al = al1 + tilt'' y' + w1 x tilt' y'
    a  = delta'' + al1 x A + w1 x (w1 x A) + al x B + w x (w x B)

with A from roll axis to tilt axis and B from tilt axis to sensor.

Velocities and accelerations are the plant's own: central differences of its positions, a period
before and after the stamp. For that the plant's motion runs a period ahead of what it tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from galen_model.arrays import Array
from galen_model.load.model import Load

from galen_sim_driver.plant.geometry import (
    ArmGeometry,
    Matrix,
    Vector,
    cross,
    rotate,
    rotate_back,
)

_ORIGIN = (0.0, 0.0, 0.0)


def inertia_about_origin(load: Load, about_com: Sequence[float]) -> Array:
    """Inertia (3, 3) about the sensor's origin, kg.m^2: I_c + m (c.c 1 - c c^T).

    about_com: entries xx yy zz xy xz yz of the tensor I_c about the load's own centre c.
    """
    xx, yy, zz, xy, xz, yz = about_com
    own = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    com = np.asarray(load.com_m, dtype=float)
    return own + load.mass_kg * (com @ com * np.eye(3) - np.outer(com, com))


class InertialLoad:
    """The wrench that motion adds to the reading, for one arm."""

    def __init__(self, geometry: ArmGeometry) -> None:
        self._geometry = geometry

    def wrench(
        self,
        matrix: Matrix,
        joints: Sequence[float],
        velocities: Sequence[float],
        accelerations: Sequence[float],
        mass: float,
        moment: Sequence[float],
        inertia: Matrix,
    ) -> list[float]:
        """Force and torque (6,) about the sensor's origin in ft_sensor, N and N.m.

        joints, velocities, accelerations (5,): m, rad and s. matrix: R_base_sensor. mass (kg),
        moment m c (3,) and inertia about the sensor's origin in ft_sensor.
        """
        w, al, a = self.sensor_motion(matrix, joints, velocities, accelerations)
        turn = cross(w, cross(w, moment))
        swing = cross(al, moment)
        lift = cross(moment, a)
        spin = rotate(inertia, al)
        gyro = cross(w, rotate(inertia, w))
        return [-mass * a[k] - swing[k] - turn[k] for k in range(3)] + [
            -lift[k] - spin[k] - gyro[k] for k in range(3)
        ]

    def sensor_motion(
        self,
        matrix: Matrix,
        joints: Sequence[float],
        velocities: Sequence[float],
        accelerations: Sequence[float],
    ) -> tuple[Vector, Vector, Vector]:
        """Angular velocity and acceleration, and the origin's acceleration, in ft_sensor, SI."""
        from_roll, from_tilt = self._geometry.arms_to_tip(joints, matrix, _ORIGIN)
        _, ay, az = (whole - part for whole, part in zip(from_roll, from_tilt, strict=True))
        # The column of R_base_sensor along the sensor's y is the tilt axis (the tilt turns about
        # it): (0, cos roll, sin roll).
        cos_roll, sin_roll = matrix[4], matrix[7]
        roll_v, tilt_v = velocities[3], velocities[4]
        roll_a, tilt_a = accelerations[3], accelerations[4]
        w = (roll_v, tilt_v * cos_roll, tilt_v * sin_roll)
        al = (
            roll_a,
            tilt_a * cos_roll - roll_v * tilt_v * sin_roll,
            tilt_a * sin_roll + roll_v * tilt_v * cos_roll,
        )
        swing = cross(al, from_tilt)
        turn = cross(w, cross(w, from_tilt))
        a = (
            accelerations[0] + swing[0] + turn[0],
            accelerations[1] - roll_a * az - roll_v * roll_v * ay + swing[1] + turn[1],
            accelerations[2] + roll_a * ay - roll_v * roll_v * az + swing[2] + turn[2],
        )
        return rotate_back(matrix, w), rotate_back(matrix, al), rotate_back(matrix, a)
