# SPDX-License-Identifier: Apache-2.0
"""`evaluate`: calibration files against recordings, loads and sensors against tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from galen_bags.archive import Archive, find_recordings, local_copy, print_summary
from galen_bags.arrays.arm_recording import topics_of
from galen_bags.arrays.tables import is_recording, read_motion, read_specific, read_table
from galen_bags.formats.files import find_bags
from galen_bags.many import ArchivedRecording, Place, json_rows, name_depth, name_of, run_many
from galen_common.arm import arm_parameters, chosen_arm
from galen_common.command import (
    EXIT_FAILED,
    EXIT_OK,
    ProgressLine,
    check_file,
    check_folder,
    print_json,
    progress,
    run_command,
    terminal,
    writing,
)
from galen_common.parameters import from_options
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError, GalenError, IdentificationError
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.load.mounting import entities
from galen_model.load.verdict import Limits
from galen_model.setup_check.check import SetupError
from rich.markup import escape

from galen_gravcomp.evaluate.bag import BagJob, EvaluationSettings
from galen_gravcomp.evaluate.bag_report import COLUMNS, RESULT_VERSION, print_overview, to_row
from galen_gravcomp.evaluate.bag_report import report as bag_report
from galen_gravcomp.evaluate.drift import judge_drift
from galen_gravcomp.evaluate.drift import report as drift_report
from galen_gravcomp.evaluate.drift_series import TEXT_SUFFIXES, read_series
from galen_gravcomp.evaluate.imu_run import imu_run_report
from galen_gravcomp.evaluate.options import NODE_OPTIONS, build_parser
from galen_gravcomp.evaluate.report import Report
from galen_gravcomp.evaluate.table_report import scores_report
from galen_gravcomp.evaluate.table_scores import evaluate_table, tool_from_table
from galen_gravcomp.parameters import GravcompParameters

_CELL_LIMITS_S = 1e-3, 3600.0


def _check_options(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, table: bool
) -> None:
    """End with exit code 2 where the options don't go together."""
    if not arguments.drift and table and len(arguments.inputs) > 1:
        parser.error("one TABLE at a time; bags and tables apart")
    if not (arguments.drift or table) and bool(arguments.tool) == bool(arguments.tool_beside):
        parser.error("bags need --tool FILE or --tool-beside NAME")
    if arguments.results and (arguments.drift or table):
        parser.error("--results is for bags")
    if arguments.run and (arguments.drift or not table):
        parser.error("--run needs a TABLE of still poses")
    if arguments.estimate and not table:
        parser.error("--estimate is for a TABLE; calibrate_from_bag estimates from recordings")
    if arguments.motion not in ("off", "joints"):
        parser.error("--motion is 'off' or 'joints'; with an IMU, see --run")
    low, high = _CELL_LIMITS_S
    if not low <= arguments.cell_s <= high:
        parser.error(f"--cell-s is {arguments.cell_s:g}, but must be {low:g} to {high:g}")
    try:
        arm_parameters(arguments)
        from_options(arguments, GravcompParameters, NODE_OPTIONS).validate()
        if arguments.estimate:
            entities(arguments.estimate, chosen_arm(arguments))
    except GalenError as error:
        parser.error(str(error))


def _columns(arguments: argparse.Namespace) -> list[str] | None:
    return arguments.columns.split(",") if arguments.columns else None


def _limits(arguments: argparse.Namespace) -> Limits:
    return Limits(arguments.limit_force_n, arguments.limit_torque_nm)


# Kinds of input


def _evaluate_drift(arguments: argparse.Namespace) -> Report:
    arm = chosen_arm(arguments)
    tool = None if arguments.tool is None else read_calibration(arguments.tool, arm)
    paths: list[Path] = []
    for given in arguments.inputs:
        paths += [given] if given.suffix in TEXT_SUFFIXES else find_bags([given])
    with progress(unit="msg") as bar:
        series = read_series(
            paths,
            topics_of(arguments),
            tool,
            _columns(arguments),
            arguments.cell_s,
            lambda done, total: _show(bar, done, total),
            arm=arm,
        )
    return drift_report(judge_drift(series, _limits(arguments)), paths[0].resolve().stem)


def _evaluate_run(arguments: argparse.Namespace) -> Report:
    still, unit = arguments.inputs[0], arguments.imu_unit_m_s2
    arm = chosen_arm(arguments)
    table = read_table(still, _columns(arguments), arguments.wrench_frame, arm=arm)
    wrench, imu, orientations = arguments.run
    run = read_motion(wrench, imu, orientations, arguments.time_unit_s, unit, arm)
    return imu_run_report(table, read_specific(still, unit), run)


def _evaluate_table(arguments: argparse.Namespace) -> Report:
    written = arguments.write_tool
    if written is not None:
        if written.suffix != ".json":
            raise CalibrationFileError(f"{written}: a calibration file is named <tool>.json")
        written = calibration_path(written.parent, written.stem)
    check_file(written)
    arm, columns = chosen_arm(arguments), _columns(arguments)
    table = read_table(arguments.inputs[0], columns, arguments.wrench_frame, arm=arm)
    if is_recording(table) and arguments.average_s is None:
        print(
            f"evaluate: {len(table)} rows look like a recording, and are averaged; --average-s"
            " SECONDS averages at rest alone",
            file=sys.stderr,
        )
    with ProgressLine(quiet=arguments.json) as line:
        result = evaluate_table(
            table,
            average_window_s=arguments.average_s,
            tool=None if arguments.tool is None else read_calibration(arguments.tool, arm),
            mounting=arguments.estimate,
            progress=line.show,
        )
    found = scores_report(result)
    if written is not None:
        if result.chosen.fault:
            raise IdentificationError(result.chosen.fault)
        if result.fits is False and not arguments.no_setup_check:
            raise SetupError(
                f"{written} is not written: {result.verdict}. --no-setup-check writes it"
            )
        tool = tool_from_table(written.stem, result.table, result.fit, result.mounted)
        write_calibration(written, tool)
        found.shown.append(f"written: {written}")
    return found


