"""The springs' Jacobian, and the wrench at the tip, of one pose: what a live stream asks for.

The same mathematics as for many poses (`galen_deflection.springs.springs`), in plain floats: for
one pose nearly all the time of an array's operation is the call, and there would be fifty of them.

The platform's matrix A (6, 6) needs no general inverse. The rods a and b of leg i are parallel,
along n_i, and end at B_a and B_b. Of their lengthening e_a, e_b, the platform's twist (v, w) is

    (dB_i x n_i) . w = e_a - e_b,                dB_i = B_a - B_b
    n_i . v + (mB_i x n_i) . w = (e_a + e_b)/2,  mB_i = (B_a + B_b)/2,

two systems of three. With N, M, Q (3, 3) of rows n_i, dB_i x n_i, mB_i x n_i, and S = N^-1,
T = M^-1, P = S Q T, a unit of lengthening of rod a or b (upper sign: a) moves the centre by

    w = +- T_i,   v = S_i / 2 -+ P_i     (columns i),

and a unit of carriage i, by both rods, n_iz S_i without turning it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from galen_model.arm.galen import GALEN, ArmParameters
from galen_model.arrays import Array

Vector = tuple[float, float, float]


def tip_wrench_at(joints: Sequence[float], wrench: Sequence[float], tip_m: Vector) -> Array:
    """Wrench (1, 6) at the tip in base_link, of ft_sensor's (6,) at joints (5,).

    f_tip = R f, t_tip = R (t - tip x f), R = Rx(roll) Ry(tilt + pi/2).
    """
    fx, fy, fz, tx, ty, tz = wrench
    x, y, z = tip_m
    tx, ty, tz = tx - (y * fz - z * fy), ty - (z * fx - x * fz), tz - (x * fy - y * fx)
    cos_r, sin_r = math.cos(joints[3]), math.sin(joints[3])
    # of tilt + pi/2
    cos_t, sin_t = -math.sin(joints[4]), math.cos(joints[4])
    f_down, t_down = cos_t * fz - sin_t * fx, cos_t * tz - sin_t * tx
    return np.array(
        [
            [
                cos_t * fx + sin_t * fz,
                cos_r * fy - sin_r * f_down,
                sin_r * fy + cos_r * f_down,
                cos_t * tx + sin_t * tz,
                cos_r * ty - sin_r * t_down,
                sin_r * ty + cos_r * t_down,
            ]
        ]
    )


class SpringsAt:
    """J (6, 11) of one pose after another, as `galen_deflection.springs.springs.Springs` has it."""

    def __init__(self, beyond_tilt_m: Array, arm: ArmParameters = GALEN) -> None:
        """beyond_tilt_m (3,): from the tilt axis to the tip at tilt zero."""
        self._delta = arm.delta
        angles = arm.leg_angles_rad
        self._feet = [
            (arm.delta_radius_m * math.cos(angle), arm.delta_radius_m * math.sin(angle))
            for angle in angles
        ]
        self._length = arm.rod_length_m
        balls = arm.delta.ball_joints_m
        self._apart = [vector(row) for row in balls[0::2] - balls[1::2]]
        self._middle = [vector(row) for row in 0.5 * (balls[0::2] + balls[1::2])]
        self._from_centre = vector(arm.platform_to_roll_m)
        self._to_tilt = vector(arm.roll_to_tilt_m)
        self._beyond_tilt = vector(beyond_tilt_m)

    def __call__(self, joints: Sequence[float]) -> tuple[Array, Array]:
        """J (6, 11) and the lever (3,) from the platform's centre to the tip, base_link.

        joints (5,). Raises KinematicsError where the rods don't reach.
        """
        cos_r, sin_r = math.cos(joints[3]), math.sin(joints[3])
        cos_t, sin_t = math.cos(joints[4]), math.sin(joints[4])
        ax, ay, az = self._beyond_tilt
        # From the tilt axis, and from the roll axis, to the tip: before roll turns them.
        x, y, z = cos_t * ax + sin_t * az, ay, cos_t * az - sin_t * ax
        tilt_y, tilt_z = cos_r * y - sin_r * z, sin_r * y + cos_r * z
        vx, vy, vz = self._to_tilt
        roll_x, y, z = x + vx, y + vy, z + vz
        roll_y, roll_z = cos_r * y - sin_r * z, sin_r * y + cos_r * z
        ux, uy, uz = self._from_centre
        lever = (roll_x + ux, roll_y + uy, roll_z + uz)

        n = self._directions(joints)
        s = _inverse(*n)
        t = _inverse(*(_cross(apart, each) for apart, each in zip(self._apart, n, strict=True)))
        q = [_cross(middle, each) for middle, each in zip(self._middle, n, strict=True)]
        columns = [
            (0.0, -roll_z, roll_y, 1.0, 0.0, 0.0),
            (cos_r * tilt_z - sin_r * tilt_y, sin_r * x, -cos_r * x, 0.0, cos_r, sin_r),
        ]
        rods = []
        for i in range(3):
            sx, sy, sz = s[i]
            up = n[i][2]
            columns.append((up * sx, up * sy, up * sz, 0.0, 0.0, 0.0))
            w = t[i]
            # P's column: S (Q w), S by its columns
            (ax, ay, az), (bx, by, bz), (cx, cy, cz) = s
            q0, q1, q2 = (_dot(row, w) for row in q)
            px = ax * q0 + bx * q1 + cx * q2
            py = ay * q0 + by * q1 + cy * q2
            pz = az * q0 + bz * q1 + cz * q2
            # of the tip: v + w x lever
            wx, wy, wz = _cross(w, lever)
            px, py, pz = px - wx, py - wy, pz - wz
            hx, hy, hz = 0.5 * sx, 0.5 * sy, 0.5 * sz
            rods.append((hx - px, hy - py, hz - pz, *w))
            rods.append((hx + px, hy + py, hz + pz, -w[0], -w[1], -w[2]))
        return np.array(columns + rods).T, np.array(lever)

    def _directions(self, joints: Sequence[float]) -> list[Vector]:
        """n_i from carriage to platform, a leg each."""
        px, py, length = joints[0], joints[1], self._length
        out = []
        for foot_x, foot_y in self._feet:
            x, y = px - foot_x, py - foot_y
            squared = length * length - x * x - y * y
            if squared <= 0.0:
                self._delta.rod_directions(joints[:3])  # says which rod does not reach
            out.append((x / length, y / length, math.sqrt(squared) / length))
        return out


def vector(values: Array) -> Vector:
    """Three numbers as plain floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _cross(a: Vector, b: Vector) -> Vector:
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _inverse(a: Vector, b: Vector, c: Vector) -> tuple[Vector, Vector, Vector]:
    """Columns of the inverse of the matrix with rows a, b, c: b x c, c x a, a x b over its det."""
    first, second, third = _cross(b, c), _cross(c, a), _cross(a, b)
    scale = 1.0 / _dot(a, first)
    return (
        (first[0] * scale, first[1] * scale, first[2] * scale),
        (second[0] * scale, second[1] * scale, second[2] * scale),
        (third[0] * scale, third[1] * scale, third[2] * scale),
    )
