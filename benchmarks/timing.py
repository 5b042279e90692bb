"""Times pieces of code against each other, turn by turn, in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

_LEAST_S = 0.05


@dataclass(frozen=True)
class Timing:
    """Time of one call, s: the least, the median and the largest of the rounds."""

    name: str
    least_s: float
    median_s: float
    largest_s: float
    rounds: int

    def each(self, pieces: float) -> Timing:
        """Of one of so many pieces that a call works on."""
        return Timing(
            self.name,
            self.least_s / pieces,
            self.median_s / pieces,
            self.largest_s / pieces,
            self.rounds,
        )


def time_calls(
    subjects: Mapping[str, Callable[[], object]], rounds: int = 9, least_s: float = _LEAST_S
) -> dict[str, Timing]:
    """Time each subject; they take turns, so that what else the machine does meets all of them.

    A round calls a subject so often that it takes at least least_s.
    """
    often = {name: _often(call, least_s) for name, call in subjects.items()}
    seconds: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(rounds):
        for name, call in subjects.items():
            started = time.perf_counter()
            for _ in range(often[name]):
                call()
            seconds[name].append((time.perf_counter() - started) / often[name])
    return {
        name: Timing(name, min(each), float(np.median(each)), max(each), rounds)
        for name, each in seconds.items()
    }


def _often(call: Callable[[], object], least_s: float) -> int:
    """How many calls take that long; the first one, which fills caches, doesn't count."""
    call()
    number = 1
    while True:
        started = time.perf_counter()
        for _ in range(number):
            call()
        taken = time.perf_counter() - started
        if taken >= least_s:
            return number
        number = max(number + 1, int(1.2 * number * least_s / max(taken, 1e-9)))
