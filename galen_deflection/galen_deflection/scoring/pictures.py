"""Which pictures of a comparison or an evaluation are drawn, and of what part of it.

| file | shows |
|---|---|
| `<name>_course_<model>.png` | the report's figures 3, 4, 5: measured and predicted over time, at the position where the models are worst |
| `<name>_along_x_<k>.png` | figures 10, 11: some pushes along x from near, all models, at two positions |
| `<name>_over_predicted_<model>.png` | measured over predicted, all samples |
| `<name>_training_<model>.png` | figure 7, of a network |
"""  # noqa: E501 - a table's row is a line

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from galen_deflection.measurement.pushes import Push, find_pushes, tip_wrench
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import DeflectionModel, PredictedSamples
from galen_deflection.networks.network import NetworkModel
from galen_deflection.scoring.plots import (
    plot_axis,
    plot_course,
    plot_training,
    plot_true_over_predicted,
)

_X = 0
_PUSHES = 6


def plot_models(
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    folder: Path,
    name: str,
    what: str,
) -> list[Path]:
    """Draw the module's pictures of predictions by models' names; returns the files.

    `name` begins the files' names, `what` the titles. Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = _rejoined(samples)
    written = []
    position = _worst_position(samples, predictions)
    set_number = samples.set_number[samples.position == position][0]
    rows = (samples.position == position) & (samples.set_number == set_number)
    for model, predicted in predictions.items():
        written += [
            plot_course(
                samples.rows(rows),
                {model: _part(predicted, rows)},
                folder / f"{name}_course_{model}.png",
                f"{what}; {model}, position {position}: where the models are worst",
            ),
            plot_true_over_predicted(
                samples,
                predicted,
                folder / f"{name}_over_predicted_{model}.png",
                f"{what}; {model}, all that was checked",
            ),
        ]
    for number, rows in enumerate(_along_x(samples), start=1):
        part = samples.rows(rows)
        written.append(
            plot_axis(
                part,
                {model: _part(predicted, rows) for model, predicted in predictions.items()},
                folder / f"{name}_along_x_{number}.png",
                title=f"{what}; pushes along x at position {part.position[0]}",
            )
        )
    return written


def plot_trainings(models: Mapping[str, DeflectionModel], folder: Path, name: str) -> list[Path]:
    """Draw how those of the models that were trained were, by their names; returns the files."""
    written = []
    for model, fitted in models.items():
        if isinstance(fitted, NetworkModel):
            curve = fitted.training
            folder.mkdir(parents=True, exist_ok=True)
            written.append(
                plot_training(
                    curve.training_loss,
                    curve.check_loss,
                    folder / f"{name}_training_{model}.png",
                    curve.best,
                    title=f"training of {model}",
                )
            )
    return written


def _part(predicted: PredictedSamples, rows: np.ndarray | slice) -> PredictedSamples:
    return PredictedSamples(*(values[rows] for values in predicted))


def _rejoined(samples: DeflectionSamples) -> DeflectionSamples:
    """With segments that end only where time does, and not where a split cut them."""
    step_ns = np.diff(samples.stamp_ns)
    within = np.abs(step_ns) <= 2.5 * np.median(np.abs(step_ns)) if len(step_ns) else step_ns == 0
    same = (np.diff(samples.segment) == 0) | within
    return replace(samples, segment=np.concatenate([[0], np.cumsum(~same)]))


def _worst_position(samples: DeflectionSamples, predictions: Mapping[str, PredictedSamples]) -> int:
    """Where the models' errors over the noise, each in units of that model's own, are largest."""
    positions = np.unique(samples.position)
    total = np.zeros(len(positions))
    for predicted in predictions.values():
        square = np.mean(((predicted.mean - samples.deflection) / samples.noise) ** 2, axis=1)
        total += [square[samples.position == p].mean() / square.mean() for p in positions]
    return int(positions[np.argmax(total)])


def _along_x(samples: DeflectionSamples) -> list[slice]:
    """Rows of some neighbouring pushes along x, at the first and the last position with such."""
    at_tip = tip_wrench(samples)
    by_position: dict[int, list[Push]] = {}
    for push in find_pushes(samples, at_tip):
        if int(np.argmax(np.abs(at_tip[push.peak, :3]))) == _X:
            by_position.setdefault(int(samples.position[push.peak]), []).append(push)
    found = []
    for position in dict.fromkeys([min(by_position), max(by_position)] if by_position else []):
        pushes = by_position[position][:_PUSHES]
        first, last = pushes[0].rows.start, pushes[0].rows.stop
        for push in pushes:
            # Of another visit, or with other pushes between: not a neighbour.
            if push.rows.start - last > push.rows.stop - push.rows.start:
                break
            last = max(push.rows.stop, push.rest.stop)
        found.append(slice(first, last))
    return found
