# SPDX-License-Identifier: Apache-2.0
"""What a blind recording may hide: causes by the contract's effects.

A `Cause` is a size and what it changes on the way from joints to files. Those of the arm change
the plant that MuJoCo simulates; those of sensor and tracker change arrays. `unlisted.py` has those
that aren't on the list.

Hysteresis, backlash, drift and cables have several models each, `member`, of which the seed picks
one: dry friction in all rods, in some, in the drives, in one of them, there with a larger static
friction, or in series with springs beside the drives' (sliders in parallel: Iwan, J. Appl. Mech.
33, 1966); gaps that close at once, with stiction, or softly; drifts that warm up, walk, do both, or
are linear; a cable that is a spring, one that hangs by its weight, and a hose that is stiff in all
directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2, Arm
from galen_model.arm.galen import GALEN, SENSOR, WRENCH_AXES
from galen_model.arrays import Array
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from galen_validation.blind.mujoco_arm import (
    DECAY,
    Body,
    Cable,
    Gap,
    InnerMass,
    Plant,
    Pull,
    Slider,
    Stribeck,
)
from galen_validation.blind.session import BAGS, any_direction

if TYPE_CHECKING:
    from galen_validation.blind.measuring import Measurement

SIGMA = SENSOR.noise_std
_SOFT = 1e4
"""Stiffness over which the softness of a rigid joint is counted, N.m/rad."""


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
    section 6 names them. plant: the arm; joints: true joints (n, k) of reported ones and of seconds
    since the recording's first stamp (n,); late: topic whose samples are older, by seconds (n,);
    sense: what the sensor makes of the whole wrench; show: what is published of the zeroed reading;
    seen: a marker's position in the tracker; stand: displacement (n, 6) of the base's marker; slip:
    that of the tool's marker in its own axes. member: which of the effect's models.
    """

    name: str
    size: float
    largest: float
    truth: Callable[[float, Measurement], Mapping[str, Any]]
    plant: Callable[[float, Plant], Plant] | None = None
    joints: Callable[[float, Array, Array], Array] | None = None
    late: tuple[str, Callable[[float, Array], Array]] | None = None
    sense: Callable[[float, Moment, Array], Array] | None = None
    show: Callable[[float, Moment, Array], Array] | None = None
    seen: Callable[[float, Array], Array] | None = None
    stand: Callable[[float, Moment], Array] | None = None
    slip: Callable[[float, Moment], Array] | None = None
    member: str = ""

    def resized(self, size: float) -> Self:
        """Return the same cause at another size.

        Args:
            size: Size in the cause's own unit; cut to -largest ... largest.

        Returns:
            A copy.

        """
        return replace(self, size=float(np.clip(size, -self.largest, self.largest)))

    @property
    def changes_motion(self) -> bool:
        """Whether the arm has to be simulated anew."""
        return any(hook is not None for hook in (self.plant, self.joints))


Draw = Callable[[np.random.Generator, "Measurement"], Cause]


def sign(rng: np.random.Generator) -> float:
    """Draw -1 or 1.

    Args:
        rng: Random generator, advanced by one draw.

    Returns:
        Either sign, as likely.

    """
    return float(rng.choice([-1.0, 1.0]))


def _numbers(vector: Array) -> list[float]:
    return [float(value) for value in vector]


# Joints and geometry


def _place(arm: Arm, joint: str) -> Array:
    return np.eye(len(arm.joints))[arm.joint_names.index(joint)]


def _zero_offset(joint: str) -> Draw:
    return lambda rng, _: Cause(
        f"joint_zero_offset:{joint}", 0.005 * sign(rng), 0.3,
        lambda size, _: {"joint": joint, "offset_rad": size},
        plant=lambda size, plant: replace(
            plant, zero=plant.zero + size * _place(plant.arm, joint)
        ),
    )  # fmt: skip


def _gain(joint: str) -> Draw:
    return lambda rng, _: Cause(
        f"joint_gain:{joint}", 0.01 * sign(rng), 0.5,
        lambda size, _: {"joint": joint, "gain": size},
        plant=lambda size, plant: replace(
            plant, gain=plant.gain + size * _place(plant.arm, joint)
        ),
    )  # fmt: skip


