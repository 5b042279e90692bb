"""Joints and geometry that aren't as reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm
from galen_diagnosis.blind.plant.cause import Cause, Moment
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.turning import turned_by

ROLL, TILT = 3, 4


@dataclass(frozen=True)
class RollZeroOffset(Cause):
    """True roll = reported + size."""

    name: ClassVar[str] = "joint_zero_offset:roll"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.3

    def joints(self, at: Moment, joints: Array) -> Array:
        """Roll is off."""
        return joints + self.size * np.eye(5)[ROLL]

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """joint, offset_rad."""
        return {"joint": "roll", "offset_rad": self.size}


@dataclass(frozen=True)
class TiltZeroOffset(Cause):
    """True tilt = reported + size."""

    name: ClassVar[str] = "joint_zero_offset:tilt"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.3

    def joints(self, at: Moment, joints: Array) -> Array:
        """Tilt is off."""
        return joints + self.size * np.eye(5)[TILT]

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """joint, offset_rad."""
        return {"joint": "tilt", "offset_rad": self.size}


@dataclass(frozen=True)
class TiltGain(Cause):
    """True tilt = (1 + size) reported."""

    name: ClassVar[str] = "joint_gain:tilt"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.5

    def joints(self, at: Moment, joints: Array) -> Array:
        """Tilt goes farther."""
        return joints * (1.0 + self.size * np.eye(5)[TILT])

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """joint, gain."""
        return {"joint": "tilt", "gain": self.size}


@dataclass(frozen=True)
class TiltAxisMisalignment(Cause):
    """The tilt axis is Rz(size) y: the chain itself is another, with its exact exponential."""

    name: ClassVar[str] = "joint_axis_misalignment:tilt"
    typical: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.4

    def arm(self, arm: BlindArm) -> BlindArm:
        """Its tilt axis turned about the roll link's z."""
        turn = turned_by(np.array([[0.0, 0.0, self.size]]))[0]
        return replace(arm, tilt_axis=turn @ arm.tilt_axis)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """joint, about, angle_rad."""
        return {"joint": "tilt", "about": "z", "angle_rad": self.size}


@dataclass(frozen=True)
class BaseInclination(Cause):
    """The base stands aslant: gravity is (Rx(a) Ry(b))^T g, (a, b) = size times way."""

    name: ClassVar[str] = "base_inclination"
    typical: ClassVar[float] = 0.005
    largest: ClassVar[float] = 0.3

    way: tuple[float, float] = (1.0, 0.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Any direction."""
        angle = rng.uniform(0.0, 2.0 * np.pi)
        return cls(cls.typical, (float(np.cos(angle)), float(np.sin(angle))))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """About both axes."""
        return [[cls(cls.typical, (1.0, 0.0)), cls(cls.typical, (0.0, 1.0))]]

    def arm(self, arm: BlindArm) -> BlindArm:
        """Gravity from another direction."""
        about_x, about_y = (
            turned_by(self.size * part * axis[None])[0]
            for part, axis in zip(self.way, np.eye(3), strict=False)
        )
        return replace(arm, gravity=(about_x @ about_y).T @ arm.gravity)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """about_x_rad, about_y_rad."""
        return {"about_x_rad": self.size * self.way[0], "about_y_rad": self.size * self.way[1]}
