"""`train`: recordings of pushes in, a model's file out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from galen_model.errors import GalenError
from galen_ros.command import (
    EXIT_OK,
    add_bags,
    add_json,
    check_file,
    make_parser,
    print_json,
    progress,
    run_command,
    terminal,
)

from galen_deflection.measurement.measured_deflection import join_recordings
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.file import KINDS, DeflectionModel, write_model
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.network import NetworkModel
from galen_deflection.models.spring_model import SpringModel
from galen_deflection.scoring.cross_check import SPLITS, cross_check, usual_splits
from galen_deflection.scoring.report import (
    TABLE_WIDTH,
    add_recordings,
    parameter_rows,
    parameter_table,
    print_problems,
    read_all,
    read_settings,
    score_table,
)
from galen_deflection.scoring.score import Score, score

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
        help="the model's file, JSON; an old one is kept as FILE.bak",
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
    add_json(parser)
    add_recordings(parser, required=True)
    return parser


def fit(kind: str, samples: DeflectionSamples, quiet: bool) -> DeflectionModel:
    """Fit to all samples, with a bar; raises GalenError."""
    with progress(1, "iteration", quiet=quiet) as bar:
        bar.set_description(kind)

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        return KINDS[kind].fit(samples, FitSettings(on_progress=show))


def held_out(
    kind: str, samples: DeflectionSamples, names: Sequence[str], quiet: bool
) -> Mapping[str, Score | str]:
    """Return scores of fits that had not seen the samples, by split; or why there is none."""
    found: dict[str, Score | str] = {}
    for name in names:
        try:
            splits = SPLITS[name](samples)
            with progress(len(splits), "fit", quiet=quiet) as bar:
                bar.set_description(f"held out, {name}")
                found[name] = cross_check(kind, samples, splits, on_split=bar.update).score
        except GalenError as error:
            found[name] = str(error)
    return found


def _checks(arguments: argparse.Namespace, model: DeflectionModel, samples: DeflectionSamples
) -> list[str]:  # fmt: skip
    if arguments.check is not None:
        return [name for name in dict.fromkeys(arguments.check) if name != "none"]
    return [] if isinstance(model, NetworkModel) else usual_splits(samples)


def run(arguments: argparse.Namespace) -> int:
    """Train as the options say; returns the exit code; raises GalenError."""
    check_file(arguments.output)
    quiet = arguments.json
    recordings = read_all(arguments.bags, read_settings(arguments), quiet)
    samples = join_recordings(recordings)
    started_s = time.monotonic()
    model = fit(arguments.kind, samples, quiet)
    seconds = time.monotonic() - started_s
    write_model(arguments.output, model)
    names = _checks(arguments, model, samples)
    checked = held_out(arguments.kind, samples, names, quiet)
    content = {
        "kind": model.name,
        "file": str(arguments.output),
        "bags": [str(recording.path) for recording in recordings],
        "tool": recordings[0].tool.tool,
        "samples": len(samples),
        "positions": len(np.unique(samples.position)),
        "fit_s": seconds,
        "parameters": parameter_rows(model),
        "unresolved": list(model.unresolved) if isinstance(model, SpringModel) else [],
        "notes": list(model.notes),
        "problems": {str(recording.path): list(recording.problems) for recording in recordings},
    }
    fitted = score(samples, model.predict(samples))
    if quiet:
        scores = {
            name: {"error": one} if isinstance(one, str) else one.to_json()
            for name, one in checked.items()
        }
        print_json(content | {"fit": fitted.to_json(), "held_out": scores})
        return EXIT_OK
    to = terminal(TABLE_WIDTH)
    print_problems(recordings, to)
    to.print(
        f"[bold]{model.name}[/bold], tool {content['tool']}: {len(samples)} samples at"
        f" {content['positions']} positions out of {len(recordings)} recordings, fitted in"
        f" {seconds:.1f} s",
        soft_wrap=True,
    )
    if isinstance(model, SpringModel):
        to.print(parameter_table(parameter_rows(model)))
    else:
        to.print(f"{model.iterations} iterations, error / noise {model.held_out_error:.2f} on what"
                 " was held out")  # fmt: skip
    notes = list(model.notes)
    if isinstance(model, SpringModel):
        notes += [f"{name}: not identifiable from these samples; it keeps its prior"
                  for name in model.unresolved]  # fmt: skip
    rows = {"fitted to": fitted} | {
        f"held out: {name}": one for name, one in checked.items() if isinstance(one, Score)
    }
    to.print(score_table(rows, "How well it predicts"))
    notes += [f"not held out, {name}: {one}" for name, one in checked.items()
              if isinstance(one, str)]  # fmt: skip
    if not checked:
        notes.append("nothing was held out: the first row says little; --check does")
    for note in notes:
        to.print(f"[yellow]{note}[/yellow]", soft_wrap=True)
    to.print(f"[bold green]model file: {arguments.output}[/bold green]", soft_wrap=True)
    to.print(
        f"next, on a recording that it was not fitted to: ros2 run galen_deflection evaluate BAG"
        f" --tool FILE --model {arguments.output}",
        soft_wrap=True,
    )
    return EXIT_OK


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = build_parser().parse_args(args)
    return run_command("train", lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
