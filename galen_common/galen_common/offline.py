# SPDX-License-Identifier: Apache-2.0
"""`galen COMMAND ...`: the commands that need no ROS, as `pip install .` installs them."""

from __future__ import annotations

import difflib
import sys

from galen_common.executable import Executable

COMMANDS = {
    "evaluate": ("galen_gravcomp.evaluate.command", "score a calibration on recordings or tables"),
    "tools": ("galen_gravcomp.tools", "list, compare, export calibration files"),
    "calibrate_from_bag": (
        "galen_calibration_behavior.calibrate_from_bag",
        "calibrate a tool from a recording",
    ),
    "diagnose": ("galen_diagnosis.diagnose", "find why arm and model differ"),
    "convert": ("galen_bags.convert", "make a bag of a table"),
    "train": ("galen_deflection.train", "fit a model of the deflection"),
    "evaluate_deflection": ("galen_deflection.evaluate", "score models of the deflection"),
}
_EXTRAS = {
    "matplotlib": "plots",
    "dask": "archive",
    "distributed": "archive",
    "fsspec": "archive",
    "pyarrow": "archive",
    "s3fs": "archive",
    "torch": "networks",
}


def main() -> object:
    """Run the command that the first argument names.

    Returns:
        Its exit code; 2 where there is no such command, 1 where a package that it needs is not
        installed.

    """
    names = sys.argv[1:2]
    if not names or names[0] not in COMMANDS:
        wanted = names and names[0] in ("-h", "--help")
        if names and not wanted:
            near = difflib.get_close_matches(names[0], COMMANDS, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            print(f"galen: {names[0]!r} is no command{hint}", file=sys.stderr)
        lines = [f"  {name:20} {text}" for name, (_, text) in COMMANDS.items()]
        usage = "\n".join(["usage: galen COMMAND ...; galen COMMAND --help", "", *lines])
        print(usage, file=sys.stdout if wanted else sys.stderr)
        return 0 if wanted else 2
    name = names[0]
    sys.argv[:2] = [f"galen {name}"]
    try:
        return Executable(COMMANDS[name][0])()
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        remedy = f"pip install '.[{_EXTRAS[package]}]' in the suite's folder"
        print(f"galen {name}: {package} is not installed: {remedy}", file=sys.stderr)
        return 1
