"""Springs that aren't the nominal ones, and what they remember."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm, Springs
from galen_diagnosis.blind.plant.cause import Cause, Moment
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import Session

_NOMINAL = {
    "k_roll": GALEN.roll_stiffness_nm_rad,
    "k_tilt": GALEN.tilt_stiffness_nm_rad,
    "k_carriage": GALEN.carriage_stiffness_n_m,
    "k_rod": GALEN.rod_stiffness_n_m,
}


@dataclass(frozen=True)
class JointCompliance(Cause):
    """One spring is softer: 1 / k = (1 + size) / k_nominal; stiffer for a negative size.

    What is beyond nominal gets less under load, x = give l (1 - harder (l / l_max)^2), as contacts
    do; roll and tilt only.
    """

    name: ClassVar[str] = "joint_compliance"
    typical: ClassVar[float] = 0.1
    largest: ClassVar[float] = 4.0

    which: str = "k_tilt"
    harder: float = 0.05

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Softer, seldom stiffer."""
        return cls(cls.typical, str(rng.choice(list(_NOMINAL))), rng.uniform(0.0, 0.12))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """All four."""
        return [[cls(cls.typical, which, 0.0) for which in _NOMINAL]]

    def arm(self, arm: BlindArm) -> BlindArm:
        """With that stiffness."""
        return replace(arm, **{self.which: getattr(arm, self.which) / (1.0 + self.size)})

    def displace(self, at: Moment, springs: Springs, loads: Array, place: int) -> Array | None:
        """Less of it under load."""
        row = {"k_roll": 6, "k_tilt": 7}.get(self.which)
        if row is None or not self.harder:
            return None
        beyond = self.size / (1.0 + self.size) * springs.give[row, row]
        load = loads[:, row]
        most = max(float(np.max(np.abs(load))), 1e-9)
        moved = -self.harder * beyond * load * (load / most) ** 2
        return np.asarray(np.outer(moved, springs.loads[row]))

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """The one stiffness."""
        stiffness = _NOMINAL[self.which] / (1.0 + self.size)
        return {"stiffness": {self.which.removeprefix("k_"): stiffness}}


_THRESHOLDS = np.array([0.04, 0.1, 0.2, 0.35, 0.55])
"""Of the plays, over the largest load."""
_WEIGHTS = np.array([0.15, 0.25, 0.3, 0.2, 0.1])


@dataclass(frozen=True)
class DeflectionHysteresis(Cause):
    """Deflection that stays.

    "plays": a generalised Prandtl-Ishlinskii operator in every spring (M. Al Janaideh, S. Rakheja,
    C.-Y. Su, Mechatronics 19, 2009, pp. 656-670): of u = l / l_max, l_max the largest load on that
    spring at that place,

        x += size give l_max sum_i w_i F_i[tanh(1.2 u) / tanh(1.2)],

    F_i the play of threshold r_i: it lags. "ahead": Bouc's and Wen's state along each of the tip's
    six displacements e, of v = e / e_max,

        dz = dv (1 - |z|^p (0.8 s + 0.2)) / knee,   s = +-1: whether v goes the way z lies

    (Y.-K. Wen, J. Eng. Mech. Div. ASCE 102 (2), 1976, pp. 249-263), added to the displacement: the
    tip runs ahead of the load and comes back too far. Between the places all is forgotten.
    """

    name: ClassVar[str] = "deflection_hysteresis"
    typical: ClassVar[float] = 0.1
    largest: ClassVar[float] = 3.0

    law: str = "plays"
    knee: float = 0.3
    shape: float = 1.5

    @classmethod
    def draw(cls, rng: np.random.Generator, session: Session) -> Self:
        """Lagging in the springs, or in a third of the cases ahead at the tip."""
        law = "ahead" if rng.random() < 1.0 / 3.0 else "plays"
        return cls(cls.typical, law, rng.uniform(0.2, 0.5), rng.uniform(1.0, 2.0))

    @classmethod
    def spans(cls, session: Session) -> list[list[Cause]]:
        """Either law."""
        return [[cls(cls.typical, "plays")], [cls(cls.typical, "ahead")]]

    def displace(self, at: Moment, springs: Springs, loads: Array, place: int) -> Array | None:
        """What is remembered."""
        return self._remembered(springs, loads, loads)

    def _remembered(self, springs: Springs, loads: Array, usual: Array) -> Array:
        """Displacement (n, 6) that loads (n, 8) leave; usual (m, 8): the loads at that place."""
        if self.law == "plays":
            most = np.maximum(np.max(np.abs(usual), axis=0), 1e-9)
            held = most * _plays(np.tanh(1.2 * loads / most) / np.tanh(1.2))
            return self.size * springs.moved(held @ springs.give.T)
        most = np.maximum(np.max(np.abs(springs.moved(usual @ springs.give.T)), axis=0), 1e-12)
        elastic = springs.moved(loads @ springs.give.T)
        return self.size * most * _bouc_wen(elastic / most, self.knee, self.shape)

    def parameters(self, machine: Machine) -> Mapping[str, Any]:
        """residual_fraction: after one largest push along each axis, root mean square."""
        take = machine.session.takes.get("push")
        if take is None or take.pushes is None:
            return {"residual_fraction": 0.0}
        up = np.linspace(0.0, 1.0, 40)
        course = np.concatenate([up, up[::-1]])
        largest_n = float(np.max(np.linalg.norm(take.pushes.force_n, axis=1)))
        left, most = 0.0, 0.0
        for joints, (begin_s, end_s) in zip(take.places, take.recorded, strict=True):
            springs, usual = machine.loads(take, joints, np.arange(begin_s, end_s, 0.05))
            for axis in range(3):
                force = largest_n * np.outer(course, np.eye(6)[axis])
                loads = springs.loaded(force)
                whole = springs.moved(loads @ springs.give.T)
                whole = whole + self._remembered(springs, loads, usual)
                left += float(np.sum(whole[-1, :3] ** 2))
                most += float(np.sum(whole[len(up) - 1, :3] ** 2))
        return {"residual_fraction": float(np.sqrt(left / most))}


def _plays(course: Array) -> Array:
    """Weighted plays (n, k) of courses (n, k) that start at rest."""
    low = course[:, :, None] - _THRESHOLDS
    high = course[:, :, None] + _THRESHOLDS
    state = np.zeros(low.shape[1:])
    held = np.zeros_like(low)
    for k in range(len(course)):
        state = np.minimum(np.maximum(state, low[k]), high[k])
        held[k] = state
    return np.asarray(held @ _WEIGHTS)


def _bouc_wen(course: Array, knee: float, shape: float) -> Array:
    """States z (n, k), within +-1, of courses (n, k) that start at rest."""
    steps = np.diff(course, axis=0, prepend=0.0) / knee
    z = np.zeros(course.shape[1])
    states = np.zeros_like(course)
    for k, step in enumerate(steps):
        if np.any(step):
            for _ in range(2):
                grip = np.abs(z) ** shape * (0.8 * np.sign(step * z) + 0.2)
                z = np.clip(z + 0.5 * step * (1.0 - grip), -1.0, 1.0)
        states[k] = z
    return states