def _evaluate_bag(job: BagJob, bag: Place) -> Report:
    with progress(unit="msg") as bar:
        result = job.evaluate(bag, lambda done, total: _show(bar, done, total))
    found = bag_report(result)
    name = name_of(bag, job.name_parts)
    if job.plots is not None:
        found.shown.append(f"written: {escape(str(job.plots / f'{name}_evaluation.png'))}")
    if job.bags_out is not None:
        found.shown.append(f"written: {escape(str(job.bags_out / f'{name}_compensated'))}")
    return found


def _evaluate_bags(arguments: argparse.Namespace) -> int:
    # A cluster's workers have another working directory.
    local = Path.absolute if arguments.scheduler else Path

    def seen(one: Place) -> Place:
        return local(one) if isinstance(one, Path) else one

    beside = arguments.tool_beside or ""
    recordings = find_recordings(
        [seen(one) for one in arguments.inputs], files=[beside] if beside else ()
    )
    bags = [recording.place for recording in recordings]
    arm = arm_parameters(arguments)
    if arm.urdf_file:
        arm = replace(arm, urdf_file=str(local(Path(arm.urdf_file))))
        arm.arm()  # one message for a wrong file, and not one for each bag
    job = BagJob(
        tool=Path(beside) if beside else seen(arguments.tool),
        tool_beside=bool(beside),
        settings=EvaluationSettings(
            topics=topics_of(arguments),
            start_s=arguments.start_offset,
            duration_s=arguments.duration,
            parameters=from_options(arguments, GravcompParameters, NODE_OPTIONS),
            arm=arm,
            limits=_limits(arguments),
        ),
        plots=None if arguments.plots is None else local(arguments.plots),
        bags_out=None if arguments.write_bags is None else local(arguments.write_bags),
        name_parts=name_depth(bags),
    )
    tool_text = b""
    if not job.tool_beside:
        with local_copy(job.tool) as tool:
            if not tool.is_file():
                read_calibration(tool, GALEN)  # likewise; which arm it is for, the bags say
            tool_text = tool.read_bytes()
    check_folder(job.bags_out)
    if arguments.results is not None:
        archive = Archive(job, seen(arguments.results), _known(job, tool_text))
        return _evaluate_archive(archive, recordings, arguments)
    if len(bags) == 1 and not arguments.scheduler:
        return _give(_evaluate_bag(job, bags[0]), arguments)
    outcomes = run_many(job, bags, scheduler=arguments.scheduler, workers=arguments.workers)
    rows = json_rows(outcomes)
    if arguments.json:
        print_json({"bags": rows})
    else:
        print_overview(rows, terminal())
    return EXIT_FAILED if any("error" in row for row in rows) else EXIT_OK


def _known(job: BagJob, tool_text: bytes) -> dict[str, Any]:
    """Return what a result depends on beside its bag."""
    urdf = job.settings.arm.urdf_file
    return {
        "evaluate": RESULT_VERSION,
        "tool": job.tool.name if isinstance(job.tool, Path) else job.tool,
        "tool_sha256": sha256(tool_text).hexdigest(),
        "urdf_sha256": sha256(Path(urdf).expanduser().read_bytes() if urdf else b"").hexdigest(),
        **asdict(job.settings),
    }


def _evaluate_archive(
    archive: Archive, recordings: Sequence[ArchivedRecording], arguments: argparse.Namespace
) -> int:
    summary = archive.run(
        recordings, COLUMNS, to_row, scheduler=arguments.scheduler, workers=arguments.workers
    )
    print_summary(summary, as_json=arguments.json)
    return EXIT_FAILED if summary["failed"] else EXIT_OK


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


def _show(bar: Any, done: int, total: int | None) -> None:
    bar.total = total
    bar.update(done - bar.n)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: the command line without the program's name; None: that of the process.

    Returns:
        The exit code.

    """
    parser = build_parser()
    arguments = parser.parse_args(args)
    table = any(Path(one).suffix in TEXT_SUFFIXES for one in arguments.inputs)
    _check_options(parser, arguments, table)

    def work() -> int:
        check_folder(arguments.plots)
        if not (arguments.drift or table):
            return _evaluate_bags(arguments)
        with ExitStack() as copies:
            arguments.inputs = [copies.enter_context(local_copy(one)) for one in arguments.inputs]
            if arguments.tool is not None:
                arguments.tool = copies.enter_context(local_copy(arguments.tool))
            if arguments.drift:
                return _give(_evaluate_drift(arguments), arguments)
            evaluate = _evaluate_run if arguments.run else _evaluate_table
            return _give(evaluate(arguments), arguments)

    return run_command("evaluate", work)


if __name__ == "__main__":
    sys.exit(main())
