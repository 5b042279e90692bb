# SPDX-License-Identifier: Apache-2.0
"""`evaluate`: deflection models on recordings of pushes, and single joints from tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.formats.files import find_bags
from galen_bags.many import distinct_names
from galen_common.arm import chosen_arm
from galen_common.command import (
    EXIT_FAILED,
    EXIT_OK,
    add_json,
    add_plots,
    check_folder,
    make_parser,
    print_json,
    progress,
    run_command,
    terminal,
    writing,
)
from galen_model.arm.arm import Arm
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile

from galen_deflection.measurement.measured_deflection import (
    Recording,
    join_recordings,
    read_recording,
)
from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples
from galen_deflection.models.file import KINDS, DeflectionModel, read_model
from galen_deflection.models.interface import FitSettings, PredictedSamples
from galen_deflection.models.network import LSTM
from galen_deflection.models.network_training import NEEDS
from galen_deflection.scoring.cross_check import (
    SPLITS,
    Checked,
    Split,
    cross_check,
    usual_splits,
)
from galen_deflection.scoring.joint_report import MODELS, add_joint_options, evaluate_tables
from galen_deflection.scoring.report import (
    TABLE_WIDTH,
    add_recordings,
    print_problems,
    read_all,
    score_table,
    tool_of,
)
from galen_deflection.scoring.score import Score, by_position, score

# Files of models


def evaluate_files(arguments: argparse.Namespace) -> int:
    """Score files of models on recordings.

    Of several recordings, one that can't be used is named, and the others are evaluated.

    Args:
        arguments: options of `build_parser`, with `model`.

    Returns:
        The exit code.

    Raises:
        GalenError: a model's file or the only recording can't be used.

    """
    arm, bags = chosen_arm(arguments), find_bags(arguments.inputs)
    paths = _model_names(list(dict.fromkeys(arguments.model)), arm)
    models = {name: read_model(path, arm) for name, path in paths.items()}
    names = distinct_names(bags)
    rows: list[dict[str, Any]] = []
    to = terminal(TABLE_WIDTH)
    with progress(None, "msg", quiet=arguments.json) as bar:
        for bag in bags:
            try:
                tool = tool_of(bag, arguments, arm)
                for name, model in models.items():
                    _check_tip(paths[name], model, bag, tool)
                recording = read_recording(
                    bag, tool, arguments.marker_offset, _shown_by(bar), arm=arm
                )
                row, scores = _scored(recording, models, paths)
                row["plots"] = _plots(
                    arguments.plots, recording.samples, _predicted(recording, models), names[bag]
                )
            except GalenError as error:
                if len(bags) == 1:
                    raise
                rows.append({"bag": str(bag), "error": str(error)})
                continue
            rows.append(row)
            if not arguments.json:
                print_problems([recording], to)
                to.print(score_table(scores, f"{bag}, tool {recording.tool.tool}"))
                for note in [*row["notes"], *(f"plot: {path}" for path in row["plots"])]:
                    to.print(f"[yellow]{note}[/yellow]", soft_wrap=True)
    failed = [row for row in rows if "error" in row]
    if arguments.json:
        print_json(rows[0] if len(bags) == 1 else {"bags": rows})
    for row in failed if not arguments.json else ():
        to.print(f"[red]{row['error']}[/red]", soft_wrap=True)
    return EXIT_FAILED if failed else EXIT_OK


def _scored(
    recording: Recording, models: Mapping[str, DeflectionModel], paths: Mapping[str, Path]
) -> tuple[dict[str, Any], dict[str, Score]]:
    """For JSON (mm, mrad, no NaN), and for a table: each model, in all and at each position."""
    samples = recording.samples
    found: dict[str, Any] = {}
    scores: dict[str, Score] = {}
    notes = []
    for name, predicted in _predicted(recording, models).items():
        parts = by_position(samples, predicted)
        scores[name] = score(samples, predicted)
        if len(parts) > 1:
            scores |= {f"{name}, position {number}": part for number, part in parts.items()}
        found[name] = scores[name].to_json() | {
            "by_position": {str(number): part.to_json() for number, part in parts.items()}
        }
        # No other recording has the same sixteen digits.
        if np.allclose(models[name].noise, samples.noise, rtol=1e-12, atol=0.0):
            notes.append(
                f"{paths[name]} was fitted to {recording.path} and to nothing else, by its noise:"
                " its scores don't hold for other recordings"
            )
    row = {
        "bag": str(recording.path),
        "tool": recording.tool.tool,
        "samples": len(samples),
        "problems": list(recording.problems),
        "notes": notes,
        "positions": {
            str(number): recording.positions[number].tolist()
            for number in np.unique(samples.position).tolist()
        },
        "models": found,
    }
    return row, scores


def _predicted(
    recording: Recording, models: Mapping[str, DeflectionModel]
) -> dict[str, PredictedSamples]:
    return {name: model.predict(recording.samples) for name, model in models.items()}


def _check_tip(path: Path, model: DeflectionModel, bag: Path, tool: CalibrationFile) -> None:
    """Raise DeflectionError for another tip than the model's."""
    tip, own = np.asarray(tool.tip_m, dtype=float), np.asarray(model.tip_m)
    if not np.allclose(own, tip, atol=1e-9):
        raise DeflectionError(
            f"{path}: was fitted for a tool with its tip at {own.tolist()} m in"
            f" {tool.sensor_frame}, but"
            f" {bag} was recorded with {tool.tool}, whose tip is at {tip.tolist()} m"
        )


