"""`evaluate`: deflection models on recordings of pushes, and single joints from tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from galen_ros.command import (
    add_json,
    add_plots,
    add_workers,
    check_folder,
    make_parser,
    run_command,
)

from galen_deflection.models.registry import KINDS
from galen_deflection.scoring import compare, evaluation
from galen_deflection.scoring.options import add_fit, add_recordings
from galen_deflection.scoring.splits import SPLITS
from galen_deflection.transmission import evaluate as joints

_TABLES = (".csv", ".txt", ".tsv", ".dat")
_RESULTS = (".json",)

_NOTES = f"""inputs:
  bags with --model        files of models, from `train`, on recordings that they have not seen
  bags                     every kind of model, fitted to a part of the recordings and scored on
                           the rest, once for each split
  {", ".join(_TABLES)}   one joint, a run each: stiffness, lost motion, models side by side
  .json                    results of --json of tables, in one table

splits:
  report    a set of each position in one half is checked, all others fitted to; in turn
            (of four positions with two sets: six sets to two, as in the 2019 report)
  push      pushes are dealt to four folds, each checked in turn: where every position was
            visited once
  set       each set in turn is checked
  position  each position in turn is checked with all its sets: none of it was fitted to

{joints.MODELS}"""

_RECORDINGS = ("tool", "tool_beside", "marker_offset", "from_rest")
_OF_FILES = ("workers", "scheduler")
_OF_KINDS = ("kinds", "split", "extra")
_FIT = ("seed", "iterations")
_OF_TABLES = (
    *("columns", "time_scale", "opposite", "torque_gear"),
    *("terms", "standstill_rad_s", "unlike", "blocks", "networks"),
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
        "       evaluate RUN.csv... --columns t=NAME,motor=NAME,link=NAME,torque=NAME [options]\n"
        "       evaluate RESULT.json... [--json]",
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
    add_workers(parser)
    group = parser.add_argument_group("kinds of models")
    group.add_argument(
        "--kinds",
        nargs="+",
        choices=list(KINDS),
        metavar="KIND",
        help=f"of {', '.join(KINDS)} (default: all)",
    )
    group.add_argument(
        "--split",
        nargs="+",
        choices=list(SPLITS),
        metavar="SPLIT",
        help=f"of {', '.join(SPLITS)} (default: position, if there are several, and report where"
        " every position has two sets, else push)",
    )
    group.add_argument(
        "--extra",
        nargs="+",
        type=Path,
        metavar="BAG",
        help="recordings that are only ever fitted to; but for the positions that are left out",
    )
    add_fit(group)
    joints.add_joint_options(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    kinds = {_kind(path) for path in arguments.inputs}
    if len(kinds) > 1:
        parser.error("bags, tables and results don't go together")
    (kind,) = kinds
    allowed: tuple[str, ...]
    if kind == "results":
        work, allowed = joints.list_results, ()
    elif kind == "tables":
        work, allowed = joints.evaluate_tables, (*_OF_TABLES, *_FIT)
    elif arguments.model:
        work, allowed = evaluation.run, ("model", *_RECORDINGS, *_OF_FILES)
    else:
        work, allowed = compare.run, (*_RECORDINGS, *_OF_KINDS, *_FIT)
    for name in ("model", *_RECORDINGS, *_OF_FILES, *_OF_KINDS, *_FIT, *_OF_TABLES):
        if name not in allowed and getattr(arguments, name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} does not apply to {kind} like these")
    if kind == "bags" and arguments.tool is None and arguments.tool_beside is None:
        parser.error("one of --tool, --tool-beside is required")
    if arguments.unlike is not None and arguments.blocks is not None:
        parser.error("--unlike is for runs held out, --blocks for blocks of time")

    def evaluate() -> int:
        check_folder(arguments.plots)
        return work(arguments)

    return run_command("evaluate", evaluate)


def _kind(path: Path) -> str:
    if path.is_dir():
        return "bags"
    suffix = path.suffix.lower()
    return "tables" if suffix in _TABLES else "results" if suffix in _RESULTS else "bags"


if __name__ == "__main__":
    sys.exit(main())
