"""The report's first model: each axis of the deflection from the same axis of the wrench.

Six compliances, those of the wrench at tool_tip in base_link; why there, `AxesBasis` says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.axes import AxesBasis
from galen_deflection.models.fit_settings import FitSettings
from galen_deflection.models.least_squares import finished, sums
from galen_deflection.models.linear import LinearModel, tip_from_json
from galen_deflection.models.linear import from_json as linear_from_json

KIND = "independent"


def fit(samples: DeflectionSamples, settings: FitSettings | None = None) -> LinearModel:
    """Fit by weighted least squares; raises FitError."""
    settings = settings or FitSettings()
    basis = _basis(samples.tip_m)
    return finished(KIND, basis, samples, sums(basis, samples, settings), only_nearby=True)


def from_json(content: Mapping[str, Any]) -> LinearModel:
    """From a file's content; raises FieldError."""
    return linear_from_json(content, _basis(tip_from_json(content)))


def _basis(tip_m: Array) -> AxesBasis:
    return AxesBasis(tip_m, tuple((axis, axis) for axis in range(6)))
