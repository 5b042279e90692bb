"""Every kind of model by its name, for commands, files and the node."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from galen_model.json_fields import FieldError

from galen_deflection.models import coupled, independent, joint_hysteresis, joint_stiffness
from galen_deflection.models.fit_settings import FitSettings
from galen_deflection.models.interface import DeflectionModel
from galen_deflection.samples import DeflectionSamples


class ModelKind(NamedTuple):
    """What can be done with a kind of model.

    fit: raises FitError. from_json: from what `DeflectionModel.to_json` gave; raises FieldError.
    """

    summary: str
    fit: Callable[[DeflectionSamples, FitSettings | None], DeflectionModel]
    from_json: Callable[[Mapping[str, Any]], DeflectionModel]


KINDS: dict[str, ModelKind] = {
    independent.KIND: ModelKind(
        "each axis from the same axis of the wrench, linear (the report's first)",
        independent.fit,
        independent.from_json,
    ),
    coupled.KIND: ModelKind(
        "each axis from all axes of the wrench, linear (the report's second)",
        coupled.fit,
        coupled.from_json,
    ),
    joint_stiffness.KIND: ModelKind(
        "springs at roll, tilt, carriages and rods",
        joint_stiffness.fit,
        joint_stiffness.from_json,
    ),
    joint_hysteresis.KIND: ModelKind(
        "the same with hysteresis at roll, tilt and carriages",
        joint_hysteresis.fit,
        joint_hysteresis.from_json,
    ),
}
"""Kinds in the order in which they are listed."""


def kind_of(name: str) -> ModelKind:
    """The kind of a name; raises FieldError that names those there are."""
    if name not in KINDS:
        raise FieldError(f'kind is "{name}"; this version knows {", ".join(KINDS)}')
    return KINDS[name]
