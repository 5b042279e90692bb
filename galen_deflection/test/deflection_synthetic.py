# SPDX-License-Identifier: Apache-2.0
"""Pushes on an arm made for the tests: positions x directions x levels, springs with Dahl friction.

The friction is none of the models': P. Dahl's law (1968), in the springs' own motion, not in their
loads. Its slope falls off smoothly where that of plays has corners, and also on the way back, where
smooth operators go straight; and its loops are not congruent.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.springs import Springs, kinds
from galen_model.arm.galen import GALEN
from galen_model.load.model import TOOLS

TIP_M = TOOLS["retractor"].tip_m
NOISE = np.array([0.03e-3] * 3 + [0.1e-3] * 3)
POSITIONS = np.array(
    [
        [0.00, 0.00, 0.408, 0.0, 0.0],
        [0.06, -0.05, 0.43, 0.7, -0.4],
        [-0.07, 0.04, 0.37, -0.9, 0.5],
        [0.03, 0.07, 0.40, 0.3, 0.8],
    ]
)
FORCES_N, TORQUES_NM = (3.0, 6.0, 10.0), (0.3, 0.8)
PUSH_S, PAUSE_S = 1.0, 0.3


@dataclass(frozen=True)
class Arm:
    """Stiffnesses (N.m/rad, N/m); friction (N.m, N): where a joint's Dahl friction saturates."""

    k_roll: float = 2000.0
    k_tilt: float = 1500.0
    k_carriage: float = 3e5
    k_rod: float = 2e6
    friction: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def compliances(self):
        return 1.0 / np.array([self.k_roll, self.k_tilt, self.k_carriage, self.k_rod])

    def displacements(self, loads):
        """Of each spring (n, 11), from its loads (n, 11) in time."""
        result = np.empty_like(loads)
        for kind, compliance, friction in zip(
            kinds(arm=GALEN), self.compliances, (*self.friction, 0.0), strict=True
        ):
            for s in kind.springs:
                result[:, s] = compliance * loads[:, s]
                if friction > 0.0:
                    result[:, s] = dahl(loads[:, s], 1.0 / compliance, friction)
        return result


def dahl(load, stiffness, friction, steps=8, share=10.0):
    """Displacement (n,) of a spring with Dahl friction beside it: load = k x + f(x).

    df/dx = sigma (1 - f sgn(dx) / friction), with sigma = share * stiffness; in small steps of the
    load.
    """
    sigma = share * stiffness
    f, now = 0.0, 0.0
    result = np.empty_like(load)
    for k, target in enumerate(load.tolist()):
        step = (target - now) / steps
        sign = math.copysign(1.0, step)
        for _ in range(steps if step else 0):
            slope = sigma * (1.0 - f * sign / friction)
            dx = step / (stiffness + slope)
            # the exact change of f over dx
            f = sign * friction + (f - sign * friction) * math.exp(-sigma * abs(dx) / friction)
        now = target
        result[k] = (target - f) / stiffness  # the load is the sum of both
    return result


def half_cosine(progress):
    """A push (n,) over its duration, 0 to 1: up and down in one smooth wave."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * progress)


def script(rate_hz, forces_n=FORCES_N, torques_nm=TORQUES_NM, axes=range(6), untouched_s=3.0):
    """Wrenches (n, 6) at the tip in base_link: untouched first, then pushes and pauses."""
    push = half_cosine(np.arange(round(PUSH_S * rate_hz)) / (PUSH_S * rate_hz))
    pause = np.zeros((round(PAUSE_S * rate_hz), 6))
    parts = [np.zeros((round(untouched_s * rate_hz), 6))]
    for axis in axes:
        for sign in (1.0, -1.0):
            for level in forces_n if axis < 3 else torques_nm:
                parts += [np.outer(push, sign * level * np.eye(6)[axis]), pause]
    return np.concatenate(parts)


def recording(
    arm=None, seed=0, positions=POSITIONS, sets=1, rate_hz=50.0, noise=NOISE, **of_script
):
    """Samples of an arm pushed at each position, each repetition a segment of its own."""
    arm = arm or Arm()
    rng = np.random.default_rng(seed)
    at_tip = script(rate_hz, **of_script)
    columns = {name: [] for name in ("segment", "position", "set_number", "joints", "wrench", "d")}
    for repetition in range(sets):
        for position, place in enumerate(positions):
            joints = np.tile(place, (len(at_tip), 1))
            jacobian = Springs(TIP_M, arm=GALEN).geometry(joints[:1]).jacobian[0]
            displacement = arm.displacements(at_tip @ jacobian) @ jacobian.T
            segment = repetition * len(positions) + position
            numbers = (segment, position, repetition)
            for name, value in zip(("segment", "position", "set_number"), numbers, strict=True):
                columns[name].append(np.full(len(at_tip), value))
            columns["joints"].append(joints)
            columns["wrench"].append(in_sensor(joints, at_tip))
            columns["d"].append(displacement)
    whole = {name: np.concatenate(values) for name, values in columns.items()}
    deflection = whole.pop("d")
    stamps = np.arange(len(deflection)) * round(1e9 / rate_hz)
    return DeflectionSamples(
        stamp_ns=stamps,
        deflection=deflection + rng.normal(size=deflection.shape) * noise,
        tip_m=TIP_M,
        noise=NOISE,
        arm=GALEN,
        **whole,
    )


def in_sensor(joints, at_tip):
    """Wrenches (n, 6) in ft_sensor about its origin of those at the tip in base_link."""
    to_tip = Springs(TIP_M, arm=GALEN).geometry(joints[:1]).to_tip[0]  # one place only
    return np.linalg.solve(to_tip, at_tip.T).T


def without_noise(samples, arm):
    """The same samples with the true deflection."""
    geometry = Springs(TIP_M, arm=GALEN).geometry(samples.joints)
    at_tip = np.einsum("nij,nj->ni", geometry.to_tip, samples.wrench)
    loads = np.einsum("nis,ni->ns", geometry.jacobian, at_tip)
    deflection = np.empty_like(samples.deflection)
    for segment in np.unique(samples.segment):
        rows = samples.segment == segment
        moved = arm.displacements(loads[rows])
        deflection[rows] = np.einsum("nis,ns->ni", geometry.jacobian[rows], moved)
    return replace(samples, deflection=deflection)
