"""Springs with hysteresis: compliances, and operators with memory beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import FieldError, array, get, items, mapping, numbers, text
from galen_model.rotation import skew
from galen_model.transmission.play import Operators, PlayOperators, SmoothOperators

from galen_deflection.models.joint_stiffness import COMPLIANCES, StiffnessRun, elastic
from galen_deflection.models.linear import Parameter, Rows, Start
from galen_deflection.springs.springs import SPRINGS, kinds

Shape = Literal["play", "stop", "smooth_play", "smooth_stop"]

STOPS: dict[Shape, Shape] = {"play": "stop", "smooth_play": "smooth_stop"}
"""What is left of the load beside each kind of play."""

JOINTS = tuple(kind.name for kind in kinds())
PLATFORM = "platform"
COLUMNS = {kind.name: range(*kind.springs.indices(len(SPRINGS))) for kind in kinds()}
COLUMNS[PLATFORM] = range(len(SPRINGS), len(SPRINGS) + 6)
"""Where an operator may sit: at the springs of a kind, or at the platform's axes, counted on."""

UNDER_PLATFORM = slice(2, 4)
"""Of the four compliances those by which the platform moves: carriages and rods."""

_UNITS = {kind.name: kind.compliance_unit for kind in kinds()} | {PLATFORM: "1"}
_LOAD_UNITS = {kind.name: kind.load_unit for kind in kinds()}


class Operator(NamedTuple):
    """A play, or a stop, at each spring of a kind, or each of the platform's axes; one weight.

    A stop is what is left of the load beside a play, with corners or smooth
    (`galen_model.transmission.play`).

    thresholds: one for each of them; N.m, N, or at the platform m and rad.
    """

    place: str
    shape: Shape
    thresholds: tuple[float, ...]

    @property
    def name(self) -> str:
        """As parameters are named."""
        size = f"{self.thresholds[0]:.4g} {_LOAD_UNITS.get(self.place, 'm')}"
        return f"{self.shape.replace('_', ' ')} of {self.place} at {size}"


@dataclass(frozen=True)
class HysteresisBasis:
    """The four compliances, then a weight for each operator.

    reference (4,): the compliances with which the platform's operators see it move; linear models
    of a load can't do with those that are being fitted.
    """

    tip_m: Array
    operators: tuple[Operator, ...]
    reference: Array = field(default_factory=lambda: np.array([p.prior for p in COMPLIANCES]))
    bounded = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """As `Basis.parameters`."""
        return COMPLIANCES + tuple(
            Parameter(operator.name, _UNITS[operator.place]) for operator in self.operators
        )

    def run(self) -> HysteresisRun:
        """As `Basis.run`."""
        return HysteresisRun(self)

    def to_json(self) -> dict[str, Any]:
        """As `Basis.to_json`."""
        return {
            "reference_compliances": numbers(self.reference),
            "operators": [
                {"place": place, "shape": shape, "thresholds": numbers(thresholds)}
                for place, shape, thresholds in self.operators
            ],
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any], tip_m: Array) -> HysteresisBasis:
        """Read with checks; raises FieldError."""
        rows = items(get(content, "operators"), "operators")
        name = "reference_compliances"
        return cls(
            tip_m,
            tuple(_operator(row, f"operators[{k}]") for k, row in enumerate(rows)),
            array(get(content, name), name, (len(COMPLIANCES),)),
        )

    def part(self, operators: Sequence[int], shape: Shape) -> HysteresisBasis:
        """With some of the operators, as plays or as stops."""
        chosen = tuple(self.operators[k]._replace(shape=shape) for k in operators)
        return HysteresisBasis(self.tip_m, chosen, self.reference)


