# SPDX-License-Identifier: Apache-2.0
"""How the sensor moves: the arm's kinematics, twice differentiated by a recursion over its joints.

From one revolute joint to the next, r the way between their origins in the axes of the link that
lies between, r', r'' its rates by the prismatic joints on it, w and al the link's angular velocity
and acceleration, a the acceleration of its origin:

    a <- a + r'' + 2 w x r' + al x r + w x (w x r).

Then all three are turned into the next link, whose joint turns about e by q:

    al <- al + q'' e + w x (q' e),   w <- w + q' e

(Craig, *Introduction to Robotics*, 3rd ed. 2005, section 6.5, eqs. 6.45 to 6.47). All of the
sensor's motion is in its own axes, its acceleration the classical one of its origin.

Arrays go through this recursion, whose overhead of some 0.2 ms a call is too much for a single
moment: that goes through Pinocchio, in a model made of the same `Arm`. Tests hold both against the
robot description, and the recursion against finite differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm, Components
from galen_model.arrays import Array

_BLOCK = 4096
"""Samples at once: what is computed of them in between stays in the processor's cache."""


class SensorMotion(NamedTuple):
    """Angular velocity, angular acceleration, acceleration of the origin: (..., 3), sensor."""

    velocity_rad_s: Array
    acceleration_rad_s2: Array
    acceleration_m_s2: Array


def sensor_motion(
    joints: ArrayLike,
    velocities: ArrayLike,
    accelerations: ArrayLike,
    arm: Arm,
) -> SensorMotion:
    """Compute the motion of the sensor; the joints' values broadcast.

    Args:
        joints: (..., n) in the order of `Arm.joints`, m and rad.
        velocities: (..., n), m/s and rad/s.
        accelerations: (..., n), m/s^2 and rad/s^2.
        arm: whose joints they are.

    Returns:
        Velocity and accelerations (..., 3), in the sensor's axes.

    """
    given = np.broadcast_arrays(
        *(np.asarray(part, dtype=float) for part in (joints, velocities, accelerations))
    )
    count = len(arm.joints)
    rows = [part.reshape(-1, count) for part in given]
    found = np.empty((3, len(rows[0]), 3))
    for first in range(0, len(rows[0]), _BLOCK):
        block = slice(first, first + _BLOCK)
        columns = (part[block].T for part in rows)
        for out, parts in zip(found, _recursion(arm, *columns), strict=True):
            for k in range(3):
                out[block, k] = parts[k]
    return SensorMotion(*found.reshape(3, *given[0].shape[:-1], 3))


def _recursion(arm: Arm, q: Array, v: Array, a: Array) -> list[Components]:
    """Return w, al and a in the sensor of joints (n, m) and their rates."""
    zero: Components = (0.0, 0.0, 0.0)
    omega = alpha = linear = way = way_rate = way_rate_2 = zero
    turned = np.eye(3)
    turns = iter(arm.turns)
    for k, joint in enumerate(arm.joints):
        way = _plus(way, turned @ joint.origin_m)
        if joint.rotation is not None:
            turned = turned @ joint.rotation
        axis = turned @ joint.axis
        if joint.kind == "prismatic":
            way, way_rate = _plus(way, axis, q[k]), _plus(way_rate, axis, v[k])
            way_rate_2 = _plus(way_rate_2, axis, a[k])
            continue
        linear = _carried(linear, omega, alpha, (way, way_rate, way_rate_2))
        turn, cos, sin = next(turns), np.cos(q[k]), np.sin(q[k])
        omega, alpha, linear = (turn(parts, cos, sin) for parts in (omega, alpha, linear))
        alpha = _plus(_plus(alpha, joint.axis, a[k]), _cross(omega, joint.axis), v[k])
        omega = _plus(omega, joint.axis, v[k])
        way = way_rate = way_rate_2 = zero
        turned = np.eye(3)
    way = _plus(way, turned @ arm.sensor_origin_m)
    linear = _carried(linear, omega, alpha, (way, way_rate, way_rate_2))
    return [arm.into_sensor(parts) for parts in (omega, alpha, linear)]


def _carried(
    linear: Components, omega: Components, alpha: Components, way: Sequence[Components]
) -> Components:
    """Return the acceleration at the end of a way (3,), its rate and second rate."""
    place, rate, rate_2 = way
    inner = _plus(_cross(omega, place), rate, 2.0)
    total = _plus(_plus(linear, rate_2), _cross(alpha, place))
    return _plus(total, _cross(omega, inner))


def _plus(parts: Components, more: Any, size: Any = 1.0) -> Components:
    """Return parts + size more; a component that is a plain zero costs nothing."""
    x, y, z = (
        p if isinstance(m, float) and m == 0.0 else p + m * size
        for p, m in zip(parts, more, strict=True)
    )
    return x, y, z


def _cross(a: Any, b: Any) -> Components:
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


class MotionOfSensor:
    """`sensor_motion` for one moment at a time, by Pinocchio."""

    def __init__(self, arm: Arm) -> None:
        import pinocchio  # slow to import, and only inertial forces need it

        model, parent = pinocchio.Model(), 0
        for joint in arm.joints:
            rotation = np.eye(3) if joint.rotation is None else joint.rotation
            kind = (
                pinocchio.JointModelRevoluteUnaligned
                if joint.kind == "revolute"
                else pinocchio.JointModelPrismaticUnaligned
            )
            placement = pinocchio.SE3(rotation, joint.origin_m)
            parent = model.addJoint(parent, kind(joint.axis), placement, joint.name)
        mount = pinocchio.SE3(arm.sensor_rotation, arm.sensor_origin_m)
        sensor = pinocchio.Frame("sensor", parent, mount, pinocchio.FrameType.OP_FRAME)
        frame = (model.addFrame(sensor), pinocchio.ReferenceFrame.LOCAL)
        at = (model, model.createData())
        self._move = partial(pinocchio.forwardKinematics, *at)
        self._velocity = partial(pinocchio.getFrameVelocity, *at, *frame)
        self._acceleration = partial(pinocchio.getFrameClassicalAcceleration, *at, *frame)

    def at(
        self, joints: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike
    ) -> tuple[list[float], list[float], list[float]]:
        """Compute the motion of the sensor at one moment.

        Args:
            joints: (n,), m and rad.
            velocities: (n,), m/s and rad/s.
            accelerations: (n,), m/s^2 and rad/s^2.

        Returns:
            Angular velocity, rad/s, angular acceleration, rad/s^2, and the origin's acceleration,
            m/s^2, three numbers each, in the sensor's axes.

        """
        q, v, a = (np.asarray(part, dtype=float) for part in (joints, velocities, accelerations))
        self._move(q, v, a)
        velocity, acceleration = self._velocity(), self._acceleration()
        return (
            velocity.angular.tolist(),
            acceleration.angular.tolist(),
            acceleration.linear.tolist(),
        )
