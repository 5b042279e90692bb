"""`blind_check`: the diagnosis on recordings whose cause it can't know, and what came of it.

Recordings are made by an arm in MuJoCo (`blind/mujoco_arm.py`). Their labels are sealed and the
hash is printed; another process diagnoses; then the labels are opened and all is scored, beside
simpler methods. `blind/blind_protocol.py` says what is hidden from whom.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_ros.command import (
    EXIT_OK,
    add_json,
    add_workers,
    check_folder,
    make_parser,
    not_negative,
    run_command,
    terminal,
    whole,
    writing,
)
from rich.markdown import Markdown

from galen_diagnosis.blind.blind_protocol import (
    DIAGNOSING,
    Places,
    answered,
    baselines,
    diagnose_blind,
    open_labels,
    sealed_set,
)
from galen_diagnosis.blind.case import generate
from galen_diagnosis.blind.labels import forget, private_directory
from galen_diagnosis.blind.making import Generate, Plan, full_plan, short_plan
from galen_diagnosis.blind.mujoco_arm import require_mujoco
from galen_diagnosis.blind.score import PROGRAM, Answered, Score, markdown, score, wrong_answers
from galen_diagnosis.effects.candidates import SOUGHT

_NOTES = """An interrupted check goes on where it stopped, if it is called again with the same
options and --output. A finished one is only scored again. Single diagnoses that failed count as
wrong."""


def build_parser() -> argparse.ArgumentParser:
    """Return the command's options."""
    parser = make_parser(
        "blind_check",
        "Make recordings with hidden causes, seal the labels, diagnose in another"
        " process that can't read them, open, and score beside simpler methods.",
        notes=_NOTES,
        ok="done; whatever the score, but for --at-least",
        failed="no recordings can be made or diagnosed, the labels aren't those that were sealed,"
        " or the score is below --at-least",
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--per-class",
        type=whole(1),
        default=3,
        metavar="N",
        help="recordings of each effect at each strength; others in proportion (default:"
        " %(default)s)",
    )
    size.add_argument(
        "--short", action="store_true", help="one recording of each sort: a check of the program"
    )
    parser.add_argument(
        "--seed",
        type=whole(0),
        metavar="N",
        help="makes the same recordings again (default: a random one, shown when all is open)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="recordings (some 20 MB each), answers, labels and score (default: nothing is kept)",
    )
    parser.add_argument(
        "--at-least",
        type=_share,
        metavar="SHARE",
        help="exit with 1 if a diagnosis failed, or top-1 by class of clear and gross singles (what"
        " the recording can't separate taken as one) is below this, 0 ... 1; with --short also if"
        " one of its answers is wrong; for CI",
    )
    add_json(parser)
    add_workers(parser)
    return parser


def _share(text: str) -> float:
    value = not_negative(text)
    if value > 1.0:
        raise argparse.ArgumentTypeError(f"{text} is above 1")
    return value


def run(
    arguments: argparse.Namespace,
    output: Path,
    command: Sequence[str] = DIAGNOSING,
    generate: Generate = generate,
) -> int:
    """Run the whole check in `output`; returns the exit code; raises GalenError."""
    check_folder(output)
    places = Places(output)
    if not places.labels.exists():
        require_mujoco()
    wanted: dict[str, Any] = {
        "short": arguments.short,
        "per_class": None if arguments.short else arguments.per_class,
    }

    def plan(seed: int) -> Plan:
        return short_plan(seed) if arguments.short else full_plan(seed, arguments.per_class)

    started_s = time.monotonic()
    sha256 = sealed_set(places, wanted, arguments.seed, plan, arguments.workers, generate)
    made_s = time.monotonic()
    _say(arguments, f"labels sealed before any diagnosis, SHA-256 {sha256}")
    if not places.labels.exists():
        locked_out = diagnose_blind(places, arguments.workers, arguments.scheduler, command)
        if arguments.scheduler is not None:
            how = "a scheduler's workers, which nothing but ignorance kept from labels"
        elif locked_out:
            how = "a process that the system kept from reading the labels"
        else:
            how = (
                "a process that doesn't know where the labels are; this system can't keep it from"
                " reading them"
            )
        _say(arguments, f"diagnosed by {how}")
    labels = open_labels(places, sha256)
    _say(arguments, "labels opened: they are those that were sealed")
    ended_s = time.monotonic()
    cases = answered(places, labels)
    beside = baselines(places, labels)
    scores = {
        name: score(found, tuple(SOUGHT)) for name, found in {PROGRAM: cases, **beside}.items()
    }
    content = {
        "schema_version": 2,
        "labels_sha256": sha256,
        "making_s": made_s - started_s,
        "diagnosing_s": ended_s - made_s,
        "scores": {name: one.to_json() for name, one in scores.items()},
    }
    tables = markdown(scores)
    for name, text in (("json", json.dumps(content, indent=1)), ("md", tables + "\n")):
        path = output / f"blind_check.{name}"
        with writing(path):
            write_whole(path, text)
    if arguments.json:
        print(json.dumps(content, indent=1))
    else:
        terminal(150).print(Markdown(tables))
    if scores[PROGRAM].failed == len(labels):
        raise GalenError(f"{output}: no recording could be diagnosed; {_first_failure(places)}")
    if arguments.at_least is not None:
        check_score(scores[PROGRAM], arguments.at_least)
        if arguments.short:
            check_answers(cases)
    return EXIT_OK


def check_score(found: Score, at_least: float) -> None:
    """Raise GalenError unless all were diagnosed and enough singles were right."""
    if found.failed:
        raise GalenError(f"{found.failed} of {found.cases} diagnoses failed")
    reached = found.numbers["top1_by_class_accepted"]
    if reached is not None and reached < at_least:
        raise GalenError(f"top-1 by class is {reached:.3f}, below the {at_least:g} wanted")


def check_answers(cases: Sequence[Answered]) -> None:
    """Raise GalenError unless every answer is right, verdict and causes."""
    if wrong := wrong_answers(cases):
        raise GalenError(f"{len(wrong)} of {len(cases)} answers are wrong: {'; '.join(wrong)}")


def _say(arguments: argparse.Namespace, text: str) -> None:
    """Print beside what --json prints."""
    print(text, file=sys.stderr if arguments.json else sys.stdout, flush=True)


def _first_failure(places: Places) -> str:
    for path in sorted(places.answers.glob("*/failed.txt")):
        return path.read_text(encoding="utf-8").strip()
    return "the diagnosing process gave no reason"


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = build_parser().parse_args(args)

    def work() -> int:
        if arguments.output is not None:
            return run(arguments, arguments.output)
        with tempfile.TemporaryDirectory(prefix="galen_blind_check_") as folder:
            try:
                return run(arguments, Path(folder))
            finally:
                forget(private_directory(Path(folder)))

    return run_command("blind_check", work)


if __name__ == "__main__":
    sys.exit(main())