class HysteresisRun:
    """As `Run`."""

    def __init__(self, basis: HysteresisBasis) -> None:
        """Of a basis; unloaded."""
        self._arm = StiffnessRun(basis.tip_m)
        self._reference = basis.reference
        single = [
            (column, k, threshold)
            for k, operator in enumerate(basis.operators)
            for column, threshold in zip(COLUMNS[operator.place], operator.thresholds, strict=True)
        ]
        self._column = np.array([column for column, _, _ in single], dtype=int)
        self._operator = np.array([k for _, k, _ in single], dtype=int)
        # One unknown thing for each spring: the loads of its past moved all its operators together.
        self._source = (self._column[:, None] == np.unique(self._column)).astype(float)
        self._parameter = len(COMPLIANCES) + self._operator
        shapes = [basis.operators[k].shape for k in self._operator]
        self._stop = np.array([shape in STOPS.values() for shape in shapes], dtype=bool)
        self._any_stop = bool(self._stop.any())
        thresholds = np.array([threshold for _, _, threshold in single])
        smooth = np.array([shape.startswith("smooth") for shape in shapes], dtype=bool)
        self._plays: list[tuple[np.ndarray, Operators]] = []
        for kind, which in ((PlayOperators, ~smooth), (SmoothOperators, smooth)):
            if which.any():
                self._plays.append((which, kind(thresholds[which])))
        self._of_operator = np.zeros((len(single), len(basis.operators)))
        self._of_operator[np.arange(len(single)), self._operator] = 1.0
        self._of_platform = any(operator.place == PLATFORM for operator in basis.operators)

    def loads(self, joints: Array, wrench: Array) -> tuple[Array, Array, Array, Array]:
        """Wrench (n, 6) at the tip, designs (n, 6, 4) of the compliances, J, and all loads.

        J and loads are (n, 6, 17) and (n, 17) with the platform's axes, if an operator is there:
        the twist of its centre (m, rad), and what that does to the tip.
        """
        at_tip, (jacobian, lever), loads = self._arm.loaded(joints, wrench)
        springs = elastic(jacobian, loads)
        if self._of_platform:
            motion = springs[:, :, UNDER_PLATFORM] @ self._reference[UNDER_PLATFORM]
            motion[:, :3] += np.cross(lever, motion[:, 3:])  # of its centre, no longer of the tip
            own = np.tile(np.eye(6), (len(loads), 1, 1))
            own[:, :3, 3:] = -skew(lever)
            jacobian = np.concatenate([jacobian, own], axis=2)
            loads = np.concatenate([loads, motion], axis=1)
        return at_tip, springs, jacobian, loads

    def rows(self, joints: Array, wrench: Array) -> Rows:
        """As `Run.rows`."""
        at_tip, springs, jacobian, loads = self.loads(joints, wrench)
        inputs = loads.take(self._column, axis=1)
        output, unknown = self._played(inputs)
        if self._any_stop:
            output = np.where(self._stop, inputs - output, output)
        columns = jacobian.take(self._column, axis=2)
        remembered = (columns * output[:, None, :]) @ self._of_operator
        design = np.concatenate([springs, remembered], axis=2)
        start = None
        if unknown.any():
            deviation = columns * unknown[:, None, :]
            start = Start(deviation, self._parameter, self._source)
        return Rows(at_tip, design, start)

    def _played(self, inputs: Array) -> tuple[Array, Array]:
        """Outputs and what is unknown of them, (n, m) each, of all plays."""
        if len(self._plays) == 1:  # nearly always, and a copy costs as much as a play
            played = self._plays[0][1].run(inputs)
            return played.output, played.unknown
        output, unknown = np.empty(inputs.shape), np.empty(inputs.shape)
        for which, plays in self._plays:
            played = plays.run(inputs[:, which])
            output[:, which], unknown[:, which] = played.output, played.unknown
        return output, unknown


def _operator(content: Any, name: str) -> Operator:
    row = mapping(content, name)
    place = text(get(row, "place"), f"{name}.place")
    if place not in COLUMNS:
        raise FieldError(f'{name}.place is "{place}"; expected one of {", ".join(COLUMNS)}')
    shape = text(get(row, "shape"), f"{name}.shape")
    shapes: dict[str, Shape] = {known: known for pair in STOPS.items() for known in pair}
    if shape not in shapes:
        raise FieldError(f'{name}.shape is "{shape}"; expected one of {", ".join(shapes)}')
    thresholds = array(get(row, "thresholds"), f"{name}.thresholds", (len(COLUMNS[place]),))
    if np.any(thresholds <= 0.0):
        raise FieldError(f"{name}.thresholds holds one that is not above zero")
    return Operator(place, shapes[shape], tuple(thresholds.tolist()))
