# SPDX-License-Identifier: Apache-2.0
"""Effects of a general shape: what a diagnosis fits where no formula of the simulator's does.

The force of a hose or of a hanging cable is some field of the tool's place; friction is somewhere
in the joints; a sensor's limit may be a bend. The simulated driver doesn't know them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect, Fitted, Instants, Loading, Posture
from galen_sim_driver.effects.hysteresis import columns_at, joint_columns, joint_stiffness

_PUSH_N = 10.0
_SHARES = (0.03, 0.1, 0.3, 0.8)
_NEAREST, _FARTHEST = 0.99, 50.0
"""Shares of a limit: up to where a reading tells its wrench, from where it is the limit."""


@dataclass(frozen=True)
class ForceField(Effect):
    """A force at the tool by its place d = p - at, the gradient of a cubic potential, in base_link.

    f = f_0 + K d + C(d), as of what is held or hangs without friction. K is symmetric: xx, yy, zz,
    xy, xz, yz; C is the gradient of c_1 x^3 + ... with x^3, x^2 y, x^2 z, x y^2, x y z, x z^2, y^3,
    y^2 z, y z^2, z^3.
    """

    name = "force_field"
    fitted = (
        Fitted("force_n", "N", 0.3, -50.0, 50.0, 3),
        Fitted("stiffness_n_m", "N/m", 0.5, -200.0, 200.0, 6),
        Fitted("cubic_n_m2", "N/m^2", 0.5, -500.0, 500.0, 10),
        Fitted("attachment_m", "m", 0.06, -0.5, 0.5, 3),
    )
    force_n: tuple[float, ...] = (0.0,) * 3
    stiffness_n_m: tuple[float, ...] = (0.0,) * 6
    cubic_n_m2: tuple[float, ...] = (0.0,) * 10
    attachment_m: tuple[float, ...] = (0.0,) * 3
    at_m: tuple[float, ...] = (0.0,) * 3

    def wrench(self, when: Instants, posture: Posture) -> Array | None:
        """Return the field's wrench about the sensor's origin.

        Args:
            when: Times of n samples; a field doesn't ask for them.
            posture: The true arm's state.

        Returns:
            Wrenches in ft_sensor, (n, 6), N and N.m.

        """
        force = self.force(posture.rotation, posture.origin)
        in_sensor = np.einsum("nji,nj->ni", posture.rotation, force)
        return np.concatenate([in_sensor, np.cross(self.attachment_m, in_sensor)], axis=1)

    def force(self, rotation: Array, origin: Array) -> Array:
        """Return the force at poses of the sensor.

        Args:
            rotation: R_base_sensor, (n, 3, 3).
            origin: The sensor's origin in base_link, (n, 3), m.

        Returns:
            Forces in base_link, (n, 3), N.

        """
        xx, yy, zz, xy, xz, yz = self.stiffness_n_m
        stiffness = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        place = origin + rotation @ np.asarray(self.attachment_m) - np.asarray(self.at_m)
        x, y, z = place.T
        c = self.cubic_n_m2
        cubic = [
            3.0 * c[0] * x**2 + 2.0 * x * (c[1] * y + c[2] * z)
            + c[3] * y**2 + c[4] * y * z + c[5] * z**2,
            c[1] * x**2 + 2.0 * y * (c[3] * x + c[7] * z)
            + c[4] * x * z + 3.0 * c[6] * y**2 + c[8] * z**2,
            c[2] * x**2 + 2.0 * z * (c[5] * x + c[8] * y)
            + c[4] * x * y + c[7] * y**2 + 3.0 * c[9] * z**2,
        ]  # fmt: skip
        return np.asarray(self.force_n + place @ stiffness + np.stack(cubic, axis=1))


@dataclass(frozen=True)
class MassAtSensor(Effect):
    """A mass that is there, or missing, at the sensor's origin: the load's moments stay."""

    name = "mass_at_sensor"
    fitted = (Fitted("delta_kg", "kg", 0.005, -1.0, 5.0),)
    delta_kg: float = 0.0

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """Add the mass; the centre moves towards the sensor's origin.

        Args:
            mass_kg: As the tool's file has it, kg.
            com_m: Centre in ft_sensor, (n, 3), m.
            direction: Not used.

        Returns:
            Mass, kg, and centre (n, 3), m.

        """
        whole = mass_kg + self.delta_kg
        return whole, com_m * (mass_kg / whole)


@dataclass(frozen=True)
class FrictionInJoints(Effect):
    """Dry friction beside the joints' springs: plays in parallel.

    A play of threshold F beside a spring k takes phi of a joint's load u, phi' = u' within +-F, so
    that the joint stands phi / k behind. A sum of plays of several thresholds, weighted, is
    Prandtl's and Ishlinskii's model (Brokate and Sprekels, Hysteresis and Phase Transitions, 1996,
    section 2.3), linear in its weights. plays: joints that share a weight, as `joint_columns` has
    them, and a threshold, N or N.m.
    """

    name = "friction_in_joints"
    weights: tuple[float, ...] = ()
    plays: tuple[tuple[tuple[int, ...], float], ...] = ()

    @classmethod
    def of(cls, arm: Arm, tip_m: Array) -> FrictionInJoints:
        """Return an arm's without any friction; thresholds are shares of what 10 N at home load.

        A delta's carriages share weights, and the two rods of each leg.

        Args:
            arm: With its stiffness; a rigid joint has no play.
            tip_m: Tip in ft_sensor, (3,), m.

        Returns:
            Four plays for each joint or group, weights 0.

        """
        count, stiffness = len(arm.joints), joint_stiffness(arm)
        groups: list[tuple[int, ...]] = [
            (joint,) for joint in range(count) if np.isfinite(stiffness[joint])
        ]
        if arm.delta is not None:
            legs = [(count + rod, count + rod + 1) for rod in (0, 2, 4)]
            groups = [(0, 1, 2), *(group for group in groups if group[0] > 2), *legs]
        loads = _PUSH_N * np.linalg.norm(joint_columns(arm.home, tip_m, arm)[:3], axis=0)
        plays = tuple(
            (group, float(share * np.max(loads[list(group)])))
            for group in groups
            for share in _SHARES
        )
        return cls((0.0,) * len(plays), plays)

    @property
    def thresholds(self) -> Array:
        """Of each play."""
        return np.array([threshold for _, threshold in self.plays])

    def of_numbers(self, weights: Array, thresholds: Array) -> FrictionInJoints:
        """Return the same joints with other weights and thresholds.

        Args:
            weights: One for each play.
            thresholds: One for each play, N or N.m.

        Returns:
            A copy.

        """
        plays = tuple(
            (joints, float(one)) for (joints, _), one in zip(self.plays, thresholds, strict=True)
        )
        return replace(self, weights=tuple(float(one) for one in weights), plays=plays)

    def joined(self) -> FrictionInJoints:
        """Return one play a group, that stays behind by as much after a large load."""
        groups = list(dict.fromkeys(joints for joints, _ in self.plays))
        plays, weights = [], []
        for group in groups:
            own = [
                (weight, threshold)
                for weight, (joints, threshold) in zip(self.weights, self.plays, strict=True)
                if joints == group
            ]
            sizes = np.array([abs(weight * threshold) for weight, threshold in own])
            at = float(np.exp(sizes @ np.log([t for _, t in own]) / max(sizes.sum(), 1e-12)))
            at = max(at, own[0][1])
            plays.append((group, at))
            weights.append(sum(weight * threshold for weight, threshold in own) / at)
        return FrictionInJoints(tuple(weights), tuple(plays))

    def vector(self) -> Array:
        """Return the weights."""
        return np.array(self.weights)

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return how far the tip stands behind.

        Args:
            when: Times of n samples in order; plays start without a load.
            loading: What bends the arm.

        Returns:
            Displacements of the tip in base_link, (n, 6), m and rad; None without friction or
            samples.

        """
        pairs = zip(self.plays, self.weights, strict=True)
        there = [
            (joint, threshold, weight)
            for (joints, threshold), weight in pairs
            for joint in joints
            if weight != 0.0
        ]
        if not there or not len(when):
            return None
        joints, limits, weights = (np.array(one) for one in zip(*there, strict=True))
        columns = columns_at(loading)
        loads = np.einsum("nij,ni->nj", columns, loading.wrench)[:, joints]
        slack = _played(loads, limits) * weights / joint_stiffness(loading.arm)[joints]
        return np.asarray(-np.einsum("nij,nj->ni", columns[:, :, joints], slack))

    def residual_fraction(self, joints: Array, tip_m: Array, arm: Arm) -> float:
        """Return what stays of the deflection after a push over that under it.

        In the mean square of one push of 10 N along each axis of base_link.

        Args:
            joints: Where the arm is pushed, (k,), m and rad.
            tip_m: Tip in ft_sensor, (3,), m.
            arm: With its stiffness.

        Returns:
            A share, 0 without friction.

        """
        pushes = _PUSH_N * np.eye(6)[:3]
        elastic = pushes @ arm.tip_compliance(joints, tip_m)
        columns = joint_columns(joints, tip_m, arm)
        k = np.array([joint for own, _ in self.plays for joint in own], dtype=int)
        count = [len(own) for own, _ in self.plays]
        limits, weights = np.repeat(self.thresholds, count), np.repeat(self.weights, count)
        loads = pushes @ columns[:, k]
        taken = np.clip(loads, -limits, limits)
        left = np.clip(taken - loads, -limits, limits)
        pushed, stayed = (
            one * weights / joint_stiffness(arm)[k] @ columns[:3, k].T for one in (taken, left)
        )
        return float(np.sqrt(np.sum(stayed**2) / np.sum((elastic[:, :3] - pushed) ** 2)))


