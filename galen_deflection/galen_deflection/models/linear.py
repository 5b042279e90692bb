"""Models that are linear in their parameters: deflection = design(loads so far) @ parameters.

All physical models are. What a model is made of is its basis, which turns samples into designs and
may remember; everything else is the same for all of them: prediction, its covariance, the stream.

The covariance of a prediction adds up three things: what the parameters' covariance does to it;
the discrepancy, a constant covariance of what the model can't say, seen on data it was not fitted
on; and, for a basis that remembers, what the unknown state at the start leaves open. The tracker's
noise is not in it, since it is about the true deflection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import (
    FieldError,
    array,
    count,
    covariance,
    get,
    items,
    mapping,
    number,
    numbers,
    text,
    texts,
)

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.fitted_range import FittedRange
from galen_deflection.models.interface import Predicted, PredictedSamples

_CHUNK = 4096


class Parameter(NamedTuple):
    """A parameter's name, its unit, and what is known of it without any sample.

    Where the samples don't tell it, it is `prior` give or take `prior_std`; None: nothing is known,
    and whether it is wanted at all is the fit's to choose.
    """

    name: str
    unit: str
    prior: float = 0.0
    prior_std: float | None = None


class Start(NamedTuple):
    """What is unknown at the start: m deviations, each moved by one of s independent things.

    deviation (n, 6, m): times its parameter, `parameter` (m,), a standard deviation. source (m, s):
    1 where the deviation is moved by the thing.
    """

    deviation: Array
    parameter: np.ndarray
    source: Array

    def covariance(self, values: Array) -> Array:
        """(n, 6, 6) of the deflection, for parameters (p,): of one thing they add up."""
        by_source = (self.deviation * values[self.parameter]) @ self.source
        return np.asarray(by_source @ by_source.transpose(0, 2, 1))


class Rows(NamedTuple):
    """What n samples give.

    wrench_at_tip (n, 6): base_link. design (n, 6, p). start: None where nothing is left unknown of
    what was before the first sample.
    """

    wrench_at_tip: Array
    design: Array
    start: Start | None = None


class Run(Protocol):
    """A basis on one segment."""

    def rows(self, joints: Array, wrench: Array) -> Rows:
        """Take the next samples: joints (n, 5), wrenches (n, 6) in ft_sensor."""


class Basis(Protocol):
    """What a model's parameters multiply."""

    @property
    def parameters(self) -> Sequence[Parameter]:
        """The p parameters."""

    @property
    def bounded(self) -> bool:
        """Whether none of them may be below zero."""

    def run(self) -> Run:
        """Begin a segment, unloaded."""

    def to_json(self) -> dict[str, Any]:
        """What, beside the kind and the tip, makes it again."""


@dataclass(frozen=True)
class FittedOn:
    """How much a model was fitted on."""

    samples: int
    segments: int
    positions: int
    sets: int

    @classmethod
    def of(cls, samples: DeflectionSamples) -> FittedOn:
        """Count."""
        places = np.stack([samples.position, samples.set_number], axis=1)
        return cls(
            len(samples),
            len(np.unique(samples.segment)),
            len(np.unique(samples.position)),
            len(np.unique(places, axis=0)),
        )

    @classmethod
    def from_json(cls, content: Any, name: str) -> FittedOn:
        """Read with checks; raises FieldError."""
        counts = mapping(content, name)
        return cls(*(count(get(counts, f.name), f"{name}.{f.name}") for f in fields(cls)))


