# SPDX-License-Identifier: Apache-2.0
"""Measures how fast everything is, each against a baseline in the same run: tables, and JSON.

python -m galen_validation.speed --output output/bench.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from galen_common.command import check_file
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from rich.console import Console

from galen_validation.speed import bags, computing, diagnosis, nodes, startup

_EPILOG = """\
groups:
  nodes     gravcomp and deflection against bare rclpy relays: latency, CPU, loss
  compute   one sample, arrays, a calibration's regression, hysteresis
  startup   each node, from its process' start till others see it
  diagnose  one recording, by part
  bags      evaluate on a bag against only reading it

Least/median/largest of the rounds where a cell has three numbers. Nothing else should run
meanwhile: the load average before each group is in the JSON. Ends with 0; 1: a subject failed."""


GROUPS: dict[str, ModuleType] = {
    "nodes": nodes,
    "compute": computing,
    "startup": startup,
    "diagnose": diagnosis,
    "bags": bags,
}
"""Each module has a `TITLE`, `measure(options, progress)` and a `table` of what that gives."""


def machine() -> dict[str, Any]:
    """Describe the machine."""
    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def build_parser() -> argparse.ArgumentParser:
    """Build the command's options."""
    parser = argparse.ArgumentParser(
        prog="make bench",
        description=(__doc__ or "").partition("\n")[0],
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS), help="groups")
    parser.add_argument(
        "--rates", type=float, nargs="+", default=[500.0, 1000.0, 2000.0], help="of nodes, Hz"
    )
    parser.add_argument(
        "--subjects", nargs="+", metavar="NAME", help="of nodes, by the table's names: these only"
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run of a node (8)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each subject (3)")
    parser.add_argument("--hours", type=float, nargs="+", default=[0.25], help="of bags (0.25)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write all as JSON as well")
    parser.add_argument("--json", action="store_true", help="print JSON in place of tables")
    return parser


def run(
    options: argparse.Namespace, console: Console, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Measure the groups that are asked for and print each one's table when it is done.

    Args:
        options: The command's options.
        console: Where tables are printed.
        progress: Called with what is measured next; with an empty text after a group.

    Returns:
        JSON content: the machine, and by group the load average before it and its measurements.

    """
    out: dict[str, Any] = {"machine": machine()}
    for name in options.only:
        group = GROUPS[name]
        load = os.getloadavg()[0]
        found = group.measure(options, progress)
        out[name] = {"load_before": load, "measured": [asdict(one) for one in found]}
        progress("")
        console.rule(f"[bold]{group.TITLE}", align="left")
        console.print(group.table(found))
    return out


def main(arguments: Iterable[str] | None = None) -> None:
    """Be the command.

    Args:
        arguments: Command line; None for the process's own.

    """
    parser = build_parser()
    options = parser.parse_args(None if arguments is None else list(arguments))
    try:
        check_file(options.output)
    except GalenError as error:
        parser.error(str(error))
    tables = Console(quiet=options.json, width=None if sys.stdout.isatty() else 190)
    line = Console(stderr=True)
    status = line.status("")

    def progress(what: str) -> None:
        if line.is_terminal:
            status.update(what)
        elif what:
            line.print(what)

    with status:
        found = run(options, tables, progress)
    text = json.dumps(found, indent=1)
    if options.output:
        write_whole(options.output, text + "\n")
    if options.json:
        print(text)


if __name__ == "__main__":
    main()
