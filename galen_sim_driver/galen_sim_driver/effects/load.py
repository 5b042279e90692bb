# SPDX-License-Identifier: Apache-2.0
"""Effects of the load on the sensor (contract, section 6).

A tool of another mass, same centre; of another centre; or loose in its mount, whose centre is

    p = p_file + shift (d_x, d_y, 0),   d the unit vector of gravity in ft_sensor.

Inertial forces of tool and adapter: Newton and Euler (`galen_model.load.inertia`) with s = -a, the
part without gravity, for tool and adapter as two points, each at its own centre p_i with the share
of `mass_kg` that it has of the weight of both:

    m_i = mass_kg w_i / sum w,   h = sum m_i p_i,   I = sum m_i (p_i.p_i 1 - p_i p_i^T)

so that they swing about their common centre h / m. What the bodies turn about their own centres,
some 1e-4 kg m^2 for a tool of this size, is `own_inertia_kg_m2`, added to I.

Cable:

    T(d) = T_0 g(kappa (d - d_0)),   g(x) = c ln(1 + exp((x_1 + x) / c)),   c = 1/4

is the tension at a distance d from attachment to anchor, T_0 that at the distance d_0: a spring of
stiffness kappa T_0 where the cable is taut, nothing where it is slack, with a rounded corner
between, as a sagging cord has it; x_1 is such that g(0) = 1. It is smooth in all its numbers, and
for a given kappa proportional to T_0.

The cord is bent where it leaves the tool: at home it lies straight, and where its direction l in
ft_sensor is another than n at home, it turns the tool back to it by M = B n x l. A cable without
weight, free to turn at its anchor, passes that moment on as a force across itself, so that all of
it together has no moment about the anchor:

    f = T l + (M x l) / d,    tau = r x f + M     about the sensor's origin, r to the attachment.

Cables on real arms have weight and friction and lie against things as well. None of that is here.

`tension_n` is the tension when the attachment is at `reference_m`. With the attachment's mean
position there (`centred`), it is the mean tension over a recording but for how the line's length
curves: a few percent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from galen_common.parameters import param
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.load.inertia import LoadInMotion, inertial_wrench, point_mass_inertia
from galen_model.load.model import Load
from galen_model.rotation import skew
from numpy.typing import ArrayLike

from galen_sim_driver.effects.effect import ConfigError, Effect, Fitted, Instants, Posture


@dataclass(frozen=True)
class ToolMassError(Effect):
    """true mass = file's + `delta_kg`."""

    name = "tool_mass_error"
    fitted = (Fitted("delta_kg", "kg", 0.005, -1.0, 5.0),)

    delta_kg: float = param(
        0.0, "how much the tool weighs more than its number says, kg", -1.0, 5.0
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """Add the mass's error; the centre stays.

        Args:
            mass_kg: as the tool's file has it, kg.
            com_m: centre (n, 3) in ft_sensor, m.
            direction: not used.

        Returns:
            Mass, kg, and centre (n, 3), m.

        """
        return mass_kg + self.delta_kg, com_m


@dataclass(frozen=True)
class ToolComError(Effect):
    """true centre = file's + `delta_m`, in ft_sensor."""

    name = "tool_com_error"
    fitted = (Fitted("delta_m", "m", 0.003, -0.5, 0.5, 3),)

    delta_m: tuple[float, ...] = param(
        (0.0,) * 3,
        "the tool's centre of mass less where its numbers say, in `ft_sensor`, m",
        -0.5,
        0.5,
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """Add the centre's error; the mass stays.

        Args:
            mass_kg: as the tool's file has it, kg.
            com_m: centre (n, 3) in ft_sensor, m.
            direction: not used.

        Returns:
            Mass, kg, and centre (n, 3), m.

        """
        return mass_kg, com_m + np.asarray(self.delta_m)


@dataclass(frozen=True)
class LooseTool(Effect):
    """The tool's centre moves by `shift_m` times x and y of gravity's direction."""

    name = "loose_tool"
    fitted = (Fitted("shift_m", "m", 0.003, -0.2, 0.2),)

    shift_m: float = param(
        0.0,
        "a tool that sags in its mount: its centre moves by this length times the x and y parts, "
        "in `ft_sensor`, of gravity's unit vector, m",
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """Let the centre sag along x and y of gravity; the mass stays.

        Args:
            mass_kg: as the tool's file has it, kg.
            com_m: centre (n, 3) in ft_sensor, m.
            direction: of gravity (n, 3) in ft_sensor, unit vectors.

        Returns:
            Mass, kg, and centre (n, 3), m.

        """
        return mass_kg, com_m + self.shift_m * direction * np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True)
class InertialLoad(Effect):
    """`mass_kg` accelerates with the sensor, tool and adapter together."""

    name = "inertial_load"
    has_limit = False
    fitted = (Fitted("mass_kg", "kg", 0.15, 0.0, 5.0),)
    needs_motion = True
    beyond_contract = ("own_inertia_kg_m2",)

    mass_kg: float = param(0.0, "mass of tool and adapter that accelerates, kg", 0.0, 5.0)
    own_inertia_kg_m2: tuple[float, ...] = param(
        (0.0,) * 6,
        "inertia of tool and adapter about their own centres, along `ft_sensor`, summed: entries "
        "xx yy zz xy xz yz of the tensor, kg m^2",
    )

    @property
    def changes_nothing(self) -> bool:
        return self.mass_kg == 0.0 and not any(self.own_inertia_kg_m2)

    def validate(self) -> None:
        xx, yy, zz, xy, xz, yz = self.own_inertia_kg_m2
        low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        # To rounding: a thin rod has two equal moments and a third of zero.
        slack = 1e-9 * max(abs(low), abs(high))
        if low < -slack or high > low + middle + slack:
            raise ConfigError(
                f"{self.name}: own_inertia_kg_m2 is {list(self.own_inertia_kg_m2)}, which no body "
                "can have"
            )

    def wrench(self, when: Instants, posture: Posture) -> Array | None:
        """Return the inertial forces of tool and adapter.

        Args:
            when: of which only the number of samples counts.
            posture: the sensor's motion, and the loads that share the mass.

        Returns:
            Wrench (n, 6) about the sensor's origin in ft_sensor, N and N.m; None without motion or
            loads.

        """
        motion = posture.motion
        loads = (posture.tool, posture.adapter)
        if motion is None or sum(load.mass_kg for load in loads) <= 0.0:
            return None
        masses = tuple((load.mass_kg, *np.asarray(load.com_m).tolist()) for load in loads)
        moments, inertia = _numbers(self.mass_kg, masses)
        inertia = inertia + np.array(self.own_inertia_kg_m2)
        moved = (-motion.acceleration_m_s2, motion.velocity_rad_s, motion.acceleration_rad_s2)
        if len(when) == 1:  # a driver's sample: some ten times as fast
            specific, turning, faster = (tuple(part[0].tolist()) for part in moved)
            return np.array([LoadInMotion(moments, inertia).wrench(specific, turning, faster)])
        return inertial_wrench(*moved, moments, inertia)


@lru_cache(maxsize=256)
def _numbers(mass_kg: float, loads: tuple[tuple[float, ...], ...]) -> tuple[Array, Array]:
    """Moments (4,) and inertia (6,) of `mass_kg` dealt to loads of (mass, centre)."""
    weight = sum(load[0] for load in loads)
    dealt = [Load(mass_kg * load[0] / weight, np.array(load[1:])) for load in loads]
    return np.sum([load.moments for load in dealt], axis=0), point_mass_inertia(*dealt)


_CORNER = 0.25
_TAUT = _CORNER * float(np.log(np.expm1(1.0 / _CORNER)))
_NEAREST_M = 0.01
"""Nearer than this the line has no direction any more; the cable is slack there."""


@dataclass(frozen=True)
class CableDrag(Effect):
    """A cable of `tension_n` from the tool to `anchor_m`.

    The wrench is linear in `tension_n` and `bending_nm`. Priors of the other numbers lie about
    their defaults, which say where a cable usually is.
    """

    name = "cable_drag"
    fitted = (
        Fitted("tension_n", "N", 0.2, 0.0, 50.0),
        Fitted("anchor_m", "m", 0.5, -5.0, 5.0, 3),
        Fitted("attachment_m", "m", 0.06, -0.5, 0.5, 3),
        Fitted("stretch_per_m", "1/m", 3.0, 0.0, 50.0),
        Fitted("bending_nm", "N.m", 0.005, -1.0, 1.0),
    )
    contract_names: ClassVar[Mapping[str, str]] = {"tension_n": "tension_N"}
    beyond_contract = (
        "anchor_m",
        "attachment_m",
        "stretch_per_m",
        "bending_nm",
        "reference_m",
    )

    tension_n: float = param(0.0, "tension when the attachment is at reference_m, N", 0.0, 50.0)
    anchor_m: tuple[float, ...] = param(
        (0.35, 0.35, 0.9), "where the cable's other end is held, in base_link, m", -5.0, 5.0
    )
    attachment_m: tuple[float, ...] = param(
        (0.08, 0.0, 0.06), "where it leaves the tool, in ft_sensor, m", -0.5, 0.5
    )
    stretch_per_m: float = param(
        3.0,
        "how much tighter a metre farther from the anchor, as a fraction of tension_n",
        0.0,
        50.0,
    )
    bending_nm: float = param(
        0.0, "moment of the cord bent to a right angle to how it lies at home, Nm", -1.0, 1.0
    )
    reference_m: tuple[float, ...] = param(
        (0.7, 0.0, 0.442), "where the attachment is at tension_n, in base_link, m", -5.0, 5.0
    )

    @property
    def changes_nothing(self) -> bool:
        return self.tension_n == 0.0 and self.bending_nm == 0.0

    def centred(self, rotation: Array, origin: Array) -> Self:
        """Return the same with `reference_m` at the attachment's mean position.

        Args:
            rotation: R_base_sensor (n, 3, 3).
            origin: of the sensor (n, 3) in base_link, m.

        Returns:
            A new effect.

        """
        at = np.mean(origin + rotation @ np.asarray(self.attachment_m), axis=0)
        return replace(self, reference_m=tuple(float(value) for value in at))

    def tension(self, rotation: Array, origin: Array) -> Array:
        """Return the cable's tension T.

        Args:
            rotation: R_base_sensor (n, 3, 3).
            origin: of the sensor (n, 3) in base_link, m.

        Returns:
            (n,), N.

        """
        return self._tension(cable_line(rotation, origin, self.anchor_m, self.attachment_m)[0])

    def _tension(self, distance_m: Array) -> Array:
        at_reference = np.linalg.norm(np.subtract(self.anchor_m, self.reference_m))
        farther = self.stretch_per_m * (distance_m - at_reference)
        return self.tension_n * relative_tension(farther)

    def wrench(self, when: Instants, posture: Posture) -> Array | None:
        """Return the cable's pull and bending moment.

        Args:
            when: not used.
            posture: the sensor's pose; the arm, for the cable's direction at home.

        Returns:
            Wrench (n, 6) about the sensor's origin in ft_sensor, N and N.m.

        """
        distance_m, direction = cable_line(
            posture.rotation, posture.origin, self.anchor_m, self.attachment_m
        )
        return cable_wrench(
            self._tension(distance_m),
            self.bending_nm,
            distance_m,
            direction,
            self._direction_at_home(posture.arm) if self.bending_nm else np.zeros(3),
            self.attachment_m,
        )

    def _direction_at_home(self, arm: Arm) -> Array:
        return cable_line(*arm.sensor_pose(arm.home), self.anchor_m, self.attachment_m)[1]


def cable_line(
    rotation: ArrayLike, origin: ArrayLike, anchor_m: ArrayLike, attachment_m: ArrayLike
) -> tuple[Array, Array]:
    """Return distance and direction from attachment to anchor.

    Args:
        rotation: R_base_sensor (..., 3, 3).
        origin: of the sensor (..., 3) in base_link, m.
        anchor_m: (3,) in base_link, m.
        attachment_m: (3,) in ft_sensor, m.

    Returns:
        Distance (...,), m, and unit vector (..., 3) in ft_sensor.

    """
    to_anchor = np.asarray(anchor_m, dtype=float) - np.asarray(origin, dtype=float)
    line = np.einsum("...ji,...j->...i", np.asarray(rotation), to_anchor)
    line = line - np.asarray(attachment_m, dtype=float)
    distance_m = np.linalg.norm(line, axis=-1)
    return distance_m, line / np.maximum(distance_m, 1e-9)[..., None]


def relative_tension(farther: ArrayLike) -> Array:
    """Return g(x), the tension over T_0.

    Args:
        farther: x = kappa (d - d_0), any shape.

    Returns:
        The same shape; 1 at 0, near 0 where the cable is slack.

    """
    return _CORNER * np.logaddexp(0.0, (_TAUT + np.asarray(farther, dtype=float)) / _CORNER)


def cable_wrench(
    tension_n: ArrayLike,
    bending_nm: float,
    distance_m: Array,
    direction: Array,
    home_direction: Array,
    attachment_m: ArrayLike,
) -> Array:
    """Return force and torque of a cable.

    Args:
        tension_n: (...,), N.
        bending_nm: B, N.m; 0: it does not bend.
        distance_m: from attachment to anchor (...,), m.
        direction: from attachment to anchor (..., 3) in ft_sensor, unit vectors.
        home_direction: the same at home (3,); not used without bending.
        attachment_m: (3,) in ft_sensor, m.

    Returns:
        Wrench (..., 6) about the sensor's origin in ft_sensor, N and N.m.

    """
    force = np.asarray(tension_n)[..., None] * direction
    # r x f as a product: numpy's cross takes longer than all the rest of one sample.
    torque_of = skew(attachment_m).T
    if not bending_nm:
        return np.concatenate([force, force @ torque_of], axis=-1)
    moment = bending_nm * direction @ skew(home_direction).T
    span_m = np.maximum(distance_m, _NEAREST_M)[..., None]
    # (n x l) x l = l (n.l) - n
    across = bending_nm * (direction * (direction @ home_direction)[..., None] - home_direction)
    force = force + across / span_m
    return np.concatenate([force, force @ torque_of + moment], axis=-1)
