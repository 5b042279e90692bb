# SPDX-License-Identifier: Apache-2.0
"""Fits without some samples, scored on those: which samples, split by split.

A set is one repetition of the pushes at one position: the samples with one position and one
set_number. The report (section 2.3.4 and 2.3.6) has eight sets, two at each of four positions, and
fits to six of them and checks on two; it doesn't specify which. Here the two come from different
positions, so that every position is among those fitted to.

Where every position was visited once, pushes are dealt out instead, never samples: neighbours 10 ms
apart are the same load. A push takes all until the next one begins with it, since the residual
after it is what a model of hysteresis is asked for. Dealt are push 0 to the first fold, 1 to the
second and so on, one further at each set: a script goes axis by axis, and of runs of neighbouring
pushes all along one axis would be missed at once. Sets of fewer pushes than folds are dealt out one
after the other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from galen_deflection.measurement.samples import (
    DeflectionError,
    DeflectionSamples,
    find_pushes,
    no_load,
)
from galen_deflection.models.file import KINDS, DeflectionModel
from galen_deflection.models.interface import FitSettings, PredictedSamples
from galen_deflection.models.springs import tip_wrench
from galen_deflection.scoring.score import Score, score


class SplitError(DeflectionError):
    """Samples that can't be split as asked; the message names what is missing."""


PUSH_FOLDS = 4


class Split(NamedTuple):
    """The rows of samples (n,) bool that are checked; all others are fitted to."""

    name: str
    check: np.ndarray


def sets_of(samples: DeflectionSamples) -> dict[int, list[int]]:
    """Return the set numbers of each position, both in increasing order.

    Args:
        samples: n samples.

    Returns:
        Set numbers by position.

    Raises:
        SplitError: a segment belongs to more than one set, or there are no samples.

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
    """Check a set of each position in one half of them in turn, as the report does.

    Of four positions with two sets that is six to two. Four such splits together check every set
    once. Of a position with more sets only the last two are checked.

    Args:
        samples: n samples.

    Returns:
        Four splits: the last set of the first half of the positions, of the second half, then the
        last but one of each.

    Raises:
        SplitError: there are fewer than two positions, or fewer than two sets at one; or as of
            `sets_of`.

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
    splits = []
    for back in (-1, -2):
        for group in (positions[:half], positions[half:]):
            pairs = [(position, sets[position][back]) for position in group]
            check = np.zeros(len(samples), dtype=bool)
            for position, number in pairs:
                check |= (samples.position == position) & (samples.set_number == number)
            name = ", ".join(f"set {number} of position {position}" for position, number in pairs)
            splits.append(Split(name, check))
    return splits


def position_splits(samples: DeflectionSamples) -> list[Split]:
    """Check each position in turn with all its sets.

    Args:
        samples: n samples.

    Returns:
        A split for each position.

    Raises:
        SplitError: there is one position only; or as of `sets_of`.

    """
    sets = sets_of(samples)
    if len(sets) < 2:
        raise SplitError(f"only position {next(iter(sets))} was recorded: none can be left out")
    return [Split(f"position {position}", samples.position == position) for position in sets]


def push_splits(samples: DeflectionSamples, folds: int = PUSH_FOLDS) -> list[Split]:
    """Check pushes, dealt into folds, in turn; every fold checks some at every position.

    They cut segments: fit with `FitSettings.use`, so that the loads of what is left out still
    count, predict whole segments, and score `checked_samples`. Segments without a push are only
    fitted to.

    Args:
        samples: n samples.
        folds: number of parts that the pushes are dealt to.

    Returns:
        A split for each fold.

    Raises:
        SplitError: the pushes at a position are too few to reach every fold, or as of `sets_of`.

    """
    places = [(p, number) for p, numbers in sets_of(samples).items() for number in numbers]
    fold = np.full(len(samples), -1)
    starts = [push.rows.start for push in find_pushes(samples, tip_wrench(samples))]
    place_of = [(int(samples.position[start]), int(samples.set_number[start])) for start in starts]
    first, next_fold = 0, {}
    for place in places:
        next_fold[place] = first
        count = place_of.count(place)
        first += count if count < folds else 1
    for start, following, place in zip(starts, [*starts[1:], len(samples)], place_of, strict=True):
        segment = samples.segment == samples.segment[start]
        block = np.zeros(len(samples), dtype=bool)
        block[start:following] = True
        # The first push of a segment has what is before it.
        block[:start] |= fold[:start] < 0
        fold[block & segment] = next_fold[place] % folds
        next_fold[place] += 1
    for position in {position for position, _ in places}:
        found = sum(place[0] == position for place in place_of)
        if len(set(fold[samples.position == position].tolist()) - {-1}) < folds:
            raise SplitError(
                f"position {position} has {found} pushes with a pause before and after: too few to"
                f" deal them to {folds} folds"
            )
    return [
        Split(f"pushes, fold {number + 1} of {folds}", fold == number) for number in range(folds)
    ]


