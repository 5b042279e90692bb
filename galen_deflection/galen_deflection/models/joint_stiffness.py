"""The contract's arm: platform on six rods, roll and tilt, each a linear spring.

The tip's compliance depends on where the arm stands, and is linear in the four compliances
1/k_roll, 1/k_tilt, 1/k_carriage and 1/k_rod (`galen_deflection.springs.springs` has the proof), so
that they come from linear least squares, none below zero. What the samples do not tell stays near
the nominal value and is named.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.least_squares import finished, sums
from galen_deflection.models.linear import LinearModel, Parameter, Rows, tip_from_json
from galen_deflection.models.linear import from_json as linear_from_json
from galen_deflection.springs.springs import SPRINGS, Geometry, Springs, TipWrench, kinds

KIND = "joint_stiffness"

COMPLIANCES = tuple(
    # The nominal stiffness of each is an estimate: it may well be twice as stiff, or half.
    Parameter(f"1/k_{kind.name}", kind.compliance_unit, kind.compliance, kind.compliance)
    for kind in kinds()
)
"""1/k_roll, 1/k_tilt, 1/k_carriage, 1/k_rod."""

_OF_KIND = np.zeros((len(SPRINGS), len(COMPLIANCES)))
for _column, _kind in enumerate(kinds()):
    _OF_KIND[_kind.springs, _column] = 1.0


@dataclass(frozen=True)
class StiffnessBasis:
    """The four compliances."""

    tip_m: Array
    bounded = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """As `Basis.parameters`."""
        return COMPLIANCES

    def run(self) -> StiffnessRun:
        """As `Basis.run`."""
        return StiffnessRun(self.tip_m)

    def to_json(self) -> dict[str, Any]:
        """As `Basis.to_json`: nothing."""
        return {}


class StiffnessRun:
    """As `Run`; also the springs' loads, for what remembers them."""

    def __init__(self, tip_m: Array) -> None:
        """tip_m (3,): in ft_sensor."""
        self._to_tip = TipWrench(tip_m)
        self._springs = Springs(tip_m)

    def loaded(self, joints: Array, wrench: Array) -> tuple[Array, Geometry, Array]:
        """Wrench (n, 6) at the tip in base_link, where the springs are, and loads (n, 11)."""
        at_tip = self._to_tip(joints, wrench)
        geometry = self._springs.geometry(joints)
        return at_tip, geometry, np.matmul(at_tip[:, None, :], geometry.jacobian)[:, 0]

    def rows(self, joints: Array, wrench: Array) -> Rows:
        """As `Run.rows`."""
        at_tip, geometry, loads = self.loaded(joints, wrench)
        return Rows(at_tip, elastic(geometry.jacobian, loads))


def elastic(jacobian: Array, loads: Array) -> Array:
    """Designs (n, 6, 4) of the four compliances, from J (n, 6, 11) and the loads (n, 11)."""
    return (jacobian * loads[:, None, :]) @ _OF_KIND


def fit(samples: DeflectionSamples, settings: FitSettings | None = None) -> LinearModel:
    """Fit by weighted least squares; raises FitError, NegativeComplianceError."""
    settings = settings or FitSettings()
    basis = StiffnessBasis(samples.tip_m)
    return finished(KIND, basis, samples, sums(basis, samples, settings), only_nearby=False)


def from_json(content: Mapping[str, Any]) -> LinearModel:
    """From a file's content; raises FieldError."""
    return linear_from_json(content, StiffnessBasis(tip_from_json(content)))
