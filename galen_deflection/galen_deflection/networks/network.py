"""A recurrent network as a deflection model: wrench and joints in, the tip's deflection out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import (
    FieldError,
    array,
    count,
    get,
    items,
    mapping,
    number,
    numbers,
    text,
    texts,
)

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
from galen_deflection.networks.recurrent_net import PacedNet, RecurrentNet, Scaling, Weights
from galen_deflection.springs.springs import TipWrench

LARGEST_HIDDEN = 512
"""Hidden units; a file that wants more is not one of ours, and would take long to reject."""

_RATES_HZ = (0.1, 10_000.0)

INPUTS = (*LOADS, "q1", "q2", "q3", "roll", "tilt")
"""The wrench at the tip in base_link, N and N.m, and the joints, m and rad."""

OUTPUTS = MOTIONS

LEAST_SCALE = 0.1 * np.concatenate([SMALLEST_MARGIN, NEARBY])
"""Of the inputs: less of a load or a way than this is nothing that a network should look at."""


@dataclass(frozen=True)
class TrainingCurve:
    """After every iteration: root mean square errors, in units of what an error is measured by.

    training_loss: on what was learnt from; check_loss: on what was held out, of the same length, or
    empty if nothing was. best: the iteration that was kept, from 0.
    """

    training_loss: tuple[float, ...]
    check_loss: tuple[float, ...]
    best: int

    def to_json(self) -> dict[str, Any]:
        """As plain numbers."""
        return {
            "training_loss": numbers(self.training_loss),
            "check_loss": numbers(self.check_loss),
            "best": self.best,
        }

    @classmethod
    def from_json(cls, content: Any, name: str) -> TrainingCurve:
        """Read with checks; raises FieldError."""
        whole = mapping(content, name)
        losses = {}
        for what in ("training_loss", "check_loss"):
            rows = get(whole, what)
            size = len(items(rows, f"{name}.{what}"))
            losses[what] = tuple(array(rows, f"{name}.{what}", (size,)).tolist())
        curve = cls(**losses, best=count(get(whole, "best"), f"{name}.best"))
        if curve.best >= len(curve.training_loss):
            raise FieldError(f"{name}.best is beyond the iterations there were")
        if len(curve.check_loss) not in (0, len(curve.training_loss)):
            raise FieldError(f"{name}.check_loss is not as long as {name}.training_loss")
        return curve


@dataclass(frozen=True)
class Network:
    """inputs, outputs: the columns' names, in their order; period_s: of its training."""

    net: RecurrentNet
    period_s: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def paced(self) -> PacedNet:
        """Run by stamps, from a fresh start."""
        return PacedNet(self.net, self.period_s)

    def to_json(self) -> dict[str, Any]:
        """All but the weights."""
        return {
            "hidden": self.net.hidden,
            "period_s": self.period_s,
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "input_scaling": _scaling_to_json(self.net.inputs),
            "output_scaling": _scaling_to_json(self.net.outputs),
        }

    @classmethod
    def from_json(
        cls,
        content: Any,
        name: str,
        tensors: Mapping[str, np.ndarray],
        inputs: Sequence[str],
        outputs: Sequence[str],
    ) -> Network:
        """From a file's field and tensors, which must be those of these columns.

        Raises FieldError.
        """
        whole = mapping(content, name)
        for what, expected in (("inputs", inputs), ("outputs", outputs)):
            found = texts(get(whole, what), f"{name}.{what}")
            if found != tuple(expected):
                raise FieldError(
                    f"{name}.{what} is {', '.join(found):.80}; expected {', '.join(expected)}"
                )
        hidden = count(get(whole, "hidden"), f"{name}.hidden")
        if not 1 <= hidden <= LARGEST_HIDDEN:
            raise FieldError(f"{name}.hidden is {hidden}; expected 1 to {LARGEST_HIDDEN}")
        period_s = number(get(whole, "period_s"), f"{name}.period_s")
        if not 1.0 / _RATES_HZ[1] <= period_s <= 1.0 / _RATES_HZ[0]:
            raise FieldError(f"{name}.period_s is {period_s:g}; expected 0.0001 to 10")
        shapes = Weights.shapes(len(inputs), hidden, len(outputs))
        _check_tensors(tensors, shapes)
        return cls(
            RecurrentNet(
                Weights.from_tensors(tensors),
                _scaling_from_json(get(whole, "input_scaling"), f"{name}.input_scaling", inputs),
                _scaling_from_json(get(whole, "output_scaling"), f"{name}.output_scaling", outputs),
            ),
            period_s,
            tuple(inputs),
            tuple(outputs),
        )


def _check_tensors(
    tensors: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise FieldError unless the tensors are finite, of these shapes, and no others."""
    if set(tensors) != set(shapes):
        raise FieldError(
            f"the tensors are {', '.join(sorted(tensors)) or 'none'}; expected "
            f"{', '.join(sorted(shapes)) or 'none'}"
        )
    for name, shape in shapes.items():
        if tensors[name].shape != shape:
            raise FieldError(f"tensor {name} has shape {tensors[name].shape}; expected {shape}")
        if not np.isfinite(tensors[name]).all():
            raise FieldError(f"tensor {name} holds a value that is not finite")


def _scaling_to_json(scaling: Scaling) -> dict[str, Any]:
    return {"mean": numbers(scaling.mean), "scale": numbers(scaling.scale)}


def _scaling_from_json(content: Any, name: str, columns: Sequence[str]) -> Scaling:
    whole = mapping(content, name)
    shape = (len(columns),)
    scale = array(get(whole, "scale"), f"{name}.scale", shape)
    if np.any(scale <= 0.0):
        raise FieldError(f"{name}.scale holds a value that isn't positive")
    return Scaling(array(get(whole, "mean"), f"{name}.mean", shape), scale)


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
        """As `DeflectionModel.tensors`."""
        return self.network.net.weights.tensors()

    @classmethod
    def from_json(
        cls, content: Mapping[str, Any], tensors: Mapping[str, np.ndarray]
    ) -> NetworkModel:
        """From a file's content and tensors; raises FieldError that names what is wrong."""
        return cls(
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
