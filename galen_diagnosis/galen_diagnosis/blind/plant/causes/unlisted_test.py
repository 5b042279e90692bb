"""Unlisted causes that only a blind check asks; no threshold has seen them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arm.galen import HOME, SENSOR, WRENCH_AXES
from galen_model.arrays import Array
from scipy.signal import lfilter

from galen_diagnosis.blind.plant.arm import Body
from galen_diagnosis.blind.plant.cause import Cause, Moment, State
from galen_diagnosis.blind.plant.causes.joint import ROLL, TILT
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import any_direction, back, cross

_FINE_S = 0.004


@dataclass(frozen=True)
class HeightScale(Cause):
    """The platform's true height is home's + (1 + size) what is reported of the way from home."""

    name: ClassVar[str] = "height_scale"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.5

    def joints(self, at: Moment, joints: Array) -> Array:
        """Higher."""
        true = np.array(joints)
        true[:, 2] += self.size * (joints[:, 2] - HOME[2])
        return true

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Gain."""
        return {"gain": self.size}


@dataclass(frozen=True)
class MagneticPull(Cause):
    """A magnet near the bench pulls at the tool: size N times (s / d)^4, d to it, s = 8 cm."""

    name: ClassVar[str] = "magnetic_pull"
    typical: ClassVar[float] = 0.2
    largest: ClassVar[float] = 100.0

    at_m: tuple[float, float, float] = (0.8, 0.0, 0.35)

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Some 10 to 15 cm from where the tool works."""
        x, y, z = np.array([0.72, 0.0, 0.50]) + rng.uniform(0.12, 0.2) * any_direction(rng)
        return cls(cls.typical, (float(x), float(y), float(z)))

    def wrench(self, at: Moment, state: State) -> Array | None:
        """Towards it."""
        com = state.tool.com_m
        rotation, origin = state.pose
        way = np.array(self.at_m) - origin - rotation @ com
        square = np.sum(way**2, axis=1, keepdims=True) + 0.05**2
        pull = self.size * (0.08**2 / square) ** 2 * way / np.sqrt(square)
        force = back(rotation, pull)
        return np.concatenate([force, cross(com, force)], axis=1)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Strength and place."""
        return {"force_N": self.size, "at_m": list(self.at_m)}


@dataclass(frozen=True)
class Vibration(Cause):
    """The wrist rings: y'' + 2 z w y' + w^2 y = w^2 a; it reads size (y - a).

    a: the sum of the angles' accelerations.
    """

    name: ClassVar[str] = "vibration"
    typical: ClassVar[float] = 0.02
    largest: ClassVar[float] = 10.0

    frequency_hz: float = 6.0
    damping: float = 0.04
    way: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Slow enough that every topic sees it."""
        way = tuple(float(part) for part in any_direction(rng, 6))
        return cls(cls.typical, rng.uniform(3.0, 8.0), rng.uniform(0.02, 0.06), way)

    def wrench(self, at: Moment, state: State) -> Array | None:
        """What rings."""
        fine_s = np.arange(0.0, at.take.end_s + 1.0, _FINE_S)
        pushed = at.take.course.at(fine_s).acceleration
        pushed = pushed[:, ROLL] + pushed[:, TILT]
        w, z, h = 2.0 * np.pi * self.frequency_hz, self.damping, _FINE_S
        # The oscillator with a held input over each step, from its two complex modes.
        pole = w * complex(-z, np.sqrt(1.0 - z**2))
        turn = np.exp(pole * h)
        modes = lfilter([1.0], [1.0, -turn], pushed)
        forced = np.imag(w**2 / (pole.imag * pole) * (turn - 1.0) * modes)
        y = np.interp(at.bag_s, fine_s[1:], forced[:-1])
        ringing = y - np.interp(at.bag_s, fine_s, pushed)
        scale = np.array(self.way) * SENSOR.noise_std / SENSOR.noise_std[0]
        return np.asarray(self.size * np.outer(ringing, scale))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Frequency and damping."""
        return {"frequency_hz": self.frequency_hz, "damping": self.damping, "size": self.size}


