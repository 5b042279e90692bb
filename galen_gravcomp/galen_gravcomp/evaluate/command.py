"""`evaluate`: calibration files against recordings, loads and sensors against tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_bags.arrays.motion_table import read_motion, read_specific
from galen_bags.arrays.orientation_table import read_table
from galen_bags.formats.find import find_bags
from galen_bags.many.inputs import distinct_names
from galen_bags.many.run import json_rows, run_many
from galen_model.errors import CalibrationFileError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_OK,
    check_file,
    check_folder,
    print_json,
    progress,
    run_command,
    terminal,
    writing,
)

from galen_gravcomp.evaluate.bag_job import BagJob
from galen_gravcomp.evaluate.bag_report import print_overview
from galen_gravcomp.evaluate.bag_report import report as bag_report
from galen_gravcomp.evaluate.drift.result import judge_drift
from galen_gravcomp.evaluate.drift.result import report as drift_report
from galen_gravcomp.evaluate.drift.series import TEXT_SUFFIXES, read_series
from galen_gravcomp.evaluate.options import (
    bag_settings,
    build_parser,
    check_options,
    columns_of,
    limits_of,
    topics_of,
)
from galen_gravcomp.evaluate.report import Report
from galen_gravcomp.evaluate.table.calibration_file import tool_from_table
from galen_gravcomp.evaluate.table.cross_validation import TableMounting
from galen_gravcomp.evaluate.table.evaluation import evaluate_table
from galen_gravcomp.evaluate.table.motion import report as motion_report
from galen_gravcomp.evaluate.table.motion import score_motion
from galen_gravcomp.evaluate.table.report import report as table_report

# Kinds of input


def _evaluate_drift(arguments: argparse.Namespace) -> Report:
    tool = None if arguments.tool is None else read_calibration(arguments.tool)
    paths: list[Path] = []
    for given in arguments.inputs:
        paths += [given] if given.suffix in TEXT_SUFFIXES else find_bags([given])
    with progress(unit="msg") as bar:
        series = read_series(
            paths,
            topics_of(arguments),
            tool,
            columns_of(arguments),
            arguments.rate_hz,
            arguments.cell_s,
            lambda done, total: _show(bar, done, total),
        )
    return drift_report(judge_drift(series, limits_of(arguments)), paths[0].resolve().stem)


def _evaluate_motion(arguments: argparse.Namespace) -> Report:
    still, unit = arguments.inputs[0], arguments.imu_unit_m_s2
    table = read_table(still, columns_of(arguments), arguments.wrench_frame)
    wrench, imu, orientations = arguments.run
    run = read_motion(wrench, imu, orientations, arguments.time_unit_s, unit)
    return motion_report(score_motion(table, read_specific(still, unit), run))


def _evaluate_table(arguments: argparse.Namespace) -> Report:
    written = _written_tool(arguments.write_tool)
    check_file(written)
    table = read_table(arguments.inputs[0], columns_of(arguments), arguments.wrench_frame)
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
        settings=bag_settings(arguments),
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
    rows = json_rows(outcomes)
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


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    table = any(path.suffix in TEXT_SUFFIXES for path in arguments.inputs)
    check_options(parser, arguments, table)

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
