"""`diagnose`: where data and model differ, what causes it, how far the gap shrinks.

Recordings are diagnosed here. Text tables have commands of their own behind the same name, chosen
by their columns: `tables/diagnose_table.py` and `tables/diagnose_joints.py`.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from galen_bags.many.run import run_many
from galen_model.arm.galen import WRENCH_AXES
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_OK,
    ProgressLine,
    add_json,
    add_tool_file,
    add_workers,
    check_file,
    make_parser,
    print_json,
    run_command,
    terminal,
)
from rich.console import Console

from galen_diagnosis.answer.answer import Answer, Diagnosis
from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.experiment.next_experiment import write_sweep
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.report.output import check_output, told, write_output
from galen_diagnosis.report.terminal import print_answer, print_overview
from galen_diagnosis.tables import diagnose_joints, diagnose_table

EXIT_GAP = 3
_WRENCH = frozenset(WRENCH_AXES)
_READ, _DIAGNOSED = 0.1, 0.75
"""Parts of the time that reading and diagnosing take; the rest is for the report."""
_NOTES = """written to the output directory, whole or not at all:
  diagnosis.json     the answer, for programs
  report.html        the same with pictures, for people; opens without a network
  found_effect.yaml  what was found, as parameters of sim_driver_node; only where something was
  pictures/          the report's pictures"""


@dataclass(frozen=True)
class Job:
    """What is done with each recording; picklable, for workers."""

    tool: Path | None
    folders: dict[Path, Path]
    report: bool
    overwrite: bool

    def __call__(self, recording: Path) -> dict[str, Any]:
        """Diagnose and write; returns what diagnosis.json holds."""
        return self.diagnose(recording, lambda stage, share: None).answer.to_json()

    def diagnose(self, recording: Path, progress: Callable[[str, float], None]) -> Diagnosis:
        """Diagnose and write; raises GalenError. progress: told each stage, and what is done."""
        folder = self.folders[recording]
        check_output(folder, overwrite=self.overwrite)
        began_s = time.monotonic()
        progress("reading", 0.0)
        read = read_recording(recording, self.tool)
        read_s = time.monotonic() - began_s
        diagnosis = diagnose_recording(
            read, progress=lambda stage, share: progress(stage, _READ + share * _DIAGNOSED)
        )
        progress("writing", _READ + _DIAGNOSED)
        diagnosis = told(diagnosis)
        diagnosis.seconds.setdefault("reading", read_s)
        write_output(diagnosis, folder, with_report=self.report, overwrite=self.overwrite)
        return diagnosis


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = make_parser(
        "diagnose",
        "Compare recordings with the nominal simulator driven along their joint states:"
        " is there a gap, where, which effect causes it, how far does it shrink with that effect in"
        " the simulator, what to do next. A text TABLE of wrenches with orientations, or of the two"
        " ends of a joint, is diagnosed as such: `diagnose TABLE --help` has its options.",
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="a recording or file can't be used; of many recordings, the others were diagnosed",
        codes={EXIT_GAP: "with --fail-on-gap: a recording has a gap (any verdict but none)"},
    )
    parser.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="RECORDING",
        help="directory with the bags sweep, motion, push (or some of them) and tool.json",
    )
    add_tool_file(parser, "the tool's calibration file, where it isn't the recording's")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="write here, of several recordings into a directory each in here (default:"
        " ./diagnosis_<recording>)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an old diagnosis in the output directory"
    )
    add_json(parser, "print diagnosis.json's content")
    parser.add_argument("--no-report", action="store_true", help="no report.html, no pictures")
    parser.add_argument(
        "--next",
        type=Path,
        metavar="FILE",
        help="write the experiment that would separate the causes that are left, as parameters of"
        " the node that runs it; none where no causes are left to separate (one recording only)",
    )
    parser.add_argument(
        "--fail-on-gap", action="store_true", help=f"exit with {EXIT_GAP} where there is a gap"
    )
    add_workers(parser)
    return parser


