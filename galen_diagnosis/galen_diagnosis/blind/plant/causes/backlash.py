"""Play in a joint: a soft dead band that motion and load cross.

The true angle is q - (gap / 2) s. Going one way s tends to the sign of the motion,

    ds = (sign(dq) - s) |dq| / (share gap),

so that the band is not crossed at once as a hard play is. A moment M of the hand beyond the
friction M_0 carries the link to the other flank: s <= 2 exp(1 - M / M_0) - 1 for M > M_0, and the
other way round; it stays there when the hand goes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm
from galen_diagnosis.blind.plant.cause import Cause, Moment
from galen_diagnosis.blind.plant.causes.joint import ROLL, TILT
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session, Take

_STEP_S = 0.02


@dataclass(frozen=True)
class Backlash(Cause):
    """size: the gap, rad."""

    name: ClassVar[str] = "backlash"
    typical: ClassVar[float] = 0.002
    largest: ClassVar[float] = 0.08

    joint: str = "tilt"
    share: float = 0.4
    friction_nm: float = 0.2

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Of roll or tilt."""
        joint = str(rng.choice(["roll", "tilt"]))
        return cls(cls.typical, joint, rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.3))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Either joint."""
        return [[cls(cls.typical, "roll")], [cls(cls.typical, "tilt")]]

    def joints(self, at: Moment, joints: Array) -> Array:
        """The joint lags."""
        grid_s = np.arange(0.0, at.take.end_s + _STEP_S, _STEP_S)
        side = self._side(at.take, grid_s)
        number = ROLL if self.joint == "roll" else TILT
        true = np.array(joints)
        true[:, number] -= 0.5 * self.size * np.interp(at.bag_s, grid_s, side)
        return true

    def _side(self, take: Take, grid_s: Array) -> Array:
        number = ROLL if self.joint == "roll" else TILT
        travel = np.diff(take.course.at(grid_s).joints[:, number], prepend=0.0)
        travel[0] = 0.0
        kept = np.exp(-np.abs(travel) / (self.share * self.size)).tolist()
        way = np.sign(travel).tolist()
        low, high = (bound.tolist() for bound in self._flanks(take, grid_s))
        side, s = [], 0.0
        for keep, to, at_least, at_most in zip(kept, way, low, high, strict=True):
            if to:
                s = to + (s - to) * keep
            s = min(max(s, at_least), at_most)
            side.append(s)
        return np.array(side)

    def _flanks(self, take: Take, grid_s: Array) -> tuple[Array, Array]:
        """Between which s must be (n,), (n,)."""
        moment = np.zeros(len(grid_s))
        if take.pushes is not None:
            wrench = take.pushes.wrench(grid_s)
            arm = BlindArm()
            for joints, (begin_s, end_s) in zip(take.places, take.recorded, strict=True):
                here = (grid_s >= begin_s) & (grid_s <= end_s)
                turn = np.kron(np.eye(2), arm.pose(joints[None]).rotation[0])
                # About the sensor's origin; the springs' loads are asked for there.
                loads = arm.springs(joints, np.zeros(3)).loads[6 if self.joint == "roll" else 7]
                moment[here] = wrench[here] @ turn.T @ loads
        beyond = 1.0 - np.exp(-np.maximum(0.0, np.abs(moment) / self.friction_nm - 1.0))
        low = np.where(moment < 0.0, 2.0 * beyond - 1.0, -1.0)
        high = np.where(moment > 0.0, 1.0 - 2.0 * beyond, 1.0)
        return low, high

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """joint, gap_rad."""
        return {"joint": self.joint, "gap_rad": self.size}
