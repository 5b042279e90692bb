# SPDX-License-Identifier: Apache-2.0
"""`diagnose`: where data and model differ, what causes it, how far the gap shrinks.

The first input decides what is diagnosed: recordings (directories), text tables of a force/torque
sensor with orientations, or text tables of the two ends of a joint.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from galen_bags.archive import (
    Archive,
    add_results,
    find_recordings,
    local_copy,
    place,
    print_summary,
)
from galen_bags.arrays.joint_table import add_column_options, joint_columns, read_joint_runs
from galen_bags.arrays.tables import ORIENTATIONS, read_table, read_text_table, still_readings
from galen_bags.many import ArchivedRecording, Place, name_depth, name_of, run_many
from galen_common.arm import add_arm, chosen_arm
from galen_common.command import (
    EXIT_FAILED,
    EXIT_OK,
    ProgressLine,
    add_json,
    add_no_setup_check,
    add_table_columns,
    add_tool_file,
    add_workers,
    add_wrench_frame,
    check_file,
    make_parser,
    print_json,
    run_command,
    terminal,
)
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration
from galen_model.load.inertia import point_mass_inertia
from galen_model.setup_check.check import SetupError, check_setup
from galen_model.transmission import time_blocks, whole_runs
from galen_sim_driver.effects.effect import ConfigError, Effect
from galen_sim_driver.effects.load import InertialLoad, ToolMassError
from galen_sim_driver.effects.registry import LIMITED
from rich.console import Console

from galen_diagnosis.answer.answer import Answer, Diagnosis
from galen_diagnosis.experiment.next_experiment import write_sweep
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import (
    DAY_TO_DAY,
    RECORDING_FILES,
    DiagnosticRecording,
    read_recording,
    require_sound_setup,
)
from galen_diagnosis.observation.rows import BAGS
from galen_diagnosis.observation.specification import (
    CALIBRATED,
    DEFAULT,
    SPECIFICATION_FILE,
    path_of,
    presets,
    specification_of,
)
from galen_diagnosis.report.corrections import corrections
from galen_diagnosis.report.mujoco_model import MODEL, mujoco_model
from galen_diagnosis.report.report import (
    COLUMNS,
    EFFECT,
    RESULT_VERSION,
    check_output,
    effect_file,
    print_answer,
    print_overview,
    print_specification,
    to_row,
    write_output,
)
from galen_diagnosis.tables.joint_conclusion import diagnose_runs
from galen_diagnosis.tables.joint_evidence import LagRows
from galen_diagnosis.tables.joint_runs import rows_of_runs
from galen_diagnosis.tables.orientations import table_recording

Kind = Literal["recording", "table", "joint"]
EXIT_GAP = 3
_WRENCH = frozenset(WRENCH_AXES)
_READ, _DIAGNOSED = 0.1, 0.75
"""Parts of the time that reading and diagnosing take; the rest is for the report."""
_ENTRIES = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
"""Of a tensor: xx yy zz xy xz yz."""
_RUNS, _BLOCKS = 4, 6
"""From so many runs of a joint on whole runs are held out, else so many blocks of time."""
_NOTES = """written to the output directory, whole or not at all:
  diagnosis.json     the answer, for programs
  report.html        the same with pictures, for people; opens without a network
  found_effect.yaml  what was found in a recording, as parameters of sim_driver_node
  found_effect.mjcf.xml
                     the arm with what was found, for MuJoCo
  corrected.urdf, corrected_TOOL.json
                     where what was identified can be corrected in the robot description or the
                     calibration file: the corrected ones
  pictures/          the report's pictures"""
_INPUTS = {
    "recording": "directory with the bags sweep, motion, push (or some of them) and tool.json, or"
    " one that is searched for such; a path or URL (s3://, gs://, az://, https://). A"
    " text TABLE of wrenches with orientations, or of the two ends of a joint, is diagnosed as"
    " such: `diagnose TABLE --help` has its options",
    "table": "text tables, each by itself: fx .. tz and an orientation ("
    f"{'; '.join(map(' '.join, (*ORIENTATIONS.values(), GALEN.turning_names)))}), perhaps t and"
    " block;"
    " with t it is cut into its rest segments",
    "joint": "text tables of one joint, a run each: angles at both ends, torque, time",
}


