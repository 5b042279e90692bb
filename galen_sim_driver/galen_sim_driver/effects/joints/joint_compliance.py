"""A stiffness is not the nominal one (contract, section 6).

The tip deflects by C w with C = sum over springs of J^T J / k, which is linear in 1/k. A fit
therefore works on how much softer than nominal a spring is,

    c = k_nominal / k - 1,

in which the deflection is linear, carriages and rods included: with the square matrix A of the
six rods' rows K_p^-1 = A^-1 (I / k_rod + G G^T / k_q) A^-T (`galen_model.arm.stiffness`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from galen_model.arm.galen import GALEN, ArmParameters
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted

ARM_FIELDS: Mapping[str, str] = {
    "roll": "roll_stiffness_nm_rad",
    "tilt": "tilt_stiffness_nm_rad",
    "carriage": "carriage_stiffness_n_m",
    "rod": "rod_stiffness_n_m",
}
"""The effect's fields and those of the arm's parameters."""


def _softer(of: str) -> Fitted:
    return Fitted(f"softness_{of}", "", 0.3, -0.9, 20.0)


@dataclass(frozen=True)
class JointCompliance(Effect):
    """Stiffnesses of the true arm, SI; 0 for one that is as nominal.

    `vector` holds k_nominal / k - 1 of roll, tilt, carriages and rods, in this order.
    """

    name: ClassVar[str] = "joint_compliance"
    fitted: ClassVar[tuple[Fitted, ...]] = tuple(map(_softer, ARM_FIELDS))
    contract_names: ClassVar[Mapping[str, str]] = {name: f"stiffness.{name}" for name in ARM_FIELDS}

    roll: float = param(0.0, "stiffness of the roll joint, 0 for the nominal one, Nm/rad", 0.0)
    tilt: float = param(0.0, "stiffness of the tilt joint, 0 for the nominal one, Nm/rad", 0.0)
    carriage: float = param(0.0, "stiffness of a carriage, 0 for the nominal one, N/m", 0.0)
    rod: float = param(0.0, "stiffness of a rod, 0 for the nominal one, N/m", 0.0)

    def vector(self) -> Array:
        """How much softer than nominal: k_nominal / k - 1, (4,)."""
        softer = []
        for field, of_arm in ARM_FIELDS.items():
            stiffness = getattr(self, field)
            softer.append(getattr(GALEN, of_arm) / stiffness - 1.0 if stiffness > 0.0 else 0.0)
        return np.array(softer)

    def with_vector(self, vector: Array) -> Self:
        """The same with other softnesses (4,); one of exactly 0 leaves its spring nominal."""
        return replace(
            self,
            **{
                field: getattr(GALEN, of_arm) / (1.0 + float(softer)) if softer != 0.0 else 0.0
                for (field, of_arm), softer in zip(ARM_FIELDS.items(), vector, strict=True)
            },
        )

    def arm(self, arm: ArmParameters) -> ArmParameters:
        """The arm with these stiffnesses."""
        given = {of_arm: getattr(self, field) for field, of_arm in ARM_FIELDS.items()}
        return replace(arm, **{of_arm: k for of_arm, k in given.items() if k > 0.0})