def _played(loads: Array, limits: Array) -> Array:
    """Return what plays of limits (k,) take of loads (n, k); none at first."""
    out = np.empty_like(loads)
    state, last = np.zeros(loads.shape[1]), np.zeros(loads.shape[1])
    for row, load in enumerate(loads):
        state = np.minimum(np.maximum(state + load - last, -limits), limits)
        out[row], last = state, load
    return out


@dataclass(frozen=True)
class SoftSaturation(Effect):
    """An axis bends towards its limit L: it reads y = x / (1 + |x / L|^p)^(1 / p) of x."""

    name = "soft_saturation"
    fitted = (Fitted("log_limit", "", 0.3, -12.0, 12.0), Fitted("log_power", "", 0.4, 1.4, 5.0))
    order = 5
    log_limit: float = 12.0
    log_power: float = 3.0
    axis: str = "fz"

    @property
    def limit(self) -> float:
        """N or N.m."""
        return float(np.exp(self.log_limit))

    def read(self, when: Instants, wrench: Array) -> Array:
        """Return the reading of a true wrench.

        Args:
            when: Times of n samples; not used.
            wrench: True wrenches in ft_sensor, (n, 6), N and N.m.

        Returns:
            Readings, (n, 6).

        """
        return self._bent(wrench, 1.0, np.inf)

    def unread(self, when: Instants, reading: Array) -> Array:
        """Return the true wrench of a reading; of one at the limit, what is sure.

        Args:
            when: Times of n samples; not used.
            reading: Readings in ft_sensor, (n, 6), N and N.m.

        Returns:
            Wrenches, (n, 6).

        """
        return self._bent(reading, -1.0, _NEAREST)

    def _bent(self, values: Array, sign: float, most: float) -> Array:
        axis, power = WRENCH_AXES.index(self.axis), float(np.exp(self.log_power))
        out = np.array(values, dtype=float)
        share = np.minimum(np.abs(out[:, axis]) / self.limit, most)
        # Beyond it the power overflows, and the reading is the limit.
        share = np.minimum(share, _FARTHEST)
        out[:, axis] = (
            np.sign(out[:, axis])
            * (self.limit * share)
            / (1.0 + sign * share**power) ** (1.0 / power)
        )
        return out
