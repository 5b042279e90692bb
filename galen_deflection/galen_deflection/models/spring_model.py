# SPDX-License-Identifier: Apache-2.0
"""The arm's springs as a fitted model, with or without hysteresis; linear in its parameters.

deflection = design(loads so far) @ parameters: the four compliances, then a weight for each
operator that remembers its load.

The covariance of a prediction adds up three things: what the parameters' covariance does to it;
the discrepancy, a constant covariance of what the model can't express, seen on data it was not
fitted on; and, with operators, what the unknown state at the start leaves open. The tracker's noise
is not in it, since it is about the true deflection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.json_fields import (
    FieldError,
    array,
    covariance,
    get,
    items,
    mapping,
    number,
    numbers,
    text,
    texts,
)
from galen_model.play import Operators, PlayOperators, SmoothOperators
from galen_model.rotation import skew

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import (
    FittedRange,
    Predicted,
    PredictedSamples,
    fitted_on_from_json,
    noise_from_json,
    tip_from_json,
)
from galen_deflection.models.springs import Kind, Springs, kinds

STIFFNESS, HYSTERESIS = "joint_stiffness", "joint_hysteresis"
"""The kinds of this model: springs alone, and springs with operators."""

Shape = Literal["play", "stop", "smooth_play", "smooth_stop"]

STOPS: dict[Shape, Shape] = {"play": "stop", "smooth_play": "smooth_stop"}
"""The rest of the load beside each kind of play."""

PLATFORM = "platform"
"""Where an operator may sit beside the kinds of springs: at a delta's platform, on its six axes."""

_CHUNK = 4096


class Parameter(NamedTuple):
    """A parameter's name, its unit, and what is known of it without any sample.

    Where the samples don't determine it, it is `prior` give or take `prior_std`; None: nothing is
    known, and whether it is wanted at all is the fit's to choose. signed: it may be below zero;
    all parameters of a basis may, or none.
    """

    name: str
    unit: str
    prior: float = 0.0
    prior_std: float | None = None
    signed: bool = False


class Operator(NamedTuple):
    """A play, or a stop, at each spring of a kind, or each of the platform's axes; one weight.

    A stop is the rest of the load beside a play, with corners or smooth (`galen_model.play`).
    thresholds: one for each; N.m, N, or at the platform m and rad.
    """

    place: str
    shape: Shape
    thresholds: tuple[float, ...]


@dataclass(frozen=True)
class SpringBasis:
    """What a model's parameters multiply: the springs' compliances, a weight for each operator.

    tip_m (3,): in ft_sensor. reference (c,): the compliances with which the platform's operators
    see it move, None for the nominal ones; a model that is linear in its parameters can't use those
    that are being fitted.
    """

    tip_m: Array
    operators: tuple[Operator, ...] = ()
    reference: Array | None = None
    arm: Arm = field(kw_only=True)

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """Springs that share a compliance."""
        return kinds(self.arm)

    @cached_property
    def compliances(self) -> tuple[Parameter, ...]:
        """1/k of each kind of spring, as 1/k_roll."""
        return tuple(
            Parameter(
                f"1/k_{kind.name}", kind.compliance_unit, kind.compliance, kind.compliance_std
            )
            for kind in self.kinds
        )

    @cached_property
    def columns(self) -> dict[str, range]:
        """The loads where an operator may sit: of a kind's springs, or the platform's axes."""
        found = {kind.name: kind.springs for kind in self.kinds}
        if self.arm.delta is not None:
            first = self.kinds[-1].springs.stop
            found[PLATFORM] = range(first, first + 6)
        return found

    @cached_property
    def under_platform(self) -> list[int]:
        """Of the compliances those by which a delta's platform moves."""
        return [k for k, kind in enumerate(self.kinds) if kind.name in ("carriage", "rod")]

    @cached_property
    def platform_compliances(self) -> Array:
        """The reference, nominal where none was given."""
        if self.reference is not None:
            return self.reference
        return np.array([compliance.prior for compliance in self.compliances])

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The p parameters: the compliances, then the operators' weights."""
        units = {kind.name: (kind.compliance_unit, kind.load_unit) for kind in self.kinds}
        found = list(self.compliances)
        for place, shape, thresholds in self.operators:
            unit, load_unit = units.get(place, ("1", "m"))
            size = f"{thresholds[0]:.4g} {load_unit}"
            found.append(Parameter(f"{shape.replace('_', ' ')} of {place} at {size}", unit))
        return tuple(found)

    @cached_property
    def _of_kind(self) -> Array:
        """(s, c): 1 where a spring has a compliance."""
        of_kind = np.zeros((self.kinds[-1].springs.stop, len(self.kinds)))
        for column, kind in enumerate(self.kinds):
            of_kind[kind.springs, column] = 1.0
        return of_kind

    def elastic(self, at_tip: Array, jacobian: Array, loads: Array) -> Array:
        """Return designs of the compliances.

        Args:
            at_tip: (n, 6) wrenches at the tip in base_link, N and N.m.
            jacobian: (n, 6, s) of the springs.
            loads: (n, s) of the springs, N.m and N.

        Returns:
            (n, 6, c): the tip's deflection in base_link for a unit of each compliance.

        """
        return np.asarray((jacobian * loads[:, None, :]) @ self._of_kind)

    def part(self, operators: Sequence[int], shape: Shape) -> SpringBasis:
        """Return it with some of the operators, all of one shape.

        Args:
            operators: indices of `self.operators`.
            shape: what they become.

        Returns:
            The same springs with these operators.

        """
        chosen = tuple(self.operators[k]._replace(shape=shape) for k in operators)
        return replace(self, operators=chosen)


