#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make the environment, build the workspace, and run commands in it.

    python3 scripts/setup_env.py setup     make .venv
    python3 scripts/setup_env.py build     make .venv and build the packages
    python3 scripts/setup_env.py dev       make .venv, and add what tests and checks the packages
    python3 scripts/setup_env.py networks  make .venv, and add PyTorch to it
    python3 scripts/setup_env.py arms      make .venv, and add descriptions of other robots to it
    python3 scripts/setup_env.py docs      make .venv, and add what builds the documentation

Any Python 3 from 3.8 on may start it; it looks for the one that the environment needs.
"""

import sys

if sys.version_info < (3, 8):  # noqa: UP036 - the script may be started by an old Python
    sys.exit("error: scripts/setup_env.py needs Python 3.8 or newer to start")

import argparse
import os
from pathlib import Path

from workspace.build import build
from workspace.environment import OPTIONAL_GROUPS, Environment
from workspace.machine import SetupError, exclusive, shared

ROOT = Path(__file__).resolve().parent.parent


def main(arguments: "list[str] | None" = None) -> int:
    """Do what the command line says; an expected error is one line and exit code 1."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "step",
        choices=("setup", "build", *OPTIONAL_GROUPS),
        help="setup: .venv only; dev: and tools of tests; docs: and MkDocs; networks: and PyTorch;"
        " arms: and robots",
    )
    options = parser.parse_args(arguments)
    try:
        do(options.step, Environment(ROOT, os.environ))
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nerror: interrupted; the next run starts that step again", file=sys.stderr)
        return 130
    return 0


def do(step: str, environment: Environment) -> None:
    """Make `.venv` where it is not ready, then go on in it.

    A build and the installation of an optional group may go side by side; while either does, no
    process makes `.venv` anew.
    """
    lock = ROOT / ".workspace.lock"
    while True:
        with shared(lock):
            if environment.is_ready():
                with exclusive(ROOT / f".workspace.{step}.lock"):
                    go_on(step, environment)
                return
        with exclusive(lock):
            environment.make()


def go_on(step: str, environment: Environment) -> None:
    """Do what comes after `.venv`."""
    if step in OPTIONAL_GROUPS:
        environment.add(step)
    elif step == "build":
        build(environment)


if __name__ == "__main__":
    sys.exit(main())