def _model_names(paths: Sequence[Path], arm: Arm) -> Mapping[str, Path]:
    """Models' files by their kinds, and by their paths where two are of one kind."""
    kinds = [read_model(path, arm).name for path in paths]
    apart = distinct_names(paths)
    return {
        kind if kinds.count(kind) == 1 else f"{kind} {apart[path]}": path
        for kind, path in zip(kinds, paths, strict=True)
    }


def _shown_by(bar: Any) -> Callable[[int, int | None], None]:
    def show(done: int, total: int | None) -> None:
        bar.total = total
        bar.update(done - bar.n)

    return show


def _plots(
    folder: Path | None,
    samples: DeflectionSamples,
    predicted: Mapping[str, PredictedSamples],
    name: str,
) -> list[str]:
    if folder is None or not predicted:
        return []
    from galen_deflection.scoring.plots import plot_models  # slow to import

    with writing(folder):
        return [str(path) for path in plot_models(samples, predicted, folder, name)]


# Kinds of models


def evaluate_kinds(arguments: argparse.Namespace) -> int:
    """Fit kinds to a part of recordings and score the rest.

    A kind that can't be fitted is named, and the others are scored.

    Args:
        arguments: options of `build_parser`, without `model`.

    Returns:
        The exit code.

    Raises:
        GalenError: a recording can't be used, or the recordings can't be split.

    """
    recordings = read_all(arguments.inputs, arguments)
    samples = join_recordings(recordings)
    names = arguments.split or usual_splits(samples)
    splits = {name: SPLITS[name](samples) for name in names}
    kinds = list(dict.fromkeys(arguments.kinds or KINDS))
    if not arguments.kinds and find_spec("torch") is None:
        kinds.remove(LSTM)
        print(f"evaluate: {LSTM} is left out: training a network {NEEDS}", file=sys.stderr)
    results, failed = [], False
    to = terminal(TABLE_WIDTH)
    if not arguments.json:
        print_problems(recordings, to)
    for name, parts in splits.items():
        checked, errors = _cross_checked(name, kinds, samples, parts, arguments.json)
        failed |= bool(errors)
        some = next(iter(checked.values())).samples if checked else samples
        predicted = {kind: one.predicted for kind, one in checked.items()}
        plots = _plots(arguments.plots, some, predicted, name)
        results.append(_split_to_json(name, checked, errors) | {"plots": plots})
        if not arguments.json:
            times = {kind: f"{np.mean(one.seconds):.1f} s" for kind, one in checked.items()}
            scores = {kind: one.score for kind, one in checked.items()}
            to.print(score_table(scores, f"split: {name}", {"a fit, CPU": times}))
            for kind, error in errors.items():
                to.print(f"[red]{kind}: {error}[/red]", soft_wrap=True)
            for path in plots:
                to.print(f"plot: {path}", soft_wrap=True)
    if arguments.json:
        content = {
            "bags": [str(recording.path) for recording in recordings],
            "tool": recordings[0].tool.tool,
            "problems": {str(one.path): list(one.problems) for one in recordings},
            "comparisons": results,
        }
        print_json(content)
    return EXIT_FAILED if failed else EXIT_OK


def _cross_checked(
    name: str,
    kinds: Sequence[str],
    samples: DeflectionSamples,
    splits: Sequence[Split],
    quiet: bool,
) -> tuple[dict[str, Checked], dict[str, str]]:
    """Return what each kind came to, or the reason why it could not be fitted."""
    checked: dict[str, Checked] = {}
    errors: dict[str, str] = {}
    with progress(len(splits) * len(kinds), "fit", quiet=quiet) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.set_postfix_str(f"{what} {done}/{total}")

        for number, kind in enumerate(kinds, start=1):
            bar.set_description(f"{name}, {kind}")
            settings = FitSettings(on_progress=show)
            try:
                checked[kind] = cross_check(kind, samples, splits, settings, bar.update)
            except GalenError as error:
                errors[kind] = str(error)
                bar.update(number * len(splits) - bar.n)
    return checked, errors