class SpringRun:
    """A basis on one segment, from an unloaded start."""

    def __init__(self, basis: SpringBasis) -> None:
        self.springs = Springs(basis.tip_m, basis.arm)
        self._elastic = basis.elastic
        single = [
            (column, k, threshold)
            for k, operator in enumerate(basis.operators)
            for column, threshold in zip(
                basis.columns[operator.place], operator.thresholds, strict=True
            )
        ]
        self._column = np.array([column for column, _, _ in single], dtype=int)
        of_operator = np.array([k for _, k, _ in single], dtype=int)
        # One unknown thing for each spring: the loads of its past moved all its operators together.
        self._source = (self._column[:, None] == np.unique(self._column)).astype(float)
        self._parameter = len(basis.compliances) + of_operator
        shapes = [basis.operators[k].shape for k in of_operator]
        self._stop = np.array([shape in STOPS.values() for shape in shapes], dtype=bool)
        self._any_stop = bool(self._stop.any())
        thresholds = np.array([threshold for _, _, threshold in single])
        smooth = np.array([shape.startswith("smooth") for shape in shapes], dtype=bool)
        self._plays: list[tuple[np.ndarray, Operators]] = []
        for kind, which in ((PlayOperators, ~smooth), (SmoothOperators, smooth)):
            if which.any():
                self._plays.append((which, kind(thresholds[which])))
        self._of_operator = np.zeros((len(single), len(basis.operators)))
        self._of_operator[np.arange(len(single)), of_operator] = 1.0
        self._of_platform = any(operator.place == PLATFORM for operator in basis.operators)
        self._under_platform = basis.under_platform
        self._platform_reference = basis.platform_compliances[basis.under_platform]

    def loads(self, joints: Array, wrench: Array) -> tuple[Array, Array, Array, Array]:
        """Return what the springs, and the platform where an operator sits there, are loaded with.

        Args:
            joints: (n, j), m and rad.
            wrench: (n, 6) in ft_sensor about its origin, N and N.m.

        Returns:
            Wrenches (n, 6) at the tip in base_link; designs (n, 6, c) of the compliances; J (n, 6,
            s) and loads (n, s) of the springs. With an operator at the platform, J and loads have
            six more columns for its axes: what a twist of its centre does to the tip, and that
            twist (m, rad).

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
        to_tip, jacobian, lever, _ = self.springs.geometry(joints)
        at_tip = np.matmul(to_tip, wrench[:, :, None])[:, :, 0]
        loads = np.matmul(at_tip[:, None, :], jacobian)[:, 0]
        elastic = self._elastic(at_tip, jacobian, loads)
        if self._of_platform:
            motion = elastic[:, :, self._under_platform] @ self._platform_reference
            motion[:, :3] += np.cross(lever, motion[:, 3:])  # of its centre, no longer of the tip
            own = np.tile(np.eye(6), (len(loads), 1, 1))
            own[:, :3, 3:] = -skew(lever)
            jacobian = np.concatenate([jacobian, own], axis=2)
            loads = np.concatenate([loads, motion], axis=1)
        return at_tip, elastic, jacobian, loads

    def rows(self, joints: Array, wrench: Array) -> tuple[Array, Array, Array | None]:
        """Take the next samples.

        Args:
            joints: (n, j), m and rad.
            wrench: (n, 6) in ft_sensor about its origin, N and N.m.

        Returns:
            Wrenches (n, 6) at the tip in base_link; the design (n, 6, p); and (n, 6, m), of each
            single operator times its weight, a standard deviation for the unknown past, None where
            it is known.

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
        at_tip, elastic, jacobian, loads = self.loads(joints, wrench)
        if not self._plays:
            return at_tip, elastic, None
        inputs = loads.take(self._column, axis=1)
        output, unknown = self._played(inputs)
        if self._any_stop:
            output = np.where(self._stop, inputs - output, output)
        columns = jacobian.take(self._column, axis=2)
        remembered = (columns * output[:, None, :]) @ self._of_operator
        design = np.concatenate([elastic, remembered], axis=2)
        return at_tip, design, columns * unknown[:, None, :] if unknown.any() else None

    def start_covariance(self, deviation: Array, values: Array) -> Array:
        """Return the covariance by the unknown past.

        Args:
            deviation: (n, 6, m), as `rows` returns it.
            values: (p,) the parameters.

        Returns:
            (n, 6, 6) of the deflection in base_link, m and rad.

        """
        by_source = (deviation * values[self._parameter]) @ self._source
        return np.asarray(by_source @ by_source.transpose(0, 2, 1))

    def _played(self, inputs: Array) -> tuple[Array, Array]:
        """Return outputs and what is unknown of them, (n, m) each, of all plays."""
        if len(self._plays) == 1:  # nearly always, and a copy costs as much as a play
            played = self._plays[0][1].run(inputs)
            return played.output, played.unknown
        output, unknown = np.empty(inputs.shape), np.empty(inputs.shape)
        for which, plays in self._plays:
            played = plays.run(inputs[:, which])
            output[:, which], unknown[:, which] = played.output, played.unknown
        return output, unknown


