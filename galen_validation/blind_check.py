# SPDX-License-Identifier: Apache-2.0
"""`blind_check`: recordings with hidden causes, for any diagnosis, and what came of it.

Recordings are made by an arm in MuJoCo (`blind/mujoco_arm.py`), their labels are sealed
(`blind/labels.py`), answers of any tool are scored (`blind/score.py`). `run` does all of it with
this program, in a process that can't read the labels (`blind/blind_protocol.py`).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from galen_common.command import (
    EXIT_OK,
    add_json,
    check_parent,
    make_parser,
    run_command,
    terminal,
    whole,
)
from galen_diagnosis.answer.answer import NONE
from galen_model.errors import GalenError
from rich.markdown import Markdown

from galen_validation.blind import blind_protocol, confine
from galen_validation.blind.answers import ANSWER
from galen_validation.blind.baselines import NAIVE_BIC, RMSE_DROP
from galen_validation.blind.blind_protocol import DIAGNOSING, Generate
from galen_validation.blind.case import generate
from galen_validation.blind.diagnosing import PROGRAM
from galen_validation.blind.labels import beside, open_labels, published_sha256
from galen_validation.blind.score import Answered, read_answers, score
from galen_validation.blind.table import fill, tables

_NOTES = """A recording takes some 20 MB, 10 to 40 s to make and 10 to 30 s to diagnose, on one
processor. An interrupted make or run goes on if it is called again with the same options."""


def build_parser() -> argparse.ArgumentParser:
    """Return the command's options."""
    parser = make_parser(
        "blind_check",
        "Make recordings with hidden causes and sealed labels; score any tool's answers.",
        notes=_NOTES,
        ok="done, whatever the score; of run --short: all six answers are right",
        failed="recordings can't be made or diagnosed, the labels aren't those that were sealed,"
        " no answer of the first tool is valid, or one of run --short is wrong",
    )
    steps = parser.add_subparsers(dest="step", required=True)
    make = steps.add_parser("make", help="make a set in SET, and its labels in SET.labels beside")
    run = steps.add_parser(
        "run", help="make, diagnose with this program into SET.answers beside, and score"
    )
    for step, many in ((make, None), (run, "?")):
        step.add_argument(
            "set",
            type=Path,
            nargs=many,
            metavar="SET",
            help="without one, run keeps nothing",
        )
        step.add_argument(
            "--per-class",
            type=whole(1),
            default=3,
            metavar="N",
            help="recordings of each effect at each strength; others in proportion (default:"
            " %(default)s)",
        )
        step.add_argument(
            "--healthy",
            type=whole(0),
            default=60,
            metavar="N",
            help="recordings without a cause (default: %(default)s)",
        )
        step.add_argument(
            "--short", action="store_true", help="six recordings: a check of the program"
        )
        step.add_argument(
            "--seed",
            type=whole(0),
            metavar="N",
            help="makes the same set again (default: a random one, which the labels name)",
        )
        step.add_argument(
            "--tables",
            type=Path,
            nargs="+",
            default=[],
            metavar="FILE",
            help="measured tables (fx .. tz and orientations, columns named in the first line):"
            " pairs of each, with an effect put in or none",
        )
        step.add_argument(
            "--workers", type=whole(1), metavar="N", help="processes (default: one a processor)"
        )
    scoring = steps.add_parser("score", help="compare tools' answers with the labels")
    scoring.add_argument("set", type=Path, metavar="SET", help="with labels.json in it or beside")
    scoring.add_argument(
        "answers",
        type=Path,
        nargs="+",
        metavar="ANSWERS",
        help=f"a tool's folder with <recording>/{ANSWER} or <recording>.json",
    )
    scoring.add_argument(
        "--page",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="Markdown whose tables, each between <!-- NAME --> and <!-- end -->, are written anew"
        " (made, score, classes, members, arms, notes)",
    )
    add_json(scoring)
    return parser


def make(arguments: argparse.Namespace, folder: Path, generate: Generate = generate) -> None:
    """Make the set and print the hash of its labels.

    Args:
        arguments: The command's options.
        folder: The set, new or begun with the same options.
        generate: Makes a recording in a directory; tests replace it.

    Raises:
        GalenError: The set can't be made.

    """
    check_parent(folder)
    if arguments.short and arguments.tables:
        raise GalenError("--tables beside --short, which has six recordings: leave out one of them")
    wanted = {name: getattr(arguments, name) for name in ("per_class", "healthy", "short")}
    published = blind_protocol.make(
        folder, wanted, arguments.seed, arguments.workers, generate, arguments.tables
    )
    print(f"labels sealed in {beside(folder, 'labels')}, SHA-256 {published}", flush=True)


