"""What every deflection model offers, whatever is inside it."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples


class Predicted(NamedTuple):
    """A prediction for one sample.

    mean (6,): translation (m) and rotation vector (rad) of tool_tip in base_link; covariance
    (6, 6) of the true deflection about it; extrapolated: the load or the arm's position lies
    outside of what the model was fitted on. start (6, 6): the part of the covariance that is there
    only because nothing is known of the loads before the stream's start; None where there is none.
    """

    mean: Array
    covariance: Array
    extrapolated: bool
    start: Array | None = None


class PredictedSamples(NamedTuple):
    """Predictions for samples (n,): mean (n, 6), covariance (n, 6, 6), extrapolated (n,)."""

    mean: Array
    covariance: Array
    extrapolated: np.ndarray


class Stream(Protocol):
    """A model at work on samples as they come; it may remember the load."""

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """Take joints (5,) and the applied wrench (6,) in ft_sensor about its origin."""

    def reset(self) -> None:
        """Forget what was: as if the arm had never been loaded."""


class DeflectionModel(Protocol):
    """A fitted model."""

    @property
    def name(self) -> str:
        """Its kind, as in model files and on the command line."""

    @property
    def tip_m(self) -> Array:
        """The tip (3,) in ft_sensor that it was fitted for."""

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """Predict every sample, each segment from a fresh start: the same as stream by stream."""

    def stream(self) -> Stream:
        """A stream that starts unloaded. Needs no torch but in the networks."""

    def to_json(self) -> dict[str, Any]:
        """Everything needed to make it again, as plain numbers, lists and texts."""


@runtime_checkable
class WithTensors(Protocol):
    """A model of which `to_json` gives all but some arrays: a network's weights."""

    def tensors(self) -> dict[str, np.ndarray]:
        """The arrays by name, float32."""
