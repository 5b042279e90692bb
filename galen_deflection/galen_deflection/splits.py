"""Which samples a model is fitted to, and which it is checked on. Segments stay whole.

A set is one repetition of the pushes at one position: the samples with one position and one
set_number. The report (section 2.3.4 and 2.3.6) has eight sets, two at each of four positions, and
fits to six of them and checks on two; it doesn't say which. (The two calibration sets beside them
hold no pushes, and no samples.) Here the two come from different positions, so that every position
is among those fitted to: else it would be the harder question, that of a position left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from galen_model.errors import GalenError

from galen_deflection.samples import DeflectionSamples


class SplitError(GalenError):
    """Samples that can't be split as asked; the message says what lacks."""


@dataclass(frozen=True)
class Split:
    """Rows of samples, (n,) booleans each; `name` says what is checked."""

    name: str
    train: np.ndarray
    check: np.ndarray


def sets_of(samples: DeflectionSamples) -> dict[int, list[int]]:
    """Set numbers of each position, both in increasing order.

    Raises SplitError if a segment belongs to more than one set, or if there are no samples.
    """
    if not len(samples):
        raise SplitError("there are no samples to split")
    keys = np.stack([samples.segment, samples.position, samples.set_number], axis=1)
    distinct = np.unique(keys, axis=0)
    for before, after in pairwise(distinct.tolist()):
        if before[0] == after[0]:
            raise SplitError(
                f"segment {before[0]} belongs to set {before[2]} of position {before[1]} and to "
                f"set {after[2]} of position {after[1]}: a split would cut it"
            )
    found: dict[int, list[int]] = {}
    for position, number in np.unique(keys[:, 1:], axis=0).tolist():
        found.setdefault(position, []).append(number)
    return found


def report_splits(samples: DeflectionSamples) -> list[Split]:
    """The report's split: a set of each position in one half is checked, all others are fitted to.

    Of four positions with two sets that is six to two. Four such splits together check every set
    once; the first, the last sets of the first half of the positions, is the one to show if one is
    shown. Of a position with more sets only the last two are checked. Raises SplitError with fewer
    than two positions, or with fewer than two sets at one.
    """
    sets = sets_of(samples)
    if len(sets) < 2:
        raise SplitError(
            "the report's split needs pushes at two positions or more, but only position "
            f"{next(iter(sets))} was recorded"
        )
    for position, numbers in sets.items():
        if len(numbers) < 2:
            raise SplitError(
                f"the report's split needs two sets at every position, but position {position} "
                "has one: record the pushes there again"
            )
    positions = list(sets)
    half = len(positions) // 2
    return [
        _checking(samples, [(position, sets[position][back]) for position in group])
        for back in (-1, -2)
        for group in (positions[:half], positions[half:])
    ]


def leave_one_position_out(samples: DeflectionSamples) -> list[Split]:
    """Each position in turn is checked with all its sets; raises SplitError if there is one."""
    sets = sets_of(samples)
    if len(sets) < 2:
        raise SplitError(f"only position {next(iter(sets))} was recorded: none can be left out")
    return [
        _split(samples, f"position {position}", samples.position == position) for position in sets
    ]


def leave_one_set_out(samples: DeflectionSamples) -> list[Split]:
    """Each set in turn is checked; raises SplitError if there is one."""
    pairs = list(_pairs(sets_of(samples)))
    if len(pairs) < 2:
        raise SplitError("only one set was recorded: none can be left out")
    return [_checking(samples, [pair]) for pair in pairs]


def _pairs(sets: dict[int, list[int]]) -> Iterator[tuple[int, int]]:
    for position, numbers in sets.items():
        for number in numbers:
            yield position, number


def _checking(samples: DeflectionSamples, pairs: list[tuple[int, int]]) -> Split:
    check = np.zeros(len(samples), dtype=bool)
    for position, number in pairs:
        check |= (samples.position == position) & (samples.set_number == number)
    name = ", ".join(f"set {number} of position {position}" for position, number in pairs)
    return _split(samples, name, check)


def _split(samples: DeflectionSamples, name: str, check: np.ndarray) -> Split:
    return Split(name, ~check, check)
