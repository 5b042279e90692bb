"""The load that hangs at the sensor: another tool, a loose one, a cable, what accelerates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import Body
from galen_diagnosis.blind.plant.cause import Cause, Moment, State, size_of
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import any_direction, back, cross, forth


@dataclass(frozen=True)
class ToolMassError(Cause):
    """The tool is heavier by size (kg), its centre where the file has it."""

    name: ClassVar[str] = "tool_mass_error"
    typical: ClassVar[float] = 0.001
    largest: ClassVar[float] = 1.0

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """A heavier one."""
        return replace(tool, mass_kg=max(1e-4, tool.mass_kg + self.size)), com_m

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """delta_kg."""
        return {"delta_kg": self.size}


@dataclass(frozen=True)
class ToolComError(Cause):
    """The tool's centre is elsewhere by size times way (m)."""

    name: ClassVar[str] = "tool_com_error"
    typical: ClassVar[float] = 0.001
    largest: ClassVar[float] = 0.1

    way: tuple[float, float, float] = (1.0, 0.0, 0.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Any direction."""
        x, y, z = size_of(any_direction(rng))
        return cls(cls.typical, (x, y, z))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """All three."""
        ways = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        return [[cls(cls.typical, way) for way in ways]]

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """Its centre moved."""
        return tool, com_m + self.size * np.array(self.way)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """delta_m."""
        return {"delta_m": size_of(self.size * np.array(self.way))}


@dataclass(frozen=True)
class LooseTool(Cause):
    """The tool sags by size (m) in its mount, with a soft stop: tanh(k u) / tanh(k) of x and y.

    u are the parts of gravity's unit vector. The stop makes it a little more at small parts than
    the contract's straight line, and the same at one.
    """

    name: ClassVar[str] = "loose_tool"
    typical: ClassVar[float] = 0.001
    largest: ClassVar[float] = 0.08

    stop: float = 0.3

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """It always sags downwards."""
        return cls(cls.typical, float(rng.uniform(0.1, 0.8)))

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """Its centre where gravity takes it."""
        down = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        sag = self.size * np.tanh(self.stop * down) / np.tanh(self.stop)
        sag[:, 2] = 0.0
        return tool, com_m + sag

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """shift_m."""
        return {"shift_m": self.size}


@dataclass(frozen=True)
class CableDrag(Cause):
    """A hanging cable pulls at the tool: a shallow catenary with friction at its guide.

    Tension T = size (1 + grow (d - d_0) / d_0) (1 + mu tanh(d' / 2 cm/s)) along the line from
    where it leaves the tool to the anchor, and half of the cable's own weight straight down: a
    shallow catenary's ends each carry half of it.
    """

    name: ClassVar[str] = "cable_drag"
    typical: ClassVar[float] = 0.1
    largest: ClassVar[float] = 15.0

    anchor_m: tuple[float, float, float] = (0.4, 0.4, 1.1)
    attachment_m: tuple[float, float, float] = (0.05, 0.0, 0.05)
    grow: float = 0.5
    weight_share: float = 0.15
    friction: float = 0.03

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Held somewhere above, beside or behind the arm."""
        x, y, z = rng.uniform([0.0, 0.2, 0.7], [0.8, 0.7, 1.5]) * [1.0, rng.choice([-1.0, 1.0]), 1]
        a, b, c = rng.uniform([0.02, -0.02, 0.02], [0.10, 0.02, 0.08])
        return cls(
            cls.typical, (x, y, z), (a, b, c), rng.uniform(0.2, 1.5), rng.uniform(0.0, 0.2),
            rng.uniform(0.0, 0.05),
        )  # fmt: skip

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Held at some places, any of them pulling more or less."""
        places = [(x, y, z) for x in (0.1, 0.7) for y in (-0.5, 0.5) for z in (0.7, 1.4)]
        return [[cls(cls.typical, place, grow=grow) for place in places for grow in (0.3, 1.2)]]

    def wrench(self, at: Moment, state: State) -> Array | None:
        """The cable's pull."""
        line, tension = self._pull(at, state)
        force = back(state.pose.rotation, tension[:, None] * line)
        down = state.gravity / np.linalg.norm(state.gravity, axis=1, keepdims=True)
        force = force + self.size * self.weight_share * down
        return np.concatenate([force, cross(np.array(self.attachment_m), force)], axis=1)

    def _pull(self, at: Moment, state: State) -> tuple[Array, Array]:
        """Direction (n, 3) in base_link and tension (n,)."""
        lever = forth(state.pose.rotation, np.array(self.attachment_m))
        way = np.array(self.anchor_m) - (state.pose.origin + lever)
        distance = np.linalg.norm(way, axis=1)
        line = way / distance[:, None]
        omega, _, speed, _ = state.arm.twist(state.joints, at.going.velocity, at.going.acceleration)
        leaving = -np.sum(line * (speed + cross(omega, lever)), axis=1)
        usual = float(np.linalg.norm(np.array(self.anchor_m) - [0.72, 0.0, 0.5]))
        tension = self.size * (1.0 + self.grow * (distance - usual) / usual)
        return line, tension * (1.0 + self.friction * np.tanh(leaving / 0.02))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """tension_N, the mean over the recording."""
        tensions = []
        for bag, take in machine.session.takes.items():
            at = machine.moment(bag, take.wrench.taken_s[::20], "wrench")
            tensions.append(self._pull(at, machine.state(at))[1])
        return {"tension_N": float(np.mean(np.concatenate(tensions)))}


@dataclass(frozen=True)
class InertialLoad(Cause):
    """Newton's and Euler's forces of tool and adapter, with their tensors, at the true motion.

        f = -m a_c,   tau = c x f - (I al + w x I w)

    size: the mass of both that accelerates (kg); each has its share of it, and of its own tensor.
    """

    name: ClassVar[str] = "inertial_load"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 5.0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """A mass is positive."""
        return cls(cls.typical)

    def wrench(self, at: Moment, state: State) -> Array | None:
        """What the motion makes of them."""
        rotation = state.pose.rotation
        w, al, _, a = (
            back(rotation, part)
            for part in state.arm.twist(state.joints, at.going.velocity, at.going.acceleration)
        )
        bodies = (state.tool, state.adapter)
        share = self.size / sum(body.mass_kg for body in bodies)
        total = np.zeros((len(at), 6))
        for body in bodies:
            com = body.com_m
            at_com = a + cross(al, com) + cross(w, cross(w, com))
            force = -share * body.mass_kg * at_com
            tensor = share * body.inertia_kg_m2
            spin = al @ tensor.T + cross(w, w @ tensor.T)
            total = total + np.concatenate([force, cross(com, force) - spin], axis=1)
        return total

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """mass_kg."""
        return {"mass_kg": self.size}