def _eccentricity(joint: str) -> Draw:
    """Put an encoder's disc off its shaft, or bend the shaft: once or twice a turn."""

    def draw(rng: np.random.Generator, healthy: Measurement) -> Cause:
        k = healthy.session.arm.joint_names.index(joint)
        cycles, phase = float(rng.integers(1, 3)), float(rng.uniform(-np.pi, np.pi))

        def joints(size: float, reported: Array, _: Array) -> Array:
            true = np.array(reported)
            true[:, k] += size * np.sin(cycles * true[:, k] + phase)
            return true

        return Cause(
            f"joint_eccentricity:{joint}", 0.005, 0.3,
            lambda size, _: {
                "joint": joint, "amplitude_rad": size, "cycles": cycles, "phase_rad": phase,
            },
            joints=joints,
        )  # fmt: skip

    return draw


def _misalignment(joint: str) -> Draw:
    """Turn an axis about z of its parent link, or about x where it lies along z."""

    def draw(rng: np.random.Generator, healthy: Measurement) -> Cause:
        arm = healthy.session.arm
        nominal = arm.joints[arm.joint_names.index(joint)]
        there = np.eye(3) if nominal.rotation is None else nominal.rotation
        about = "x" if abs((there @ nominal.axis)[2]) > 0.9 else "z"
        way = there.T @ np.eye(3)["xyz".index(about)]

        def turned(size: float, plant: Plant) -> Plant:
            turn = Rotation.from_rotvec(size * way)
            joints = tuple(
                replace(own, axis=turn.apply(own.axis)) if own.name == joint else own
                for own in plant.arm.joints
            )
            return replace(plant, arm=replace(plant.arm, joints=joints))

        return Cause(
            f"joint_axis_misalignment:{joint}", 0.01 * sign(rng), 0.4,
            lambda size, _: {"joint": joint, "about": about, "angle_rad": size}, plant=turned,
        )  # fmt: skip

    return draw


def _inclination(rng: np.random.Generator, _: Measurement) -> Cause:
    return inclined(*any_direction(rng, 2))


def inclined(about_x: float, about_y: float) -> Cause:
    """Incline the base about a direction: gravity is (Rx(a) Ry(b))^T g.

    Args:
        about_x: Share of the size about x of base_link: a = size * about_x, rad.
        about_y: Share of the size about the turned y: b = size * about_y, rad.

    Returns:
        A `base_inclination` of 5 mrad, 0.3 rad at most.

    """

    def aslant(size: float, plant: Plant) -> Plant:
        turn = Rotation.from_euler("XY", [size * about_x, size * about_y])
        gravity = turn.inv().apply(plant.arm.gravity_m_s2)
        return replace(plant, arm=replace(plant.arm, gravity_m_s2=gravity))

    return Cause(
        "base_inclination", 0.005, 0.3,
        lambda size, _: {"about_x_rad": size * about_x, "about_y_rad": size * about_y},
        plant=aslant,
    )  # fmt: skip


