"""Every kind of model by its name, for commands, files and the node.

Nothing here imports PyTorch; only training a network does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from galen_model.files.json_fields import FieldError, get, text

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models import axes, joint_hysteresis, joint_stiffness
from galen_deflection.models.interface import DeflectionModel, FitSettings
from galen_deflection.networks import lstm
from galen_deflection.networks.network import NetworkModel


class ModelKind(NamedTuple):
    """What can be done with a kind of model.

    fit: raises FitError. make: from a file's content, and the tensors of a network; raises
    FieldError. is_network: fitting it needs PyTorch, and its file safetensors.
    """

    summary: str
    fit: Callable[[DeflectionSamples, FitSettings | None], DeflectionModel]
    make: Callable[..., DeflectionModel]
    is_network: bool = False


KINDS: dict[str, ModelKind] = {
    axes.INDEPENDENT: ModelKind(
        "each axis from the same axis of the wrench, linear (the report's first)",
        partial(axes.fit, axes.INDEPENDENT),
        axes.from_json,
    ),
    axes.COUPLED: ModelKind(
        "each axis from all axes of the wrench, linear (the report's second)",
        partial(axes.fit, axes.COUPLED),
        axes.from_json,
    ),
    joint_stiffness.KIND: ModelKind(
        "springs at roll, tilt, carriages and rods",
        joint_stiffness.fit,
        joint_stiffness.from_json,
    ),
    joint_hysteresis.KIND: ModelKind(
        "the same with hysteresis in these springs, or of the platform as a whole",
        joint_hysteresis.fit,
        joint_hysteresis.from_json,
    ),
    lstm.KIND: ModelKind(
        "the report's network: LSTM of 18 units, fully connected to the axes",
        partial(lstm.fit, lstm.KIND),
        NetworkModel.from_json,
        is_network=True,
    ),
    lstm.KIND_DIRECT: ModelKind(
        "the variant its authors suggest: no fully connected layer",
        partial(lstm.fit, lstm.KIND_DIRECT),
        NetworkModel.from_json,
        is_network=True,
    ),
}
"""Kinds in the order in which they are listed."""


def model_from(
    content: Mapping[str, Any], tensors: Mapping[str, np.ndarray] | None
) -> DeflectionModel:
    """Make a model from a file's content, and its tensors if it has any; raises FieldError."""
    name = text(get(content, "kind"), "kind")
    kind = kind_of(name)
    if kind.is_network != (tensors is not None):
        raise FieldError(
            f"a model of the kind {name} is in {'safetensors' if kind.is_network else 'JSON'}, not"
            " in this format"
        )
    return kind.make(content) if tensors is None else kind.make(content, tensors)


def kind_of(name: str) -> ModelKind:
    """The kind of a name; raises FieldError that names those there are."""
    if name not in KINDS:
        raise FieldError(f'kind is "{name}"; this version knows {", ".join(KINDS)}')
    return KINDS[name]
