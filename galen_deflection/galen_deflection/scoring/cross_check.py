"""A kind of model fitted without some samples and scored on those, split by split."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from galen_deflection.measurement.pushes import PushLimits, tip_wrench
from galen_deflection.measurement.recordings import Recording, join_recordings
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import DeflectionModel, FitSettings, PredictedSamples
from galen_deflection.models.registry import kind_of
from galen_deflection.scoring.score import Score, score
from galen_deflection.scoring.splits import (
    SPLITS,
    Split,
    SplitError,
    checked_samples,
    report_splits,
)

_APART = "position"
"""The split that checks positions that were not fitted to."""


@dataclass(frozen=True)
class Task:
    """One question: samples, the splits that ask it, and what is only ever fitted to.

    use (splits, n + extra) bool: what each split's fit may look at. `samples` is what is checked,
    `whole` the same with the extra samples after it.
    """

    split: str
    splits: tuple[Split, ...]
    samples: DeflectionSamples
    whole: DeflectionSamples
    use: np.ndarray

    @classmethod
    def of(
        cls,
        split: str,
        samples: DeflectionSamples,
        whole: DeflectionSamples | None = None,
    ) -> Task:
        """Ask `split` (of `SPLITS`); whole: `samples`, and after them what is only fitted to.

        Where positions are left out, they are left out of the extra samples as well. Raises
        SplitError.
        """
        whole = samples if whole is None else whole
        splits = tuple(SPLITS[split](samples))
        use = np.ones((len(splits), len(whole)), dtype=bool)
        for row, one in zip(use, splits, strict=True):
            row[: len(samples)] = one.train
            if split == _APART:
                row &= ~np.isin(whole.position, np.unique(samples.position[one.check]))
        return cls(split, splits, samples, whole, use)


@dataclass(frozen=True)
class Checked:
    """How a kind does at a task.

    samples, predicted: those checked, each by the model that was fitted without it. seconds: CPU
    time of each fit. models: one a split.
    """

    samples: DeflectionSamples
    predicted: PredictedSamples
    score: Score
    seconds: tuple[float, ...]
    models: tuple[DeflectionModel, ...]


def make_tasks(
    names: Sequence[str] | None, recordings: Sequence[Recording], extra: Sequence[Recording] = ()
) -> list[Task]:
    """The splits by their names, None for those that are told most by; raises SplitError.

    Of a single position None are the pushes: it can't be left out.
    """
    whole = join_recordings([*recordings, *extra])
    # Numbers of positions are those of the whole; the noise is that of what is checked.
    own = join_recordings(recordings)
    samples = replace(own, position=whole.position[: len(own)])
    if names is None:
        names = [seen_split(samples)]
        if len(np.unique(samples.position)) > 1:
            names.append(_APART)
    return [Task.of(name, samples, whole) for name in dict.fromkeys(names)]


def seen_split(samples: DeflectionSamples) -> str:
    """The split that asks for positions which were fitted to."""
    try:
        report_splits(samples)
    except SplitError:
        return "push"
    return "report"


def cross_check(
    kind: str,
    task: Task,
    settings: FitSettings | None = None,
    on_split: Callable[[Split], Any] | None = None,
) -> Checked:
    """Fit and predict for each split, and score all at once; raises GalenError.

    `settings.use` is the task's own affair. `on_split` is called after each split.
    """
    settings = settings or FitSettings()
    count = len(task.samples)
    mean, covariance = np.full((count, 6), np.nan), np.full((count, 6, 6), np.nan)
    extrapolated = np.zeros(count, dtype=bool)
    seconds, models = [], []
    for split, use in zip(task.splits, task.use, strict=True):
        started_s = time.process_time()  # a busy machine takes longer, not more
        models.append(fit_without(kind, task.whole, use, settings))
        seconds.append(time.process_time() - started_s)
        # Whole segments, since models remember the load.
        rows = np.isin(task.samples.segment, task.samples.segment[split.check])
        predicted = models[-1].predict(task.samples.rows(rows))
        wanted = split.check[rows]
        mean[split.check] = predicted.mean[wanted]
        covariance[split.check] = predicted.covariance[wanted]
        extrapolated[split.check] = predicted.extrapolated[wanted]
        if on_split is not None:
            on_split(split)
    samples = checked_samples(task.samples, task.splits)
    rows = np.any([split.check for split in task.splits], axis=0)
    pooled = PredictedSamples(mean[rows], covariance[rows], extrapolated[rows])
    # What is no load, by all pushes: a split that cuts at pauses found them like that.
    limits = PushLimits().absolute(tip_wrench(task.samples))
    result = score(samples, pooled, limits)
    return Checked(samples, pooled, result, tuple(seconds), tuple(models))


def fit_without(
    kind: str, samples: DeflectionSamples, use: np.ndarray, settings: FitSettings
) -> DeflectionModel:
    """Fit to the samples in `use` (n,) bool; segments without one are not even shown to the fit.

    Of the others in a segment only the loads count. Raises GalenError.
    """
    shown = np.isin(samples.segment, samples.segment[use])
    return kind_of(kind).fit(samples.rows(shown), replace(settings, use=use[shown]))


def by_position(samples: DeflectionSamples, predicted: PredictedSamples) -> dict[int, Score]:
    """The score of each position's samples by itself, by its number."""
    limits = PushLimits().absolute(tip_wrench(samples))
    found = {}
    for position in np.unique(samples.position).tolist():
        rows = samples.position == position
        part = PredictedSamples(*(values[rows] for values in predicted))
        found[position] = score(samples.rows(rows), part, limits)
    return found
