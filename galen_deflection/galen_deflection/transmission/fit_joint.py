"""`fit_joint`: how one joint or transmission gives, from tables of readings."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from galen_bags.arrays.joint_table import (
    add_column_options,
    check_column_options,
    column_map,
    read_joint_runs,
)
from galen_model.transmission.parts import time_blocks, whole_runs
from galen_model.transmission.terms import COMMON
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    check_folder,
    positive,
    run_command,
)

from galen_deflection.scoring.options import (
    console,
    progress,
    written,
)
from galen_deflection.transmission.comparison import Comparison, JointSettings, compare
from galen_deflection.transmission.joint_parameters import estimate
from galen_deflection.transmission.joint_report import (
    LAG_UNITS,
    joint_table,
    print_comparison,
    read_listed,
    to_dict,
    to_rows,
)

_EPILOG = f"""models, each checked on what it was not fitted to:
  constant, common terms   baselines: no give
  linear                   a spring
  direction                and the motor's direction of motion
  torque plays             a spring with friction (Prandtl-Ishlinskii, of the torque)
  lost motion              a spring, and plays of the motor's motion (backlash)
  both plays
  ours                     of these, what hold-outs among the fitted readings choose
  LSTM, LSTM direct        with --networks

exit codes:
  {EXIT_OK}    done
  {EXIT_FAILED}    a table can't be used; a line says why
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="fit_joint",
        usage="fit_joint RUN.csv... --columns t=NAME,motor=NAME,link=NAME,torque=NAME [options]\n"
        "       fit_joint --table RESULT.json... [options]",
        description="From readings of the angles at both ends of a joint and of its torque: how it"
        " gives, and which model predicts readings held out best. --table: several results of"
        " --json in one table.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="text tables, a run each; or results"
    )
    parser.add_argument("--table", action="store_true", help="the files are results of --json")
    parser.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    parser.add_argument(
        "--plots", type=Path, metavar="DIR", help="write a picture of the loops here"
    )
    parser.add_argument("--label", metavar="TEXT", help="what it is called in tables and pictures")
    parser.add_argument(
        "--unit", choices=tuple(LAG_UNITS), default="mrad", help="of lags (default: %(default)s)"
    )
    add_column_options(parser.add_argument_group("columns"))
    _add_model_options(parser.add_argument_group("models and hold-outs"))
    return parser


def _add_model_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--terms",
        type=_terms,
        default=(),
        metavar="NAMES",
        help="in all models but the constant: gear (lag grows with the motor's angle), delay (with"
        " its velocity); comma-separated (default: none)",
    )
    group.add_argument(
        "--velocity-window-s",
        type=positive,
        default=JointSettings.window_s,
        metavar="S",
        help="the velocity is the slope over so much (default: %(default)s)",
    )
    group.add_argument(
        "--standstill-rad-s",
        type=positive,
        metavar="V",
        help="the direction of motion fades below this velocity (default: a twentieth of the"
        " fastest)",
    )
    group.add_argument(
        "--hold-out",
        choices=("run", "block"),
        help="whole runs, or blocks of time of all runs (default: runs, where there are three)",
    )
    group.add_argument(
        "--unlike",
        metavar="REGEX",
        help="fit only to runs whose file's name differs from the checked one's in every group of"
        " this regular expression",
    )
    group.add_argument(
        "--blocks", type=int, default=6, metavar="N", help="of time (default: %(default)s)"
    )
    group.add_argument(
        "--networks", action="store_true", help="train recurrent networks as well; takes minutes"
    )
    group.add_argument(
        "--iterations",
        type=int,
        default=JointSettings.iterations,
        metavar="N",
        help="of the networks' training (default: %(default)s)",
    )
    group.add_argument(
        "--seed", type=int, default=JointSettings.seed, metavar="N", help="(default: %(default)s)"
    )


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    if arguments.unlike is not None and arguments.hold_out == "block":
        parser.error("--unlike is for runs held out, not for blocks")
    check_column_options(parser, arguments)
    if arguments.iterations < 1:
        parser.error("--iterations must be at least 1")
    if arguments.seed < 0:
        parser.error("--seed must not be below 0")
    return run_command(
        "fit_joint", lambda: _table(arguments) if arguments.table else _fit(arguments)
    )


def _table(arguments: argparse.Namespace) -> int:
    listed = [read_listed(file) for file in arguments.files]
    if arguments.json:
        print(json.dumps(to_rows(listed), indent=2))
    else:
        console().print(joint_table(listed, arguments.unit))
    return EXIT_OK


def _fit(arguments: argparse.Namespace) -> int:
    check_folder(arguments.plots)
    runs = read_joint_runs(arguments.files, column_map(arguments))
    held = arguments.hold_out or ("run" if len(runs) >= 3 or arguments.unlike else "block")
    parts = (
        whole_runs(runs, arguments.unlike) if held == "run" else time_blocks(runs, arguments.blocks)
    )
    settings = JointSettings(
        common=arguments.terms,
        window_s=arguments.velocity_window_s,
        standstill_rad_s=arguments.standstill_rad_s,
        networks=arguments.networks,
        iterations=arguments.iterations,
        seed=arguments.seed,
    )
    with progress(1, "step", arguments.json) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        comparison = compare(runs, parts, settings, show)
    label = arguments.label or arguments.files[0].stem
    parameters = estimate(comparison)
    picture = _picture(comparison, label, arguments)
    if arguments.json:
        print(json.dumps(to_dict(comparison, parameters, label), indent=2))
        return EXIT_OK
    to = console()
    print_comparison(comparison, parameters, label, arguments.unit, to)
    for file in picture:
        to.print(f"plot: {file}", soft_wrap=True)
    return EXIT_OK


def _picture(comparison: Comparison, label: str, arguments: argparse.Namespace) -> list[Path]:
    folder: Path | None = arguments.plots
    if folder is None:
        return []
    from galen_deflection.transmission.joint_plots import plot_joint  # slow to import

    place = folder
    return written(lambda: [plot_joint(comparison, label, arguments.unit, place)], place)


def _terms(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in COMMON:
            raise argparse.ArgumentTypeError(f"{name!r}: expected {' or '.join(COMMON)}")
    return tuple(name for name in COMMON if name in names)


if __name__ == "__main__":
    sys.exit(main())
