# SPDX-License-Identifier: Apache-2.0
"""`train`: recordings of pushes in, a model's file out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from galen_common.command import (
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
from galen_deflection.models.spring_model import SpringModel
from galen_deflection.scoring.report import (
    TABLE_WIDTH,
    add_recordings,
    parameter_rows,
    parameter_table,
    print_problems,
    read_all,
    score_table,
)
from galen_deflection.scoring.score import score

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
    add_json(parser)
    add_recordings(parser, required=True)
    return parser


def fit(kind: str, samples: DeflectionSamples, quiet: bool) -> DeflectionModel:
    """Fit to all samples, with a progress bar.

    Args:
        kind: one of `KINDS`.
        samples: n samples to fit to.
        quiet: without the bar.

    Returns:
        The fitted model.

    Raises:
        GalenError: the model can't be fitted.

    """
    with progress(1, "iteration", quiet=quiet) as bar:
        bar.set_description(kind)

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        return KINDS[kind].fit(samples, FitSettings(on_progress=show))


def run(arguments: argparse.Namespace) -> int:
    """Train as the options ask for.

    Args:
        arguments: options of `build_parser`.

    Returns:
        The exit code.

    Raises:
        GalenError: a file can't be used or written, or the model can't be fitted.

    """
    check_file(arguments.output)
    quiet = arguments.json
    recordings = read_all(arguments.bags, arguments)
    samples = join_recordings(recordings)
    started_s = time.monotonic()
    model = fit(arguments.kind, samples, quiet)
    seconds = time.monotonic() - started_s
    write_model(arguments.output, model)
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
        print_json(content | {"fit": fitted.to_json()})
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
    to.print(score_table({"fitted to": fitted}, "How well it predicts the same samples"))
    notes.append(
        "nothing was held out: `evaluate BAG --kinds` fits to a part and scores on the rest"
    )
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
    """Run the command.

    Args:
        args: the command line without the program's name; None: that of the process.

    Returns:
        The exit code.

    """
    arguments = build_parser().parse_args(args)
    return run_command("train", lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