@dataclass(frozen=True)
class SpringModel:
    """A fitted model; `name` is its kind.

    values (p,), covariance (p, p): of the basis' parameters, in its units. discrepancy (6, 6),
    noise (6,): m and rad, base_link; noise is that of one measured deflection. unresolved: names of
    parameters that the samples did not determine and that are near what they were before. notes:
    sentences on what the fit found.
    """

    name: str
    basis: SpringBasis
    values: Array
    covariance: Array
    discrepancy: Array
    noise: Array
    fitted_range: FittedRange
    fitted_on: Mapping[str, int]
    unresolved: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def tip_m(self) -> Array:
        """The tip (3,) in ft_sensor that it was fitted for."""
        return self.basis.tip_m

    @property
    def std(self) -> Array:
        """Standard deviations (p,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """Predict every sample, each segment from a fresh start: the same as stream by stream.

        Args:
            samples: n samples, of whole segments; their deflections are not looked at.

        Returns:
            Predictions (n) in base_link, m and rad.

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
        size = len(samples)
        predicted = PredictedSamples(
            np.empty((size, 6)), np.empty((size, 6, 6)), np.empty(size, dtype=bool)
        )
        for segment in samples.segments():
            run = SpringRun(self.basis)
            for first in range(segment.start, segment.stop, _CHUNK):
                part = slice(first, min(first + _CHUNK, segment.stop))
                result, _ = self._predict(run, samples.joints[part], samples.wrench[part])
                for whole, piece in zip(predicted, result, strict=True):
                    whole[part] = piece
        return predicted

    def stream(self) -> SpringStream:
        """Return a stream that starts unloaded."""
        return SpringStream(self)

    def _predict(
        self, run: SpringRun, joints: Array, wrench: Array
    ) -> tuple[PredictedSamples, Array | None]:
        """Predictions, and which part of their covariance (n, 6, 6) the unknown start has."""
        at_tip, design, deviation = run.rows(joints, wrench)
        mean = design @ self.values
        covariance = design @ self.covariance @ design.transpose(0, 2, 1)
        covariance += self.discrepancy
        start = None
        if deviation is not None:
            start = run.start_covariance(deviation, self.values)
            covariance += start
        outside = self.fitted_range.left_by(joints, at_tip)
        return PredictedSamples(mean, covariance, outside), start

    def to_json(self) -> dict[str, Any]:
        """Return everything needed to make it again: numbers, lists and texts."""
        content: dict[str, Any] = {"kind": self.name, "tip_m": numbers(self.tip_m)}
        if self.name == HYSTERESIS:
            content["reference_compliances"] = numbers(self.basis.platform_compliances)
            content["operators"] = [
                {"place": place, "shape": shape, "thresholds": numbers(thresholds)}
                for place, shape, thresholds in self.basis.operators
            ]
        return content | {
            "parameters": [
                {"name": parameter.name, "unit": parameter.unit, "value": float(value)}
                for parameter, value in zip(self.basis.parameters, self.values, strict=True)
            ],
            "covariance": [numbers(row) for row in self.covariance],
            "discrepancy": [numbers(row) for row in self.discrepancy],
            "noise": numbers(self.noise),
            "fitted_range": self.fitted_range.to_json(),
            "fitted_on": dict(self.fitted_on),
            "unresolved": list(self.unresolved),
            "notes": list(self.notes),
        }

    @classmethod
    def from_json(
        cls, content: Mapping[str, Any], arm: Arm, basis: SpringBasis | None = None
    ) -> SpringModel:
        """Read a file's content, by default of springs.

        Args:
            content: the whole file's content.
            arm: the arm that the model is used on.
            basis: what the parameters multiply; None: the arm's springs.

        Returns:
            The model.

        Raises:
            FieldError: naming the fault.

        """
        name = text(get(content, "kind"), "kind")
        basis = basis or SpringBasis(tip_from_json(content), arm=arm)
        if name == HYSTERESIS:
            basis = _with_operators(basis, content)
        size = len(basis.parameters)
        return cls(
            name=name,
            basis=basis,
            values=_values_from_json(content, basis.parameters),
            covariance=covariance(get(content, "covariance"), "covariance", size),
            discrepancy=covariance(get(content, "discrepancy"), "discrepancy", 6),
            noise=noise_from_json(content),
            fitted_range=FittedRange.from_json(get(content, "fitted_range"), "fitted_range", arm),
            fitted_on=fitted_on_from_json(get(content, "fitted_on")),
            unresolved=texts(get(content, "unresolved"), "unresolved"),
            notes=texts(get(content, "notes"), "notes"),
        )