def output_folders(recordings: Sequence[Path], output: Path | None) -> dict[Path, Path]:
    """Where each recording's diagnosis goes; raises DiagnosisError where two would go to one."""
    folders: dict[Path, Path] = {}
    for recording in recordings:
        name = f"diagnosis_{recording.resolve().name or 'recording'}"
        if output is None:
            folder = Path(name)
        else:
            folder = output if len(recordings) == 1 else output / name
        if folder in folders.values() or recording in folders:
            raise DiagnosisError(
                f"{recording}: {folder} would be written twice; diagnose recordings of the same"
                " name one by one, with --output"
            )
        folders[recording] = folder
    return folders


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Diagnose; returns the exit code; raises GalenError."""
    # A cluster's workers have another working directory.
    place = Path.absolute if arguments.scheduler else Path
    recordings = [place(recording) for recording in arguments.recordings]
    folders = output_folders(recordings, arguments.output)
    job = Job(
        tool=None if arguments.tool is None else place(arguments.tool),
        folders={recording: place(folder) for recording, folder in folders.items()},
        report=not arguments.no_report,
        overwrite=arguments.overwrite,
    )
    for folder in folders.values():
        check_output(folder, overwrite=arguments.overwrite)  # before minutes of work
    check_file(arguments.next)
    if len(recordings) == 1 and not arguments.scheduler:
        return _one(job, recordings[0], arguments, console)
    outcomes = run_many(job, recordings, scheduler=arguments.scheduler, workers=arguments.workers)
    rows: list[dict[str, Any]] = [
        {"path": str(outcome.bag), "error": outcome.error}
        if outcome.result is None
        else {"path": str(outcome.bag), **outcome.result}
        for outcome in outcomes
    ]
    if arguments.json:
        print_json({"recordings": rows})
    else:
        print_overview(rows, console)
    if any("error" in row for row in rows):
        return EXIT_FAILED
    return _code(arguments, [row["verdict"] for row in rows])


def _one(job: Job, recording: Path, arguments: argparse.Namespace, console: Console) -> int:
    with ProgressLine(quiet=arguments.json) as line:
        diagnosis = job.diagnose(recording, lambda stage, share: line.show(stage, share, 1.0))
    if arguments.next is not None:
        if diagnosis.experiment is None:
            print(f"diagnose: {arguments.next} not written: {_why_none(diagnosis.answer)}",
                  file=sys.stderr)  # fmt: skip
        else:
            write_sweep(diagnosis.experiment, arguments.next)
    if arguments.json:
        print_json(diagnosis.answer.to_json())
    else:
        print_answer(diagnosis.answer, console)
        console.print(f"written: {job.folders[recording]}", soft_wrap=True, markup=False)
        if arguments.next is not None and diagnosis.experiment is not None:
            console.print(f"next experiment: {arguments.next}", soft_wrap=True, markup=False)
    return _code(arguments, [diagnosis.answer.verdict])


def _why_none(answer: Answer) -> str:
    if answer.verdict == "ambiguous":
        return "no experiment that is known here would separate the causes that are left"
    return f"the verdict is {answer.verdict}, so no causes are left to separate"


def _code(arguments: argparse.Namespace, verdicts: Sequence[str]) -> int:
    if arguments.fail_on_gap and any(verdict != "none" for verdict in verdicts):
        return EXIT_GAP
    return EXIT_OK


def _table_command(given: Sequence[str]) -> Callable[[Sequence[str]], int] | None:
    """The command for the first input if that is a text table; None for recordings."""
    words = [word for word in given if word not in ("-h", "--help")]
    if all(word.startswith("-") for word in words):
        return None
    inputs, others = build_parser().parse_known_args(words)
    tables = [path for path in inputs.recordings if path.is_file()]
    if not tables:
        return None
    named = [word.partition("=")[2] for word in others if word.startswith("--columns=")]
    named += [word for flag, word in pairwise(words) if flag == "--columns"]
    # Columns of a joint are given as ROLE=NAME, those of a table without names in their order.
    if "=" in named[0] if named else not _first_words(tables[0]) >= _WRENCH:
        return diagnose_joints.main
    return diagnose_table.main


def _first_words(table: Path) -> set[str]:
    """Words of the first line that is no comment."""
    with table.open(encoding="utf-8", errors="replace") as lines:
        first = next((line for line in lines if line.strip() and line[0] != "#"), "")
    return set(re.split(r"[,;\s\"']+", first))


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    given = sys.argv[1:] if args is None else list(args)
    table_main = _table_command(given)
    if table_main is not None:
        return table_main(given)
    parser = build_parser()
    arguments = parser.parse_args(given)
    several = len(arguments.recordings) > 1
    if arguments.next is not None and several:
        parser.error("--next is for one RECORDING")
    return run_command("diagnose", partial(run, arguments, terminal()))


if __name__ == "__main__":
    sys.exit(main())
