"""Kinds of models on the same questions, each scored where it was not fitted."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.errors import GalenError
from galen_ros.command import EXIT_FAILED, EXIT_OK, print_json, progress, terminal, writing
from rich.console import Console

from galen_deflection.models.interface import FitSettings
from galen_deflection.models.registry import KINDS
from galen_deflection.scoring.cross_check import Checked, Task, by_position, cross_check, make_tasks
from galen_deflection.scoring.options import (
    TABLE_WIDTH,
    fit_settings,
    print_problems,
    read_all,
    read_settings,
)
from galen_deflection.scoring.score_table import comparison_table

_BASELINE = "lstm"


@dataclass(frozen=True)
class Compared:
    """One split's outcome: kinds with what they did, or with a sentence why there is nothing."""

    task: Task
    kinds: Mapping[str, Checked | str]

    @property
    def checked(self) -> dict[str, Checked]:
        """The kinds that could be fitted."""
        return {name: one for name, one in self.kinds.items() if isinstance(one, Checked)}

    def times_better(self, kind: str) -> tuple[float | None, float | None]:
        """The network's RMSE over this kind's, and the same of the errors beyond the noise.

        None without the network, or where this kind's error is lost in the noise.
        """
        checked = self.checked
        if _BASELINE not in checked or kind not in checked:
            return None, None
        network, own = checked[_BASELINE].score, checked[kind].score
        beyond = network.beyond_noise, own.beyond_noise
        return network.ratio_all / own.ratio_all, (
            None if beyond[0] is None or beyond[1] is None else beyond[0] / beyond[1]
        )


def compare(
    tasks: Sequence[Task], kinds: Sequence[str], settings: FitSettings, quiet: bool
) -> list[Compared]:
    """Every kind at every task."""
    folds = sum(len(task.splits) for task in tasks)
    results = []
    with progress(folds * len(kinds), "fit", quiet=quiet) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.set_postfix_str(f"{what} {done}/{total}")

        for task in tasks:
            outcomes: dict[str, Checked | str] = {}
            for kind in kinds:
                bar.set_description(f"{task.split}, {kind}")
                before = bar.n
                try:
                    outcomes[kind] = cross_check(
                        kind, task, replace(settings, on_progress=show), lambda _: bar.update()
                    )
                except GalenError as error:
                    outcomes[kind] = str(error)
                    bar.update(before + len(task.splits) - bar.n)
            results.append(Compared(task, outcomes))
    return results


def _print(result: Compared, to: Console) -> None:
    task, checked = result.task, result.checked
    title = f"{task.split}: {len(task.splits)} splits"
    if len(task.whole) > len(task.samples):
        title += f", {len(task.whole) - len(task.samples)} samples more to fit to"
    seconds = {name: f"{np.mean(one.seconds):.1f} s" for name, one in checked.items()}
    more = {"a fit, CPU": seconds}
    better = {name: result.times_better(name) for name in checked}
    if _BASELINE in checked:
        for column, heading in enumerate(("LSTM's /\nits RMSE", "LSTM's / its\nbeyond noise")):
            more[heading] = {
                name: f"{value:.1f}"
                for name, values in better.items()
                if (value := values[column]) is not None
            }
    scores = {name: one.score for name, one in checked.items()}
    to.print(comparison_table(scores, title, more, to.width))
    for name, one in result.kinds.items():
        if isinstance(one, str):
            to.print(f"[red]{name}: {one}[/red]", soft_wrap=True)


def _to_dict(result: Compared) -> dict[str, Any]:
    kinds: dict[str, Any] = {}
    for name, one in result.kinds.items():
        if isinstance(one, str):
            kinds[name] = {"error": one}
            continue
        kinds[name] = one.score.to_dict() | {
            "fit_cpu_s": list(one.seconds),
            "lstm_rmse_over_its": result.times_better(name)[0],
            "lstm_error_beyond_noise_over_its": result.times_better(name)[1],
            "rmse_over_noise_by_position": {
                str(position): score.ratio_all
                for position, score in by_position(one.samples, one.predicted).items()
            },
        }
    task = result.task
    return {
        "split": task.split,
        "splits": [split.name for split in task.splits],
        "samples_checked": int(sum(split.check.sum() for split in task.splits)),
        "samples_only_fitted_to": len(task.whole) - len(task.samples),
        "kinds": kinds,
    }


def _pictures(result: Compared, folder: Path) -> list[Path]:
    from galen_deflection.scoring.pictures import plot_models, plot_trainings  # slow to import

    checked = result.checked
    if not checked:
        return []
    samples = next(iter(checked.values())).samples
    predictions = {name: one.predicted for name, one in checked.items()}
    what = f"split: {result.task.split}"
    pictures = plot_models(samples, predictions, folder, result.task.split, what)
    firsts = {name: one.models[0] for name, one in checked.items()}
    return pictures + plot_trainings(firsts, folder, result.task.split)


def run(arguments: argparse.Namespace) -> int:
    """Compare as the options say; returns the exit code; raises GalenError."""
    settings = read_settings(arguments)
    recordings = read_all(arguments.inputs, settings, arguments.json)
    extra = read_all(arguments.extra, settings, arguments.json) if arguments.extra else []
    tasks = make_tasks(arguments.split, recordings, extra)
    kinds = list(dict.fromkeys(arguments.kinds or KINDS))
    results = compare(tasks, kinds, fit_settings(arguments), arguments.json)
    pictures: list[Path] = []
    if arguments.plots is not None:
        with writing(arguments.plots):
            pictures = [path for one in results for path in _pictures(one, arguments.plots)]
    if arguments.json:
        content = {
            "bags": [str(recording.path) for recording in recordings],
            "extra": [str(recording.path) for recording in extra],
            "tool": recordings[0].tool.tool,
            "problems": {
                str(recording.path): list(recording.problems) for recording in [*recordings, *extra]
            },
            "plots": [str(path) for path in pictures],
            "comparisons": [_to_dict(result) for result in results],
        }
        print_json(content)
    else:
        to = terminal(TABLE_WIDTH)
        print_problems([*recordings, *extra], to)
        for result in results:
            _print(result, to)
        for path in pictures:
            to.print(f"plot: {path}", soft_wrap=True)
    failed = any(isinstance(one, str) for result in results for one in result.kinds.values())
    return EXIT_FAILED if failed else EXIT_OK
