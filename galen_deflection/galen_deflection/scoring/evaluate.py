"""`evaluate`: models' files against recordings of pushes that they were not fitted to."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from galen_bags.formats.find import find_bags
from galen_bags.many.inputs import distinct_names
from galen_bags.many.run import run_many
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    add_workers,
    check_folder,
    run_command,
)
from rich.console import Console

from galen_deflection.models.file import read_model
from galen_deflection.scoring.evaluation import Evaluation, EvaluationJob, to_dict
from galen_deflection.scoring.options import (
    add_bags,
    console,
    print_problems,
    progress,
    read_settings,
)
from galen_deflection.scoring.score_table import axis_table, comparison_table, overview_table

_EPILOG = f"""exit codes:
  {EXIT_OK}    done, however well the models predict
  {EXIT_FAILED}    a bag, a tool's or a model's file can't be used; a line says why. Of many bags,
       the others were evaluated
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="evaluate",
        usage="evaluate BAG... (--tool FILE | --tool-beside NAME) --model FILE... [options]",
        description="Predict the deflections in recordings of pushes by models' files, and say how"
        " far from the measured ones that is.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_bags(parser)
    parser.add_argument(
        "--model",
        nargs="+",
        required=True,
        type=Path,
        metavar="FILE",
        help="models' files, from `train`",
    )
    parser.add_argument("--plots", metavar="DIR", type=Path, help="write pictures here")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_workers(parser)
    return parser


def model_names(paths: Sequence[Path]) -> Mapping[str, Path]:
    """Models' files by their kinds, with their paths' own parts as far as two are of one kind."""
    kinds = [read_model(path).name for path in paths]
    apart = distinct_names(paths)
    return {
        kind if kinds.count(kind) == 1 else f"{kind} {apart[path]}": path
        for kind, path in zip(kinds, paths, strict=True)
    }


def _print(result: Evaluation, to: Console) -> None:
    print_problems([result.recording], to)
    recording = result.recording
    for name, score in result.scores.items():
        to.print(axis_table(score, f"{name}: {recording.path}, tool {recording.tool.tool}"))
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
    """Do it; returns the exit code; raises GalenError."""
    check_folder(arguments.plots)
    bags = find_bags(arguments.bags)
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
        with progress(0, "msg", arguments.json) as bar:

            def show(done: int, total: int | None) -> None:
                bar.total = total
                bar.update(done - bar.n)

            result = job.evaluate(bags[0], show)
        if arguments.json:
            print(json.dumps(to_dict(result), indent=2))
        else:
            _print(result, console())
        return EXIT_OK
    outcomes = run_many(
        job,
        bags,
        scheduler=arguments.scheduler,
        workers=arguments.workers,
        progress=not arguments.json,
    )
    rows: list[dict[str, Any]] = [
        {"bag": str(outcome.bag), "error": outcome.error}
        if outcome.result is None
        else outcome.result
        for outcome in outcomes
    ]
    if arguments.json:
        print(json.dumps({"bags": rows}, indent=2))
    else:
        to = console()
        named = [{"name": job.names[bag]} | row for bag, row in zip(bags, rows, strict=True)]
        to.print(overview_table(named))
        for row in rows:
            for text in [*row.get("notes", ()), *([row["error"]] if "error" in row else [])]:
                to.print(f"[yellow]{text}[/yellow]", soft_wrap=True)
    return EXIT_FAILED if any("error" in row for row in rows) else EXIT_OK


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = build_parser().parse_args(args)
    return run_command("evaluate", lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
