# SPDX-License-Identifier: Apache-2.0
"""The diagnosing process: gets recordings, leaves an answer of each method for each.

    python -m galen_validation.blind.diagnosing RECORDINGS ANSWERS LABELS [--workers N]

Where the system can, it first takes the right to read LABELS from itself and its children.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from galen_bags.many import run_many
from galen_common.command import EXIT_OK, run_command, whole
from galen_model.files.atomic_file import write_whole

from galen_validation.blind import confine
from galen_validation.blind.answers import ANSWER
from galen_validation.blind.session import REFERENCE

PROGRAM = "galen_diagnosis"
Diagnose = Callable[[Path], Mapping[str, Any]]
"""Returns the answers to a recording, as JSON, by method."""


def diagnosed(recording: Path) -> dict[str, Any]:
    """Return the baselines' answers and the program's to one recording.

    Args:
        recording: Directory of the recording.

    Returns:
        Answers in the form of `diagnosis.json` by method; the program's is the last, with its wall
        time `seconds`.

    Raises:
        GalenError: The recording can't be read or diagnosed.

    """
    from galen_bags.arrays.tables import read_table
    from galen_diagnosis.inference.diagnosing import diagnose_recording
    from galen_diagnosis.observation.observation import Observation
    from galen_diagnosis.observation.recording import read_recording
    from galen_diagnosis.tables.orientations import table_recording
    from galen_model.arm.galen import GALEN

    from galen_validation.blind.baselines import answers
    from galen_validation.blind.measured_tables import EARLIER, TABLE, simple_table_answers

    started_s = time.monotonic()
    if (recording / TABLE).exists():
        table, reference = (read_table(recording / name, arm=GALEN) for name in (TABLE, EARLIER))
        found = diagnose_recording(table_recording(table, references=[reference])).answer.to_json()
        own = {**found, "seconds": time.monotonic() - started_s}
        return {**simple_table_answers(recording), PROGRAM: own}
    given = specified(recording)
    read = read_recording(recording, specification=given)
    earlier = [
        read_recording(folder, specification=given)
        for folder in [recording / REFERENCE]
        if folder.exists()
    ]
    found = diagnose_recording(read, references=earlier).answer.to_json()
    own = {**found, "seconds": time.monotonic() - started_s}
    return {**answers(Observation(read)), PROGRAM: own}


def specified(recording: Path) -> tuple[str, ...]:
    """Return the specification of a set's recording: its file, or that of a calibrated arm.

    Args:
        recording: Directory of the recording.

    Returns:
        As `read_recording` takes it; () for the recording's own file.

    """
    from galen_diagnosis.observation.specification import CALIBRATED, SPECIFICATION_FILE

    return () if (recording / SPECIFICATION_FILE).exists() else (CALIBRATED,)


def diagnose_one(recording: Path, answers: Path, diagnose: Diagnose = diagnosed) -> None:
    """Write the answers to one recording, the program's last; called in any process.

    Args:
        recording: Directory of the recording.
        answers: Folder that gets METHOD/RECORDING/diagnosis.json.
        diagnose: Returns the answers by method; tests replace it.

    """
    for method, answer in diagnose(recording).items():
        write_whole(answers / method / recording.name / ANSWER, json.dumps(answer, indent=1))


def main(args: Sequence[str] | None = None, diagnose: Diagnose = diagnosed) -> int:
    """Diagnose what has no answer yet.

    Args:
        args: Command line; None for the process's own.
        diagnose: Returns the answers to a recording by method.

    Returns:
        The exit code, 0 also where recordings couldn't be diagnosed.

    """
    parser = argparse.ArgumentParser(prog="blind_check: diagnosing")
    for name in ("recordings", "answers", "labels"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--workers", type=whole(1))
    given = parser.parse_args(args)
    if confine.available():
        confine.lock_out(given.labels)

    def work() -> int:
        waiting = [
            folder
            for folder in sorted(given.recordings.iterdir())
            if not (given.answers / PROGRAM / folder.name / ANSWER).exists()
        ]
        one = partial(diagnose_one, answers=given.answers, diagnose=diagnose)
        for outcome in run_many(one, waiting, workers=given.workers):
            if outcome.error is not None:
                print(f"{Path(str(outcome.bag)).name}: {outcome.error}", file=sys.stderr)
        return EXIT_OK

    return run_command(parser.prog, work)


if __name__ == "__main__":
    sys.exit(main())