class SpringStream:
    """A model on samples as they come: the same steps as `predict`, one sample at a time."""

    def __init__(self, model: SpringModel) -> None:
        self._model = model
        self.reset()

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """Take the next sample.

        Args:
            stamp_ns: its stamp; not used, since springs and plays know no time.
            joints: (j,), m and rad.
            wrench: (6,) applied, in ft_sensor about its origin, N and N.m.

        Returns:
            The deflection of tool_tip in base_link.

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
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

    def tip_pose(self, joints: Array) -> tuple[Array, Array]:
        """Return the tip's pose by the joints, without deflection.

        Args:
            joints: (j,), m and rad.

        Returns:
            R (3, 3) and position (3,), m, in base_link.

        """
        rotation, position = self._run.springs.geometry(joints[None]).tip
        return rotation[0], position[0]

    def reset(self) -> None:
        """Forget all loads, as if the arm had never been loaded."""
        self._run = SpringRun(self._model.basis)


def _with_operators(basis: SpringBasis, content: Mapping[str, Any]) -> SpringBasis:
    rows = items(get(content, "operators"), "operators")
    name = "reference_compliances"
    return replace(
        basis,
        operators=tuple(
            _operator(row, f"operators[{k}]", basis.columns) for k, row in enumerate(rows)
        ),
        reference=array(get(content, name), name, (len(basis.compliances),)),
    )


def _operator(content: Any, name: str, columns: Mapping[str, range]) -> Operator:
    row = mapping(content, name)
    place = text(get(row, "place"), f"{name}.place")
    if place not in columns:
        raise FieldError(f'{name}.place is "{place}"; expected one of {", ".join(columns)}')
    shape = text(get(row, "shape"), f"{name}.shape")
    shapes: dict[str, Shape] = {known: known for pair in STOPS.items() for known in pair}
    if shape not in shapes:
        raise FieldError(f'{name}.shape is "{shape}"; expected one of {", ".join(shapes)}')
    thresholds = array(get(row, "thresholds"), f"{name}.thresholds", (len(columns[place]),))
    if np.any(thresholds <= 0.0):
        raise FieldError(f"{name}.thresholds holds one that is not above zero")
    return Operator(place, shapes[shape], tuple(thresholds.tolist()))


def _values_from_json(content: Mapping[str, Any], parameters: Sequence[Parameter]) -> Array:
    rows = items(get(content, "parameters"), "parameters")
    if len(rows) != len(parameters):
        raise FieldError(f"parameters has {len(rows)} entries; expected {len(parameters)}")
    values = np.empty(len(parameters))
    for k, parameter in enumerate(parameters):
        name = f"parameters[{k}]"
        row = mapping(rows[k], name)
        for what, expected in (("name", parameter.name), ("unit", parameter.unit)):
            found = text(get(row, what), f"{name}.{what}")
            if found != expected:
                raise FieldError(f'{name}.{what} is "{found}"; expected "{expected}"')
        values[k] = number(get(row, "value"), f"{name}.value")
        if values[k] < 0.0 and not parameter.signed:
            raise FieldError(f"{name}.value is {values[k]}, below zero")
    return values
