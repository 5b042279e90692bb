# SPDX-License-Identifier: Apache-2.0
"""SIGINT at any time of an executable's life: while it imports, works, and ends."""

import os
import subprocess
import sys

import pytest

_PROGRAM = """
import os, signal, sys, time
sys.path.insert(0, sys.argv[1])
from galen_common.executable import Executable
sys.exit(Executable("work")())
"""

_WORK = """
import os, signal, sys, time, rclpy
from galen_ros.node.spin import run
from rclpy.node import Node

def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)

class AtTheEnd:
    def __init__(self):
        self.interrupt, self.where = os.kill, (os.getpid(), signal.SIGINT)

    def __del__(self):
        self.interrupt(*self.where)

what = sys.argv[2]
if what == "imports":
    try:
        interrupt()
    except BaseException as error:  # as libraries do
        raise ImportError("an interrupted import") from error

class Quick(Node):
    def destroy_node(self):
        super().destroy_node()
        print("destroyed", flush=True)
        interrupt()

def make_node():
    node = Quick("quick")
    node.create_timer(0.01, interrupt)
    return node

def main():
    if what == "node":
        import atexit
        atexit.register(interrupt)
        run(make_node)
        interrupt()
        print("counted", flush=True)
        return 0
    if what == "end":
        import atexit
        atexit.register(interrupt)
        sys.modules["kept to the end"] = AtTheEnd()
        return 7
    try:
        interrupt()
        time.sleep(10.0)
    finally:
        if what != "once":
            if what == "later":
                import galen_common.executable as executable
                executable._SAME_S = 0.0
            interrupt()
        print("tidied up", flush=True)
"""


@pytest.fixture
def end(tmp_path):
    (tmp_path / "work.py").write_text(_WORK, encoding="utf-8")

    def run(what):
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM, str(tmp_path), what],
            capture_output=True,
            text=True,
            timeout=30.0,
            check=False,
        )
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.mark.parametrize(
    ("what", "code", "printed"),
    [
        ("imports", 130, ""),
        ("once", 130, "tidied up\n"),
        ("twice", 130, "tidied up\n"),  # one Ctrl-C may be sent twice, as by a launch
        ("later", 130, ""),  # ends a command that tidies up for long
        ("end", 7, ""),
        ("node", 0, "destroyed\ncounted\n"),
    ],
)
def test_an_interrupt_at_any_time_ends_it_quietly(end, what, code, printed):
    assert end(what) == (code, printed, "")


@pytest.mark.parametrize("length", [1, 100_000])
@pytest.mark.parametrize("then", ["return 0", "raise SystemExit(0)"])
def test_a_reader_that_went_away_ends_the_command_quietly(tmp_path, length, then):
    work = f"def main():\n    print('x' * {length})\n    {then}\n"
    (tmp_path / "work.py").write_text(work, encoding="utf-8")
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(tmp_path)],
        stdout=writer,
        stderr=subprocess.PIPE,
        timeout=30.0,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")
