"""Every kind of model by its name, for commands, files and the node.

Nothing here imports PyTorch; only training a network does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from galen_model.files.json_fields import FieldError

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models import coupled, independent, joint_hysteresis, joint_stiffness
from galen_deflection.models.fit_settings import FitSettings
from galen_deflection.models.interface import DeflectionModel
from galen_deflection.networks import lstm, network_model


class ModelKind(NamedTuple):
    """What can be done with a kind of model.

    fit: raises FitError. One of the others, raising FieldError: from_json, from what
    `DeflectionModel.to_json` gave; or, of a network, from_tensors, from that and its tensors.
    """

    summary: str
    fit: Callable[[DeflectionSamples, FitSettings | None], DeflectionModel]
    from_json: Callable[[Mapping[str, Any]], DeflectionModel] | None = None
    from_tensors: (
        Callable[[Mapping[str, Any], Mapping[str, np.ndarray]], DeflectionModel] | None
    ) = None

    @property
    def is_network(self) -> bool:
        """Whether fitting it needs PyTorch, and its file safetensors."""
        return self.from_tensors is not None

    def make(
        self, content: Mapping[str, Any], tensors: Mapping[str, np.ndarray] | None
    ) -> DeflectionModel:
        """From a file's content, and its tensors if it has any; raises FieldError."""
        if self.from_tensors is not None and tensors is not None:
            return self.from_tensors(content, tensors)
        if self.from_json is not None and tensors is None:
            return self.from_json(content)
        raise FieldError(
            f"a model of the kind {content['kind']} is in "
            f"{'safetensors' if self.is_network else 'JSON'}, not in this format"
        )


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
        "the same with hysteresis in these springs, or of the platform as a whole",
        joint_hysteresis.fit,
        joint_hysteresis.from_json,
    ),
    lstm.KIND: ModelKind(
        "the report's network: LSTM of 18 units, fully connected to the axes",
        lstm.fit,
        from_tensors=network_model.from_tensors,
    ),
    lstm.KIND_DIRECT: ModelKind(
        "the variant its authors suggest: no fully connected layer",
        lstm.fit_direct,
        from_tensors=network_model.from_tensors,
    ),
}
"""Kinds in the order in which they are listed."""


def kind_of(name: str) -> ModelKind:
    """The kind of a name; raises FieldError that names those there are."""
    if name not in KINDS:
        raise FieldError(f'kind is "{name}"; this version knows {", ".join(KINDS)}')
    return KINDS[name]
