# SPDX-License-Identifier: Apache-2.0
"""An arm as springs in series: its elastic joints, and a delta's carriages and rods.

Contract section 2. A delta's platform stands on six rods with the square matrix A (6, 6) of their
rows, so that rod forces f = A^-T w hold a wrench w at its centre, and the rods' lengthening e moves
the centre by the twist A^-1 e. Rod j deflects by f_j / k_rod, and all rods of a carriage by the
carriage's (G^T f)_i / k_q times n_z: e = f / k_rod + G G^T f / k_q. Since A is square,

    C_p = K_p^-1 = A^-1 (I / k_rod + G G^T / k_q) A^-T

is linear in the compliances 1/k_rod and 1/k_q, where K_p = A^T (...)^-1 A is not. Taken to the
tip, and with the elastic joints beside it, this is a sum over all springs,

    deflection = sum_s J_s d_s,   d_s = c_s l_s,   l_s = J_s^T w_tip,

where J_s (6,) is what the tip does when the spring s deflects by one unit, and by virtual work also
what the wrench at the tip loads it with: moments about revolute joints (N.m; d in rad), forces of
prismatic joints, carriages and rods (N; d in m).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.rotation import skew

from galen_deflection.measurement.samples import DeflectionSamples

# An arm that stands while it is pushed reports a few joint vectors again and again, since its
# encoders have steps. Only a vector that is equal to the last bit gets what was calculated before.
_KEPT_POSES = 64

Vector = tuple[float, float, float]
Columns = tuple[Vector, Vector, Vector]


USUAL_COMPLIANCE = {"rad": 5e-4, "m": 3e-6}
"""1/k, rad/(N.m) and m/N, of a drive of which nothing is known: softer than most are (2000 N.m/rad
and 3e5 N/m, as estimated of the Galen; harmonic drives of industrial arms have 1e4 and more)."""


class Kind(NamedTuple):
    """Springs that share their parameters; `springs` are columns.

    compliance: the nominal, 0 of a joint whose stiffness is not known; compliance_std: how far the
    true one may be from it.
    """

    name: str
    springs: range
    compliance: float
    compliance_std: float
    load_unit: str
    compliance_unit: str


def elastic_joints(arm: Arm) -> list[int]:
    """Return the places of the joints that deflect: all but those that stand for a delta's rods.

    Args:
        arm: the arm whose joints they are.

    Returns:
        Indices of the arm's joints, increasing.

    """
    return list(range(0 if arm.delta is None else 3, len(arm.joints)))


def kinds(arm: Arm) -> tuple[Kind, ...]:
    """Return the elastic joints in their order, then a delta's carriages and rods.

    Args:
        arm: the arm; its nominal stiffnesses by name, N.m/rad and N/m.

    Returns:
        Kinds with nominal compliances 1/k in rad/(N.m) and m/N; their columns follow each other.

    """
    springs = [(arm.joint_names[k], 1, arm.units[k]) for k in elastic_joints(arm)]
    if arm.delta is not None:
        springs += [("carriage", 3, "m"), ("rod", 6, "m")]
    found, first = [], 0
    for name, size, unit in springs:
        units = ("N.m", "rad/(N.m)") if unit == "rad" else ("N", "m/N")
        compliance = 1.0 / arm.stiffness.get(name, np.inf)
        # A nominal stiffness is an estimate: the true one may well be twice as stiff, or half.
        std = compliance or USUAL_COMPLIANCE[unit]
        found.append(Kind(name, range(first, first + size), compliance, std, *units))
        first += size
    return tuple(found)


class Geometry(NamedTuple):
    """Of n joint vectors, in base_link.

    to_tip (n, 6, 6): takes wrenches from ft_sensor to the tip. jacobian (n, 6, s): the springs' J.
    lever (n, 3): from a delta's platform to the tip. tip: R (n, 3, 3) and position (n, 3), m.
    """

    to_tip: Array
    jacobian: Array
    lever: Array
    tip: tuple[Array, Array]


class Springs:
    """J of the tip, and the wrench there, for many joint vectors."""

    def __init__(self, tip_m: Array, arm: Arm) -> None:
        """tip_m (3,): in ft_sensor."""
        self._arm = arm
        self._tip_m = np.asarray(tip_m, dtype=float)
        self._elastic = elastic_joints(arm)
        self._turns = np.array([[float(k in arm.turning)] for k in self._elastic])
        self._chain = [
            (
                joint.kind == "revolute",
                _vector(joint.axis),
                _vector(joint.origin_m),
                None if joint.rotation is None else _columns(joint.rotation),
            )
            for joint in arm.joints
        ]
        self._end = _vector(arm.sensor_origin_m), _columns(arm.sensor_rotation), _vector(tip_m)
        if arm.delta is not None:
            self._delta = arm.delta
            self._balls = skew(arm.delta.ball_joints_m)
            first, second = arm.delta.ball_joints_m[0::2], arm.delta.ball_joints_m[1::2]
            self._apart = [_vector(row) for row in first - second]
            self._middle = [_vector(row) for row in 0.5 * (first + second)]
        # t_tip = R (t - tip x f)
        self._lever_to_tip = -skew(self._tip_m)
        self._single = lru_cache(maxsize=_KEPT_POSES)(self._calculate_single)

    def geometry(self, joints: Array) -> Geometry:
        """Return the geometry at some joints; calculated once for equal neighbours.

        Don't change it: it may be given again.

        Args:
            joints: (n, j) of float64, m and rad.

        Returns:
            The geometry of the n joint vectors, in base_link.

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
        if len(joints) == 1:
            return self._single(joints.tobytes())
        new = np.ones(len(joints), dtype=bool)
        new[1:] = np.any(joints[1:] != joints[:-1], axis=1)
        to_tip, jacobian, lever, (rotation, position) = self._calculate(joints[new])
        which = np.cumsum(new) - 1
        tip = rotation[which], position[which]
        return Geometry(to_tip[which], jacobian[which], lever[which], tip)

    def at_tip(self, joints: Array, wrench: Array) -> Array:
        """Return wrenches about the tip in base_link.

        Args:
            joints: (n, j), m and rad.
            wrench: (n, 6) in ft_sensor about its origin, N and N.m.

        Returns:
            (n, 6), N and N.m.

        """
        rotation = self._arm.tip_pose(joints, self._tip_m)[0]
        return np.asarray(np.matmul(self._to_tip(rotation), wrench[:, :, None])[:, :, 0])

    def _calculate_single(self, packed: bytes) -> Geometry:
        """As `_calculate`, of one joint vector's bytes: the arm's chain in plain floats."""
        joints = np.frombuffer(packed)
        turned: Columns = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        at = _ZERO
        origins, axes = [], []
        for value, (revolute, axis, origin, fixed) in zip(
            joints.tolist(), self._chain, strict=True
        ):
            at = _moved(at, turned, origin)
            if fixed is not None:
                turned = _product(turned, fixed)
            axes.append(_moved(_ZERO, turned, axis))
            if revolute:
                turned = _product(turned, _about(axis, value))
            else:
                x, y, z = axis
                at = _moved(at, turned, (value * x, value * y, value * z))
            origins.append(at)
        sensor, mount, tip = self._end
        at = _moved(at, turned, sensor)
        turned = _product(turned, mount)
        at = _moved(at, turned, tip)
        columns: list[tuple[float, ...]] = []
        for k in self._elastic:
            revolute = self._chain[k][0]
            linear = _cross(axes[k], _less(at, origins[k])) if revolute else axes[k]
            columns.append((*linear, *(axes[k] if revolute else _ZERO)))
        lever = _ZERO
        if self._arm.delta is not None:
            px, py, pz = joints[:3].tolist()
            lever = _less(at, (px, py, pz))
            columns += self._platform_columns(px, py, pz, lever)
        rotation = np.array([turned]).swapaxes(1, 2)
        return Geometry(
            self._to_tip(rotation),
            np.array([columns]).swapaxes(1, 2),
            np.array([lever]),
            (rotation, np.array([at])),
        )

    def _platform_columns(
        self, px: float, py: float, pz: float, lever: Vector
    ) -> list[tuple[float, ...]]:
        """As `_platform_springs`, of one position in plain floats.

        A needs no general inverse. The rods a and b of leg i are parallel, along n_i, and end at
        B_a and B_b. Of their lengthening e_a, e_b, the platform's twist (v, w) is

            (dB_i x n_i) . w = e_a - e_b,                dB_i = B_a - B_b
            n_i . v + (mB_i x n_i) . w = (e_a + e_b)/2,  mB_i = (B_a + B_b)/2,

        two systems of three. With N, M, Q (3, 3) of rows n_i, dB_i x n_i, mB_i x n_i, and S = N^-1,
        T = M^-1, P = S Q T, a unit of lengthening of rod a or b (upper sign: a) moves the centre by
        w = +- T_i, v = S_i / 2 -+ P_i (columns i).
        """
        delta, length = self._delta, self._delta.rod_length_m
        n: list[Vector] = []
        for foot_x, foot_y in delta.feet_m.tolist():
            x, y = px - foot_x, py - foot_y
            squared = length * length - x * x - y * y
            if squared <= 0.0:
                delta.rod_directions((px, py, pz))  # raises, naming the rod
            n.append((x / length, y / length, math.sqrt(squared) / length))
        s = _inverse(*n)
        t = _inverse(*(_cross(apart, each) for apart, each in zip(self._apart, n, strict=True)))
        q = [_cross(middle, each) for middle, each in zip(self._middle, n, strict=True)]
        carriages: list[tuple[float, ...]] = []
        rods: list[tuple[float, ...]] = []
        for i in range(3):
            up, half, turn = n[i][2], s[i], t[i]
            carriages.append((up * half[0], up * half[1], up * half[2], 0.0, 0.0, 0.0))
            shift = _moved(_ZERO, s, (_dot(q[0], turn), _dot(q[1], turn), _dot(q[2], turn)))
            x, y, z = _less(shift, _cross(turn, lever))  # of the tip: v + w x lever
            hx, hy, hz = 0.5 * half[0], 0.5 * half[1], 0.5 * half[2]
            rods.append((hx - x, hy - y, hz - z, *turn))
            rods.append((hx + x, hy + y, hz + z, -turn[0], -turn[1], -turn[2]))
        return carriages + rods

    def _calculate(self, joints: Array) -> Geometry:
        rotation, position = self._arm.tip_pose(joints, self._tip_m)
        origins, axes = self._arm.joint_axes(joints)
        # A revolute joint moves the tip by (axis x lever, axis), a prismatic one by (axis, 0).
        axes, levers = axes[:, self._elastic], position[:, None] - origins[:, self._elastic]
        across = np.matmul(skew(axes), levers[..., None])[..., 0]
        linear = self._turns * across + (1.0 - self._turns) * axes
        jacobian = np.concatenate([linear, self._turns * axes], axis=2).swapaxes(1, 2)
        lever = np.zeros((len(joints), 3))
        if self._arm.delta is not None:
            lever = position - joints[:, :3]
            platform = self._platform_springs(joints[:, :3], lever)
            jacobian = np.concatenate([jacobian, platform], axis=2)
        return Geometry(self._to_tip(rotation), jacobian, lever, (rotation, position))

    def _to_tip(self, rotation: Array) -> Array:
        """(n, 6, 6): from ft_sensor to the tip, then turned into base_link."""
        matrices = np.zeros((len(rotation), 6, 6))
        matrices[:, :3, :3] = matrices[:, 3:, 3:] = rotation
        matrices[:, 3:, :3] = rotation @ self._lever_to_tip
        return matrices

    def _platform_springs(self, platform: Array, lever: Array) -> Array:
        """Columns (n, 6, 9) of carriages and rods, at the tip."""
        directions = self._rod_directions(platform)[:, :, :, None]
        rows = np.concatenate([directions[..., 0], np.matmul(self._balls, directions)[..., 0]], 2)
        rods = np.linalg.inv(rows)  # a column a rod: the centre's twist for a unit of lengthening
        rods[:, :3] -= skew(lever) @ rods[:, 3:]
        upward = rows[:, 0::2, 2]
        carriages = (rods[:, :, 0::2] + rods[:, :, 1::2]) * upward[:, None, :]
        return np.concatenate([carriages, rods], axis=2)

    def _rod_directions(self, platform: Array) -> Array:
        """Return unit vectors (n, 6, 3) from carriage to platform, a rod each."""
        delta = self._delta
        across = platform[:, None, :2] - delta.feet_m
        squared = delta.rod_length_m**2 - np.sum(across**2, axis=2)
        beyond = (squared <= 0.0).any(axis=1)
        if beyond.any():
            delta.rod_directions(platform[np.argmax(beyond)])  # raises, naming the rod
        directions = np.concatenate([across, np.sqrt(squared)[:, :, None]], axis=2)
        return np.repeat(directions / delta.rod_length_m, 2, axis=1)


