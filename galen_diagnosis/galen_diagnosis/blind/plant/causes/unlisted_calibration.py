"""Unlisted causes that thresholds may be calibrated on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arm.galen import SENSOR, WRENCH_AXES
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import Body
from galen_diagnosis.blind.plant.cause import Cause, Moment, State
from galen_diagnosis.blind.plant.causes.joint import ROLL, TILT
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import back, cross


@dataclass(frozen=True)
class QuadraticSensor(Cause):
    """An axis bends: reading += size x^2 / x_r, x_r = 100 noises; even, where gains are odd."""

    name: ClassVar[str] = "quadratic_sensor"
    typical: ClassVar[float] = 0.03
    largest: ClassVar[float] = 1.0

    axis: int = 0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """On any axis."""
        return cls(cls.typical * float(rng.choice([-1.0, 1.0])), int(rng.integers(6)))

    def sense(self, at: Moment, total: Array) -> Array:
        """Bent."""
        sensed = np.array(total)
        sensed[:, self.axis] += self.size * total[:, self.axis] ** 2 / self._reference
        return sensed

    @property
    def _reference(self) -> float:
        return float(100.0 * SENSOR.noise_std[self.axis])

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Coefficient in 1/N or 1/(N.m)."""
        return {"axis": WRENCH_AXES[self.axis], "coefficient": self.size / self._reference}


@dataclass(frozen=True)
class RollGain(Cause):
    """True roll = (1 + size) reported; the list has only tilt's."""

    name: ClassVar[str] = "roll_gain"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3

    def joints(self, at: Moment, joints: Array) -> Array:
        """Roll goes farther."""
        return joints * (1.0 + self.size * np.eye(5)[ROLL])

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Gain."""
        return {"gain": self.size}


@dataclass(frozen=True)
class EncoderEccentricity(Cause):
    """Roll's encoder is off its axis: roll += size (sin(roll + phase) - sin(phase))."""

    name: ClassVar[str] = "encoder_eccentricity"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3

    phase_rad: float = 0.5 * np.pi

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Mostly even in roll."""
        return cls(cls.typical * float(rng.choice([-1.0, 1.0])), rng.uniform(1.0, 2.1))

    def joints(self, at: Moment, joints: Array) -> Array:
        """Roll is off with roll."""
        true = np.array(joints)
        roll = joints[:, ROLL]
        true[:, ROLL] += self.size * (np.sin(roll + self.phase_rad) - np.sin(self.phase_rad))
        return true

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Amplitude and phase."""
        return {"amplitude_rad": self.size, "phase_rad": self.phase_rad}


@dataclass(frozen=True)
class FluidHose(Cause):
    """A hose half full: the tool's centre moves by size along its long axis with gravity's z."""

    name: ClassVar[str] = "fluid_hose"
    typical: ClassVar[float] = 0.002
    largest: ClassVar[float] = 0.1

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Always downwards."""
        return cls(cls.typical)

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """Its centre runs along z and x as z of gravity goes."""
        down = gravity[:, 2:] / np.linalg.norm(gravity, axis=1, keepdims=True)
        along = tool.com_m / np.linalg.norm(tool.com_m)
        return tool, com_m + self.size * (down + 0.5 * down**2) * along

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Way at gravity along z."""
        return {"way_m": self.size}


@dataclass(frozen=True)
class ViscousDrag(Cause):
    """A bellows drags at the tool: f = -size v, v the velocity of its centre."""

    name: ClassVar[str] = "viscous_drag"
    typical: ClassVar[float] = 0.1
    largest: ClassVar[float] = 50.0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Drag brakes."""
        return cls(cls.typical)

    def wrench(self, at: Moment, state: State) -> Array | None:
        """Against the motion."""
        w, _, speed, _ = state.arm.twist(state.joints, at.going.velocity, at.going.acceleration)
        com = state.tool.com_m
        rotation = state.pose.rotation
        force = -self.size * (back(rotation, speed) + cross(back(rotation, w), com))
        return np.concatenate([force, cross(com, force)], axis=1)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """In N s / m."""
        return {"drag_N_s_m": self.size}


@dataclass(frozen=True)
class SensorDeadband(Cause):
    """Small values don't come out: reading = x - d tanh(x / d), d = size noises, on every axis."""

    name: ClassVar[str] = "sensor_deadband"
    typical: ClassVar[float] = 1.0
    largest: ClassVar[float] = 60.0
    linear: ClassVar[bool] = False

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Some width."""
        return cls(cls.typical)

    def show(self, at: Moment, reading: Array) -> Array:
        """Less near zero."""
        width = self.size * SENSOR.noise_std
        return np.asarray(reading - width * np.tanh(reading / width))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """Width over the noise."""
        return {"width_sigmas": self.size}


@dataclass(frozen=True)
class WeightSag(Cause):
    """The arm beyond the tilt joint sags under its own weight: tilt += size cos(tilt) cos(roll)."""

    name: ClassVar[str] = "weight_sag"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.3

    def joints(self, at: Moment, joints: Array) -> Array:
        """Tilt is off with the pose."""
        true = np.array(joints)
        true[:, TILT] += self.size * (np.cos(joints[:, TILT]) * np.cos(joints[:, ROLL]) - 1.0)
        return true

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """At home, beyond the joint's zero."""
        return {"sag_rad": self.size}
