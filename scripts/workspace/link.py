# SPDX-License-Identifier: Apache-2.0
"""Installs the Python packages of a workspace as links: an edit of a source needs no build.

`python link.py ROOT` reads each setup.py and lays below ROOT/install what `colcon build
--symlink-install` would: data files, executables in lib/PACKAGE, modules, and their metadata.
"""

import os
import sys
from distutils.core import run_setup  # setuptools brings it; the standard library had it to 3.11
from pathlib import Path
from typing import Any

# A path with blanks, or a long one, is none for `#!`.
EXECUTABLE = """#!/bin/sh
'''exec' "{python}" "$0" "$@"
' '''
import sys
from {module} import {first}
if __name__ == "__main__":  # worker processes import this script
    sys.exit({function}())
"""


def link_package(folder: Path, install: Path) -> None:
    """Install the package in ``folder``."""
    os.chdir(folder)
    found: Any = run_setup("setup.py", stop_after="init")
    name = found.get_name()
    for target, files in found.data_files:
        for file in files:
            _link(install / target / Path(file).name, folder / file)
    for package in {package.split(".")[0] for package in found.packages}:
        _link(install / "python" / package, folder / package)
    metadata = install / "python" / f"{name}-{found.get_version()}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {name}\nVersion: {found.get_version()}\n")
    entries = found.entry_points["console_scripts"]
    (metadata / "entry_points.txt").write_text("\n".join(["[console_scripts]", *entries, ""]))
    for entry in entries:
        executable, _, reference = entry.partition(" = ")
        module, _, function = reference.partition(":")
        path = install / "lib" / name / executable
        path.parent.mkdir(parents=True, exist_ok=True)
        first = function.partition(".")[0]
        script = EXECUTABLE.format(
            python=sys.executable, module=module, first=first, function=function
        )
        path.write_text(script)
        path.chmod(0o755)


def _link(path: Path, to: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(to)


if __name__ == "__main__":
    root = Path(sys.argv[1])
    for setup_file in sorted(root.glob("*/setup.py")):
        link_package(setup_file.parent, root / "install")
