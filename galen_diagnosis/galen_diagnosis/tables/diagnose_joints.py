"""`diagnose` of tables of a joint: what makes its two ends differ."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from galen_bags.arrays.joint_table import (
    add_column_options,
    joint_columns,
    read_joint_runs,
)
from galen_model.transmission.parts import time_blocks, whole_runs
from galen_ros.command import EXIT_OK, make_parser, run_command

from galen_diagnosis.tables.joint_rows import prepare_joint
from galen_diagnosis.tables.output import (
    add_output_options,
    check_outputs,
    diagnose_rows,
    give,
    name_of,
)

_NOTES = """effects: joint_compliance, backlash, deflection_hysteresis, wrench_delay (the torque's
stamps are late), and two that the arm's list has not: encoder_delay (the link's stamps are late
against the motor's), gear_error. Nominal is a rigid gear."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = make_parser(
        "diagnose",
        "From readings of the angles at both ends of a joint and of its torque: what"
        " makes them differ, how sure that is, and how much of it is closed on readings held out.",
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="a table can't be used; one line gives the reason",
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="text tables of one joint, a run each"
    )
    add_column_options(parser.add_argument_group("columns"))
    parser.add_argument(
        "--blocks",
        type=int,
        metavar="N",
        help="hold out so many blocks of time (default: whole runs where there are four, else 6)",
    )
    add_output_options(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    if arguments.blocks is not None and arguments.blocks < 4:
        parser.error("--blocks must be at least 4")
    return run_command("diagnose", lambda: _diagnose(arguments))


def _diagnose(arguments: argparse.Namespace) -> int:
    check_outputs(arguments)
    name = name_of(arguments.files[0], arguments.label)
    runs = read_joint_runs(arguments.files, joint_columns(arguments))
    by_run = arguments.blocks is None and len(runs) >= 4
    parts = whole_runs(runs) if by_run else time_blocks(runs, arguments.blocks or 6)
    give([diagnose_rows(name, prepare_joint(runs, parts), quiet=arguments.json)], arguments)
    return EXIT_OK
