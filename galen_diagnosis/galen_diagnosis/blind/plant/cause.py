"""What a hidden cause may change on the way from joints to readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm, Body, Pose, Springs
from galen_diagnosis.blind.plant.course import Going
from galen_diagnosis.blind.plant.session import Session, Take

if TYPE_CHECKING:
    from galen_diagnosis.blind.plant.machine import Machine


@dataclass(frozen=True)
class Moment:
    """n true times of a bag: since its first stamp, since the recording's, and how the arm goes."""

    take: Take
    bag_s: Array
    session_s: Array
    going: Going

    def __len__(self) -> int:
        return len(self.bag_s)


@dataclass(frozen=True)
class State:
    """The true arm at n times: joints (n, 5), pose, gravity (n, 3) in ft_sensor, tool."""

    arm: BlindArm
    joints: Array
    pose: Pose
    gravity: Array
    tool: Body
    adapter: Body
    tip_m: Array


@dataclass(frozen=True)
class Cause:
    """Base of all causes; changes nothing.

    size: how much, in the unit of `typical`, which is where the search for a strength starts;
    `largest`: beyond it makes no sense. What else a cause has is its shape.
    """

    name: ClassVar[str]
    typical: ClassVar[float]
    largest: ClassVar[float]
    order: ClassVar[int] = 0
    linear: ClassVar[bool] = True
    """Whether readings change by `size` times something, nearly."""

    size: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """One of its kind at its typical size."""
        return cls(size=cls.typical * float(rng.choice([-1.0, 1.0])))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """What an answer with this name can explain: a list of linear families."""
        return [[cls(size=cls.typical)]]

    def times(self, factor: float) -> Self:
        """The same, larger by a factor."""
        return replace(self, size=self.size * factor)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """As the contract's section 6 names them."""
        raise NotImplementedError

    # --- the way from joints to readings ------------------------------------------------------

    def late(self, stamp_s: Array, of: str) -> Array:
        """When samples were really taken that are thought of as taken at `stamp_s` (n,).

        of: "wrench" or "tracker".
        """
        return stamp_s

    def joints(self, at: Moment, joints: Array) -> Array:
        """True joints (n, 5)."""
        return joints

    def arm(self, arm: BlindArm) -> BlindArm:
        """The arm's numbers."""
        return arm

    def tool(self, at: Moment, tool: Body, com_m: Array, gravity: Array) -> tuple[Body, Array]:
        """The tool, and its centre (n, 3) that may move with gravity (n, 3) in ft_sensor."""
        return tool, com_m

    def wrench(self, at: Moment, state: State) -> Array | None:
        """What else pulls at the sensor (n, 6), about its origin in ft_sensor."""
        return None

    def sense(self, at: Moment, total: Array) -> Array:
        """What the sensor makes of the whole wrench (n, 6) on it."""
        return total

    def show(self, at: Moment, reading: Array) -> Array:
        """What is published of the zeroed reading (n, 6)."""
        return reading

    def displace(self, at: Moment, springs: Springs, loads: Array, place: int) -> Array | None:
        """More displacement (n, 6) of the tip in base_link under loads (n, 8) of the springs.

        At one place of pushes, on an even grid of `HISTORY_S` from the arrival there.
        """
        return None

    def track(self, at: Moment, position: Array) -> Array:
        """A marker's position (n, 3) as the tracker tells it."""
        return position

    def stand(self, at: Moment) -> Array | None:
        """How far the base marker's stand has moved (n, 6): m and rad in base_link."""
        return None


def size_of(vector: Array) -> list[float]:
    """Numbers for a truth's file."""
    return [float(value) for value in vector]
