"""A model that is a network alone: wrench and joints in, the tip's deflection out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import get, numbers, text, texts

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.axes import LOADS, MOTIONS
from galen_deflection.models.fitted_range import NEARBY, SMALLEST_MARGIN, FittedRange
from galen_deflection.models.interface import Predicted, PredictedSamples
from galen_deflection.models.linear import (
    FittedOn,
    covariance_from_json,
    noise_from_json,
    segments,
    tip_from_json,
)
from galen_deflection.networks.network import Network
from galen_deflection.networks.training_curve import TrainingCurve
from galen_deflection.springs.springs import TipWrench

INPUTS = (*LOADS, "q1", "q2", "q3", "roll", "tilt")
"""The wrench at the tip in base_link, N and N.m, and the joints, m and rad."""

OUTPUTS = MOTIONS

LEAST_SCALE = 0.1 * np.concatenate([SMALLEST_MARGIN, NEARBY])
"""Of the inputs: less of a load or a way than this is nothing that a network should look at."""


@dataclass(frozen=True)
class NetworkModel:
    """As `DeflectionModel`; the fields as `LinearModel`'s.

    training: of a network for which part of the samples was held out, in units of the noise.
    """

    name: str
    tip_m: Array
    network: Network
    discrepancy: Array
    noise: Array
    fitted_range: FittedRange
    fitted_on: FittedOn
    training: TrainingCurve
    notes: tuple[str, ...] = ()

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """As `DeflectionModel.predict`."""
        size = len(samples)
        mean, outside = np.empty((size, 6)), np.empty(size, dtype=bool)
        for segment in segments(samples):
            stream = self.stream()
            mean[segment], outside[segment] = stream.run(
                samples.stamp_ns[segment], samples.joints[segment], samples.wrench[segment]
            )
        return PredictedSamples(mean, np.tile(self.discrepancy, (size, 1, 1)), outside)

    def stream(self) -> NetworkStream:
        """As `DeflectionModel.stream`."""
        return NetworkStream(self)

    def to_json(self) -> dict[str, Any]:
        """As `DeflectionModel.to_json`, but for the weights (`tensors`)."""
        return {
            "kind": self.name,
            "tip_m": numbers(self.tip_m),
            "network": self.network.to_json(),
            "discrepancy": [numbers(row) for row in self.discrepancy],
            "noise": numbers(self.noise),
            "fitted_range": self.fitted_range.to_json(),
            "fitted_on": dict(vars(self.fitted_on)),
            "training": self.training.to_json(),
            "notes": list(self.notes),
        }

    def tensors(self) -> dict[str, np.ndarray]:
        """As `WithTensors.tensors`."""
        return self.network.net.weights.tensors()


class NetworkStream:
    """As `Stream`."""

    def __init__(self, model: NetworkModel) -> None:
        """Start unloaded."""
        self._model = model
        self._to_tip = TipWrench(model.tip_m)
        self._paced = model.network.paced()

    def run(self, stamp_ns: np.ndarray, joints: Array, wrench: Array) -> tuple[Array, np.ndarray]:
        """Means (n, 6), and whether they are extrapolated (n,), of the next n samples."""
        at_tip = self._to_tip(joints, wrench)
        mean = self._paced.run(stamp_ns, np.hstack([at_tip, joints]))
        return mean, self._model.fitted_range.left_by(joints, at_tip)

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """As `Stream.step`; the stamps say how far a sample is from those before."""
        mean, outside = self.run(
            np.array([stamp_ns]),
            np.asarray(joints, dtype=float)[None],
            np.asarray(wrench, dtype=float)[None],
        )
        return Predicted(mean[0], self._model.discrepancy, bool(outside[0]))

    def reset(self) -> None:
        """As `Stream.reset`."""
        self._paced.reset()


def from_tensors(content: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> NetworkModel:
    """From a file's content and tensors; raises FieldError that names what is wrong."""
    return NetworkModel(
        name=text(get(content, "kind"), "kind"),
        tip_m=tip_from_json(content),
        network=Network.from_json(get(content, "network"), "network", tensors, INPUTS, OUTPUTS),
        discrepancy=covariance_from_json(content, "discrepancy", 6),
        noise=noise_from_json(content),
        fitted_range=FittedRange.from_json(get(content, "fitted_range"), "fitted_range"),
        fitted_on=FittedOn.from_json(get(content, "fitted_on"), "fitted_on"),
        training=TrainingCurve.from_json(get(content, "training"), "training"),
        notes=texts(get(content, "notes"), "notes"),
    )
