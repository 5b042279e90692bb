"""Effects of what hangs on the sensor (contract, section 6).

The tool weighs other than its file says: true mass - file's mass, same centre (contract, 6).

The tool's centre of mass isn't where its file says: true - file's.

The tool sags in its mount.

centre = file's + shift (d_x, d_y, 0),   d: the unit vector of gravity in ft_sensor.

Forces of acceleration of tool and adapter, which nominal leaves out.

Newton and Euler (`galen_model.load.inertia.inertial`) with s = -a, the part without gravity, for
tool and adapter as two points, each at its own centre p_i with the share of `mass_kg` that it has
of the weight of both:

    m_i = mass_kg w_i / sum w,   h = sum m_i p_i,   I = sum m_i (p_i.p_i 1 - p_i p_i^T)

so that they swing about their common centre h / m. What the bodies turn about their own centres,
some 1e-4 kg m^2 for a tool of this size, is `own_inertia_kg_m2`, added to I.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_model.load.inertia.inertial import LoadInMotion, inertial_wrench, point_mass_inertia
from galen_model.load.model import Load
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, Posture
from galen_sim_driver.errors import ConfigError


@dataclass(frozen=True)
class ToolMassError(Effect):
    """true mass = file's + `delta_kg`."""

    name: ClassVar[str] = "tool_mass_error"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delta_kg", "kg", 0.005, -1.0, 5.0),)

    delta_kg: float = param(
        0.0, "how much the tool weighs more than its number says, kg", -1.0, 5.0
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The centre stays."""
        return mass_kg + self.delta_kg, com_m


@dataclass(frozen=True)
class ToolComError(Effect):
    """true centre = file's + `delta_m`, in ft_sensor."""

    name: ClassVar[str] = "tool_com_error"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delta_m", "m", 0.003, -0.5, 0.5, 3),)

    delta_m: tuple[float, ...] = param(
        (0.0,) * 3,
        "the tool's centre of mass less where its numbers say, in `ft_sensor`, m",
        -0.5,
        0.5,
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The mass stays."""
        return mass_kg, com_m + np.asarray(self.delta_m)


@dataclass(frozen=True)
class LooseTool(Effect):
    """The tool's centre moves by `shift_m` times x and y of gravity's direction."""

    name: ClassVar[str] = "loose_tool"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("shift_m", "m", 0.003, -0.2, 0.2),)

    shift_m: float = param(
        0.0,
        "a tool that sags in its mount: its centre moves by this length times the x and y parts, "
        "in `ft_sensor`, of gravity's unit vector, m",
    )

    def tool_load(self, mass_kg: float, com_m: Array, direction: Array) -> tuple[float, Array]:
        """The centre hangs lower."""
        return mass_kg, com_m + self.shift_m * direction * np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True)
class InertialLoad(Effect):
    """`mass_kg` accelerates with the sensor, tool and adapter together."""

    name: ClassVar[str] = "inertial_load"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("mass_kg", "kg", 0.15, 0.0, 5.0),)
    needs_motion: ClassVar[bool] = True
    beyond_contract: ClassVar[tuple[str, ...]] = ("own_inertia_kg_m2",)

    mass_kg: float = param(0.0, "mass of tool and adapter that accelerates, kg", 0.0, 5.0)
    own_inertia_kg_m2: tuple[float, ...] = param(
        (0.0,) * 6,
        "inertia of tool and adapter about their own centres, along `ft_sensor`, summed: entries "
        "xx yy zz xy xz yz of the tensor, kg m^2",
    )

    @property
    def changes_nothing(self) -> bool:
        """Neither mass nor inertia."""
        return self.mass_kg == 0.0 and not any(self.own_inertia_kg_m2)

    def validate(self) -> None:
        """Raise ConfigError unless a body can have the inertia: its moments make a triangle."""
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
        """What the motion adds to the weight."""
        motion = posture.motion
        loads = (posture.tool, posture.adapter)
        if motion is None or sum(load.mass_kg for load in loads) <= 0.0:
            return None
        told = tuple((load.mass_kg, *np.asarray(load.com_m).tolist()) for load in loads)
        moments, inertia = _numbers(self.mass_kg, told)
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
