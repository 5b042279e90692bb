"""Errors of the parameters that a diagnosis tells, in its own standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

_SIGMAS_95 = 1.959964
"""Half the width of a normal's 95 % interval, in standard deviations."""


@dataclass(frozen=True)
class ParameterError:
    """One number of one cause: true and said, SI; interval as said, None where it wasn't.

    name: of the parameter, with its index where it is a vector's.
    """

    recording: str
    effect: str
    name: str
    true: float
    said: float
    low: float | None
    high: float | None

    @property
    def in_sigma(self) -> float | None:
        """(said - true) over the standard deviation that the interval tells; None without one."""
        if self.low is None or self.high is None or self.high <= self.low:
            return None
        return (self.said - self.true) / ((self.high - self.low) / (2.0 * _SIGMAS_95))

    @property
    def covered(self) -> bool | None:
        """Whether the interval holds the truth; None without one."""
        if self.low is None or self.high is None:
            return None
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Compared:
    """Parameters of one cause: numbers, and whether its words (axis, joint, bag) are right.

    words: None where the effect has none. Of a cause whose words are wrong no number is compared:
    a coefficient from fx isn't one from fy. missing: true parameters that weren't told.
    """

    numbers: tuple[ParameterError, ...]
    words: bool | None
    missing: tuple[str, ...]


def compare(
    recording: str, effect: str, true: Mapping[str, Any], said: Mapping[str, Any]
) -> Compared:
    """A cause's parameters as they are and as they were said (`diagnosis.json`'s form)."""
    true, said = _flat(true), _flat(said)
    words = [name for name, value in true.items() if isinstance(value, str)]
    right = all(_word(said.get(name)) == true[name] for name in words) if words else None
    missing = tuple(name for name in true if said.get(name) is None)
    numbers: list[ParameterError] = []
    if right is not False:
        for name, value in true.items():
            if name in words or name in missing:
                continue
            numbers += _numbers(recording, effect, name, value, said[name])
    return Compared(tuple(numbers), right, missing)


def _flat(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of mappings, but for values with their intervals, under "name.entry"."""
    flat: dict[str, Any] = {}
    for name, value in parameters.items():
        if isinstance(value, Mapping) and "value" not in value:
            flat |= {f"{name}.{entry}": part for entry, part in value.items()}
        else:
            flat[name] = value
    return flat


def _word(said: Any) -> Any:
    return said.get("value") if isinstance(said, Mapping) else said


def _numbers(recording: str, effect: str, name: str, true: Any, said: Any) -> list[ParameterError]:
    value = said.get("value") if isinstance(said, Mapping) else said
    interval = said.get("ci95") if isinstance(said, Mapping) else None
    scalar = np.ndim(true) == 0
    trues, values = np.atleast_1d(true), np.atleast_1d(np.asarray(value, dtype=float))
    if len(trues) != len(values):
        return []
    intervals = [interval] if scalar else (interval or [None] * len(trues))
    found = []
    for index, (one, other, limits) in enumerate(zip(trues, values, intervals, strict=True)):
        low, high = (None, None) if limits is None else limits
        if np.isfinite(other):
            label = name if scalar else f"{name}[{index}]"
            found.append(
                ParameterError(recording, effect, label, float(one), float(other), low, high)
            )
    return found
