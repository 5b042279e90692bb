"""Physics with hysteresis and, it may be, a network for what that leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import get, mapping, numbers, texts

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models import joint_hysteresis
from galen_deflection.models.axes import LOADS, MOTIONS
from galen_deflection.models.interface import Predicted, PredictedSamples
from galen_deflection.models.linear import LinearModel, LinearStream
from galen_deflection.networks.network import Network, check_tensors
from galen_deflection.networks.sequences import run
from galen_deflection.networks.training_curve import TrainingCurve
from galen_deflection.springs.springs import TipWrench

KIND = "hysteresis_residual"

INPUTS = (*LOADS, *(f"predicted_{motion}" for motion in MOTIONS))
"""The wrench at the tip in base_link, N and N.m, and what the physics predicts, m and rad."""

OUTPUTS = MOTIONS


def inputs_of(samples: DeflectionSamples, predicted: Array) -> Array:
    """The network's inputs (n, 12), from what the physics predicts (n, 6)."""
    return np.hstack([TipWrench(samples.tip_m)(samples.joints, samples.wrench), predicted])


@dataclass(frozen=True)
class ResidualModel:
    """As `DeflectionModel`; without a network it is `physics`, but for name and notes.

    training: of the networks, over all positions left out; None if none was trained.
    """

    physics: LinearModel
    network: Network | None
    training: TrainingCurve | None
    notes: tuple[str, ...]
    name: str = KIND

    @property
    def tip_m(self) -> Array:
        """As `DeflectionModel.tip_m`."""
        return self.physics.tip_m

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """As `DeflectionModel.predict`."""
        predicted = self.physics.predict(samples)
        if self.network is None:
            return predicted
        inputs = inputs_of(samples, predicted.mean)
        added = run(self.network.net, samples, inputs, self.network.period_s)
        return predicted._replace(mean=predicted.mean + added)

    def stream(self) -> LinearStream | ResidualStream:
        """As `DeflectionModel.stream`."""
        if self.network is None:
            return self.physics.stream()
        return ResidualStream(self.physics, self.network)

    def to_json(self) -> dict[str, Any]:
        """As `DeflectionModel.to_json`, but for the weights (`tensors`)."""
        return {
            "kind": self.name,
            "tip_m": numbers(self.tip_m),
            "physics": self.physics.to_json(),
            "network": None if self.network is None else self.network.to_json(),
            "training": None if self.training is None else self.training.to_json(),
            "notes": list(self.notes),
        }

    def tensors(self) -> dict[str, np.ndarray]:
        """As `WithTensors.tensors`; none without a network."""
        return {} if self.network is None else self.network.net.weights.tensors()


class ResidualStream:
    """As `Stream`, with a network."""

    def __init__(self, physics: LinearModel, network: Network) -> None:
        """Start unloaded."""
        self._to_tip = TipWrench(physics.tip_m)
        self._physics, self._paced = physics.stream(), network.paced()

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """As `Stream.step`; the stamps say how far a sample is from those before."""
        predicted = self._physics.step(stamp_ns, joints, wrench)
        at_tip = self._to_tip(
            np.asarray(joints, dtype=float)[None], np.asarray(wrench, dtype=float)[None]
        )
        inputs = np.concatenate([at_tip[0], predicted.mean])[None]
        added = self._paced.run(np.array([stamp_ns]), inputs)[0]
        return predicted._replace(mean=predicted.mean + added)

    def reset(self) -> None:
        """As `Stream.reset`."""
        self._physics.reset()
        self._paced.reset()


def from_tensors(content: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> ResidualModel:
    """From a file's content and tensors; raises FieldError that names what is wrong."""
    physics = joint_hysteresis.from_json(mapping(get(content, "physics"), "physics"))
    network, training = get(content, "network"), get(content, "training")
    if network is None:
        check_tensors(tensors, {})
    return ResidualModel(
        physics=physics,
        network=(
            None
            if network is None
            else Network.from_json(network, "network", tensors, INPUTS, OUTPUTS)
        ),
        training=None if training is None else TrainingCurve.from_json(training, "training"),
        notes=texts(get(content, "notes"), "notes"),
    )
