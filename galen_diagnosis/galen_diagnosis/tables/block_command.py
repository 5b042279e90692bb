"""What `diagnose_table` and `diagnose_joints` share: from rows to an answer, shown or written."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.evidence.held_out import BlockEvidence
from galen_model.evidence.search import SearchSettings, search
from galen_model.files.atomic_file import write_whole
from galen_ros.command import check_folder, progress, terminal, writing

from galen_diagnosis.tables.block_answer import BlockDiagnosis, conclude
from galen_diagnosis.tables.block_report import plot_diagnosis, print_diagnosis
from galen_diagnosis.tables.table_rows import Prepared

_TABLE_WIDTH = 170


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """How an answer is given."""
    parser.add_argument("--json", action="store_true", help="print diagnosis.json's content")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="write <name>_diagnosis.json here"
    )
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write a picture here")
    parser.add_argument("--label", metavar="TEXT", help="what it is called (default: the file's)")


def check_outputs(arguments: argparse.Namespace) -> None:
    """Raise GalenError before the work if what was asked for can't be written."""
    check_folder(arguments.plots)
    check_folder(arguments.output)


def diagnose_rows(
    name: str,
    prepared: Prepared,
    settings: SearchSettings | None = None,
    quiet: bool = True,
) -> BlockDiagnosis:
    """Search, and conclude from it."""
    evidence = BlockEvidence(prepared.rows, prepared.effects.nominal)
    with progress(0, "hypothesis", quiet=quiet) as bar:

        def show(text: str) -> None:
            bar.set_description(f"{name}: {text}", refresh=False)
            bar.update()

        found = search(evidence, prepared.effects, settings, show)
    return conclude(name, evidence, found, prepared.effects, prepared.words)


def give(found: list[BlockDiagnosis], arguments: argparse.Namespace) -> None:
    """Write and print what was found; raises GalenError where a file can't be written."""
    answers = [one.answer.to_json() for one in found]
    pictures: list[Path] = []
    if arguments.plots is not None:
        folder: Path = arguments.plots
        with writing(folder):
            pictures = [plot_diagnosis(one, folder) for one in found]
    if arguments.output is not None:
        for one, answer in zip(found, answers, strict=True):
            _write(arguments.output, one.answer.recording, answer)
    if arguments.json:
        print(json.dumps(answers[0] if len(answers) == 1 else answers, indent=2))
        return
    to = terminal(_TABLE_WIDTH)
    for one in found:
        print_diagnosis(one, to)
    for picture in pictures:
        to.print(f"plot: {picture}", soft_wrap=True)


def name_of(path: Path, label: str | None) -> str:
    """The label, or the file's name; neither is ever a path."""
    name = label or path.stem
    if not name.strip() or any(letter in name for letter in "/\\\0"):
        raise GalenError(f"--label {name!r}: a name, not a path")
    return name


def _write(folder: Path, name: str, answer: dict[str, object]) -> None:
    path = folder / f"{name}_diagnosis.json"
    try:
        write_whole(path, json.dumps(answer, indent=2) + "\n")
    except OSError as error:
        raise GalenError(f"{path}: can't be written: {error.strerror}") from error
    print(f"wrote {path}", file=sys.stderr)
