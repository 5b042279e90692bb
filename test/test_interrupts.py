# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C while any executable imports what it needs: no traceback, exit code 130."""

import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from galen_common.executable import Executable

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("galen_*/setup.py"))

INTERRUPT_AT_IMPORT = """
import os, signal, sys
from importlib.metadata import distribution

package, executable, module = sys.argv[1:4]

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
(entry,) = distribution(package).entry_points.select(group="console_scripts", name=executable)
sys.argv = [executable, "--help"]
sys.exit(entry.load()())
"""
LOADED_AT_START = """
import sys
import PACKAGE.executables
print([name for name in ("numpy", "rclpy") if name in sys.modules])
"""


def executables():
    """All, as (package, name, what is loaded)."""
    for package in PACKAGES:
        for entry in distribution(package).entry_points.select(group="console_scripts"):
            yield package, entry.name, entry.load()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_executable_handles_interrupts_before_its_imports(package):
    found = [value for of, _, value in executables() if of == package]
    assert all(isinstance(one, Executable) for one in found)
    if found:
        program = LOADED_AT_START.replace("PACKAGE", package)
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        assert done.stdout == "[]\n", done.stderr


@pytest.mark.parametrize("name", ["gravcomp_node", "evaluate", "panel"])
def test_interrupted_import_ends_without_a_traceback(name):
    package, _, executable = next(one for one in executables() if one[1] == name)
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPT_AT_IMPORT, package, name, executable.module],
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