def tip_wrench(samples: DeflectionSamples) -> Array:
    """Return the applied wrenches about the tip in base_link.

    Args:
        samples: n samples, with wrenches in ft_sensor.

    Returns:
        (n, 6), N and N.m.

    """
    return Springs(samples.tip_m, samples.arm).at_tip(samples.joints, samples.wrench)


_ZERO: Vector = (0.0, 0.0, 0.0)


def _less(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _inverse(a: Vector, b: Vector, c: Vector) -> Columns:
    """Columns of the inverse of the matrix with rows a, b, c: b x c, c x a, a x b over its det."""
    first, second, third = _cross(b, c), _cross(c, a), _cross(a, b)
    scale = 1.0 / _dot(a, first)
    return (
        (first[0] * scale, first[1] * scale, first[2] * scale),
        (second[0] * scale, second[1] * scale, second[2] * scale),
        (third[0] * scale, third[1] * scale, third[2] * scale),
    )


def _vector(values: Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _columns(matrix: Array) -> Columns:
    x, y, z = (_vector(column) for column in matrix.T)
    return x, y, z


def _moved(at: Vector, columns: Columns, by: Vector) -> Vector:
    """At + R by, with R by its columns."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = columns
    a, b, c = by
    return (
        at[0] + a * xx + b * yx + c * zx,
        at[1] + a * xy + b * yy + c * zy,
        at[2] + a * xz + b * yz + c * zz,
    )


def _product(columns: Columns, other: Columns) -> Columns:
    x, y, z = other
    return _moved(_ZERO, columns, x), _moved(_ZERO, columns, y), _moved(_ZERO, columns, z)


def _about(axis: Vector, angle: float) -> Columns:
    """Return the rotation about a unit axis, by Rodrigues' formula."""
    a, b, c = axis
    cos, sin = math.cos(angle), math.sin(angle)
    rest = 1.0 - cos
    return (
        (cos + rest * a * a, rest * a * b + sin * c, rest * a * c - sin * b),
        (rest * a * b - sin * c, cos + rest * b * b, rest * b * c + sin * a),
        (rest * a * c + sin * b, rest * b * c - sin * a, cos + rest * c * c),
    )
