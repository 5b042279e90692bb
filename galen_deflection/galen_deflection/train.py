"""`train`: recordings of pushes in, a model's file out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_ros.command import (
    EXIT_OK,
    add_bags,
    add_json,
    add_plots,
    check_file,
    check_folder,
    make_parser,
    print_json,
    progress,
    run_command,
    terminal,
    writing,
)

from galen_deflection.measurement.recordings import Recording, join_recordings
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.file import write_model
from galen_deflection.models.interface import DeflectionModel, FitSettings
from galen_deflection.models.registry import KINDS
from galen_deflection.scoring.cross_check import cross_check, make_tasks, seen_split
from galen_deflection.scoring.options import (
    TABLE_WIDTH,
    add_fit,
    add_recordings,
    fit_settings,
    read_all,
    read_settings,
)
from galen_deflection.scoring.score import Score, score
from galen_deflection.scoring.splits import SPLITS, SplitError
from galen_deflection.scoring.train_report import print_training, to_dict

_KINDS = f"""kinds:
{chr(10).join(f"  {name:<20} {kind.summary}" for name, kind in KINDS.items())}"""


def build_parser() -> argparse.ArgumentParser:
    """Build the command's parser."""
    parser = make_parser(
        "train",
        "Fit a model of the arm's deflection to recordings of pushes with one tool, and write its"
        " file.",
        notes=_KINDS,
        ok="done, the model's file is written",
        failed="a bag or a calibration file can't be used, the model can't be fitted or its file\n"
        "       not written; one line gives the reason, and an old file is unchanged",
        usage="train BAG... (--tool FILE | --tool-beside NAME) --kind KIND -o FILE [options]",
    )
    add_bags(parser, "recording of pushes with the tracker")
    parser.add_argument("--kind", required=True, choices=list(KINDS), help="of model")
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="FILE",
        help="the model's file: JSON, or safetensors of a network; an old one is kept as FILE.bak",
    )
    parser.add_argument(
        "--check",
        nargs="+",
        choices=[*SPLITS, "none"],
        metavar="SPLIT",
        help="fit again without some of the samples and score on those, as `evaluate` does: of"
        f" {', '.join(SPLITS)}, none (default: seen and unseen positions; none for a network, since"
        " each takes as long as the training)",
    )
    add_plots(parser)
    add_json(parser)
    add_recordings(parser, required=True)
    add_fit(parser.add_argument_group("fits"))
    return parser


def fit(
    kind: str, samples: DeflectionSamples, settings: FitSettings, quiet: bool
) -> DeflectionModel:
    """Fit to all samples, with a bar; raises GalenError."""
    with progress(1, "fit", quiet=quiet) as bar:
        bar.set_description(kind)
        told = False

        def show(done: int, total: int, what: str) -> None:
            nonlocal told
            told, bar.total, bar.unit = True, total, "iteration"
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        model = KINDS[kind].fit(samples, replace(settings, on_progress=show))
        if not told:  # too quick to say anything
            bar.update()
        return model


def held_out(
    kind: str,
    recordings: Sequence[Recording],
    names: Sequence[str],
    settings: FitSettings,
    quiet: bool,
) -> Mapping[str, Score | str]:
    """Scores of fits that had not seen the samples, by split; or why there is none."""
    found: dict[str, Score | str] = {}
    for name in names:
        try:
            (task,) = make_tasks([name], recordings)
        except SplitError as error:
            found[name] = str(error)
            continue
        with progress(len(task.splits), "fit", quiet=quiet) as bar:
            bar.set_description(f"held out, {name}")
            try:
                found[name] = cross_check(kind, task, settings, lambda _: bar.update()).score
            except GalenError as error:
                found[name] = str(error)
    return found


def _checks(arguments: argparse.Namespace, samples: DeflectionSamples) -> list[str]:
    if arguments.check is not None:
        return [name for name in dict.fromkeys(arguments.check) if name != "none"]
    if KINDS[arguments.kind].is_network:
        return []
    return [seen_split(samples), "position"]


def run(arguments: argparse.Namespace) -> int:
    """Train as the options say; returns the exit code; raises GalenError."""
    check_file(arguments.output)
    check_folder(arguments.plots)
    quiet = arguments.json
    recordings = read_all(arguments.bags, read_settings(arguments), quiet)
    samples = join_recordings(recordings)
    settings = fit_settings(arguments)
    started_s = time.monotonic()
    model = fit(arguments.kind, samples, settings, quiet)
    seconds = time.monotonic() - started_s
    write_model(arguments.output, model)
    pictures = _pictures(model, arguments.plots, arguments.output.stem)
    checked = held_out(arguments.kind, recordings, _checks(arguments, samples), settings, quiet)
    result: dict[str, Any] = {
        "file": arguments.output,
        "recordings": recordings,
        "samples": samples,
        "model": model,
        "seconds": seconds,
        "fit": score(samples, model.predict(samples)),
        "checked": checked,
        "pictures": pictures,
    }
    if arguments.json:
        print_json(to_dict(**result))
    else:
        print_training(**result, to=terminal(TABLE_WIDTH))
    return EXIT_OK


def _pictures(model: DeflectionModel, folder: Path | None, name: str) -> list[Path]:
    if folder is None:
        return []
    from galen_deflection.scoring.pictures import plot_trainings  # slow to import

    with writing(folder):
        return plot_trainings({model.name: model}, folder, name)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = build_parser().parse_args(args)
    return run_command("train", lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
