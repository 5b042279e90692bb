"""Files of models against recordings that they were not fitted to; one bag is a job."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.formats.find import find_bags
from galen_bags.many.inputs import distinct_names
from galen_bags.many.run import json_rows, run_many
from galen_model.files.calibration_file import CalibrationFile
from galen_ros.command import EXIT_FAILED, EXIT_OK, print_json, progress, terminal, writing
from rich.console import Console

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
from galen_deflection.scoring.options import TABLE_WIDTH, print_problems, read_settings
from galen_deflection.scoring.score import Score, score
from galen_deflection.scoring.score_table import axis_table, comparison_table, overview_table


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
        """Evaluate one bag; returns plain numbers and texts."""
        return to_dict(self.evaluate(bag))

    def evaluate(
        self, bag: Path, on_progress: Callable[[int, int | None], None] | None = None
    ) -> Evaluation:
        """Evaluate one bag; raises GalenError that names the bag or file."""
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
            with writing(folder):
                pictures = plot_models(samples, predicted, folder, name, name)
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


def model_names(paths: Sequence[Path]) -> Mapping[str, Path]:
    """Name models' files by their kinds, and by their paths where two are of one kind."""
    kinds = [read_model(path).name for path in paths]
    apart = distinct_names(paths)
    return {
        kind if kinds.count(kind) == 1 else f"{kind} {apart[path]}": path
        for kind, path in zip(kinds, paths, strict=True)
    }


def _print(result: Evaluation, to: Console) -> None:
    print_problems([result.recording], to)
    recording = result.recording
    for name, one in result.scores.items():
        to.print(axis_table(one, f"{name}: {recording.path}, tool {recording.tool.tool}"))
        parts = {f"position {number}": part for number, part in result.by_position[name].items()}
        if len(parts) > 1:
            to.print(comparison_table(parts, f"{name}, by position", width=to.width))
    if len(result.scores) > 1:
        to.print(comparison_table(result.scores, "all models", width=to.width))
    for note in result.notes:
        to.print(f"[yellow]{note}[/yellow]", soft_wrap=True)
    for path in result.pictures:
        to.print(f"plot: {path}", soft_wrap=True)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate files of models as the options say; returns the exit code; raises GalenError."""
    bags = find_bags(arguments.inputs)
    settings = read_settings(arguments)
    models = model_names(list(dict.fromkeys(arguments.model)))
    plots = arguments.plots
    if arguments.scheduler:
        # A cluster's workers have another working directory.
        bags = [bag.absolute() for bag in bags]
        models = {name: path.absolute() for name, path in models.items()}
        plots = None if plots is None else plots.absolute()
        if not settings.tool_beside:
            settings = replace(settings, tool=settings.tool.absolute())
    job = EvaluationJob(models, settings, plots, distinct_names(bags))
    if len(bags) == 1 and not arguments.scheduler:
        with progress(None, "msg", quiet=arguments.json) as bar:

            def show(done: int, total: int | None) -> None:
                bar.total = total
                bar.update(done - bar.n)

            result = job.evaluate(bags[0], show)
        if arguments.json:
            print_json(to_dict(result))
        else:
            _print(result, terminal(TABLE_WIDTH))
        return EXIT_OK
    outcomes = run_many(
        job,
        bags,
        scheduler=arguments.scheduler,
        workers=arguments.workers,
        progress=not arguments.json,
    )
    rows = json_rows(outcomes)
    if arguments.json:
        print_json({"bags": rows})
    else:
        to = terminal(TABLE_WIDTH)
        named = [{"name": job.names[bag]} | row for bag, row in zip(bags, rows, strict=True)]
        to.print(overview_table(named))
        for row in rows:
            for text in [*row.get("notes", ()), *([row["error"]] if "error" in row else [])]:
                to.print(f"[yellow]{text}[/yellow]", soft_wrap=True)
    return EXIT_FAILED if any("error" in row for row in rows) else EXIT_OK
