"""The interface of every deflection model, and how one is fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

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
    """A model on samples as they come; it may remember the load."""

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

    @property
    def noise(self) -> Array:
        """Standard deviation (6,) of one measured deflection that it was fitted to."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what the fit found."""

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """Predict every sample, each segment from a fresh start: the same as stream by stream."""

    def stream(self) -> Stream:
        """A stream that starts unloaded. Needs no torch but in the networks."""

    def to_json(self) -> dict[str, Any]:
        """Everything needed to make it again, but `tensors`: numbers, lists and texts."""

    def tensors(self) -> dict[str, np.ndarray] | None:
        """A network's weights by name, float32; None for a model without any."""


@dataclass(frozen=True)
class FitSettings:
    """What every kind of model takes; a kind that doesn't need one of these leaves it alone.

    use (n,) bool, or None for all: the samples whose measured deflection a fit may look at. The
    loads of the others still count for what the arm remembers, as they would live. seed: of all
    that is drawn by chance. iterations: of a network's training, None for its kind's own number.
    on_progress(done, total, what): called now and then.
    """

    use: np.ndarray | None = None
    seed: int = 0
    iterations: int | None = None
    on_progress: Callable[[int, int, str], None] | None = None

    def used(self, count: int) -> np.ndarray:
        """The samples (count,) to look at; raises ValueError for another number of them."""
        if self.use is None:
            return np.ones(count, dtype=bool)
        use = np.asarray(self.use, dtype=bool)
        if use.shape != (count,):
            raise ValueError(f"use has the shape {use.shape} for {count} samples")
        return use
