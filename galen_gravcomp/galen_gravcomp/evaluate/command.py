"""`evaluate`: calibration files against recordings, loads and sensors against tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_bags.arrays.arm_recording import ArmTopics
from galen_bags.arrays.motion_table import read_motion, read_specific
from galen_bags.arrays.orientation_table import read_table
from galen_bags.formats.find import find_bags
from galen_bags.many.inputs import distinct_names
from galen_bags.many.run import run_many
from galen_model.arm.galen import GRAVITY_M_S2, JOINT_NAMES
from galen_model.errors import CalibrationFileError, IdentificationError
from galen_model.evidence.verdict import Limits
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.load.mounting.mounting import entities
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_OK,
    add_json,
    add_plots,
    add_tool_file,
    add_topic,
    add_workers,
    check_file,
    check_folder,
    make_parser,
    not_negative,
    positive,
    print_json,
    progress,
    run_command,
    terminal,
    writing,
)
from galen_ros.parameters.param import add_options, from_options

from galen_gravcomp.evaluate.bag_evaluation import EvaluationSettings
from galen_gravcomp.evaluate.bag_job import BagJob
from galen_gravcomp.evaluate.bag_report import print_overview
from galen_gravcomp.evaluate.bag_report import report as bag_report
from galen_gravcomp.evaluate.drift.result import judge_drift
from galen_gravcomp.evaluate.drift.result import report as drift_report
from galen_gravcomp.evaluate.drift.series import CELL_S, TEXT_SUFFIXES, read_series
from galen_gravcomp.evaluate.report import Report
from galen_gravcomp.evaluate.table.calibration_file import tool_from_table
from galen_gravcomp.evaluate.table.cross_validation import TableMounting
from galen_gravcomp.evaluate.table.evaluation import evaluate_table
from galen_gravcomp.evaluate.table.motion import report as motion_report
from galen_gravcomp.evaluate.table.motion import score_motion
from galen_gravcomp.evaluate.table.report import report as table_report
from galen_gravcomp.parameters import GravcompParameters

_USAGE = """evaluate BAG... (--tool FILE | --tool-beside NAME) [options]
       evaluate TABLE [--tool FILE] [options]
       evaluate TABLE --run WRENCH IMU ORIENTATIONS [options]
       evaluate BAG|TABLE... --drift [--tool FILE] [options]"""
_NOTES = """BAG: rosbag2 directory, .mcap, .db3, ROS 1 .bag, or a folder that is searched for
them: does the calibration file still fit the recording, and where not?
TABLE: .csv, .txt, .tsv or .dat with fx fy fz tx ty tz (N, N.m; a push reads positive in
its direction) and one of gx gy gz | r11..r33 (R_base_sensor) | qx qy qz qw (sensor in
base) | roll tilt; optional: t (s), block (label): a load is fitted, and scored on
readings held out, beside the plain ten-parameter least squares."""
# The node's own parameters that decide what becomes of a wrench, with its defaults.
_NODE_OPTIONS = ("max_joint_age_s", "motion", "motion_lag_s")
_CELL_LIMITS_S = 1e-3, 3600.0


def build_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = make_parser(
        "evaluate",
        "Judge calibration files, loads and sensors on recordings and tables; the kind is found"
        " from the input.",
        usage=_USAGE,
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="an input can't be used; a line gives the reason. Of many bags, the others were"
        " evaluated",
    )
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help="bags or tables")
    add_tool_file(parser, "the calibration file; with a table optional, scored beside")
    add_plots(parser)
    add_json(parser)
    for unit, metavar, default in (
        ("force-n", "N", Limits.force_n),
        ("torque-nm", "NM", Limits.torque_nm),
    ):
        parser.add_argument(
            f"--limit-{unit}",
            type=positive,
            default=default,
            metavar=metavar,
            help="a file fits if no axis has a larger RMSE over the rest segments; with --drift:"
            " how far a tare may be off (1 sigma; default: %(default)s)",
        )
    _add_bag_options(parser.add_argument_group("bags"))
    _add_table_options(parser.add_argument_group("tables"))
    _add_drift_options(parser.add_argument_group("long recordings without contact"))
    return parser


def _add_bag_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--tool-beside",
        metavar="NAME",
        help="instead of --tool: use the file of this name in each bag's directory or above it",
    )
    topics = ArmTopics()
    add_topic(group, "--joint-states", topics.joint_states, "the joint states")
    add_topic(group, "--wrench-raw", topics.wrench_raw, "the raw wrench")
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
        "--write-bags",
        metavar="DIR",
        type=Path,
        help="write each bag with wrench_compensated in it as DIR/<name>_compensated",
    )
    add_workers(group)


def _add_table_options(group: argparse._ArgumentGroup) -> None:
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
        help="the table is a recording: find its rest segments and average this long within them",
    )
    group.add_argument(
        "--bias-drift",
        action="store_true",
        help="beside the others, a model whose offset may drift, in the order of the readings; its"
        " shape is chosen by blocks, within what is not held out (takes some seconds a block)",
    )
    group.add_argument(
        "--estimate",
        metavar="GROUPS",
        default=(),
        type=lambda text: tuple(text.split(",")),
        help="score a model beside that has these together with the load, comma-separated; rejected"
        " where the orientations don't distinguish them: sensor_rotation, axis_gain, gain_ratio,"
        " base_inclination (not with gx gy gz alone) and their parts",
    )
    group.add_argument(
        "--write-tool",
        metavar="FILE",
        type=Path,
        help="write the load from all readings as the calibration file <tools_dir>/<tool>.json; one"
        " load doesn't distinguish the adapter from the tool, and the file notes it",
    )
    group.add_argument(
        "--run",
        nargs=3,
        type=Path,
        metavar=("WRENCH", "IMU", "ORIENTATIONS"),
        help="the table holds still poses with an IMU (ax ay az): calibrate load and IMU on them,"
        " subtract weight and inertial forces from this run (tables of t and fx .. tz; t, ax ay az;"
        " t and an orientation), and score the residual",
    )
    group.add_argument(
        "--time-unit-s",
        type=positive,
        default=1.0,
        metavar="SECONDS",
        help="a unit of the run's column t (default: %(default)s)",
    )
    group.add_argument(
        "--imu-unit-m-s2",
        type=positive,
        default=1.0,
        metavar="UNIT",
        help=f"a unit of ax ay az; {-GRAVITY_M_S2[2]} for g (default: %(default)s)",
    )


def _add_drift_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--drift",
        action="store_true",
        help="the inputs, in their order, are one recording without contact: its course, Allan"
        " deviation, how long a tare holds, and whether the drift is predictable, on hours that no"
        " fit has seen. Tables are read whole; --tool: the arm was at rest in several poses",
    )
    group.add_argument(
        "--rate-hz", type=positive, metavar="HZ", help="rate of a table without the column t"
    )
    group.add_argument(
        "--cell-s",
        type=positive,
        default=CELL_S,
        metavar="SECONDS",
        help="readings are averaged over so much first; less for a short recording (default:"
        " %(default)s)",
    )


# Kinds of input


def _evaluate_drift(arguments: argparse.Namespace) -> Report:
    tool = None if arguments.tool is None else read_calibration(arguments.tool)
    paths: list[Path] = []
    for given in arguments.inputs:
        paths += [given] if given.suffix in TEXT_SUFFIXES else find_bags([given])
    with progress(unit="msg") as bar:
        series = read_series(
            paths,
            _topics(arguments),
            tool,
            _columns(arguments),
            arguments.rate_hz,
            arguments.cell_s,
            lambda done, total: _show(bar, done, total),
        )
    return drift_report(judge_drift(series, _limits(arguments)), paths[0].resolve().stem)


def _evaluate_motion(arguments: argparse.Namespace) -> Report:
    still, unit = arguments.inputs[0], arguments.imu_unit_m_s2
    table = read_table(still, _columns(arguments), arguments.wrench_frame)
    wrench, imu, orientations = arguments.run
    run = read_motion(wrench, imu, orientations, arguments.time_unit_s, unit)
    return motion_report(score_motion(table, read_specific(still, unit), run))


def _evaluate_table(arguments: argparse.Namespace) -> Report:
    written = _written_tool(arguments.write_tool)
    check_file(written)
    table = read_table(arguments.inputs[0], _columns(arguments), arguments.wrench_frame)
    result = evaluate_table(
        table,
        average_window_s=arguments.average_s,
        tool=None if arguments.tool is None else read_calibration(arguments.tool),
        mounting=TableMounting(arguments.estimate) if arguments.estimate else None,
        bias_drift=arguments.bias_drift,
    )
    found = table_report(result)
    if written is not None:
        tool = tool_from_table(written.stem, result.table, result.fit, result.mounted)
        write_calibration(written, tool)
        found.shown.append(f"written: {written}")
    return found


def _evaluate_bag(arguments: argparse.Namespace, job: BagJob, bag: Path) -> Report:
    with progress(unit="msg") as bar:
        result = job.evaluate(bag, lambda done, total: _show(bar, done, total))
    found = bag_report(result)
    name = job.names[bag]
    if job.plots is not None:
        found.shown.append(f"written: {job.plots / f'{name}_evaluation.png'}")
    if job.bags_out is not None:
        found.shown.append(f"written: {job.bags_out / f'{name}_compensated'}")
    return found


def _evaluate_bags(arguments: argparse.Namespace) -> int:
    bags = find_bags(arguments.inputs)
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
        read_calibration(job.tool)  # one message for a wrong file, and not one for each bag
    check_folder(job.bags_out)
    if len(bags) == 1 and not arguments.scheduler:
        return _give(_evaluate_bag(arguments, job, bags[0]), arguments)
    outcomes = run_many(job, bags, scheduler=arguments.scheduler, workers=arguments.workers)
    rows: list[dict[str, Any]] = [
        {"bag": str(outcome.bag), "error": outcome.error}
        if outcome.result is None
        else outcome.result
        for outcome in outcomes
    ]
    if arguments.json:
        print_json({"bags": rows})
    else:
        print_overview(rows, terminal())
    return EXIT_FAILED if any("error" in row for row in rows) else EXIT_OK


def _give(found: Report, arguments: argparse.Namespace) -> int:
    """Write the picture and print the report."""
    if arguments.plots is not None and found.plot is not None:
        with writing(arguments.plots):
            found.shown.append(f"written: {found.plot(arguments.plots)}")
    if arguments.json:
        print_json(found.content)
    else:
        found.print(terminal())
    return EXIT_OK


# Options


def _topics(arguments: argparse.Namespace) -> ArmTopics:
    names = tuple(arguments.joint_names.split(","))
    return ArmTopics(arguments.joint_states, arguments.wrench_raw, names)


def _columns(arguments: argparse.Namespace) -> list[str] | None:
    return arguments.columns.split(",") if arguments.columns else None


def _limits(arguments: argparse.Namespace) -> Limits:
    return Limits(arguments.limit_force_n, arguments.limit_torque_nm)


def _bag_settings(arguments: argparse.Namespace) -> EvaluationSettings:
    parameters = from_options(arguments, GravcompParameters, _NODE_OPTIONS)
    return EvaluationSettings(
        topics=_topics(arguments),
        start_s=arguments.start_offset,
        duration_s=arguments.duration,
        parameters=parameters,
        limits=_limits(arguments),
    )


def _written_tool(path: Path | None) -> Path | None:
    """Check that the calibration file's name is one that a tool may have."""
    if path is None:
        return None
    if path.suffix != ".json":
        raise CalibrationFileError(f"{path}: a calibration file is named <tool>.json")
    return calibration_path(path.parent, path.stem)


