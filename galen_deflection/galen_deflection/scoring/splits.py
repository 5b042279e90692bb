"""Which samples a model is fitted to, and which it is checked on.

Sets stay whole, and so do segments, but for the split by pushes.

A set is one repetition of the pushes at one position: the samples with one position and one
set_number. The report (section 2.3.4 and 2.3.6) has eight sets, two at each of four positions, and
fits to six of them and checks on two; it doesn't say which. (The two calibration sets beside them
hold no pushes, and no samples.) Here the two come from different positions, so that every position
is among those fitted to: else it would be the harder question, that of a position left out.

Where every position was visited once, there is no such split, and pushes are dealt out instead,
never samples: neighbours 10 ms apart are the same load. A push takes all until the next one begins
with it, since what is left after it is what a model of hysteresis is asked for. Dealt are push 0 to
the first fold, 1 to the second and so on, one further at each set. Stretches of neighbouring pushes
would be no better: a script goes axis by axis, and all pushes along one axis would be missed at
once, which is another question. Dealt like this, a push's like in the same place is not fitted to,
but its neighbours are, and its like at other positions: what the report's split has, too, where
the same script was played twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from galen_model.errors import GalenError

from galen_deflection.measurement.pushes import PushLimits, find_pushes, tip_wrench
from galen_deflection.measurement.samples import DeflectionSamples

PUSH_FOLDS = 4


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


def push_splits(
    samples: DeflectionSamples, limits: PushLimits | None = None, folds: int = PUSH_FOLDS
) -> list[Split]:
    """Pushes dealt into folds, each checked in turn; every fold checks some at every position.

    They cut segments: fit with `FitSettings.use`, so that the loads of what is left out still
    count, predict whole segments, and score `checked_samples`. Segments without a push are fitted
    to in all. Raises SplitError for a position with fewer pushes than folds.
    """
    places = [(p, number) for p, numbers in sets_of(samples).items() for number in numbers]
    fold = np.full(len(samples), -1)
    done = dict.fromkeys(places, 0)
    starts = [push.rows.start for push in find_pushes(samples, tip_wrench(samples), limits)]
    for start, following in zip(starts, [*starts[1:], len(samples)], strict=True):
        segment = samples.segment == samples.segment[start]
        place = (int(samples.position[start]), int(samples.set_number[start]))
        block = np.zeros(len(samples), dtype=bool)
        block[start:following] = True
        # The first push of a segment has what is before it.
        block[:start] |= fold[:start] < 0
        fold[block & segment] = (done[place] + places.index(place)) % folds
        done[place] += 1
    for position in {position for position, _ in places}:
        found = sum(count for place, count in done.items() if place[0] == position)
        if len(set(fold[samples.position == position].tolist()) - {-1}) < folds:
            raise SplitError(
                f"position {position} has {found} pushes with a pause before and after: too few to"
                f" deal them to {folds} folds"
            )
    return [
        _split(samples, f"pushes, fold {number + 1} of {folds}", fold == number)
        for number in range(folds)
    ]


SPLITS: dict[str, Callable[[DeflectionSamples], list[Split]]] = {
    "report": report_splits,
    "push": push_splits,
    "set": leave_one_set_out,
    "position": leave_one_position_out,
}
"""Every split by its name on the command line."""


def checked_samples(samples: DeflectionSamples, splits: Sequence[Split]) -> DeflectionSamples:
    """The samples that some split checks, in their order, to be scored.

    A segment ends where the split does, or where a sample between was not checked, so that no push
    and no pause is scored over a cut. Raises ValueError if two splits check the same sample.
    """
    which = np.full(len(samples), -1)
    for number, split in enumerate(splits):
        if np.any(which[split.check] >= 0):
            raise ValueError(f"{split.name}: some of its samples are checked by another split, too")
        which[split.check] = number
    rows = np.flatnonzero(which >= 0)
    part = samples.rows(rows)
    cut = (np.diff(rows) > 1) | (np.diff(which[rows]) != 0) | (np.diff(part.segment) != 0)
    return replace(part, segment=np.concatenate([[0], np.cumsum(cut)]))


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
