"""The arm of the blind recordings: numbers as they are, kinematics, springs; written anew.

Chain (contract, section 1), each axis any unit vector, so that tolerances can turn it:

    R1 = exp(e_roll^ roll),  R2 = R1 exp(e_tilt^ tilt),  R = R2 Ry(pi/2)
    origin of ft_sensor = delta + a0 + R1 a1 + R2 a2

Springs: load l = L w on platform (6), roll and tilt from a wrench w at the tip; by virtual work
(the work of w on the tip's twist is that of l on the springs' displacements x) the tip moves by
L^T x. The platform's stiffness is the Schur complement of the rods' and carriages' energy

    E = 1/2 k_rod |A xi - G d|^2 + 1/2 k_q |d|^2,   d: the carriages' displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.turning import cross, turned_about, unit

_SENSOR_ON_TILT = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Ry(pi / 2)."""


@dataclass(frozen=True)
class Body:
    """A rigid body: mass (kg), centre (3,) in ft_sensor (m), inertia (3, 3) about it (kg.m^2)."""

    mass_kg: float
    com_m: Array
    inertia_kg_m2: Array


class Pose(NamedTuple):
    """R_base_sensor (n, 3, 3) and the sensor's origin in base_link (n, 3), m."""

    rotation: Array
    origin: Array


@dataclass(frozen=True)
class BlindArm:
    """One arm's true numbers; SI. The defaults are the nominal ones."""

    platform_to_roll_m: Array = field(default_factory=lambda: np.array(GALEN.platform_to_roll_m))
    roll_to_tilt_m: Array = field(default_factory=lambda: np.array(GALEN.roll_to_tilt_m))
    tilt_to_sensor_m: Array = field(default_factory=lambda: np.array(GALEN.tilt_to_sensor_m))
    roll_axis: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    tilt_axis: Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    joint_zero: Array = field(default_factory=lambda: np.zeros(5))
    joint_gain: Array = field(default_factory=lambda: np.ones(5))
    gravity: Array = field(default_factory=lambda: np.array(GRAVITY_M_S2))
    rod_length_m: float = GALEN.rod_length_m
    k_roll: float = GALEN.roll_stiffness_nm_rad
    k_tilt: float = GALEN.tilt_stiffness_nm_rad
    k_carriage: float = GALEN.carriage_stiffness_n_m
    k_rod: float = GALEN.rod_stiffness_n_m
    sensor_gain: Array = field(default_factory=lambda: np.ones(6))
    places: Array = field(default_factory=lambda: np.zeros((4, 6)))
    """Twist (m, rad) of the platform in base_link at each of the places of pushes."""
    tracker_scale: float = 1.0

    def turned_joints(self, reported: Array) -> Array:
        """True joints (..., 5) of a healthy arm."""
        return reported * self.joint_gain + self.joint_zero

    def pose(self, joints: Array) -> Pose:
        """Of the sensor at true joints (n, 5)."""
        rolled = turned_about(unit(self.roll_axis), joints[:, 3])
        tilted = rolled @ turned_about(unit(self.tilt_axis), joints[:, 4])
        origin = joints[:, :3] + self.platform_to_roll_m
        origin = origin + rolled @ self.roll_to_tilt_m + tilted @ self.tilt_to_sensor_m
        return Pose(tilted @ _SENSOR_ON_TILT, origin)

    def twist(
        self, joints: Array, velocity: Array, acceleration: Array
    ) -> tuple[Array, Array, Array, Array]:
        """The sensor's angular velocity, angular acceleration, its origin's velocity, acceleration.

        All (n, 3) in base_link, from joints and their rates (n, 5).
        """
        axis_1 = unit(self.roll_axis)
        rolled = turned_about(axis_1, joints[:, 3])
        axis_2 = rolled @ unit(self.tilt_axis)
        tilted = rolled @ turned_about(unit(self.tilt_axis), joints[:, 4])
        arm_1 = rolled @ self.roll_to_tilt_m
        arm_2 = tilted @ self.tilt_to_sensor_m
        w1 = velocity[:, 3:4] * axis_1
        w2 = w1 + velocity[:, 4:5] * axis_2
        al1 = acceleration[:, 3:4] * axis_1
        al2 = al1 + acceleration[:, 4:5] * axis_2 + cross(w1, velocity[:, 4:5] * axis_2)
        speed = velocity[:, :3] + cross(w1, arm_1) + cross(w2, arm_2)
        push = acceleration[:, :3] + cross(al1, arm_1) + cross(al2, arm_2)
        push = push + cross(w1, cross(w1, arm_1)) + cross(w2, cross(w2, arm_2))
        return w2, al2, speed, push

    def springs(self, joints: Array, tip_m: Array) -> Springs:
        """What bends at true joints (5,) under a wrench at the tip, tip_m (3,) in ft_sensor."""
        pose = self.pose(joints[None])
        tip = pose.origin[0] + pose.rotation[0] @ tip_m
        rolled = turned_about(unit(self.roll_axis), joints[3:4])[0]
        roll_at = joints[:3] + self.platform_to_roll_m
        tilt_at = roll_at + rolled @ self.roll_to_tilt_m
        loads = np.zeros((8, 6))
        loads[:3, :3] = np.eye(3)
        x, y, z = tip - joints[:3]
        loads[3:6, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        loads[3:6, 3:] = np.eye(3)
        for row, axis, at in (
            (6, unit(self.roll_axis), roll_at),
            (7, rolled @ unit(self.tilt_axis), tilt_at),
        ):
            loads[row, :3] = cross(axis, tip - at)
            loads[row, 3:] = axis
        give = np.zeros((8, 8))
        give[:6, :6] = np.linalg.inv(self._platform_stiffness(joints[:3]))
        give[6, 6], give[7, 7] = 1.0 / self.k_roll, 1.0 / self.k_tilt
        return Springs(loads, give)

    def _platform_stiffness(self, platform_m: Array) -> Array:
        rods = np.zeros((6, 6))
        rails = np.zeros((6, 3))
        for leg, angle in enumerate(GALEN.leg_angles_rad):
            out = np.array([np.cos(angle), np.sin(angle), 0.0])
            along = np.array([-np.sin(angle), np.cos(angle), 0.0])
            foot = GALEN.delta_radius_m * out
            flat = np.array([*platform_m[:2], 0.0]) - foot
            height = np.sqrt(self.rod_length_m**2 - flat @ flat)
            direction = np.array([flat[0], flat[1], height]) / self.rod_length_m
            for side in (0, 1):
                ball = GALEN.platform_radius_m * out
                ball = ball + (1 - 2 * side) * GALEN.rod_half_spacing_m * along
                rods[2 * leg + side] = [*direction, *cross(ball, direction)]
                rails[2 * leg + side, leg] = direction[2]
        own = self.k_rod * rods.T @ rods
        mixed = self.k_rod * rods.T @ rails
        moved = self.k_rod * rails.T @ rails + self.k_carriage * np.eye(3)
        return np.asarray(own - mixed @ np.linalg.solve(moved, mixed.T))


class Springs(NamedTuple):
    """loads L (8, 6): on platform, roll, tilt of a wrench at the tip; give (8, 8): x = give l."""

    loads: Array
    give: Array

    def loaded(self, wrench: Array) -> Array:
        """Loads (n, 8) of wrenches (n, 6) at the tip in base_link."""
        return np.asarray(wrench @ self.loads.T)

    def moved(self, displacement: Array) -> Array:
        """Displacement (n, 6) of the tip of those (n, 8) of the springs."""
        return np.asarray(displacement @ self.loads)