def _show(bar: Any, done: int, total: int | None) -> None:
    bar.total = total
    bar.update(done - bar.n)


def _check(parser: argparse.ArgumentParser, arguments: argparse.Namespace, table: bool) -> None:
    """End with exit code 2 where the options don't go together."""
    if not arguments.drift and table and len(arguments.inputs) > 1:
        parser.error("one TABLE at a time; bags and tables apart")
    if not (arguments.drift or table) and bool(arguments.tool) == bool(arguments.tool_beside):
        parser.error("bags need --tool FILE or --tool-beside NAME")
    if arguments.run and (arguments.drift or not table):
        parser.error("--run needs a TABLE of still poses")
    if arguments.estimate and not table:
        parser.error("--estimate is for a TABLE; calibrate_from_bag estimates from recordings")
    if arguments.motion not in ("off", "joints"):
        parser.error("--motion is 'off' or 'joints'; with an IMU, see --run")
    low, high = _CELL_LIMITS_S
    if not low <= arguments.cell_s <= high:
        parser.error(f"--cell-s is {arguments.cell_s:g}, but must be {low:g} to {high:g}")
    if arguments.drift and len(arguments.joint_names.split(",")) != len(JOINT_NAMES):
        parser.error(f"--joint-names needs {len(JOINT_NAMES)} names, separated by commas")
    try:
        from_options(arguments, GravcompParameters, _NODE_OPTIONS).validate()
        entities(arguments.estimate)
    except (ValueError, IdentificationError) as error:
        parser.error(str(error))


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    table = any(path.suffix in TEXT_SUFFIXES for path in arguments.inputs)
    _check(parser, arguments, table)

    def work() -> int:
        check_folder(arguments.plots)
        if arguments.drift:
            return _give(_evaluate_drift(arguments), arguments)
        if arguments.run:
            return _give(_evaluate_motion(arguments), arguments)
        if table:
            return _give(_evaluate_table(arguments), arguments)
        return _evaluate_bags(arguments)

    return run_command("evaluate", work)


if __name__ == "__main__":
    sys.exit(main())
