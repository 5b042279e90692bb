"""`evaluate`: a tool's file against recordings, and loads against tables of readings."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from galen_bags.arrays.arm_recording import ArmTopics
from galen_bags.arrays.orientation_table import read_table
from galen_bags.formats.find import find_bags
from galen_bags.many.run import run_many
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.errors import CalibrationFileError, GalenError, IdentificationError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.load.mounting.groups import entities
from galen_model.load.mounting.identification import KnownLoad
from galen_model.rest.binned import StillCellSettings
from galen_model.rest.orientations import StillSettings
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    add_workers,
    check_file,
    check_folder,
    not_negative,
    positive,
    run_command,
)
from galen_ros.parameters.param import add_options, from_options
from rich.console import Console
from tqdm import tqdm

from galen_gravcomp.evaluate.bag_evaluation import EvaluationSettings
from galen_gravcomp.evaluate.bag_job import BagJob, distinct_names
from galen_gravcomp.evaluate.bag_report import print_evaluation, print_overview, to_dict
from galen_gravcomp.evaluate.residual_decomposition import Limits
from galen_gravcomp.evaluate.table.calibration_file import tool_from_table
from galen_gravcomp.evaluate.table.evaluation import evaluate_table
from galen_gravcomp.evaluate.table.mounting import TableMounting
from galen_gravcomp.evaluate.table.report import print_report, to_json
from galen_gravcomp.parameters import GravcompParameters

_EPILOG = f"""exit codes:
  {EXIT_OK}    done, whatever the verdict
  {EXIT_FAILED}    a bag, table or tool's file can't be used; a line says why. Of many bags, the
       others were evaluated
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""
# The node's own parameters that decide what becomes of a wrench, with its defaults.
_NODE_OPTIONS = (
    "max_joint_age_s", "restart_gap_s", "sensor_frame",
    "motion", "motion_window_s", "motion_delay_s", "motion_lag_s",
)  # fmt: skip


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="evaluate",
        usage="evaluate BAG... --tool FILE [options]\n       evaluate --table FILE [options]",
        description="BAG...: send recordings through the node's compensation and say whether the"
        " tool's file still fits, and where not. --table: fit a load to readings with orientations"
        " and score it on readings held out, beside the plain ten-parameter least squares.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "bags",
        nargs="*",
        type=Path,
        metavar="BAG",
        help="rosbag2 directory, .mcap, .db3, ROS 1 .bag, or a folder that is searched for them",
    )
    parser.add_argument(
        "--tool",
        metavar="FILE",
        type=Path,
        help="the tool's file; with --table optional, scored beside",
    )
    parser.add_argument(
        "--plots", metavar="DIR", type=Path, help="write a picture of each bag or table here"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    parser.add_argument(
        "--still-rate-rad-s",
        type=positive,
        default=StillSettings.max_rate_rad_s,
        metavar="RATE",
        help="slower than this counts as still (default: %(default)s)",
    )
    parser.add_argument(
        "--still-min-s",
        type=positive,
        metavar="SECONDS",
        help="shortest still phase used, its rims cut off (default:"
        f" {StillCellSettings.min_duration_s} for bags, {StillSettings.min_duration_s} for tables)",
    )
    _add_bag_options(parser.add_argument_group("bags"))
    add_workers(parser)
    _add_table_options(parser.add_argument_group("tables"))
    return parser


def _add_bag_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--tool-beside",
        metavar="NAME",
        help="instead of --tool: use the file of this name in each bag's directory or above it",
    )
    topics = ArmTopics()
    group.add_argument(
        "--joint-states",
        default=topics.joint_states,
        metavar="TOPIC",
        help="topic of the joint states (default: %(default)s, in any one namespace)",
    )
    group.add_argument(
        "--wrench-raw",
        default=topics.wrench_raw,
        metavar="TOPIC",
        help="topic of the raw wrench (default: %(default)s, in any one namespace)",
    )
    group.add_argument(
        "--joint-names",
        default=",".join(JOINT_NAMES),
        metavar="NAMES",
        help="names of the five joints; only the last two must be there (default: %(default)s)",
    )
    group.add_argument(
        "--start-offset",
        type=not_negative,
        default=0.0,
        metavar="SECONDS",
        help="leave out so much at the beginning (default: %(default)s)",
    )
    group.add_argument(
        "--duration", type=positive, metavar="SECONDS", help="look at so much only (default: all)"
    )
    add_options(group, GravcompParameters, _NODE_OPTIONS)
    group.add_argument(
        "--sensor-range",
        nargs=6,
        type=positive,
        default=list(GravcompParameters().sensor_range),
        metavar=tuple(axis.upper() for axis in WRENCH_AXES),
        help="N, N.m; readings at or beyond it are counted (default: %(default)s)",
    )
    group.add_argument(
        "--limit-force-n",
        type=positive,
        default=Limits.force_n,
        metavar="N",
        help="a file fits if no axis has a larger RMSE over the still phases (default:"
        " %(default)s)",
    )
    group.add_argument(
        "--limit-torque-nm",
        type=positive,
        default=Limits.torque_nm,
        metavar="NM",
        help="the same for torques, N.m (default: %(default)s)",
    )
    group.add_argument(
        "--write-bags",
        metavar="DIR",
        type=Path,
        help="write each bag with wrench_compensated in it as DIR/<name>_compensated",
    )


