# SPDX-License-Identifier: Apache-2.0
"""Resolve requirements/*.in to exact pins with hashes in requirements/*.txt, with uv on PATH.

A file holds only what the files before it do not hold, in the order of ``GROUPS``. Pins stay as
they are where they can; with ``--upgrade`` the groups that are named are resolved anew.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path

from workspace.environment import read_pins

GROUPS = ("uv", "runtime", "build", "ros", "dev", "docs", "arms", "networks")
REQUIREMENTS = Path(__file__).resolve().parent.parent / "requirements"


def main() -> None:
    """Write the lock files."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--upgrade", action="store_true", help="take the newest versions")
    options = parser.parse_args()
    if unknown := sorted(set(options.groups) - set(GROUPS)):
        parser.error(f"there is no group {', '.join(unknown)}")
    held: list[str] = []
    for number, group in enumerate(GROUPS):
        path = REQUIREMENTS / f"{group}.txt"
        if not options.groups or group in options.groups:
            # The oldest supported Python, so that the pins install on the newer one too.
            command = ["uv", "pip", "compile", "--quiet", "--python-version", "3.11"]
            command += ["--generate-hashes", "--no-annotate", "--no-header", "-o", str(path)]
            command += ["--upgrade"] if options.upgrade else []
            for before in GROUPS[:number]:
                command += ["-c", str(REQUIREMENTS / f"{before}.txt")]
            for name in held:
                command += ["--no-emit-package", name]
            command += [str(REQUIREMENTS / f"{name}.in") for name in GROUPS[: number + 1]]
            subprocess.run(command, check=True)
            header = f"# Made from {group}.in by scripts/lock_requirements.py; do not edit.\n"
            text = path.read_text(encoding="utf-8")
            path.write_text(header + text.removeprefix(header), encoding="utf-8")
        pins = read_pins(path)
        held += pins
        print(f"{group}.txt: {len(pins)} distributions")


if __name__ == "__main__":
    main()
