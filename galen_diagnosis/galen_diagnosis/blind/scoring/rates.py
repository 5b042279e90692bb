"""Rates and parameter errors of a score.

Rates with their intervals, and how well probabilities hold.

Errors of the parameters that a diagnosis tells, in its own standard deviations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array
from scipy.stats import binomtest

_LEAST_PROBABILITY = 1e-6
"""A probability of 0 for the truth would cost infinitely much in the logarithmic score."""
CALIBRATION_BINS = 10


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
        interval, value = self.interval, self.value
        return {
            # Counts out of numpy are no integers to json.
            "value": None if value is None else float(value),
            "wilson95": None if interval is None else list(interval),
            "hits": int(self.hits),
            "of": int(self.of),
        }


def rate(hits: Iterable[bool]) -> Rate:
    """Count."""
    found = list(hits)
    return Rate(sum(found), len(found))


@dataclass(frozen=True)
class Calibration:
    """How well probabilities hold, over n answers.

    error: expected calibration error, the mean |share of right ones - mean probability| over bins
    of equal width of the first's probability, weighted by their numbers (M. P. Naeini et al., AAAI
    2015). brier: mean sum over the names of (probability - truth)^2, 0 ... 2 (G. W. Brier, 1950).
    log_score: mean -ln of the truth's probability, nats. by_chance: the error that probabilities
    that hold exactly would show at this n on average; an error isn't 0 for few answers.
    Bins (b,): mean probability, share of right ones, how many.
    """

    n: int
    error: float
    by_chance: float
    brier: float
    log_score: float
    probability: Array
    right: Array
    count: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Numbers, and the bins that hold anything."""
        return {
            "answers": self.n,
            "expected_calibration_error": self.error,
            "error_by_chance_alone": self.by_chance,
            "brier": self.brier,
            "log_score_nats": self.log_score,
            "bins": [
                {"probability": float(p), "right": float(r), "count": int(c)}
                for p, r, c in zip(self.probability, self.right, self.count, strict=True)
                if c
            ],
        }


def calibration(
    rankings: Sequence[dict[str, float]], truths: Sequence[str], bins: int = CALIBRATION_BINS
) -> Calibration | None:
    """Of rankings (probabilities by name) and the true names; None of nothing."""
    if not rankings:
        return None
    first = [max(r, key=lambda name: r[name]) for r in rankings]
    sure = np.array([r[name] for r, name in zip(rankings, first, strict=True)])
    right = np.array([name == truth for name, truth in zip(first, truths, strict=True)], float)
    chance = np.random.default_rng(0)
    drawn = [
        _binned(sure, (chance.random(len(sure)) < sure).astype(float), bins) for _ in range(200)
    ]
    probability, share, count = _binned(sure, right, bins)
    brier = np.mean(
        [
            sum((p - (name == truth)) ** 2 for name, p in r.items()) + (truth not in r)
            for r, truth in zip(rankings, truths, strict=True)
        ]
    )
    of_truth = [r.get(truth, 0.0) for r, truth in zip(rankings, truths, strict=True)]
    return Calibration(
        n=len(rankings),
        error=_error(probability, share, count),
        by_chance=float(np.mean([_error(*one) for one in drawn])),
        brier=float(brier),
        log_score=float(-np.mean(np.log(np.maximum(of_truth, _LEAST_PROBABILITY)))),
        probability=probability,
        right=share,
        count=count,
    )


def _binned(sure: Array, right: Array, bins: int) -> tuple[Array, Array, np.ndarray]:
    index = np.minimum((sure * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    some = np.maximum(count, 1)
    return (
        np.bincount(index, sure, bins) / some,
        np.bincount(index, right, bins) / some,
        count,
    )


def _error(probability: Array, right: Array, count: np.ndarray) -> float:
    return float(np.sum(count * np.abs(right - probability)) / np.sum(count))


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
