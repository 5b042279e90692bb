"""Models against one recording, as a job: everything it needs can be sent to another process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.files.calibration_file import CalibrationFile

from galen_deflection.errors import ModelFileError
from galen_deflection.measurement.recordings import (
    ReadSettings,
    Recording,
    find_tool,
    read_recording,
)
from galen_deflection.models.file import read_model
from galen_deflection.models.interface import DeflectionModel, PredictedSamples
from galen_deflection.scoring.cross_check import by_position
from galen_deflection.scoring.options import written
from galen_deflection.scoring.score import Score, score


@dataclass(frozen=True)
class Evaluation:
    """What models predict of a recording; mappings by the models' names.

    by_position: of each, the score at each position. notes: sentences.
    """

    recording: Recording
    predicted: Mapping[str, PredictedSamples]
    scores: Mapping[str, Score]
    by_position: Mapping[str, Mapping[int, Score]]
    notes: tuple[str, ...]
    pictures: tuple[Path, ...]


@dataclass(frozen=True)
class EvaluationJob:
    """What is to be done with each bag.

    models: files by the names that they have in tables. names: what each bag's pictures are called.
    """

    models: Mapping[str, Path]
    settings: ReadSettings
    plots: Path | None = None
    names: Mapping[Path, str] = field(default_factory=dict)

    def __call__(self, bag: Path) -> dict[str, Any]:
        """Do it, and return it as plain numbers and texts."""
        return to_dict(self.evaluate(bag))

    def evaluate(
        self, bag: Path, on_progress: Callable[[int, int | None], None] | None = None
    ) -> Evaluation:
        """Do it; raises GalenError that names the bag, the tool's or the model's file."""
        models = {name: read_model(path) for name, path in self.models.items()}
        tool = find_tool(bag, self.settings)
        for name, model in models.items():
            _check_tip(self.models[name], model, bag, tool)
        recording = read_recording(bag, self.settings, on_progress)
        samples = recording.samples
        predicted = {name: model.predict(samples) for name, model in models.items()}
        notes = [
            f"{self.models[name]} was fitted to {bag} and to nothing else, by its noise: its scores"
            " say little of other recordings"
            for name, model in models.items()
            if _same_noise(model, recording)
        ]
        pictures: list[Path] = []
        if self.plots is not None:
            from galen_deflection.scoring.pictures import plot_models  # slow to import

            folder, name = self.plots, self.names.get(bag, bag.stem)
            pictures = written(lambda: plot_models(samples, predicted, folder, name, name), folder)
        return Evaluation(
            recording,
            predicted,
            {name: score(samples, one) for name, one in predicted.items()},
            {name: by_position(samples, one) for name, one in predicted.items()},
            tuple(notes),
            tuple(pictures),
        )


def to_dict(result: Evaluation) -> dict[str, Any]:
    """For JSON: mm, mrad, mJ; no NaN."""
    recording = result.recording
    return {
        "bag": str(recording.path),
        "tool": recording.tool.tool,
        "samples": len(recording.samples),
        "problems": list(recording.problems),
        "notes": list(result.notes),
        "positions": {
            str(number): recording.positions[number].tolist()
            for number in np.unique(recording.samples.position).tolist()
        },
        "models": {
            name: one.to_dict()
            | {
                "by_position": {
                    str(position): part.to_dict()
                    for position, part in result.by_position[name].items()
                }
            }
            for name, one in result.scores.items()
        },
        "plots": [str(path) for path in result.pictures],
    }


def _check_tip(path: Path, model: DeflectionModel, bag: Path, tool: CalibrationFile) -> None:
    """Raise ModelFileError for another tip than the model's."""
    tip, own = np.asarray(tool.tip_m, dtype=float), np.asarray(model.tip_m)
    if not np.allclose(own, tip, atol=1e-9):
        raise ModelFileError(
            f"{path}: was fitted for a tool with its tip at {own.tolist()} m in ft_sensor, but"
            f" {bag} was recorded with {tool.tool}, whose tip is at {tip.tolist()} m"
        )


def _same_noise(model: DeflectionModel, recording: Recording) -> bool:
    """Whether the model was fitted to just this: no other recording has the same sixteen digits."""
    return np.allclose(model.noise, recording.samples.noise, rtol=1e-12, atol=0.0)