def _add_table_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--table",
        metavar="FILE",
        help="text table: fx fy fz tx ty tz (N, N.m; a push reads positive in its direction) and "
        "one of gx gy gz | r11..r33 (R_base_sensor) | qx qy qz qw (sensor in base) | roll tilt; "
        "optional: t (s), block (label)",
    )
    group.add_argument(
        "--columns",
        metavar="NAMES",
        help="comma-separated column names of a file without a first line of names; "
        "'-' for a column to skip",
    )
    group.add_argument(
        "--wrench-frame",
        choices=("sensor", "base"),
        default="sensor",
        help="axes that the file's wrenches are written in (default: sensor)",
    )
    group.add_argument(
        "--average-s",
        type=positive,
        metavar="SECONDS",
        help="the table is a recording: find its still phases and average this long within them",
    )
    group.add_argument(
        "--bias-drift",
        action="store_true",
        help="beside the others, a model whose bias may drift, in the order of the readings; its"
        " shape is chosen by blocks, within what is not held out (takes some seconds a block)",
    )
    group.add_argument(
        "--blocks", type=int, metavar="N", help="blocks of neighbouring readings to hold out"
    )
    group.add_argument(
        "--estimate",
        metavar="GROUPS",
        type=lambda text: tuple(text.split(",")),
        help="score a model beside that has these together with the load, comma-separated; rejected"
        " where the orientations can't tell them apart: sensor_rotation, axis_gain, gain_ratio,"
        " base_inclination (not with gx gy gz alone) and their parts",
    )
    group.add_argument(
        "--known-mass-kg",
        type=positive,
        metavar="KG",
        help="mass of all that hangs on the sensor, as a scale tells it, for the force gains",
    )
    group.add_argument(
        "--known-mass-std-kg", type=positive, metavar="KG", help="and its standard deviation"
    )
    group.add_argument(
        "--write-tool",
        metavar="FILE",
        help="write the load from all readings as the tool's file <tools_dir>/<tool>.json; one "
        "load can't tell the adapter from the tool, and the file says so",
    )


def run_table(arguments: argparse.Namespace, console: Console) -> None:
    """Evaluate a table; raises GalenError."""
    columns = arguments.columns.split(",") if arguments.columns else None
    check_folder(arguments.plots)
    written_tool = _written_tool(arguments.write_calibration)
    check_file(written_tool)
    table = read_table(arguments.table, columns, arguments.wrench_frame)
    tool = read_calibration(arguments.tool) if arguments.tool else None
    settings = StillSettings(
        arguments.still_rate_rad_s,
        min_duration_s=arguments.still_min_s or StillSettings.min_duration_s,
    )
    result = evaluate_table(
        table,
        arguments.blocks,
        arguments.average_s,
        settings,
        tool,
        _mounting(arguments),
        arguments.bias_drift,
    )
    if written_tool is not None:
        write_calibration(
            written_tool,
            tool_from_table(written_tool.stem, result.table, result.fit, result.mounted),
        )
        if not arguments.json:
            console.print(f"tool file: {written_tool}")
    if arguments.plots:
        from galen_gravcomp.evaluate.table.plots import (
            plot_scores,  # slow to import, so only when asked
        )

        try:
            written = plot_scores(result, arguments.plots)
        except OSError as error:
            raise GalenError(f"{arguments.plots}: can't be written: {error.strerror}") from error
        if not arguments.json:
            console.print(f"plot: {written}")
    if arguments.json:
        print(json.dumps(to_json(result), indent=2))
    else:
        print_report(result, console)


def _mounting(arguments: argparse.Namespace) -> TableMounting | None:
    if arguments.estimate is None:
        return None
    mass, std = arguments.known_mass_kg, arguments.known_mass_std_kg
    return TableMounting(arguments.estimate, None if mass is None else KnownLoad(mass, std))


def _written_tool(file: str | None) -> Path | None:
    """The tool's file to write; its name must be one that a tool may have."""
    if file is None:
        return None
    path = Path(file)
    if path.suffix != ".json":
        raise CalibrationFileError(f"{path}: a tool's file is named <tool>.json")
    return calibration_path(path.parent, path.stem)


