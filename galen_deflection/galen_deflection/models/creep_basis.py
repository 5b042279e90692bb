"""Springs with hysteresis that go on giving way for a while: Kelvin-Voigt elements beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import FieldError, get, items, mapping, number, text

from galen_deflection.models.hysteresis_basis import COLUMNS, HysteresisBasis
from galen_deflection.models.linear import Parameter, Rows, Start
from galen_deflection.springs.creep import LagOperators
from galen_deflection.springs.springs import kinds

_KINDS = {kind.name: kind for kind in kinds()}


class Lag(NamedTuple):
    """An element at each spring of a kind; one compliance. place: the kind's name."""

    place: str
    time_constant_s: float

    @property
    def name(self) -> str:
        """As parameters are named."""
        return f"creep of {self.place}, {self.time_constant_s:g} s"


@dataclass(frozen=True)
class CreepBasis:
    """Parameters of `springs`, then the compliance of each lag."""

    springs: HysteresisBasis
    lags: tuple[Lag, ...]
    bounded = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """As `Basis.parameters`."""
        return self.springs.parameters + tuple(
            Parameter(lag.name, _KINDS[lag.place].compliance_unit) for lag in self.lags
        )

    def run(self) -> CreepRun:
        """As `Basis.run`."""
        return CreepRun(self)

    def to_json(self) -> dict[str, Any]:
        """As `Basis.to_json`."""
        lags = [{"place": lag.place, "time_constant_s": lag.time_constant_s} for lag in self.lags]
        return {**self.springs.to_json(), "lags": lags}


class CreepRun:
    """As `Run`."""

    def __init__(self, basis: CreepBasis) -> None:
        """Of a basis; unloaded."""
        self._run = basis.springs.run()
        single = [(column, k) for k, lag in enumerate(basis.lags) for column in COLUMNS[lag.place]]
        self._column, lag = np.array(single, dtype=int).reshape(-1, 2).T
        self._lags = LagOperators(np.array([basis.lags[k].time_constant_s for k in lag]))
        self._of_lag = np.zeros((len(single), len(basis.lags)))
        self._of_lag[np.arange(len(single)), lag] = 1.0
        self._parameter = len(basis.springs.parameters) + lag
        # One unknown thing for each spring: how long its load has been there.
        self._source = (self._column[:, None] == np.unique(self._column)).astype(float)

    def rows(self, stamp_ns: np.ndarray, joints: Array, wrench: Array) -> Rows:
        """As `Run.rows`."""
        (at_tip, design, start), jacobian, loads = self._run.loaded_rows(joints, wrench)
        crept = self._lags.run(stamp_ns, loads[:, self._column])
        columns = jacobian[:, :, self._column]
        late = (columns * crept.output[:, None, :]) @ self._of_lag
        if crept.unknown.any():
            unknown = Start(columns * crept.unknown[:, None, :], self._parameter, self._source)
            start = unknown if start is None else start.beside(unknown)
        return Rows(at_tip, np.concatenate([design, late], axis=2), start)


def lags_from_json(content: Mapping[str, Any]) -> tuple[Lag, ...]:
    """The field lags, which need not be there; raises FieldError."""
    found = []
    for k, row in enumerate(items(content.get("lags", []), "lags")):
        name = f"lags[{k}]"
        fields = mapping(row, name)
        place = text(get(fields, "place"), f"{name}.place")
        if place not in _KINDS:
            raise FieldError(f'{name}.place is "{place}"; expected one of {", ".join(_KINDS)}')
        time_constant_s = number(get(fields, "time_constant_s"), f"{name}.time_constant_s")
        if time_constant_s <= 0.0:
            raise FieldError(f"{name}.time_constant_s is {time_constant_s}, not above zero")
        found.append(Lag(place, time_constant_s))
    return tuple(found)
