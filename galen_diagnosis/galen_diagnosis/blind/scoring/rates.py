"""Rates with their intervals, and how well probabilities hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