@dataclass(frozen=True)
class SensorHysteresis(Cause):
    """The element creeps back along another line: reading -= size (x - play(x)), by axis.

    The play's width is a tenth of what the axis sees in that bag.
    """

    name: ClassVar[str] = "sensor_hysteresis"
    typical: ClassVar[float] = 0.1
    largest: ClassVar[float] = 3.0

    share: float = 0.1

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Some width."""
        return cls(cls.typical, rng.uniform(0.08, 0.25))

    def sense(self, at: Moment, total: Array) -> Array:
        """What it still has of before."""
        if len(at) < 2:
            return total
        width = self.share * 0.5 * np.ptp(total, axis=0)
        low, high = total - width, total + width
        held = np.empty_like(total)
        state = total[0]
        for k in range(len(total)):
            state = np.minimum(np.maximum(state, low[k]), high[k])
            held[k] = state
        return np.asarray(total - self.size * (total - held))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Share of what was, and width."""
        return {"share": self.size, "width": self.share}


@dataclass(frozen=True)
class BendingTool(Cause):
    """A slender tool bends: its centre goes sideways (x) by size times |gravity's z|."""

    name: ClassVar[str] = "bending_tool"
    typical: ClassVar[float] = 0.002
    largest: ClassVar[float] = 0.1

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """Its centre aside."""
        down = np.abs(gravity[:, 2:]) / np.linalg.norm(gravity, axis=1, keepdims=True)
        return tool, com_m + self.size * (down - 0.5) * np.array([1.0, 0.6, 0.0])

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Way."""
        return {"way_m": self.size}


@dataclass(frozen=True)
class CrossTerm(Cause):
    """An axis has the product of two others: reading_k += size f_x f_z / 1 N, in its noises."""

    name: ClassVar[str] = "cross_term"
    typical: ClassVar[float] = 0.5
    largest: ClassVar[float] = 500.0

    axis: int = 1

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """In any axis."""
        return cls(cls.typical * float(rng.choice([-1.0, 1.0])), int(rng.integers(6)))

    def sense(self, at: Moment, total: Array) -> Array:
        """With the product."""
        sensed = np.array(total)
        sensed[:, self.axis] += self.size * SENSOR.noise_std[self.axis] * total[:, 0] * total[:, 2]
        return sensed

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Axis and coefficient."""
        size = self.size * float(SENSOR.noise_std[self.axis])
        return {"axis": WRENCH_AXES[self.axis], "coefficient": size}


@dataclass(frozen=True)
class EncoderSecondHarmonic(Cause):
    """True angle = reported + size (sin(2 angle + phase) - sin(phase)), of roll or tilt."""

    name: ClassVar[str] = "encoder_second_harmonic"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.2

    joint: int = ROLL
    phase_rad: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Of either."""
        return cls(cls.typical, int(rng.choice([ROLL, TILT])), rng.uniform(0.0, 2.0 * np.pi))

    def joints(self, at: Moment, joints: Array) -> Array:
        """Off with the angle."""
        true = np.array(joints)
        angle = 2.0 * joints[:, self.joint]
        true[:, self.joint] += self.size * (np.sin(angle + self.phase_rad) - np.sin(self.phase_rad))
        return true

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Joint, amplitude, phase."""
        joint = "roll" if self.joint == ROLL else "tilt"
        return {"joint": joint, "amplitude_rad": self.size, "phase_rad": self.phase_rad}


@dataclass(frozen=True)
class AngleCoupling(Cause):
    """The tilt's drive runs along the roll's: true tilt = reported + size reported roll."""

    name: ClassVar[str] = "angle_coupling"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.3

    def joints(self, at: Moment, joints: Array) -> Array:
        """Tilt goes with roll."""
        true = np.array(joints)
        true[:, TILT] += self.size * joints[:, ROLL]
        return true

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Share."""
        return {"coupling": self.size}
