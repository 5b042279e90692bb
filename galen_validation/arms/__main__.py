# SPDX-License-Identifier: Apache-2.0
"""Shows the suite on arms that the project did not write, in docs/results/arms.md."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

from galen_model.errors import GalenError

from galen_validation.arms import kinematics
from galen_validation.arms.calibrations import coverage, through_the_action
from galen_validation.arms.recordings import measured_panda, ur5_in_mujoco

OUTPUT = Path(__file__).parents[2] / "docs/results/arms.md"
PARTS: dict[str, tuple[str, Callable[[], str]]] = {
    "kinematics": ("Kinematics", kinematics),
    "action": ("Calibrated through the action, in simulation", through_the_action),
    "covariance": ("Covariance", coverage),
    "mujoco": ("A UR5 in MuJoCo", ur5_in_mujoco),
    "panda": ("A measured Panda", measured_panda),
}
"""Title and content of each part, in the document's order."""

_HEAD = """# Arms that the project did not write

Made by `make arms`; parts alone by `make arms ARGS="panda mujoco"`. Descriptions are those of
example-robot-data 6.0.0. σ is the standard deviation that the suite states with its result; noise
is that of one reading, rounding included.
"""


def document(old: str, made: dict[str, str]) -> str:
    """Return the text with the parts that were made, the others as they were.

    Args:
        old: The present text; empty for none.
        made: Markdown by the part's name in `PARTS`.

    Returns:
        The whole document; parts that are in neither are left out.

    """
    held = dict(re.findall(r"^## (.+?)\n\n(.*?)\n*(?=^## |\Z)", old, re.MULTILINE | re.DOTALL))
    held |= {PARTS[name][0]: text for name, text in made.items()}
    sections = [f"## {title}\n\n{held[title]}\n" for title, _ in PARTS.values() if title in held]
    return "\n".join([_HEAD, *sections])


def main(arguments: list[str] | None = None) -> int:
    """Make parts of the document; one that can't be made is left as it was.

    Args:
        arguments: Command line; None for the process's own.

    Returns:
        Exit code; 1 where a part could not be made.

    """
    parser = argparse.ArgumentParser(prog="make arms", description=__doc__)
    parser.add_argument("part", nargs="*", help=f"of {', '.join(PARTS)} (default: all)")
    chosen = parser.parse_args(arguments).part or list(PARTS)
    if unknown := sorted(set(chosen) - set(PARTS)):
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    failed = False
    for name in chosen:
        print(f"{name} ...", flush=True)
        try:
            text = PARTS[name][1]()
        except GalenError as error:
            print(f"error: {name}: {error}", file=sys.stderr)
            failed = True
            continue
        print(text, flush=True)
        old = OUTPUT.read_text(encoding="utf-8") if OUTPUT.exists() else ""
        OUTPUT.write_text(document(old, {name: text}), encoding="utf-8")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
