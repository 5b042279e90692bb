"""The diagnosing process: gets a directory of recordings, leaves an answer for each.

    python -m galen_diagnosis.blind.diagnosing RECORDINGS ANSWERS [--workers N]

It gets nothing else, and `confine` starts it so that it can't read the labels.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from galen_bags.many import run_many
from galen_model.files.atomic_file import write_whole
from galen_ros.command import EXIT_FAILED, EXIT_OK, add_workers, run_command

ANSWER, BESIDE, FAILED = "diagnosis.json", "beside.json", "failed.txt"


def diagnosed(recording: Path) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the program's answer and the baselines' on the same rows, as JSON."""
    from galen_diagnosis.blind.baselines import answers
    from galen_diagnosis.inference.diagnosing import diagnose_recording
    from galen_diagnosis.observation.observation import Observation
    from galen_diagnosis.observation.recording import read_recording

    started_s = time.monotonic()
    read = read_recording(recording)
    found = diagnose_recording(read)
    seconds = time.monotonic() - started_s
    return found.answer.to_json(), {"seconds": seconds, "baselines": answers(Observation(read))}


Diagnose = Callable[[Path], tuple[Mapping[str, Any], Mapping[str, Any]]]


def diagnose_one(recording: Path, answers: Path, diagnose: Diagnose = diagnosed) -> None:
    """Write the answer last, so that it is there only when all is; called in any process."""
    answer, beside = diagnose(recording)
    folder = answers / recording.name
    write_whole(folder / BESIDE, json.dumps(beside))
    write_whole(folder / ANSWER, json.dumps(answer, indent=2))


def diagnose_all(
    recordings: Path,
    answers: Path,
    diagnose: Diagnose = diagnosed,
    workers: int | None = None,
    scheduler: str | None = None,
) -> int:
    """Diagnose what has no answer yet; returns how many failed, which say why in a file."""
    waiting = [
        folder
        for folder in sorted(recordings.iterdir())
        if not (answers / folder.name / ANSWER).exists()
    ]
    one = partial(diagnose_one, answers=answers, diagnose=diagnose)
    outcomes = run_many(one, waiting, scheduler=scheduler, workers=workers)
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    for outcome in failed:
        write_whole(answers / outcome.bag.name / FAILED, f"{outcome.error}\n")
    return len(failed)


def main(args: Sequence[str] | None = None, diagnose: Diagnose = diagnosed) -> int:
    """Entry point; returns the exit code: that some recordings failed is for the score."""
    parser = argparse.ArgumentParser(prog="blind_check: diagnosing")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("answers", type=Path)
    add_workers(parser)
    given = parser.parse_args(args)
    os.environ["OMP_NUM_THREADS"] = "1"

    def work() -> int:
        failed = diagnose_all(
            given.recordings, given.answers, diagnose, given.workers, given.scheduler
        )
        total = sum(1 for _ in given.recordings.iterdir())
        return EXIT_FAILED if failed == total else EXIT_OK

    return run_command("blind_check: diagnosing", work)


if __name__ == "__main__":
    sys.exit(main())
