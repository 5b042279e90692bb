# SPDX-License-Identifier: Apache-2.0
"""Causes that aren't on the contract's list, in two lists that share nothing.

Thresholds are calibrated on the one, `blind_check` asks the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from galen_model.arrays import Array

from galen_validation.blind.causes import SIGMA, Cause, Draw, Moment, sign, smooth
from galen_validation.blind.mujoco_arm import InnerMass, Plant, Pull, Wobble
from galen_validation.blind.session import any_direction

if TYPE_CHECKING:
    from galen_validation.blind.measuring import Measurement


def _unlisted(name: str, size: float, largest: float, **hooks: Any) -> Cause:
    return Cause(name, size, largest, lambda size, _: {"size": size}, **hooks)


def _turning(healthy: Measurement, rng: np.random.Generator) -> str:
    """Draw one of the last three joints, which turn the sensor against gravity."""
    return str(rng.choice(healthy.session.arm.turning_names[-3:]))


def _mixed_axes(rng: np.random.Generator, _: Measurement) -> Cause:
    """Let an axis read a part of the product of two others, in units of 100 noises."""
    first, second, axis = rng.choice(6, 3, replace=False)
    way = np.eye(6)[axis] * SIGMA[axis] / (100.0 * SIGMA[first] * SIGMA[second])
    return _unlisted(
        "mixed_axes", 0.03 * sign(rng), 1.0,
        sense=lambda size, _, total: total + np.outer(
            size * total[:, first] * total[:, second], way
        ),
    )  # fmt: skip


def _hum(rng: np.random.Generator, _: Measurement) -> Cause:
    """Let a pump or a fan shake all axes, by size noises."""
    frequency_hz, phases = rng.uniform(3.0, 20.0), rng.uniform(0.0, 2.0 * np.pi, 6)

    def show(size: float, at: Moment, reading: Array) -> Array:
        turned = 2.0 * np.pi * frequency_hz * at.session_s[:, None] + phases
        return np.asarray(reading + size * SIGMA * np.sin(turned))

    return _unlisted("hum", 0.5, 20.0, show=show)


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


def _leaning(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Touch something elastic (N/m) in the outermost fifth of the poses, without being pushed."""
    arm, at_m = healthy.session.arm, 0.6 * healthy.session.tool.tip_m
    course = [take.course(take.wrench.taken_s) for take in healthy.session.takes.values()]
    rotation, origin = arm.sensor_pose(np.concatenate(course)[::20])
    way = any_direction(rng)
    reach = np.quantile((origin + rotation @ at_m) @ way, 0.8)

    def force(at: Array, size: float) -> Array:
        return -np.outer(size * np.maximum(at @ way - reach, 0.0), way)

    return _unlisted(
        "leaning_tool", 10.0, 1e4,
        plant=lambda size, plant: replace(plant, pull=Pull(at_m, lambda at: force(at, size))),
    )  # fmt: skip


def _slipped_marker(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Let the tool's marker slip on the tool, once, by size (m) and three of its rad a metre."""
    way = np.concatenate([any_direction(rng), 3.0 * any_direction(rng)])
    take = healthy.session.takes.get("push")
    time_s = float((100.0 if take is None else take.end_s) * rng.uniform(0.12, 0.88))
    return _unlisted(
        "slipped_marker", 1e-4, 0.02,
        slip=lambda size, at: size * np.outer(smooth((at.bag_s - time_s) / 0.05), way),
    )  # fmt: skip


def _wobble(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Let a worn bearing tilt its axis twice a turn."""
    joint, phase = _turning(healthy, rng), rng.uniform(0.0, 2.0 * np.pi)
    return _unlisted(
        "wobbling_bearing", 0.004, 0.1,
        plant=lambda size, plant: replace(plant, wobble=Wobble(joint, size, phase)),
    )  # fmt: skip


def _temperature(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Let one temperature move the zero, and by size the gains with it: up and down again."""
    period_s = healthy.session.duration_s * rng.uniform(0.4, 1.2)
    phase, way = rng.uniform(0.0, 2.0 * np.pi), any_direction(rng, 6)

    def warm(at: Moment) -> Array:
        return np.sin(2.0 * np.pi * at.session_s / period_s + phase)[:, None]

    return _unlisted(
        "warm_sensor", 0.02, 0.5,
        sense=lambda size, at, total: total * (1.0 + size * warm(at)) + (
            100.0 * size * warm(at) * SIGMA * way
        ),
    )  # fmt: skip


def _uneven_tracker(rng: np.random.Generator, _: Measurement) -> Cause:
    """Let the tracker's latency swing with its queue, from none to twice the size."""
    period_s = rng.uniform(0.3, 6.0)
    return _unlisted(
        "uneven_tracker", 0.01, 0.2,
        late=("tracker", lambda size, at_s: size * (1.0 - np.cos(2.0 * np.pi * at_s / period_s))),
    )  # fmt: skip


def _slipping_zero(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Let an encoder slip on its shaft, by size (rad) over the whole recording."""
    arm, rate = healthy.session.arm, sign(rng) / healthy.session.duration_s
    k = arm.joint_names.index(_turning(healthy, rng))

    def joints(size: float, reported: Array, session_s: Array) -> Array:
        true = np.array(reported)
        true[:, k] += size * rate * session_s
        return true

    return _unlisted("slipping_zero", 0.01, 0.3, joints=joints)


_CALIBRATION: Mapping[str, Draw] = {
    "mixed_axes": _mixed_axes, "hum": _hum, "weight_sag": _sag, "thermal_gain": _warm_gain,
}  # fmt: skip
_TEST: Mapping[str, Draw] = {
    "rattling_mass": _rattle, "sloshing_mass": _slosh,
    "creep": _creep, "tracker_distance": _far_tracker,
    "leaning_tool": _leaning, "slipped_marker": _slipped_marker, "wobbling_bearing": _wobble,
    "warm_sensor": _temperature, "uneven_tracker": _uneven_tracker,
    "slipping_zero": _slipping_zero,
}  # fmt: skip

UNLISTED: Mapping[str, Draw] = {**_CALIBRATION, **_TEST}
CALIBRATION_UNKNOWN, TEST_UNKNOWN = tuple(_CALIBRATION), tuple(_TEST)
NEED_SPRINGS = ("weight_sag",)
"""A rigid joint doesn't show it."""