SPLITS: dict[str, Callable[[DeflectionSamples], list[Split]]] = {
    "report": report_splits,
    "push": push_splits,
    "position": position_splits,
}
"""Every split by its name on the command line."""


def usual_splits(samples: DeflectionSamples) -> list[str]:
    """Return the splits for positions that were fitted to, and for others if there are several.

    Args:
        samples: n samples.

    Returns:
        Names of `SPLITS`.

    """
    try:
        report_splits(samples)
    except SplitError:
        names = ["push"]
    else:
        names = ["report"]
    return [*names, "position"] if len(np.unique(samples.position)) > 1 else names


def checked_samples(samples: DeflectionSamples, splits: Sequence[Split]) -> DeflectionSamples:
    """Return the samples that some split checks, in their order, to be scored.

    A segment ends where the split does, or where a sample between was not checked, so that no push
    and no pause is scored over a cut.

    Args:
        samples: n samples.
        splits: of these samples; no sample is checked twice.

    Returns:
        The checked samples, with segments of their own.

    Raises:
        ValueError: two splits check the same sample.

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


@dataclass(frozen=True)
class Checked:
    """How a kind does at a split.

    samples, predicted: those checked, each by the model that was fitted without it. seconds: CPU
    time of each fit. models: one for each part checked.
    """

    samples: DeflectionSamples
    predicted: PredictedSamples
    score: Score
    seconds: tuple[float, ...]
    models: tuple[DeflectionModel, ...]


def cross_check(
    kind: str,
    samples: DeflectionSamples,
    splits: Sequence[Split],
    settings: FitSettings | None = None,
    on_split: Callable[[], Any] = lambda: None,
) -> Checked:
    """Fit without each part and predict it, and score all at once.

    Args:
        kind: one of `KINDS`.
        samples: n samples.
        splits: of these samples; no sample is checked twice.
        settings: of each fit; `use` is ignored; None: the defaults.
        on_split: called after each fit.

    Returns:
        Predictions of the checked samples by models that were fitted without them, and their score.

    Raises:
        GalenError: a model can't be fitted.
        ValueError: two splits check the same sample.

    """
    settings = settings or FitSettings()
    count = len(samples)
    pooled = PredictedSamples(
        np.full((count, 6), np.nan), np.full((count, 6, 6), np.nan), np.zeros(count, dtype=bool)
    )
    seconds, models = [], []
    for split in splits:
        started_s = time.process_time()  # a busy machine takes longer, not more
        models.append(fit_without(kind, samples, split, settings))
        seconds.append(time.process_time() - started_s)
        # Whole segments, since models remember the load.
        rows = np.isin(samples.segment, samples.segment[split.check])
        predicted = models[-1].predict(samples.rows(rows)).rows(split.check[rows])
        for whole, part in zip(pooled, predicted, strict=True):
            whole[split.check] = part
        on_split()
    checked = checked_samples(samples, splits)
    pooled = pooled.rows(np.any([split.check for split in splits], axis=0))
    # What is no load, by all pushes: a split that cuts at pauses found them like that.
    result = score(checked, pooled, no_load(tip_wrench(samples)))
    return Checked(checked, pooled, result, tuple(seconds), tuple(models))


def fit_without(
    kind: str, samples: DeflectionSamples, split: Split, settings: FitSettings
) -> DeflectionModel:
    """Fit to the samples that are not checked.

    Segments without one are not even shown to the fit; of others in a segment only loads count.

    Args:
        kind: one of `KINDS`.
        samples: n samples.
        split: whose checked samples are left out.
        settings: of the fit; `use` is ignored.

    Returns:
        The fitted model.

    Raises:
        GalenError: it can't be fitted.

    """
    use = ~split.check
    shown = np.isin(samples.segment, samples.segment[use])
    return KINDS[kind].fit(samples.rows(shown), replace(settings, use=use[shown]))
