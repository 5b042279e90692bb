"""The report's two models: the wrench's axes themselves are the loads.

`independent`: each axis of the deflection from the same axis of the wrench, six compliances.
`coupled`: from all axes of the wrench, a full 6 x 6 compliance; as in the report nothing makes it
symmetric.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from galen_model.arm.galen import HOME
from galen_model.arm.stiffness import tip_compliance
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.least_squares import finished, sums
from galen_deflection.models.linear import LinearModel, Parameter, Rows, tip_from_json
from galen_deflection.models.linear import from_json as linear_from_json
from galen_deflection.springs.springs import TipWrench

LOADS = ("fx", "fy", "fz", "tx", "ty", "tz")
MOTIONS = ("dx", "dy", "dz", "rx", "ry", "rz")
INDEPENDENT, COUPLED = "independent", "coupled"
_PAIRS = {
    INDEPENDENT: tuple((axis, axis) for axis in range(6)),
    COUPLED: tuple(product(range(6), range(6))),
}


@dataclass(frozen=True)
class AxesBasis:
    """Parameters C[motion, load] for some pairs; they remember nothing.

    The report writes the deflection in the robot's base (its eq. 14) and does not say where the
    force is, which for "the same axis" must be the same frame; and a moment only belongs to the
    point that moves. So: the wrench at tool_tip, in base_link. (In ft_sensor, which is turned by 90
    degrees at home, x of the force would be z of the arm, and the models would be worse.)

    There is no offset: without load there is no deflection (contract, section 2). An offset would
    be the registration's, and a model that shifts the tip of an arm without contact is wrong.
    """

    tip_m: Array
    pairs: tuple[tuple[int, int], ...]
    bounded = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Zero, give or take what the axes' own nominal compliances at home allow."""
        own = np.sqrt(np.diag(tip_compliance(HOME, self.tip_m)))
        return tuple(
            Parameter(
                f"{MOTIONS[motion]}/{LOADS[load]}",
                f"{'m' if motion < 3 else 'rad'}/{'N' if load < 3 else '(N.m)'}",
                0.0,
                float(own[motion] * own[load]),  # C is positive: C_ij^2 <= C_ii C_jj
            )
            for motion, load in self.pairs
        )

    def run(self) -> AxesRun:
        """As `Basis.run`."""
        return AxesRun(self)

    def to_json(self) -> dict[str, Any]:
        """As `Basis.to_json`: nothing."""
        return {}


class AxesRun:
    """As `Run`."""

    def __init__(self, basis: AxesBasis) -> None:
        """Of a basis."""
        self._to_tip = TipWrench(basis.tip_m)
        self._motion, self._load = np.array(basis.pairs).T
        self._column = np.arange(len(basis.pairs))

    def rows(self, joints: Array, wrench: Array) -> Rows:
        """As `Run.rows`."""
        at_tip = self._to_tip(joints, wrench)
        design = np.zeros((len(joints), 6, len(self._column)))
        design[:, self._motion, self._column] = at_tip[:, self._load]
        return Rows(at_tip, design)


def fit(kind: str, samples: DeflectionSamples, settings: FitSettings | None = None) -> LinearModel:
    """Fit INDEPENDENT or COUPLED by weighted least squares; raises FitError."""
    basis = AxesBasis(samples.tip_m, _PAIRS[kind])
    totals = sums(basis, samples, settings or FitSettings())
    return finished(kind, basis, samples, totals, only_nearby=True)


def from_json(content: Mapping[str, Any]) -> LinearModel:
    """Read a model from a file's content; raises FieldError."""
    return linear_from_json(content, AxesBasis(tip_from_json(content), _PAIRS[content["kind"]]))