@dataclass(frozen=True)
class Job:
    """Diagnoses each recording; picklable, for workers.

    What is written goes to the recording's folder of `folders`, or into one in `output` that is
    named by so many parts of the recording's place. inertial_forces: the nominal model has them.
    """

    tool: Place | None
    folders: Mapping[Any, Path]
    report: bool
    overwrite: bool
    output: Path | None = None
    name_parts: int = 1
    inertial_forces: bool = False
    check_setup: bool = True
    wrench_frame: str = "sensor"
    specification: tuple[str | Path, ...] = ()
    reference: tuple[Place, ...] = ()

    def __call__(self, recording: Place) -> dict[str, Any]:
        """Diagnose and write; returns what diagnosis.json holds."""
        return self.diagnose(recording, lambda stage, share: None).answer.to_json()

    def diagnose(self, place: Place, progress: Callable[[str, float], None]) -> Diagnosis:
        """Diagnose a recording and write what is asked for.

        Args:
            place: Path or URL of the recording.
            progress: Called with the stage and the share of the whole, 0 ... 1.

        Returns:
            The diagnosis; where it was written, its answer has the corrections.

        Raises:
            GalenError: The recording or a reference can't be used, its set-up is wrong, or the
                directory can't be written.

        """
        folder = self.folders.get(place)
        if self.output is not None:
            folder = self.output / f"diagnosis_{name_of(place, self.name_parts)}"
        if folder is not None:
            check_output(folder, overwrite=self.overwrite)
        progress("reading", 0.0)
        with ExitStack() as copies:
            tool = self.tool and copies.enter_context(local_copy(self.tool))
            recording, *references = (
                read_recording(
                    copies.enter_context(local_copy(one, folders=BAGS, files=RECORDING_FILES)),
                    tool,
                    inertial_forces=self.inertial_forces,
                    wrench_frame=self.wrench_frame,
                    specification=self.specification,
                )
                for one in (place, *self.reference)
            )
            if self.check_setup:
                require_sound_setup(recording)
            diagnosis = diagnose_recording(
                recording,
                progress=lambda stage, share: progress(stage, _READ + share * _DIAGNOSED),
                references=references,
            )
        if folder is None:
            return diagnosis
        progress("writing", _READ + _DIAGNOSED)
        corrected = corrections(recording, diagnosis)
        answer = replace(diagnosis.answer, corrections=corrected.sentences)
        files = dict(corrected.files)
        try:
            found = in_driver(recording, diagnosis.effects)
            driver = effect_file(answer.recording, found, recording.arm)
            if driver is not None:
                files |= {EFFECT: driver, MODEL: mujoco_model(recording, found)}
        except ConfigError as error:
            problem = f"{EFFECT} is not written: {error}"
            answer = replace(answer, problems=(*answer.problems, problem))
        diagnosis = replace(diagnosis, answer=answer)
        draw = partial(_draw, diagnosis) if self.report else None
        write_output(answer, folder, files=files, draw=draw, overwrite=self.overwrite)
        return diagnosis