def _backlash(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """At once, with stiction, or softly over a few tenths of a newton metre."""
    joint = str(rng.choice(healthy.session.arm.turning_names))
    kind, moment = int(rng.integers(3)), rng.uniform(0.05, 0.3)

    def gap(size: float, plant: Plant) -> Plant:
        soft = 2.0 * moment / size if kind == 2 else 0.0
        stiction = 0.3 * moment if kind == 1 else 0.0
        return replace(plant, gap=Gap(joint, size, soft, stiction))

    return Cause(
        "backlash", 0.004, 0.08, lambda size, _: {"joint": joint, "gap_rad": size}, plant=gap,
        member=("hard", "stiction", "soft")[kind],
    )  # fmt: skip


# Springs


def _compliance(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Soften a spring by a share, or a rigid joint to _SOFT over the size."""
    known = healthy.session.arm.stiffness
    name = str(rng.choice(list(known or healthy.session.arm.turning_names)))

    def stiffness(size: float) -> float:
        return known[name] / (1.0 + size) if known else _SOFT / max(size, 1e-3)

    def softer(size: float, plant: Plant) -> Plant:
        # The healthy arm's own is a little other than the nominal one.
        own = plant.arm.stiffness[name] / (1.0 + size) if known else stiffness(size)
        return replace(plant, arm=plant.arm.with_stiffness({name: own}))

    return Cause(
        "joint_compliance", 0.1, 4.0, lambda size, _: {"stiffness": {name: stiffness(size)}},
        plant=softer,
    )  # fmt: skip


def _hysteresis(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Dry friction (N; 50 mm of lever in a joint): the arm stays where the last push left it."""
    members = ["rods", "some rods", "drives", "one drive", "stick-slip", "sliders"]
    member, joint = str(rng.choice(members)), str(rng.choice(healthy.session.arm.turning_names))
    falls = float(rng.uniform(0.02, 0.2))
    legs = rng.permutation([1.0, float(rng.integers(2)), 0.0])
    rods = np.ones(6) if member == "rods" else np.repeat(legs, 2)
    levers = {name: 1.0 if name == "carriage" else 0.05 for name in healthy.plant.arm.stiffness}
    del levers["rod"]

    def rubs(size: float, plant: Plant) -> Plant:
        if "rods" in member:
            return replace(plant, rod_friction_n=size * rods)
        if member == "stick-slip":
            # Stribeck's fall from a static friction twice as large.
            return replace(plant, stribeck=Stribeck(joint, 0.05 * size, 0.025 * size, falls))
        if member == "one drive":
            return replace(plant, friction={joint: 0.05 * size})
        return replace(plant, friction={name: size * lever for name, lever in levers.items()})

    slides_n = rng.uniform(2.0, 8.0)

    def slides(size: float, plant: Plant) -> Plant:
        """Sliders carry a share of each drive's load until it is slides_n or twice that."""
        beside, own = [], {}
        for name, lever in levers.items():
            stiffness = plant.arm.stiffness[name]
            own[name] = (1.0 - size) * stiffness
            joints = [f"carriage{leg}" for leg in range(3)] if name == "carriage" else [name]
            for part, limit in ((0.6, 1.0), (0.4, 2.0)):
                friction = part * size * limit * slides_n * lever
                beside += [Slider(joint, part * size * stiffness, friction) for joint in joints]
        return replace(plant, arm=plant.arm.with_stiffness(own), sliders=tuple(beside))

    start, largest = {"sliders": (0.2, 0.8), "drives": (2.0, 6.0)}.get(member, (5.0, 60.0))
    return Cause(
        "deflection_hysteresis", start, largest,
        lambda _, measured: {"residual_fraction": measured.residual_fraction()},
        plant=slides if member == "sliders" else rubs, member=member,
    )  # fmt: skip


def _creep(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """To what pushes move the tip, e, comes c with tau dc/dt = size e - c."""
    tau_s = float(np.exp(rng.uniform(0.0, np.log(10.0))))

    @cache
    def crept() -> tuple[Array, Array]:
        at_s, moved = healthy.pushed_by("push")
        keep = np.exp(-(at_s[1] - at_s[0]) / tau_s)
        return at_s, np.asarray(lfilter([1.0 - keep], [1.0, -keep], moved, axis=0))

    def slip(size: float, at: Moment) -> Array:
        if at.bag != "push":
            return np.zeros((len(at.bag_s), 6))
        times, state = crept()
        columns = [size * np.interp(at.bag_s, times, column) for column in state.T]
        return np.stack(columns, axis=1)

    return Cause(
        "deflection_creep", 0.1, 3.0, lambda size, _: {"fraction": size, "tau_s": tau_s}, slip=slip
    )


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


def _cable(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Held somewhere above, beside or behind the tool; its size is the usual tension."""
    arm = healthy.session.arm
    rotation, origin = arm.sensor_pose(arm.home)
    away = rng.uniform([-0.7, 0.2, 0.2], [0.1, 0.7, 1.0]) * [1.0, sign(rng), 1.0]
    hold = rng.uniform([0.02, -0.02, 0.02], [0.10, 0.02, 0.08])
    rest = origin + rotation @ hold
    x, y, z = rest + away
    member = str(rng.choice(["spring", "hanging", "hose"]))
    usual = float(np.linalg.norm(away))
    grow, weight, friction = rng.uniform([1.05, 0.05, 0.0], [2.5, 0.3, 0.03])
    slack, sideways = rng.uniform(1.05, 1.3), rng.uniform(0.2, 1.0)
    courses = [take.course(take.wrench.taken_s[::20]) for take in healthy.session.takes.values()]
    turns, origins = arm.sensor_pose(np.concatenate(courses))
    farthest = float(np.max(np.linalg.norm(rest + away - origins - turns @ hold, axis=1)))

    def hung(size: float, plant: Plant) -> Plant:
        if member == "hose":
            # Straight it pulls by `size` where the arm is at home, and is a spring in all ways.
            along = away / usual
            spring = 2.0 * size / usual * np.diag(np.where(np.eye(3)[2], 1.0, sideways))
            neutral = rest + np.linalg.solve(spring, size * along)
            return replace(plant, pull=Pull(hold, lambda at: (neutral - at) @ spring))
        if member == "hanging":
            length = slack * farthest
            return replace(
                plant, pull=Pull(hold, lambda at: catenary(at, rest + away, length, size))
            )
        # Tension `size` at the usual distance, and `grow` times more of it at twice that.
        cable = Cable(
            (x, y, z), tuple(hold), size * grow / usual, usual * (1.0 - 1.0 / grow),
            size * weight / STANDARD_GRAVITY_M_S2, size * friction,
        )  # fmt: skip
        return replace(plant, cable=cable)

    return Cause(
        "cable_drag", 0.2, 10.0, lambda _, measured: {"tension_N": measured.mean_tension()},
        plant=hung, member=member,
    )  # fmt: skip


def catenary(at: Array, anchor: Array, length_m: float, weight_n: float) -> Array:
    """Return the force of a heavy cable on its lower ends.

    With the span h, the height v and sinh(x) / x = sqrt(L^2 - v^2) / h it pulls by the weight of h
    / (2 x) sideways, and down by half its weight less v / L coth(x) of that (Irvine, Cable
    Structures, 1981, chapter 1).

    Args:
        at: Lower ends in base_link, z up, (n, 3), m.
        anchor: Upper end in base_link, (3,), m.
        length_m: Length L of the cable.
        weight_n: Weight of the whole cable.

    Returns:
        Forces in base_link, (n, 3), N.

    """
    away = anchor - at
    span = np.maximum(np.linalg.norm(away[:, :2], axis=1), 1e-3)
    height = away[:, 2]
    slack = np.sqrt(np.maximum(length_m**2 - height**2, 1e-9)) / span
    x = np.full(len(at), 5.0)
    for _ in range(50):  # Newton's, from above: sinh(x) / x is convex
        x = x - (np.sinh(x) / x - np.maximum(slack, 1.0001)) * x**2 / (x * np.cosh(x) - np.sinh(x))
    density = weight_n / length_m
    down = 0.5 * density * (length_m - height / np.tanh(x))
    sideways = (0.5 * density / x)[:, None] * away[:, :2]
    return np.column_stack([sideways, -down])


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


def _bent(rng: np.random.Generator, _: Measurement) -> Cause:
    """Bend an axis: reading += size x^2 / (100 noises), in half of the cases with x's sign."""
    axis, odd = int(rng.integers(6)), bool(rng.random() < 0.5)
    unit = 1.0 / (100.0 * SIGMA[axis])

    def sense(size: float, _: Moment, total: Array) -> Array:
        read, own = np.array(total), total[:, axis]
        read[:, axis] += size * unit * own * (np.abs(own) if odd else own)
        return read

    return Cause(
        "sensor_nonlinearity", 0.03 * sign(rng), 1.0,
        lambda size, _: {"axis": WRENCH_AXES[axis], "coefficient": size * unit}, sense=sense,
    )  # fmt: skip


def _lagging(rng: np.random.Generator, _: Measurement) -> Cause:
    """Come back along another line: x - size (x - play of x), the play a share of the largest."""
    share = rng.uniform(0.05, 0.4)

    def sense(size: float, _: Moment, total: Array) -> Array:
        if len(total) < 2:
            return total
        width = share * np.max(np.abs(total - total[0]), axis=0)
        held, state = np.empty_like(total), total[0]
        for k, (low, high) in enumerate(zip(total - width, total + width, strict=True)):
            state = np.minimum(np.maximum(state, low), high)
            held[k] = state
        return np.asarray(total - size * (total - held))

    return Cause(
        "sensor_hysteresis", 0.1, 0.9, lambda size, _: {"fraction": size * share}, sense=sense
    )


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
    """Warming up, 1 - exp(-t / tau), a random walk that returns, half of each, or straight."""
    way = any_direction(rng, 6) * SIGMA
    member = str(rng.choice(["warming", "walk", "both", "linear"]))
    duration_s = healthy.session.duration_s
    at_s = np.arange(0.0, duration_s + 8.0, 4.0)
    warm = 1.0 - np.exp(-at_s / rng.uniform(60.0, 900.0))
    keep = np.exp(-4.0 / rng.uniform(60.0, 2000.0))
    walk = lfilter([1.0], [1.0, -keep], rng.standard_normal((len(at_s), 6)), axis=0)
    walk = walk / np.std(walk)
    even = np.ones(6) * (warm / warm[-1])[:, None]
    shapes = {
        "warming": even, "walk": walk, "both": 0.5 * (even + walk),
        "linear": np.outer(at_s / duration_s, np.ones(6)),
    }  # fmt: skip
    values = shapes[member]
    shape = PchipInterpolator(at_s, way * (values - values[0]))
    last = shape(duration_s) / duration_s * 3600.0
    return Cause(
        "sensor_drift", 1.0, 500.0, lambda size, _: {"rate_per_hour": _numbers(size * last)},
        show=lambda size, at, reading: reading + size * shape(np.maximum(at.session_s, 0.0)),
        member=member,
    )  # fmt: skip


def _step(rng: np.random.Generator, healthy: Measurement) -> Cause:
    """Within some tens of ms, in the middle three quarters of a bag."""
    bag = str(rng.choice(list(healthy.session.takes)))
    way = any_direction(rng, 6) * SIGMA
    time_s = float(healthy.session.takes[bag].end_s * rng.uniform(0.12, 0.88))
    takes_s = float(rng.uniform(0.02, 0.05))

    def show(size: float, at: Moment, reading: Array) -> Array:
        late = BAGS.index(at.bag) - BAGS.index(bag)
        gone = smooth((at.bag_s - time_s) / takes_s) if late == 0 else float(late > 0)
        return reading + size * np.multiply.outer(np.broadcast_to(gone, len(reading)), way)

    return Cause(
        "bias_step", 2.0, 1000.0,
        lambda size, _: {
            "time_s": time_s + 0.5 * takes_s, "step": _numbers(size * way), "bag": bag
        },
        show=show,
    )  # fmt: skip


def smooth(part: Array) -> Array:
    """Rise from 0 to 1 between the parts 0 and 1, without a kink.

    Args:
        part: Elapsed share of the step, any shape; outside 0 ... 1 the ends hold.

    Returns:
        Shares 0 ... 1, of the same shape.

    """
    share = np.clip(part, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def _delay(topic: str) -> Draw:
    """By a delay that beats a little, as a polled buffer's does.

    The tracker's is steady where an arm doesn't give: it shows on three short ways alone.
    """

    def draw(rng: np.random.Generator, healthy: Measurement) -> Cause:
        beat, period_s = rng.uniform(0.0, 0.12), rng.uniform(2.0, 15.0)
        if topic == "tracker" and not healthy.session.arm.stiffness:
            beat = 0.0
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
        stand=lambda size, at: size * np.outer(smooth((at.bag_s - time_s) / takes_s), way),
    )  # fmt: skip


def listed(arm: Arm) -> dict[str, Draw]:
    """Return an arm's causes by what a diagnosis distinguishes, with the joint where it has one.

    Gains and axes of the Galen are its last joint's; of other arms every joint's. The zero of a
    joint about gravity does nothing that where the tracker stands wouldn't do, and where no joint
    gives, no deflection can stay.

    Args:
        arm: The nominal arm.

    Returns:
        By identity, how a seed draws the cause.

    """
    names = arm.turning_names
    _, axes = arm.joint_axes(arm.home)
    upright = abs(axes[arm.turning[0]] @ arm.gravity_m_s2) > 0.999 * STANDARD_GRAVITY_M_S2
    zeros = names[1:] if upright else names
    others = names[-1:] if arm.delta is not None else zeros
    return {
        **{f"joint_zero_offset:{joint}": _zero_offset(joint) for joint in zeros},
        **{f"joint_gain:{joint}": _gain(joint) for joint in others},
        **{f"joint_eccentricity:{joint}": _eccentricity(joint) for joint in zeros},
        **{f"joint_axis_misalignment:{joint}": _misalignment(joint) for joint in others},
        **{name: draw for name, draw in _ANYWHERE.items() if arm.stiffness or name not in _SPRINGY},
    }


_ANYWHERE: Mapping[str, Draw] = {
    "base_inclination": _inclination,
    "sensor_mount_rotation": _mount,
    "axis_gain": _axis_gain,
    "crosstalk": _crosstalk,
    "sensor_nonlinearity": _bent,
    "sensor_hysteresis": _lagging,
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
    "deflection_creep": _creep,
    "backlash": _backlash,
    "tracker_delay": _delay("tracker"),
    "tracker_scale": _tracker_scale,
    "base_shift": _base_shift,
}

_SPRINGY = ("deflection_hysteresis", "deflection_creep")

EFFECTS = tuple(listed(GALEN))
"""Of the Galen."""

NEED_PUSHES = (
    "joint_compliance", "deflection_hysteresis", "deflection_creep", "tracker_delay",
    "tracker_scale", "base_shift",
)  # fmt: skip
"""Only the bag of pushes shows them."""

_ALIKE = (
    {"axis_gain", "crosstalk"}, {"axis_gain", "tool_mass_error"}, {"sensor_drift", "bias_step"},
    {"sensor_mount_rotation", "crosstalk"},
)  # fmt: skip


def pairs(arm: Arm) -> tuple[tuple[str, str], ...]:
    """Return all pairs of an arm's causes but those of near twins.

    Args:
        arm: The nominal arm.

    Returns:
        Pairs of identities, each once, in the order of `listed`.

    """
    return tuple(pair for pair in combinations(listed(arm), 2) if set(pair) not in _ALIKE)


PAIRS = pairs(GALEN)
"""Of the Galen."""


def twins(arm: Arm) -> dict[str, Draw]:
    """Return exact twins where nothing pushes: all turn gravity about the same axis.

    These are zeros of parallel joints, and of the first joint and the base.

    Args:
        arm: The nominal arm.

    Returns:
        By identity, how a seed draws the cause.

    """
    if arm.delta is not None:
        return {
            f"joint_zero_offset:{arm.turning_names[0]}": _zero_offset(arm.turning_names[0]),
            "base_inclination": lambda rng, _: inclined(sign(rng), 0.0),
        }
    _, axes = arm.joint_axes(arm.home)
    along = np.abs(np.sum(axes[1:] * axes[:-1], axis=1)) > 0.999
    parallel = np.concatenate([[False], along]) | np.concatenate([along, [False]])
    joints = [name for name, one in zip(arm.joint_names, parallel, strict=True) if one]
    return {f"joint_zero_offset:{joint}": _zero_offset(joint) for joint in joints}
