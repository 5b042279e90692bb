"""`evaluate`: deflection models on recordings of pushes, and single joints from tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from galen_ros.command import add_json, add_plots, check_folder, make_parser, run_command

from galen_deflection.models.file import KINDS
from galen_deflection.scoring.cross_check import SPLITS
from galen_deflection.scoring.evaluation import evaluate_files, evaluate_kinds
from galen_deflection.scoring.joint_report import MODELS, add_joint_options, evaluate_tables
from galen_deflection.scoring.report import add_recordings

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

_OF_BAGS = ("tool", "tool_beside", "marker_offset", "plots")
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
    add_joint_options(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
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