def in_driver(recording: DiagnosticRecording, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return found effects for a driver, whose nominal model has no mounting and no motion.

    Args:
        recording: Its mounting and inertial forces are in the nominal model.
        effects: Those that were found; since a reference, what has changed.

    Returns:
        Those and the mounting; inertial forces are those of the whole load. Nothing where nothing
        was found.

    """
    inertia = recording.inertia_kg_m2
    if not effects:
        return ()
    effects = (*recording.mounted_effects, *map(_as_body, effects))
    if inertia is None:
        return effects
    loads = recording.tool.load.load, recording.tool.adapter.load
    beyond = next((e for e in effects if isinstance(e, InertialLoad)), InertialLoad())
    own = inertia - point_mass_inertia(*loads) + np.array(beyond.own_inertia_kg_m2)
    mass_kg = sum(load.mass_kg for load in loads) + beyond.mass_kg
    mass_kg += sum(e.delta_kg for e in effects if isinstance(e, ToolMassError))
    whole = _as_body(InertialLoad(mass_kg, tuple(own.tolist())))
    return (*(e for e in effects if not isinstance(e, InertialLoad)), whole)


def _as_body(effect: Effect) -> Effect:
    """Return an effect whose own inertia is the nearest that a body can have.

    That is one whose second moments of mass, J = tr(I) / 2 - I, are not negative.
    """
    if not isinstance(effect, InertialLoad) or not any(effect.own_inertia_kg_m2):
        return effect
    xx, yy, zz, xy, xz, yz = effect.own_inertia_kg_m2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    sizes, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    moments = (axes * np.maximum(sizes, 0.0)) @ axes.T
    body = np.trace(moments) * np.eye(3) - moments
    return replace(effect, own_inertia_kg_m2=tuple(body[_ENTRIES].tolist()))


def _draw(diagnosis: Diagnosis, folder: Path) -> Mapping[str, Path]:
    from galen_diagnosis.report.pictures import write_pictures  # slow to import

    return write_pictures(diagnosis, folder)


def _no_pictures(_folder: Path) -> Mapping[str, Path]:
    return {}


def build_parser(kind: Kind = "recording") -> argparse.ArgumentParser:
    """Return the command's options for a kind of input.

    Args:
        kind: What the first input is.

    Returns:
        The parser.

    """
    parser = make_parser(
        "diagnose",
        "Compare data with the nominal model (of recordings the simulator, driven along their"
        " joint states): is there a gap, where, which effect causes it, how far does it shrink with"
        " that effect in the model, what to do next.",
        notes=_NOTES,
        ok="done, whatever the verdict",
        failed="an input can't be used; of many recordings, the others were diagnosed",
        codes={EXIT_GAP: "with --fail-on-gap: an input has a gap (any verdict but none)"},
    )
    name = kind.upper()
    # Tables are files here.
    types = place if kind == "recording" else Path
    parser.add_argument("inputs", nargs="+", type=types, metavar=name, help=_INPUTS[kind])
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="write here, of several inputs into a directory each in here (default:"
        " ./diagnosis_<input>)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an old diagnosis in the output directory"
    )
    add_json(parser, "print diagnosis.json's content")
    parser.add_argument("--no-report", action="store_true", help="no report.html, no pictures")
    parser.add_argument(
        "--fail-on-gap", action="store_true", help=f"exit with {EXIT_GAP} where there is a gap"
    )
    if kind == "joint":
        add_column_options(parser.add_argument_group("columns"))
    else:
        what = "the tool's calibration file (default: the recording's; of a table, it is fitted)"
        add_tool_file(parser, what).type = types
        parser.add_argument(
            "--reference",
            type=types,
            nargs="+",
            default=(),
            metavar=name,
            help="earlier ones of the same arm and tool, by time: what has changed since is"
            f" diagnosed, beyond {DAY_TO_DAY} of the limits",
        )
        _add_specification(parser)
        (_add_table_options if kind == "table" else _add_recording_options)(parser)
    return parser


def _add_recording_options(parser: argparse.ArgumentParser) -> None:
    add_wrench_frame(parser)
    add_no_setup_check(parser)
    parser.add_argument(
        "--inertial-forces",
        action="store_true",
        help="the nominal model has the inertial forces of tool and adapter, by the calibration"
        " file, as gravcomp_node has them with its parameter motion",
    )
    parser.add_argument(
        "--next",
        type=Path,
        metavar="FILE",
        help="write the experiment that would separate the causes that are left, as parameters of"
        " the node that runs it; none where no causes are left to separate (one recording only)",
    )
    add_results(parser)
    add_workers(parser)


def _add_specification(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--specification",
        type=_file_or_preset,
        nargs="+",
        default=(),
        metavar="FILE|PRESET",
        help="limits of what is healthy for this arm and its sensor, by effect; the first comes"
        f" before the others (default: a recording's {SPECIFICATION_FILE}; without one"
        f" {CALIBRATED} for the Galen, {DEFAULT} for other arms and tables). Presets:"
        f" {', '.join(presets())}",
    )
    parser.add_argument(
        "--show-specification",
        action=_ShowSpecification,
        nargs="*",
        metavar="FILE|PRESET",
        help="print the limits, each with its source, and exit",
    )


def _file_or_preset(given: str) -> str | Path:
    return given if given in presets() else Path(given)


class _ShowSpecification(argparse.Action):
    """As --help is: prints and exits."""

    def __call__(
        self, parser: argparse.ArgumentParser, _: Any, values: Any, option: str | None = None
    ) -> None:
        """Print the limits."""
        given = [_file_or_preset(one) for one in values] or [DEFAULT]
        try:
            found = specification_of(given, dict.fromkeys(LIMITED))
        except GalenError as error:
            parser.error(str(error))
        print_specification(found, terminal(110))
        parser.exit()


def _add_table_options(parser: argparse.ArgumentParser) -> None:
    add_table_columns(parser)
    parser.add_argument(
        "--noise",
        type=Path,
        metavar="TABLE",
        help="readings of the sensor, still and untouched (fx .. tz): the floor of a table without"
        " time",
    )
    add_arm(parser)


def output_folders(inputs: Sequence[Place], output: Path | None) -> dict[Any, Path]:
    """Return each input's directory.

    Args:
        inputs: Paths or URLs.
        output: Directory of one input, or in which those of several are; None for the working
            directory.

    Returns:
        `diagnosis_NAME` by input, or `output` itself.

    Raises:
        GalenError: Two inputs would go to one directory.

    """
    folders: dict[Any, Path] = {}
    for path in inputs:
        name = f"diagnosis_{_name(path)}"
        if output is None:
            folder = Path(name)
        else:
            folder = output if len(inputs) == 1 else output / name
        if folder in folders.values() or path in folders:
            raise GalenError(
                f"{path}: {folder} would be written twice; diagnose inputs of the same name one by"
                " one, with --output"
            )
        folders[path] = folder
    return folders


def _name(path: Place) -> str:
    if isinstance(path, str):
        return name_of(path)
    return path.stem if path.is_file() else path.resolve().name or "recording"


# Recordings


def _recordings(arguments: argparse.Namespace, console: Console) -> int:
    # A cluster's workers have another working directory.
    local = Path.absolute if arguments.scheduler else Path

    def seen(one: Place) -> Place:
        return local(one) if isinstance(one, Path) else one

    found = find_recordings([seen(one) for one in arguments.inputs], BAGS, RECORDING_FILES)
    recordings = [recording.place for recording in found]
    tool = None if arguments.tool is None else seen(arguments.tool)
    job = Job(
        tool,
        folders={},
        report=not arguments.no_report,
        overwrite=arguments.overwrite,
        inertial_forces=arguments.inertial_forces,
        check_setup=not arguments.no_setup_check,
        wrench_frame=arguments.wrench_frame,
        specification=tuple(
            local(one) if isinstance(one, Path) else one for one in arguments.specification
        ),
        reference=tuple(seen(one) for one in arguments.reference),
    )
    if arguments.results is not None:
        output = None if arguments.output is None else local(arguments.output)
        job = replace(job, output=output, name_parts=name_depth(recordings))
        archive = Archive(job, seen(arguments.results), _known(tool, arguments))
        return _archive(archive, found, arguments)
    folders = output_folders(recordings, arguments.output)
    job = replace(job, folders={place: local(folder) for place, folder in folders.items()})
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


def _known(tool: Place | None, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what a result depends on beside its recording."""
    known = {"diagnose": RESULT_VERSION, "inertial_forces": arguments.inertial_forces}
    if arguments.wrench_frame != "sensor":
        known["wrench_frame"] = arguments.wrench_frame
    if arguments.specification:
        specification_of(arguments.specification, dict.fromkeys(LIMITED))  # or raise
        files = [path_of(one).read_bytes() for one in arguments.specification]
        known["specification_sha256"] = sha256(b"\n".join(files)).hexdigest()
    if arguments.reference:
        known["reference"] = [str(one) for one in arguments.reference]
    if tool is not None:
        with local_copy(tool) as path:
            if not path.is_file():
                read_calibration(path, GALEN)  # one message, and not one a recording
            known["tool_sha256"] = sha256(path.read_bytes()).hexdigest()
    return known


def _archive(
    archive: Archive, recordings: Sequence[ArchivedRecording], arguments: argparse.Namespace
) -> int:
    summary = archive.run(
        recordings, COLUMNS, to_row, scheduler=arguments.scheduler, workers=arguments.workers
    )
    print_summary(summary, as_json=arguments.json)
    return EXIT_FAILED if summary["failed"] else _code(arguments, list(summary["verdicts"]))


def _one(job: Job, recording: Place, arguments: argparse.Namespace, console: Console) -> int:
    with ProgressLine(quiet=arguments.json) as line:
        diagnosis = job.diagnose(recording, lambda stage, share: line.show(stage, share, 1.0))
    if arguments.next is not None:
        if diagnosis.experiment is None:
            print(f"diagnose: {arguments.next} not written: {_why_none(diagnosis.answer)}",
                  file=sys.stderr)  # fmt: skip
        else:
            write_sweep(diagnosis.experiment, arguments.next, diagnosis.rows.arm)
    if arguments.json:
        print_json(diagnosis.answer.to_json())
    else:
        _print(diagnosis.answer, job.folders[recording], console)
        if arguments.next is not None and diagnosis.experiment is not None:
            console.print(f"next experiment: {arguments.next}", soft_wrap=True, markup=False)
    return _code(arguments, [diagnosis.answer.verdict])


def _print(answer: Answer, folder: Path, console: Console) -> None:
    print_answer(answer, console)
    console.print(f"written: {folder}", soft_wrap=True, markup=False)


def _why_none(answer: Answer) -> str:
    if answer.verdict == "ambiguous":
        return "no experiment that is known here would separate the causes that are left"
    return f"the verdict is {answer.verdict}, so no causes are left to separate"


def _code(arguments: argparse.Namespace, verdicts: Sequence[str]) -> int:
    if arguments.fail_on_gap and any(verdict != "none" for verdict in verdicts):
        return EXIT_GAP
    return EXIT_OK


# Tables


def _tables(kind: Kind, arguments: argparse.Namespace, console: Console) -> int:
    inputs = arguments.inputs if kind == "table" else arguments.inputs[:1]
    folders = output_folders(inputs, arguments.output)
    for folder in folders.values():
        check_output(folder, overwrite=arguments.overwrite)
    answers = []
    for path, folder in folders.items():
        with ProgressLine(quiet=arguments.json) as line:
            draw: Callable[[Path], Mapping[str, Path]] = _no_pictures
            if kind == "table":
                diagnosis = diagnose_recording(
                    _table(path, arguments),
                    progress=lambda stage, share: line.show(stage, share, 1.0),
                )
                answer, draw = diagnosis.answer, partial(_draw, diagnosis)
            else:
                answer = diagnose_runs(_name(path), _runs(arguments), line.show)
        write_output(
            answer,
            folder,
            files={},
            draw=None if arguments.no_report else draw,
            overwrite=arguments.overwrite,
        )
        if not arguments.json:
            _print(answer, folder, console)
        answers.append(answer)
    if arguments.json:
        content = [answer.to_json() for answer in answers]
        print_json(content[0] if len(content) == 1 else content)
    return _code(arguments, [answer.verdict for answer in answers])


def _runs(arguments: argparse.Namespace) -> LagRows:
    runs = read_joint_runs(arguments.inputs, joint_columns(arguments))
    return rows_of_runs(
        runs, whole_runs(runs) if len(runs) >= _RUNS else time_blocks(runs, _BLOCKS)
    )


def _table(path: Path, arguments: argparse.Namespace) -> DiagnosticRecording:
    columns = arguments.columns.split(",") if arguments.columns else None
    arm = chosen_arm(arguments)
    table, *references = (
        read_table(one, columns, arguments.wrench_frame, arm=arm)
        for one in (path, *arguments.reference)
    )
    for option in ("noise", "tool"):
        if references and getattr(arguments, option) is not None:
            raise GalenError(
                f"--{option} beside --reference: load and noise of a table are then the"
                " reference's; leave out one of the two"
            )
    found = check_setup(still_readings(table))
    if found is not None and found.gross and not arguments.no_setup_check:
        raise SetupError(f"{path}: {found.sentence}; --no-setup-check diagnoses it all the same")
    return table_recording(
        table,
        noise=None if arguments.noise is None else _noise(arguments.noise),
        tool=None if arguments.tool is None else read_calibration(arguments.tool, arm),
        references=references,
        specification=specification_of(arguments.specification, dict.fromkeys(LIMITED))
        if arguments.specification
        else None,
    )


def _noise(path: Path) -> Array:
    text = read_text_table(path, set(WRENCH_AXES))
    return np.column_stack([text.require(axis) for axis in WRENCH_AXES])


def _kind(given: Sequence[str]) -> Kind:
    """Return the kind of the first input."""
    words = [word for word in given if word not in ("-h", "--help")]
    if all(word.startswith("-") for word in words):
        return "recording"
    known, others = build_parser().parse_known_args(words)
    tables = [path for path in known.inputs if isinstance(path, Path) and path.is_file()]
    if not tables:
        return "recording"
    named = [word.partition("=")[2] for word in others if word.startswith("--columns=")]
    named += [word for flag, word in pairwise(words) if flag == "--columns"]
    # Columns of a joint are given as ROLE=NAME, those of a table without names in their order.
    of_joint = "=" in named[0] if named else not _first_words(tables[0]) >= _WRENCH
    return "joint" if of_joint else "table"


def _first_words(table: Path) -> set[str]:
    """Words of the first line that is no comment, and of the comments before it."""
    words: list[str] = []
    with table.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            words += re.split(r"[,;\s\"'\[\]()%#]+", line.lower())
            if line.strip() and line.lstrip()[0] not in "#%":
                break
    return set(words)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point.

    Args:
        args: Command line; None for the process's own.

    Returns:
        The exit code.

    """
    given = sys.argv[1:] if args is None else list(args)
    kind = _kind(given)
    parser = build_parser(kind)
    arguments = parser.parse_args(given)
    if kind != "recording":
        return run_command("diagnose", lambda: _tables(kind, arguments, terminal(170)))
    if arguments.next is not None and (len(arguments.inputs) > 1 or arguments.results):
        parser.error("--next is for one RECORDING, without --results")
    return run_command("diagnose", lambda: _recordings(arguments, terminal()))


if __name__ == "__main__":
    sys.exit(main())