def run(
    arguments: argparse.Namespace,
    folder: Path,
    command: Sequence[str] = DIAGNOSING,
    generate: Generate = generate,
) -> int:
    """Make a set, diagnose and score it.

    Args:
        arguments: The command's options.
        folder: The set; answers go into FOLDER.answers beside it.
        command: Start of the diagnosing process's command line.
        generate: Makes a recording in a directory.

    Returns:
        The exit code, 0.

    Raises:
        GalenError: Making or diagnosing fails, there is no valid answer, or one of a short set is
            wrong.

    """
    make(arguments, folder, generate)
    blind_protocol.diagnose(folder, arguments.workers, command)
    kept = "kept" if confine.available() else "can't keep"
    print(f"diagnosed by a process that this system {kept} from reading the labels", flush=True)
    tools = [beside(folder, "answers") / name for name in (PROGRAM, RMSE_DROP, NAIVE_BIC)]
    cases = scored(folder, [tool for tool in tools if tool.is_dir()] or tools[:1])
    wrong = [
        f"{case.label.recording}: verdict {case.verdict or case.why} of {case.label.names or NONE}"
        for case in cases
        if not case.solved
    ]
    if arguments.short and wrong:
        raise GalenError(f"{len(wrong)} of {len(cases)} answers are wrong: {'; '.join(wrong)}")
    return EXIT_OK


def scored(
    folder: Path, tools: Sequence[Path], pages: Sequence[Path] = (), as_json: bool = False
) -> list[Answered]:
    """Score tools side by side and print that.

    Args:
        folder: The set.
        tools: Folders of answers; tools go by the folders' names.
        pages: Markdown files whose tables are written anew.
        as_json: Whether to print JSON in place of tables.

    Returns:
        Labels with the answers of the first tool.

    Raises:
        GalenError: Labels aren't those that were sealed, two folders have the same name, a page
            can't be filled, or the first tool has no valid answer.

    """
    plan, labels = open_labels(folder)
    cases = {tool.resolve().name: read_answers(labels, tool) for tool in tools}
    if len(cases) < len(tools):
        raise GalenError("two folders of answers have the same name; tools go by their names")
    found = tables(cases, _made(folder, plan, len(labels)))
    if as_json:
        scores: dict[str, Any] = {tool: score(own).to_json() for tool, own in cases.items()}
        print(json.dumps({"labels_sha256": published_sha256(folder), "scores": scores}, indent=1))
    else:
        terminal(150).print(Markdown("\n\n".join(text for text in found.values() if text)))
    for page in pages:
        fill(page, found)
    first, own = next(iter(cases.items()))
    if labels and all(case.said is None for case in own):
        raise GalenError(f"{first}: no recording has a valid answer; the first: {own[0].why}")
    return own


def _made(folder: Path, plan: dict[str, Any], recordings: int) -> str:
    """Name the set of a table, and the day of its score."""
    options = "--short" if plan.get("short") else ""
    for name in () if options else ("per_class", "healthy"):
        options += f" --{name.replace('_', '-')} {plan.get(name)}"
    if tables_of := plan.get("tables"):
        options += f" --tables {' '.join(tables_of)}"
    return (
        f"{recordings} recordings of `python -m galen_validation.blind_check make SET"
        f" --seed {plan.get('seed')} {options.strip()}`, labels' SHA-256"
        f" `{published_sha256(folder)}`, scored on {datetime.now(UTC):%Y-%m-%d}. Intervals are"
        " Wilson's, 95 %."
    )


def main(args: Sequence[str] | None = None) -> int:
    """Entry point.

    Args:
        args: Command line; None for the process's own.

    Returns:
        The exit code.

    """
    arguments = build_parser().parse_args(args)

    def work() -> int:
        if arguments.step == "make":
            make(arguments, arguments.set)
        elif arguments.step == "score":
            scored(arguments.set, arguments.answers, arguments.page, arguments.json)
        elif arguments.set is not None:
            return run(arguments, arguments.set)
        else:
            with tempfile.TemporaryDirectory(prefix="galen_blind_check_") as kept:
                return run(arguments, Path(kept) / "set")
        return EXIT_OK

    return run_command("blind_check", work)


if __name__ == "__main__":
    sys.exit(main())
