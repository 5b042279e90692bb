"""What a blind recording may hide: causes by the contract's effects.

A `Cause` is a size and what it changes on the way from joints to files. Those of the arm change
the plant that MuJoCo simulates; those of sensor and tracker change arrays. `unlisted.py` has those
that aren't on the list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arm.galen import GALEN, SENSOR, WRENCH_AXES
from galen_model.arrays import Array
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from galen_diagnosis.blind.mujoco_arm import DECAY, Body, Cable, Gap, InnerMass, Plant
from galen_diagnosis.blind.session import BAGS, any_direction

if TYPE_CHECKING:
    from galen_diagnosis.blind.measuring import Measurement

TURNING = GALEN.turning_names
_LAST = TURNING[-1]
SIGMA = SENSOR.noise_std


@dataclass(frozen=True)
class Moment:
    """True times (n,) of a bag's samples: since its first stamp, since the recording's."""

    bag: str
    bag_s: Array
    session_s: Array


@dataclass(frozen=True)
class Cause:
    """A cause; hooks take its size first, and those that are None change nothing.

    name: identity, with the joint where the effect has one. truth: parameters as the contract's
    section 6 names them. plant: the arm; joints: true joints (n, k) of reported ones; late: topic
    whose samples are older, by seconds (n,); sense: what the sensor makes of the whole wrench;
    show: what is published of the zeroed reading; seen: a marker's position in the tracker; stand:
    displacement (n, 6) of the base's marker.
    """

    name: str
    size: float
    largest: float
    truth: Callable[[float, Measurement], Mapping[str, Any]]
    plant: Callable[[float, Plant], Plant] | None = None
    joints: Callable[[float, Array], Array] | None = None
    late: tuple[str, Callable[[float, Array], Array]] | None = None
    sense: Callable[[float, Moment, Array], Array] | None = None
    show: Callable[[float, Moment, Array], Array] | None = None
    seen: Callable[[float, Array], Array] | None = None
    stand: Callable[[float, Moment], Array] | None = None

    def resized(self, size: float) -> Self:
        """Return the same cause at a size, at most the largest."""
        return replace(self, size=float(np.clip(size, -self.largest, self.largest)))

    @property
    def changes_motion(self) -> bool:
        """Whether the arm has to be simulated anew."""
        return any(hook is not None for hook in (self.plant, self.joints))


Draw = Callable[[np.random.Generator, "Measurement"], Cause]


def sign(rng: np.random.Generator) -> float:
    """Draw -1 or 1."""
    return float(rng.choice([-1.0, 1.0]))


def _numbers(vector: Array) -> list[float]:
    return [float(value) for value in vector]


# Joints and geometry


def _place(joint: str) -> Array:
    return np.eye(len(GALEN.joints))[GALEN.joint_names.index(joint)]


def _zero_offset(joint: str) -> Draw:
    return lambda rng, _: Cause(
        f"joint_zero_offset:{joint}", 0.005 * sign(rng), 0.3,
        lambda size, _: {"joint": joint, "offset_rad": size},
        plant=lambda size, plant: replace(plant, zero=plant.zero + size * _place(joint)),
    )  # fmt: skip


def _gain(joint: str) -> Draw:
    return lambda rng, _: Cause(
        f"joint_gain:{joint}", 0.01 * sign(rng), 0.5,
        lambda size, _: {"joint": joint, "gain": size},
        plant=lambda size, plant: replace(plant, gain=plant.gain + size * _place(joint)),
    )  # fmt: skip


def _misalignment(joint: str) -> Draw:
    def turned(size: float, plant: Plant) -> Plant:
        turn = Rotation.from_rotvec([0.0, 0.0, size])
        joints = tuple(
            replace(own, axis=turn.apply(own.axis)) if own.name == joint else own
            for own in plant.arm.joints
        )
        return replace(plant, arm=replace(plant.arm, joints=joints))

    return lambda rng, _: Cause(
        f"joint_axis_misalignment:{joint}", 0.01 * sign(rng), 0.4,
        lambda size, _: {"joint": joint, "about": "z", "angle_rad": size}, plant=turned,
    )  # fmt: skip


def _inclination(rng: np.random.Generator, _: Measurement) -> Cause:
    return inclined(*any_direction(rng, 2))


def inclined(about_x: float, about_y: float) -> Cause:
    """Incline the base about a direction: gravity is (Rx(a) Ry(b))^T g."""

    def aslant(size: float, plant: Plant) -> Plant:
        turn = Rotation.from_euler("XY", [size * about_x, size * about_y])
        gravity = turn.inv().apply(plant.arm.gravity_m_s2)
        return replace(plant, arm=replace(plant.arm, gravity_m_s2=gravity))

    return Cause(
        "base_inclination", 0.005, 0.3,
        lambda size, _: {"about_x_rad": size * about_x, "about_y_rad": size * about_y},
        plant=aslant,
    )  # fmt: skip


def _backlash(rng: np.random.Generator, _: Measurement) -> Cause:
    """At once, with stiction, or softly over a few tenths of a newton metre."""
    joint, kind, moment = str(rng.choice(TURNING)), int(rng.integers(3)), rng.uniform(0.05, 0.3)

    def gap(size: float, plant: Plant) -> Plant:
        soft = 2.0 * moment / size if kind == 2 else 0.0
        stiction = 0.3 * moment if kind == 1 else 0.0
        return replace(plant, gap=Gap(joint, size, soft, stiction))

    return Cause(
        "backlash", 0.004, 0.08, lambda size, _: {"joint": joint, "gap_rad": size}, plant=gap
    )


# Springs


def _compliance(rng: np.random.Generator, _: Measurement) -> Cause:
    name = str(rng.choice(list(GALEN.stiffness)))

    def softer(size: float, plant: Plant) -> Plant:
        stiffness = plant.arm.stiffness[name] / (1.0 + size)
        return replace(plant, arm=plant.arm.with_stiffness({name: stiffness}))

    return Cause(
        "joint_compliance", 0.1, 4.0,
        lambda size, _: {"stiffness": {name: GALEN.stiffness[name] / (1.0 + size)}},
        plant=softer,
    )  # fmt: skip


def _hysteresis(rng: np.random.Generator, _: Measurement) -> Cause:
    """Dry friction along the rods, in newtons: the platform stays where the last push left it."""
    return Cause(
        "deflection_hysteresis", 5.0, 60.0,
        lambda _, measured: {"residual_fraction": measured.residual_fraction()},
        plant=lambda size, plant: replace(plant, rod_friction_n=size),
    )  # fmt: skip


# Load


def _with_tool(plant: Plant, mass_kg: float, com_m: Array) -> Plant:
    return replace(plant, tool=Body(max(mass_kg, 1e-3), com_m, plant.tool.inertia_kg_m2))


def _mass_error(rng: np.random.Generator, _: Measurement) -> Cause:
    return Cause(
        "tool_mass_error", 0.001 * sign(rng), 1.0, lambda size, _: {"delta_kg": size},
        plant=lambda size, plant: _with_tool(plant, plant.tool.mass_kg + size, plant.tool.com_m),
    )  # fmt: skip


def _com_error(rng: np.random.Generator, _: Measurement) -> Cause:
    way = any_direction(rng)
    return Cause(
        "tool_com_error", 0.001, 0.1, lambda size, _: {"delta_m": _numbers(size * way)},
        plant=lambda size, plant: _with_tool(
            plant, plant.tool.mass_kg, plant.tool.com_m + size * way
        ),
    )  # fmt: skip


def _loose(rng: np.random.Generator, _: Measurement) -> Cause:
    """Nine tenths of the tool's mass sag across ft_sensor's z, between soft stops."""

    def sags(size: float, plant: Plant) -> Plant:
        mass, way = 0.9 * plant.tool.mass_kg, size / 0.9
        stiffness = mass * STANDARD_GRAVITY_M_S2 / way
        inner = InnerMass(mass, (1.5 * way, 1.5 * way, 0.0), stiffness, DECAY * mass)
        return replace(plant, inner=inner)

    return Cause("loose_tool", 0.001, 0.05, lambda size, _: {"shift_m": size}, plant=sags)


def _cable(rng: np.random.Generator, _: Measurement) -> Cause:
    """Held somewhere above, beside or behind the arm; its size is the usual tension."""
    x, y, z = rng.uniform([0.0, 0.2, 0.7], [0.8, 0.7, 1.5]) * [1.0, sign(rng), 1.0]
    a, b, c = rng.uniform([0.02, -0.02, 0.02], [0.10, 0.02, 0.08])
    grow, weight, friction = rng.uniform([1.05, 0.05, 0.0], [2.5, 0.3, 0.03])
    usual = float(np.linalg.norm(np.array([x, y, z]) - [0.72, 0.0, 0.5]))

    def hung(size: float, plant: Plant) -> Plant:
        # Tension `size` at the usual distance, and `grow` times more of it at twice that.
        cable = Cable(
            (x, y, z), (a, b, c), size * grow / usual, usual * (1.0 - 1.0 / grow),
            size * weight / STANDARD_GRAVITY_M_S2, size * friction,
        )  # fmt: skip
        return replace(plant, cable=cable)

    return Cause(
        "cable_drag", 0.2, 10.0, lambda _, measured: {"tension_N": measured.mean_tension()},
        plant=hung,
    )  # fmt: skip


def _inertial(rng: np.random.Generator, healthy: Measurement) -> Cause:
    whole = healthy.plant.tool.mass_kg + healthy.plant.adapter.mass_kg
    return Cause(
        "inertial_load", 0.02, 5.0, lambda size, _: {"mass_kg": size},
        plant=lambda size, plant: replace(plant, inertial=size / whole),
    )  # fmt: skip


# Sensor


def _mount(rng: np.random.Generator, _: Measurement) -> Cause:
    way = any_direction(rng)

    def sense(size: float, _: Moment, total: Array) -> Array:
        turn = Rotation.from_rotvec(size * way).as_matrix()
        return np.concatenate([total[:, :3] @ turn, total[:, 3:] @ turn], axis=1)

    return Cause(
        "sensor_mount_rotation", 0.01, 0.5,
        lambda size, _: {"rotvec_rad": _numbers(size * way)}, sense=sense,
    )  # fmt: skip


def _axis_gain(rng: np.random.Generator, _: Measurement) -> Cause:
    """One axis in half of the cases, else all six as they come."""
    every = rng.uniform(-1.0, 1.0, 6)
    one = sign(rng) * np.eye(6)[rng.integers(6)]
    way = one if rng.random() < 0.5 else every / np.max(np.abs(every))
    return Cause(
        "axis_gain", 0.02, 0.6, lambda size, _: {"gain": _numbers(size * way)},
        sense=lambda size, _, total: total * (1.0 + size * way),
    )  # fmt: skip


def _crosstalk(rng: np.random.Generator, _: Measurement) -> Cause:
    a, b = (int(axis) for axis in rng.choice(6, 2, replace=False))
    unit = SIGMA[b] / SIGMA[a]
    return Cause(
        "crosstalk", 0.02 * sign(rng), 1.0,
        lambda size, _: {"from": WRENCH_AXES[a], "to": WRENCH_AXES[b], "coefficient": size * unit},
        sense=lambda size, _, total: total + size * unit * np.outer(total[:, a], np.eye(6)[b]),
    )  # fmt: skip


def _saturation(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Hard or soft, x / (1 + |x / L|^p)^(1 / p), at L = twice the peak times exp(-size)."""
    axis = int(rng.integers(6))
    power = float(rng.uniform(12.0, 40.0)) if rng.random() < 0.5 else 0.0
    peak = 2.0 * float(healthy.peaks()[axis])

    def show(size: float, _: Moment, reading: Array) -> Array:
        limit, x = peak * np.exp(-size), reading[:, axis]
        shown = np.array(reading)
        soft = x / (1.0 + np.abs(x / limit) ** power) ** (1.0 / max(power, 1.0))
        shown[:, axis] = soft if power else np.clip(x, -limit, limit)
        return shown

    return Cause(
        "sensor_saturation", 1.0, 4.0,
        lambda size, _: {"limit": float(peak * np.exp(-size)), "axis": WRENCH_AXES[axis]},
        show=show,
    )  # fmt: skip


