"""Resolve requirements/*.in to exact pins in requirements/*.txt.

Run it with the oldest supported Python (3.11), so that the pins install on the newer one too:

    python3.11 scripts/lock_requirements.py

A file holds only what the files before it do not hold, in the order of ``GROUPS``. Groups that
are named on the command line alone are resolved anew; the files of the others count as they are.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

GROUPS = ("runtime", "dev", "build", "ros", "docs", "arms", "networks")
REQUIREMENTS = Path(__file__).resolve().parent.parent / "requirements"


def resolve(groups: list[str], constraints: dict[str, str]) -> dict[str, str]:
    """Return the version of every distribution that pip would install for ``groups``."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        constraint_file = Path(folder, "constraints.txt")
        constraint_file.write_text("".join(f"{n}=={v}\n" for n, v in constraints.items()))
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run"]
        command += ["--ignore-installed", "--report", str(report), "-c", str(constraint_file)]
        for group in groups:
            command += ["-r", str(REQUIREMENTS / f"{group}.in")]
        subprocess.run(command, check=True)
        items = json.loads(report.read_text())["install"]
    found = {item["metadata"]["name"].lower(): item["metadata"]["version"] for item in items}
    return dict(sorted(found.items()))


def main() -> None:
    """Write the lock files."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}")
    wanted = parser.parse_args().groups or GROUPS
    if unknown := sorted(set(wanted) - set(GROUPS)):
        parser.error(f"there is no group {', '.join(unknown)}")
    pins: dict[str, str] = {}
    for number, group in enumerate(GROUPS, start=1):
        if group not in wanted:
            lines = (REQUIREMENTS / f"{group}.txt").read_text().splitlines()[1:]
            pins.update({name: pin for name, _, pin in (line.partition("==") for line in lines)})
            continue
        found = resolve(list(GROUPS[:number]), pins)
        lines = [f"# Made from {group}.in by scripts/lock_requirements.py; do not edit."]
        lines += [f"{name}=={version}" for name, version in found.items() if name not in pins]
        (REQUIREMENTS / f"{group}.txt").write_text("\n".join(lines) + "\n")
        pins.update(found)
        print(f"{group}.txt: {len(lines) - 1} distributions")


if __name__ == "__main__":
    main()