@dataclass(frozen=True)
class LinearModel:
    """A fitted model that is linear in its parameters.

    values (p,), covariance (p, p): of the basis's parameters, in its units. discrepancy (6, 6),
    noise (6,): m and rad, base_link. unresolved: names of parameters that the samples did not tell
    and that are, more or less, what they were before. notes: sentences on what the fit found.
    """

    name: str
    tip_m: Array
    basis: Basis
    values: Array
    covariance: Array
    discrepancy: Array
    noise: Array
    fitted_range: FittedRange
    fitted_on: FittedOn
    unresolved: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def std(self) -> Array:
        """Standard deviations (p,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """As `DeflectionModel.predict`."""
        size = len(samples)
        predicted = PredictedSamples(
            np.empty((size, 6)), np.empty((size, 6, 6)), np.empty(size, dtype=bool)
        )
        for segment in segments(samples):
            run = self.basis.run()
            for first in range(segment.start, segment.stop, _CHUNK):
                part = slice(first, min(first + _CHUNK, segment.stop))
                result, _ = self._predict(run, samples.joints[part], samples.wrench[part])
                for whole, piece in zip(predicted, result, strict=True):
                    whole[part] = piece
        return predicted

    def stream(self) -> LinearStream:
        """As `DeflectionModel.stream`."""
        return LinearStream(self)

    def _predict(
        self, run: Run, joints: Array, wrench: Array
    ) -> tuple[PredictedSamples, Array | None]:
        """Predictions, and which part of their covariance (n, 6, 6) the unknown start has."""
        rows = run.rows(joints, wrench)
        mean = rows.design @ self.values
        covariance = rows.design @ self.covariance @ rows.design.transpose(0, 2, 1)
        covariance += self.discrepancy
        start = None
        if rows.start is not None:
            start = rows.start.covariance(self.values)
            covariance += start
        outside = self.fitted_range.left_by(joints, rows.wrench_at_tip)
        return PredictedSamples(mean, covariance, outside), start

    def tensors(self) -> None:
        """As `DeflectionModel.tensors`."""

    def to_json(self) -> dict[str, Any]:
        """As `DeflectionModel.to_json`."""
        return {
            "kind": self.name,
            "tip_m": numbers(self.tip_m),
            **self.basis.to_json(),
            "parameters": [
                {"name": parameter.name, "unit": parameter.unit, "value": float(value)}
                for parameter, value in zip(self.basis.parameters, self.values, strict=True)
            ],
            "covariance": [numbers(row) for row in self.covariance],
            "discrepancy": [numbers(row) for row in self.discrepancy],
            "noise": numbers(self.noise),
            "fitted_range": self.fitted_range.to_json(),
            "fitted_on": dict(vars(self.fitted_on)),
            "unresolved": list(self.unresolved),
            "notes": list(self.notes),
        }


class LinearStream:
    """As `Stream`: the same steps as `LinearModel.predict`, one sample at a time."""

    def __init__(self, model: LinearModel) -> None:
        """Start unloaded."""
        self._model = model
        self.reset()

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """As `Stream.step`."""
        predicted, start = self._model._predict(
            self._run,
            np.asarray(joints, dtype=float)[None],
            np.asarray(wrench, dtype=float)[None],
        )
        return Predicted(
            predicted.mean[0],
            predicted.covariance[0],
            bool(predicted.extrapolated[0]),
            None if start is None else start[0],
        )

    def reset(self) -> None:
        """As `Stream.reset`."""
        self._run = self._model.basis.run()


def segments(samples: DeflectionSamples) -> Iterator[slice]:
    """The samples' segments, in their order."""
    starts = np.flatnonzero(np.diff(samples.segment)) + 1
    bounds = [0, *starts.tolist(), len(samples)]
    for first, last in pairwise(bounds):
        yield slice(first, last)


def tip_from_json(content: Mapping[str, Any]) -> Array:
    """The field tip_m; raises FieldError."""
    return array(get(content, "tip_m"), "tip_m", (3,))


def from_json(content: Mapping[str, Any], basis: Basis) -> LinearModel:
    """A model from its file's content; raises FieldError that names what is wrong."""
    rows = items(get(content, "parameters"), "parameters")
    size = len(basis.parameters)
    if len(rows) != size:
        raise FieldError(f"parameters has {len(rows)} entries; expected {size}")
    values = np.empty(size)
    for k, parameter in enumerate(basis.parameters):
        name = f"parameters[{k}]"
        row = mapping(rows[k], name)
        for what, expected in (("name", parameter.name), ("unit", parameter.unit)):
            found = text(get(row, what), f"{name}.{what}")
            if found != expected:
                raise FieldError(f'{name}.{what} is "{found}"; expected "{expected}"')
        values[k] = number(get(row, "value"), f"{name}.value")
        if basis.bounded and values[k] < 0.0:
            raise FieldError(f"{name}.value is {values[k]}, below zero")
    return LinearModel(
        name=text(get(content, "kind"), "kind"),
        tip_m=tip_from_json(content),
        basis=basis,
        values=values,
        covariance=covariance_from_json(content, "covariance", size),
        discrepancy=covariance_from_json(content, "discrepancy", 6),
        noise=noise_from_json(content),
        fitted_range=FittedRange.from_json(get(content, "fitted_range"), "fitted_range"),
        fitted_on=FittedOn.from_json(get(content, "fitted_on"), "fitted_on"),
        unresolved=texts(get(content, "unresolved"), "unresolved"),
        notes=texts(get(content, "notes"), "notes"),
    )


def noise_from_json(content: Mapping[str, Any]) -> Array:
    """The field noise; raises FieldError."""
    noise = array(get(content, "noise"), "noise", (6,))
    if np.any(noise <= 0.0):
        raise FieldError("noise holds a value that isn't positive")
    return noise


def covariance_from_json(content: Mapping[str, Any], name: str, size: int) -> Array:
    """A field that holds a covariance (size, size); raises FieldError."""
    return covariance(get(content, name), name, size)
