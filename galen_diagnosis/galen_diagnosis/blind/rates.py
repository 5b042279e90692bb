"""Rates with their intervals, how well probabilities hold, errors of parameters in own sigmas."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array
from scipy.stats import binomtest

_LEAST_PROBABILITY = 1e-6
"""A probability of 0 for the truth would cost infinitely much in the logarithmic score."""
_BINS = 10
_SIGMAS_95 = 1.959964
"""Half the width of a normal's 95 % interval, in standard deviations."""


class Rate(NamedTuple):
    """`hits` of `of`."""

    hits: int
    of: int

    @property
    def value(self) -> float | None:
        """The share; None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
        if not self.of:
            return None
        found = binomtest(self.hits, self.of).proportion_ci(0.95, method="wilson")
        return float(found.low), float(found.high)

    def to_json(self) -> dict[str, Any]:
        """Value, interval and the counts."""
        return {
            "value": self.value, "wilson95": self.interval, "hits": self.hits, "of": self.of
        }  # fmt: skip


def rate(hits: Iterable[bool]) -> Rate:
    """Count."""
    found = [bool(hit) for hit in hits]
    return Rate(sum(found), len(found))


@dataclass(frozen=True)
class ParameterError:
    """One number of one cause: true and said, SI; interval as said, None without one.

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
        """(said - true) over the interval's standard deviation; None without one."""
        if self.low is None or self.high is None or self.high <= self.low:
            return None
        return (self.said - self.true) / ((self.high - self.low) / (2.0 * _SIGMAS_95))

    @property
    def covered(self) -> bool | None:
        """Whether the interval holds the truth; None without one."""
        if self.low is None or self.high is None:
            return None
        return self.low <= self.true <= self.high


def calibration(
    rankings: Sequence[Mapping[str, float]], truths: Sequence[str]
) -> dict[str, float | None]:
    """Say how well probabilities hold; None of nothing.

    calibration_error: mean |share of right ones - mean probability| over ten bins of the first's
    probability, weighted by their numbers (M. P. Naeini et al., AAAI 2015); by_chance: the same of
    probabilities that hold exactly, at this number. brier: mean sum over the names of
    (probability - truth)^2, 0 ... 2 (G. W. Brier, 1950). log_score: mean -ln of the truth's, nats.
    """
    names = ("calibration_error", "calibration_error_by_chance", "brier", "log_score")
    if not rankings:
        return dict.fromkeys(names)
    rows = list(zip(rankings, truths, strict=True))
    first = [max(ranking, key=lambda name: ranking[name]) for ranking in rankings]
    sure = np.array([ranking[name] for ranking, name in zip(rankings, first, strict=True)])
    right = np.array([name == truth for name, truth in zip(first, truths, strict=True)], float)
    chance = np.random.default_rng(0)
    drawn = [
        _binned_error(sure, (chance.random(len(sure)) < sure).astype(float)) for _ in range(200)
    ]
    brier = np.mean(
        [
            sum((p - (name == truth)) ** 2 for name, p in ranking.items()) + (truth not in ranking)
            for ranking, truth in rows
        ]
    )
    of_truth = np.array([ranking.get(truth, 0.0) for ranking, truth in rows])
    log_score = -np.mean(np.log(np.maximum(of_truth, _LEAST_PROBABILITY)))
    values = (_binned_error(sure, right), np.mean(drawn), brier, log_score)
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _binned_error(sure: Array, right: Array) -> float:
    index = np.minimum((sure * _BINS).astype(int), _BINS - 1)
    excess = np.bincount(index, right - sure, _BINS)
    return float(np.sum(np.abs(excess)) / len(sure))


def compare(
    recording: str, effect: str, true: Mapping[str, Any], said: Mapping[str, Any]
) -> tuple[list[ParameterError], bool | None]:
    """Compare a cause's parameters with those of `diagnosis.json`: errors, and if words are right.

    The second is None where the effect has no words. Of a cause whose words are wrong no number is
    compared: a coefficient from fx isn't one from fy.
    """
    true, said = _flat(true), _flat(said)
    words = [name for name, value in true.items() if isinstance(value, str)]
    right = all(_value(said.get(name)) == true[name] for name in words) if words else None
    if right is False:
        return [], right
    numbers: list[ParameterError] = []
    for name, value in true.items():
        if name not in words and said.get(name) is not None:
            numbers += _numbers(recording, effect, name, value, said[name])
    return numbers, right


def _flat(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of mappings, but for values with their intervals, under "name.entry"."""
    flat: dict[str, Any] = {}
    for name, value in parameters.items():
        if isinstance(value, Mapping) and "value" not in value:
            flat |= {f"{name}.{entry}": part for entry, part in value.items()}
        else:
            flat[name] = value
    return flat


def _value(said: Any) -> Any:
    return said.get("value") if isinstance(said, Mapping) else said


def _numbers(recording: str, effect: str, name: str, true: Any, said: Any) -> list[ParameterError]:
    interval = said.get("ci95") if isinstance(said, Mapping) else None
    scalar = np.ndim(true) == 0
    trues = np.atleast_1d(true)
    values = np.atleast_1d(np.asarray(_value(said), dtype=float))
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