def _drift(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Warming up, 1 - exp(-t / tau), a random walk that returns, or half of each."""
    way = any_direction(rng, 6) * SIGMA
    share = float(rng.choice([0.0, 0.5, 1.0]))
    duration_s = healthy.session.duration_s
    at_s = np.arange(0.0, duration_s + 8.0, 4.0)
    warm = 1.0 - np.exp(-at_s / rng.uniform(60.0, 900.0))
    keep = np.exp(-4.0 / rng.uniform(60.0, 2000.0))
    walk = lfilter([1.0], [1.0, -keep], rng.standard_normal((len(at_s), 6)), axis=0)
    values = (1.0 - share) * (warm / warm[-1])[:, None] + share * walk / np.std(walk)
    shape = PchipInterpolator(at_s, way * (values - values[0]))
    last = shape(duration_s) / duration_s * 3600.0
    return Cause(
        "sensor_drift", 1.0, 500.0, lambda size, _: {"rate_per_hour": _numbers(size * last)},
        show=lambda size, at, reading: reading + size * shape(np.maximum(at.session_s, 0.0)),
    )  # fmt: skip


def _step(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Within some tens of ms, in the middle three quarters of a bag."""
    bag = str(rng.choice(list(healthy.session.takes)))
    way = any_direction(rng, 6) * SIGMA
    time_s = float(healthy.session.takes[bag].end_s * rng.uniform(0.12, 0.88))
    takes_s = float(rng.uniform(0.02, 0.05))

    def show(size: float, at: Moment, reading: Array) -> Array:
        late = BAGS.index(at.bag) - BAGS.index(bag)
        gone = _smooth((at.bag_s - time_s) / takes_s) if late == 0 else float(late > 0)
        return reading + size * np.multiply.outer(np.broadcast_to(gone, len(reading)), way)

    return Cause(
        "bias_step", 2.0, 1000.0,
        lambda size, _: {
            "time_s": time_s + 0.5 * takes_s, "step": _numbers(size * way), "bag": bag
        },
        show=show,
    )  # fmt: skip


def _smooth(part: Array) -> Array:
    share = np.clip(part, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def _delay(topic: str) -> Draw:
    """By a delay that beats a little, as a polled buffer's does."""

    def draw(rng: np.random.Generator, _: Measurement) -> Cause:
        beat, period_s = rng.uniform(0.0, 0.12), rng.uniform(2.0, 15.0)
        return Cause(
            f"{topic}_delay", 0.005, 0.5, lambda size, _: {"delay_s": size},
            late=(topic, lambda size, at_s: size * (
                1.0 + beat * (2.0 * np.mod(at_s / period_s, 1.0) - 1.0)
            )),
        )  # fmt: skip

    return draw


# Tracker


def _tracker_scale(rng: np.random.Generator, _: Measurement) -> Cause:
    return Cause(
        "tracker_scale", 0.002 * sign(rng), 0.2, lambda size, _: {"gain": size},
        seen=lambda size, position: position * (1.0 + size),
    )  # fmt: skip


def _base_shift(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Once, in the middle three quarters of the pushes."""
    way = np.concatenate([any_direction(rng), rng.uniform(0.5, 5.0) * any_direction(rng)])
    take = healthy.session.takes.get("push")
    time_s = float((100.0 if take is None else take.end_s) * rng.uniform(0.12, 0.88))
    takes_s = float(rng.uniform(0.06, 0.15))
    return Cause(
        "base_shift", 1e-4, 0.2,
        lambda size, _: {
            "translation_m": _numbers(size * way[:3]), "rotvec_rad": _numbers(size * way[3:]),
            "time_s": time_s + 0.5 * takes_s,
        },
        stand=lambda size, at: size * np.outer(_smooth((at.bag_s - time_s) / takes_s), way),
    )  # fmt: skip


LISTED: Mapping[str, Draw] = {
    **{f"joint_zero_offset:{joint}": _zero_offset(joint) for joint in TURNING},
    f"joint_gain:{_LAST}": _gain(_LAST),
    f"joint_axis_misalignment:{_LAST}": _misalignment(_LAST),
    "base_inclination": _inclination,
    "sensor_mount_rotation": _mount,
    "axis_gain": _axis_gain,
    "crosstalk": _crosstalk,
    "sensor_drift": _drift,
    "bias_step": _step,
    "wrench_delay": _delay("wrench"),
    "sensor_saturation": _saturation,
    "tool_mass_error": _mass_error,
    "tool_com_error": _com_error,
    "loose_tool": _loose,
    "cable_drag": _cable,
    "inertial_load": _inertial,
    "joint_compliance": _compliance,
    "deflection_hysteresis": _hysteresis,
    "backlash": _backlash,
    "tracker_delay": _delay("tracker"),
    "tracker_scale": _tracker_scale,
    "base_shift": _base_shift,
}
"""By what a diagnosis distinguishes: the contract's names, with the joint where it has one."""

EFFECTS = tuple(LISTED)

NEED_PUSHES = (
    "joint_compliance", "deflection_hysteresis", "tracker_delay", "tracker_scale", "base_shift",
)  # fmt: skip
"""Only the bag of pushes shows them."""

_ALIKE = (
    {"axis_gain", "crosstalk"}, {"axis_gain", "tool_mass_error"}, {"sensor_drift", "bias_step"},
    {"sensor_mount_rotation", "crosstalk"},
)  # fmt: skip

PAIRS = tuple(pair for pair in combinations(EFFECTS, 2) if set(pair) not in _ALIKE)
"""All pairs but those of near twins."""

TWINS: Mapping[str, Draw] = {
    f"joint_zero_offset:{TURNING[0]}": _zero_offset(TURNING[0]),
    "base_inclination": lambda rng, _: inclined(sign(rng), 0.0),
}
"""Exact twins where nothing pushes: both turn gravity about the first turning axis."""