def _split_to_json(
    name: str, checked: Mapping[str, Checked], errors: Mapping[str, str]
) -> dict[str, Any]:
    kinds: dict[str, Any] = {kind: {"error": error} for kind, error in errors.items()}
    for kind, one in checked.items():
        parts = by_position(one.samples, one.predicted)
        kinds[kind] = one.score.to_json() | {
            "fit_cpu_s": list(one.seconds),
            "rmse_over_noise_by_position": {
                str(position): part.ratio_of() for position, part in parts.items()
            },
        }
    return {"split": name, "kinds": kinds}


_TABLES = (".csv", ".txt", ".tsv", ".dat")

_NOTES = f"""inputs:
  bags with --model        files of models, from `train`, on recordings that they have not seen
  bags                     every kind of model, fitted to a part of the recordings and scored on
                           the rest, once for each split
  {", ".join(_TABLES)}   one joint, a run each: stiffness, lost motion, models side by side

splits:
  report    a set of each position in one half is checked, all others fitted to; in turn
            (of four positions with two sets: six sets to two, as in the 2019 report)
  push      pushes are dealt to four folds, each checked in turn: where every position was
            visited once
  position  each position in turn is checked with all its sets: none of it was fitted to

{MODELS}"""

_OF_BAGS = (
    *("tool", "tool_beside", "marker_offset", "plots"),
    *("urdf", "base_frame", "sensor_frame", "gravity"),
)
_OF_KINDS = ("kinds", "split")
_OF_TABLES = (
    *("columns", "time_scale", "opposite", "torque_gear"),
    *("terms", "unlike", "blocks"),
)


def build_parser() -> argparse.ArgumentParser:
    """Build the command's parser."""
    parser = make_parser(
        "evaluate",
        "Compare models of the deflection with what was measured, each on data that it was not"
        " fitted to; the inputs decide which.",
        notes=_NOTES,
        ok="done, however well the models predict",
        failed="an input can't be used or a kind of model can't be fitted; one line gives the\n"
        "       reason. Other bags and kinds were evaluated",
        usage="evaluate BAG... (--tool FILE | --tool-beside NAME) [--model FILE...] [options]\n"
        "       evaluate RUN.csv... --columns t=NAME,motor=NAME,link=NAME,torque=NAME [options]",
    )
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT", help="recordings of pushes, or tables"
    )
    parser.add_argument(
        "--model", nargs="+", type=Path, metavar="FILE", help="models' files, from `train`"
    )
    add_plots(parser)
    add_json(parser)
    add_recordings(parser, required=False)
    group = parser.add_argument_group("kinds of models")
    group.add_argument(
        "--kinds",
        nargs="+",
        choices=list(KINDS),
        metavar="KIND",
        help=f"of {', '.join(KINDS)} (default: all; without PyTorch no {LSTM})",
    )
    group.add_argument(
        "--split",
        nargs="+",
        choices=list(SPLITS),
        metavar="SPLIT",
        help=f"of {', '.join(SPLITS)} (default: position, if there are several, and report where"
        " every position has two sets, else push)",
    )
    add_joint_options(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: the command line without the program's name; None: that of the process.

    Returns:
        The exit code.

    """
    parser = build_parser()
    arguments = parser.parse_args(args)
    tables = [not path.is_dir() and path.suffix.lower() in _TABLES for path in arguments.inputs]
    if any(tables) and not all(tables):
        parser.error("bags and tables don't go together")
    allowed: tuple[str, ...]
    if all(tables):
        work, allowed = evaluate_tables, _OF_TABLES
    elif arguments.model:
        work, allowed = evaluate_files, ("model", *_OF_BAGS)
    else:
        work, allowed = evaluate_kinds, (*_OF_BAGS, *_OF_KINDS)
    for name in ("model", *_OF_BAGS, *_OF_KINDS, *_OF_TABLES):
        if name not in allowed and getattr(arguments, name) != parser.get_default(name):
            what = "tables" if all(tables) else "bags"
            parser.error(f"--{name.replace('_', '-')} does not apply to {what} like these")
    if not all(tables) and arguments.tool is None and arguments.tool_beside is None:
        parser.error("one of --tool, --tool-beside is required")
    if arguments.unlike is not None and arguments.blocks is not None:
        parser.error("--unlike is for runs held out, --blocks for blocks of time")

    def evaluate() -> int:
        check_folder(arguments.plots)
        return work(arguments)

    return run_command("evaluate", evaluate)


if __name__ == "__main__":
    sys.exit(main())