def run_bags(arguments: argparse.Namespace, console: Console) -> int:
    """Evaluate bags; returns the exit code; raises GalenError."""
    bags = find_bags(arguments.bags)
    # A cluster's workers have another working directory.
    place = Path.absolute if arguments.scheduler else Path
    bags = [place(bag) for bag in bags]
    job = BagJob(
        tool=Path(arguments.tool_beside) if arguments.tool is None else place(arguments.tool),
        tool_beside=arguments.tool is None,
        settings=_bag_settings(arguments),
        plots=None if arguments.plots is None else place(arguments.plots),
        bags_out=None if arguments.write_bags is None else place(arguments.write_bags),
        names=distinct_names(bags),
    )
    if not job.tool_beside:
        read_calibration(job.tool)  # a wrong file is said once, and not for each bag
    for folder in (job.plots, job.bags_out):
        check_folder(folder)
    if len(bags) == 1 and not arguments.scheduler:
        with tqdm(unit="msg", unit_scale=True, disable=not sys.stderr.isatty()) as bar:
            result = job.evaluate(bags[0], lambda done, total: _show(bar, done, total))
        if arguments.json:
            print(json.dumps(to_dict(result), indent=2))
        else:
            print_evaluation(result, console)
            for written in _written(job, bags[0]):
                console.print(f"written: {written}", soft_wrap=True)
        return EXIT_OK
    outcomes = run_many(job, bags, scheduler=arguments.scheduler, workers=arguments.workers)
    rows: list[dict[str, Any]] = [
        {"bag": str(outcome.bag), "error": outcome.error}
        if outcome.result is None
        else outcome.result
        for outcome in outcomes
    ]
    if arguments.json:
        print(json.dumps({"bags": rows}, indent=2))
    else:
        print_overview(rows, console)
    return EXIT_FAILED if any("error" in row for row in rows) else EXIT_OK


def _bag_settings(arguments: argparse.Namespace) -> EvaluationSettings:
    parameters = from_options(arguments, GravcompParameters, _NODE_OPTIONS)
    parameters = replace(parameters, sensor_range=tuple(arguments.sensor_range))
    return EvaluationSettings(
        topics=ArmTopics(
            arguments.joint_states, arguments.wrench_raw, tuple(arguments.joint_names.split(","))
        ),
        start_s=arguments.start_offset,
        duration_s=arguments.duration,
        compensator=parameters.settings(),
        still=StillCellSettings(
            arguments.still_rate_rad_s,
            min_duration_s=arguments.still_min_s or StillCellSettings.min_duration_s,
        ),
        limits=Limits(arguments.limit_force_n, arguments.limit_torque_nm),
        motion=parameters.motion_settings() if parameters.motion == "joints" else None,
    )


def _show(bar: Any, done: int, total: int | None) -> None:
    bar.total = total
    bar.update(done - bar.n)


def _written(job: BagJob, bag: Path) -> list[Path]:
    name = job.names[bag]
    written = [] if job.plots is None else [job.plots / f"{name}_evaluation.png"]
    return written + ([] if job.bags_out is None else [job.bags_out / f"{name}_compensated"])


def _check_motion(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    if arguments.motion not in ("off", "joints"):
        parser.error("--motion is 'off' or 'joints'; with an IMU, see score_motion")
    try:
        from_options(arguments, GravcompParameters, _NODE_OPTIONS).validate()
    except ValueError as error:
        parser.error(str(error))


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    if bool(arguments.bags) == bool(arguments.table):
        parser.error("give bags, or a --table")
    if arguments.bags and bool(arguments.tool) == bool(arguments.tool_beside):
        parser.error("bags need --tool FILE or --tool-beside NAME")
    _check_motion(parser, arguments)
    try:
        entities(arguments.estimate or ())
    except IdentificationError as error:
        parser.error(f"--estimate: {error}")
    if arguments.known_mass_kg is not None and arguments.estimate is None:
        parser.error("--known-mass-kg is for --estimate")
    if (arguments.known_mass_kg is None) != (arguments.known_mass_std_kg is None):
        parser.error("--known-mass-kg and --known-mass-std-kg belong together")
    if arguments.estimate and not arguments.table:
        parser.error("--estimate is for a --table; calibrate_from_bag estimates from recordings")
    console = Console(width=None if sys.stdout.isatty() else 120)

    def work() -> int:
        if arguments.bags:
            return run_bags(arguments, console)
        run_table(arguments, console)
        return EXIT_OK

    return run_command("evaluate", work)


if __name__ == "__main__":
    sys.exit(main())
