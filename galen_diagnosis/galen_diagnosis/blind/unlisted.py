"""Causes that aren't on the contract's list, in two lists that share nothing.

Thresholds are calibrated on the one, `blind_check` asks the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array

from galen_diagnosis.blind.causes import SIGMA, TURNING, Cause, Draw, Moment, sign
from galen_diagnosis.blind.mujoco_arm import InnerMass, Plant

if TYPE_CHECKING:
    from galen_diagnosis.blind.measuring import Measurement


def _unlisted(name: str, size: float, largest: float, **hooks: Any) -> Cause:
    return Cause(name, size, largest, lambda size, _: {"size": size}, **hooks)


def _eccentricity(rng: np.random.Generator, _: Measurement) -> Cause:
    """Put an encoder off its axis: q + size (sin(q + phase) - sin(phase))."""
    k, phase = GALEN.turning[0], rng.uniform(1.0, 2.1)

    def joints(size: float, reported: Array) -> Array:
        true = np.array(reported)
        true[:, k] += size * (np.sin(true[:, k] + phase) - np.sin(phase))
        return true

    return _unlisted("encoder_eccentricity", 0.01 * sign(rng), 0.3, joints=joints)


def _bent_sensor(rng: np.random.Generator, _: Measurement) -> Cause:
    """Bend an axis: reading += size x^2 / (100 noises)."""
    axis = int(rng.integers(6))
    way = np.eye(6)[axis] / (100.0 * SIGMA)
    return _unlisted(
        "quadratic_sensor", 0.03 * sign(rng), 1.0,
        sense=lambda size, _, total: total + size * total**2 * way,
    )  # fmt: skip


def _sag(rng: np.random.Generator, _: Measurement) -> Cause:
    """Drives leave a share of the weight uncompensated: the arm sags on its springs."""
    return _unlisted("weight_sag", 0.5, 20.0, plant=lambda size, plant: replace(plant, weight=size))


def _warm_gain(rng: np.random.Generator, _: Measurement) -> Cause:
    """All gains grow while the sensor warms up."""
    tau_s = rng.uniform(60.0, 300.0)
    return _unlisted(
        "thermal_gain", 0.02 * sign(rng), 0.5,
        sense=lambda size, at, total: total * (
            1.0 + size * (1.0 - np.exp(-np.maximum(at.session_s, 0.0) / tau_s))
        )[:, None],
    )  # fmt: skip


def _friction(rng: np.random.Generator, _: Measurement) -> Cause:
    """Dry friction (N.m) in a joint, behind its spring: the link lags behind the drive."""
    joint = str(rng.choice(TURNING))
    return _unlisted(
        "joint_friction", 1.0, 100.0,
        plant=lambda size, plant: replace(plant, friction={joint: size}),
    )  # fmt: skip


def _rattle(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Let a part of the tool's mass slide freely along one of ft_sensor's axes."""
    axis, mass = int(rng.integers(2)), 0.3 * healthy.plant.tool.mass_kg

    def plant(size: float, plant: Plant) -> Plant:
        reach = size * np.eye(3)[axis]
        return replace(plant, inner=InnerMass(mass, (reach[0], reach[1], reach[2])))

    return _unlisted("rattling_mass", 0.004, 0.08, plant=plant)


def _slosh(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Liquid in the tool: a share of its mass swings on soft springs, hardly damped."""
    frequency_hz = rng.uniform(2.0, 4.0)

    def plant(size: float, plant: Plant) -> Plant:
        mass = size * plant.tool.mass_kg
        omega = 2.0 * np.pi * frequency_hz
        inner = InnerMass(mass, (0.06,) * 3, mass * omega**2, 0.06 * mass * omega)
        return replace(plant, inner=inner)

    return _unlisted("sloshing_mass", 0.2, 0.8, plant=plant)


def _creep(rng: np.random.Generator, _: Measurement) -> Cause:
    """Follow a share of the load late: x + size (low-passed x - x)."""
    tau_s = rng.uniform(10.0, 40.0)

    def sense(size: float, at: Moment, total: Array) -> Array:
        if len(total) < 2:
            return total
        keep = np.exp(-np.diff(at.bag_s, prepend=at.bag_s[0]) / tau_s)
        slow = np.array(total)
        for k in range(1, len(total)):
            slow[k] = total[k] + (slow[k - 1] - total[k]) * keep[k]
        return np.asarray(total + size * (slow - total))

    return _unlisted("creep", 0.02, 0.8, sense=sense)


def _far_tracker(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Positions are off along the line of sight by size (1/m) times their distance squared."""

    def seen(size: float, position: Array) -> Array:
        return position * (1.0 + size * np.linalg.norm(position, axis=1, keepdims=True))

    return _unlisted("tracker_distance", 0.002 * sign(rng), 0.5, seen=seen)


def _sensor_hysteresis(rng: np.random.Generator, _: Measurement) -> Cause:
    """Come back along another line: x - size (x - play of x)."""
    share = rng.uniform(0.04, 0.12)

    def sense(size: float, _: Moment, total: Array) -> Array:
        if len(total) < 2:
            return total
        width = share * np.ptp(total, axis=0)
        held, state = np.empty_like(total), total[0]
        for k, (low, high) in enumerate(zip(total - width, total + width, strict=True)):
            state = np.minimum(np.maximum(state, low), high)
            held[k] = state
        return np.asarray(total - size * (total - held))

    return _unlisted("sensor_hysteresis", 0.1, 3.0, sense=sense)


_CALIBRATION: Mapping[str, Draw] = {
    "encoder_eccentricity": _eccentricity, "quadratic_sensor": _bent_sensor, "weight_sag": _sag,
    "thermal_gain": _warm_gain,
}  # fmt: skip
_TEST: Mapping[str, Draw] = {
    "joint_friction": _friction, "rattling_mass": _rattle, "sloshing_mass": _slosh,
    "creep": _creep, "tracker_distance": _far_tracker, "sensor_hysteresis": _sensor_hysteresis,
}  # fmt: skip

UNLISTED: Mapping[str, Draw] = {**_CALIBRATION, **_TEST}
CALIBRATION_UNKNOWN, TEST_UNKNOWN = tuple(_CALIBRATION), tuple(_TEST)
