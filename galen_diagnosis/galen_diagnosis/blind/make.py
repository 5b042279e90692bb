"""`python -m galen_diagnosis.blind.make`: one recording of the blind arm, with its truth."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from galen_model.files.atomic_file import write_whole
from galen_ros.command import EXIT_OK, add_json, check_file, make_parser, run_command

from galen_diagnosis.blind.plant.case import KINDS, STRENGTHS, Case, generate
from galen_diagnosis.blind.plant.listed import EFFECTS
from galen_diagnosis.blind.plant.session import BAGS
from galen_diagnosis.blind.plant.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = make_parser(
        "python -m galen_diagnosis.blind.make",
        "Make a diagnostic recording with a hidden cause, by other laws than the "
        "diagnosis fits. What the seed doesn't draw can be given.",
        ok="the recording is written",
        failed="the recording can't be written",
    )
    parser.add_argument("--kind", choices=KINDS, default="single", help="(default: %(default)s)")
    parser.add_argument(
        "--effect",
        action="append",
        default=[],
        choices=(*EFFECTS, *CALIBRATION_UNKNOWN, *TEST_UNKNOWN),
        metavar="NAME",
        help="of the contract or an unlisted kind; twice for a pair (default: drawn)",
    )
    parser.add_argument(
        "--strength", choices=tuple(STRENGTHS), default="clear", help="(default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=1.0,
        metavar="SCALE",
        help="of the healthy arm's differences, 0 for an exactly nominal one (default: 1)",
    )
    parser.add_argument(
        "--bags", nargs="+", choices=BAGS, default=list(BAGS), help="(default: all three)"
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="DIR", help="new folder"
    )
    parser.add_argument("--truth", type=Path, metavar="FILE", help="write the truth there (JSON)")
    parser.add_argument(
        "--twin", type=Path, metavar="DIR", help="write the same there without the cause"
    )
    add_json(parser, "print the truth as JSON")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error("--seed is a number from 0 on")
    return run_command("make", lambda: _make(options))


def _make(options: argparse.Namespace) -> int:
    case = Case(
        options.seed,
        options.kind,
        tuple(options.effect),
        options.strength,
        tuple(bag for bag in BAGS if bag in options.bags),
        options.tolerance,
    )
    check_file(options.truth)
    truth = generate(case, options.output, options.twin).to_json()
    if options.truth is not None:
        write_whole(options.truth, json.dumps(truth, indent=1) + "\n")
    if options.json:
        print(json.dumps(truth))
        return EXIT_OK
    for line in _lines(truth):
        print(line)
    return EXIT_OK


def _lines(truth: dict[str, Any]) -> list[str]:
    if not truth["effects"]:
        return ["none: a healthy arm"]
    rows = zip(truth["effects"], truth["d"], truth["acceptable"], strict=True)
    return [
        f"{effect['effect']}  D = {d:.1f}  {json.dumps(effect['parameters'])}  "
        f"right: {', '.join(names)}"
        for effect, d, names in rows
    ]


if __name__ == "__main__":
    sys.exit(main())
