"""Single joints from tables: stiffness, lost motion, models on readings held out."""

from __future__ import annotations

import argparse
from pathlib import Path

from galen_bags.arrays.joint_table import add_column_options, joint_columns, read_joint_runs
from galen_model.transmission.parts import time_blocks, whole_runs
from galen_model.transmission.terms import COMMON
from galen_ros.command import (
    EXIT_OK,
    positive,
    print_json,
    progress,
    terminal,
    whole,
    writing,
)

from galen_deflection.scoring.options import TABLE_WIDTH
from galen_deflection.transmission.comparison import JointSettings, compare
from galen_deflection.transmission.joint_parameters import estimate
from galen_deflection.transmission.joint_report import (
    joint_table,
    print_comparison,
    read_listed,
    to_dict,
    to_rows,
)

_BLOCKS = 6
_FEWEST_RUNS = 3

MODELS = """models of a joint, each checked on readings that it was not fitted to:
  constant, common terms   baselines: rigid
  linear                   a spring
  direction                and the motor's direction of motion
  torque plays             a spring with friction (Prandtl-Ishlinskii, of the torque)
  lost motion              a spring, and plays of the motor's motion (backlash)
  both plays
  ours                     of these, what hold-outs among the fitted readings choose
  LSTM, LSTM direct        with --networks"""


def add_joint_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for tables of a joint's readings."""
    add_column_options(parser.add_argument_group("tables of a joint: columns"))
    group = parser.add_argument_group("tables of a joint: models and hold-outs")
    group.add_argument(
        "--terms",
        type=_terms,
        metavar="NAMES",
        help="in all models but the constant: gear (lag grows with the motor's angle), delay (with"
        " its velocity); comma-separated (default: none)",
    )
    group.add_argument(
        "--standstill-rad-s",
        type=positive,
        metavar="V",
        help="the direction of motion fades below this velocity (default: a twentieth of the"
        " fastest)",
    )
    group.add_argument(
        "--unlike",
        metavar="REGEX",
        help="fit only to runs whose file's name differs from the checked one's in every group of"
        " this regular expression",
    )
    group.add_argument(
        "--blocks",
        type=whole(3),
        metavar="N",
        help=f"hold out N blocks of time of all runs (default: whole runs where there are three,"
        f" else {_BLOCKS} blocks)",
    )
    group.add_argument(
        "--networks", action="store_true", help="train recurrent networks as well; takes minutes"
    )


def evaluate_tables(arguments: argparse.Namespace) -> int:
    """Fit and compare models of one joint; returns the exit code; raises GalenError."""
    runs = read_joint_runs(arguments.inputs, joint_columns(arguments))
    by_run = arguments.unlike is not None or len(runs) >= _FEWEST_RUNS
    if by_run and arguments.blocks is None:
        parts = whole_runs(runs, arguments.unlike)
    else:
        parts = time_blocks(runs, arguments.blocks or _BLOCKS)
    settings = JointSettings(
        common=arguments.terms or (),
        standstill_rad_s=arguments.standstill_rad_s,
        networks=arguments.networks,
        iterations=arguments.iterations or JointSettings.iterations,
        seed=arguments.seed,
    )
    with progress(1, "step", quiet=arguments.json) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        comparison = compare(runs, parts, settings, show)
    label = arguments.inputs[0].stem
    parameters = estimate(comparison)
    pictures: list[Path] = []
    if arguments.plots is not None:
        from galen_deflection.transmission.joint_plots import plot_joint  # slow to import

        with writing(arguments.plots):
            pictures = [plot_joint(comparison, label, arguments.plots)]
    if arguments.json:
        print_json(to_dict(comparison, parameters, label))
        return EXIT_OK
    to = terminal(TABLE_WIDTH)
    print_comparison(comparison, parameters, label, to)
    for file in pictures:
        to.print(f"plot: {file}", soft_wrap=True)
    return EXIT_OK


def list_results(arguments: argparse.Namespace) -> int:
    """Print several results of `--json` in one table; returns the exit code."""
    listed = [read_listed(file) for file in arguments.inputs]
    if arguments.json:
        print_json(to_rows(listed))
    else:
        terminal(TABLE_WIDTH).print(joint_table(listed))
    return EXIT_OK


def _terms(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in COMMON:
            raise argparse.ArgumentTypeError(f"{name!r}: expected {' or '.join(COMMON)}")
    return tuple(name for name in COMMON if name in names)
