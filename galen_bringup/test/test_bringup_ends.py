# SPDX-License-Identifier: Apache-2.0
"""The demonstration ends with one line and without leaving a process behind."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from galen_bringup.demo import main
from galen_bringup.processes import ProcessError, Processes

from galen_bringup import processes as processes_module


def wait_for(predicate, timeout_s, what):
    deadline = time.monotonic() + timeout_s
    while not (result := predicate()):
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)
    return result


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def children(pid):
    found = []
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(child) for child in listed.read_text().split()]
    return found


@pytest.fixture
def executable(tmp_path, monkeypatch):
    """Makes an executable of a shell script, in the place of one that colcon installed."""

    def make(name, script):
        path = tmp_path / name
        path.write_text(f"#!/bin/bash\n{script}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)

    monkeypatch.setattr(processes_module, "executable_path", lambda _, name: tmp_path / name)
    return make


STUBBORN = "trap '' INT; echo up; while true; do read -t 0.1 < <(:); done"


def test_a_process_that_ends_by_itself_is_named_with_its_log(executable, tmp_path):
    executable("node", "echo the reason; exit 3")
    with Processes(tmp_path / "logs") as processes:
        pid = processes.start("package", "node")
        wait_for(lambda: not alive(pid), 5.0, "its end")
        with pytest.raises(ProcessError, match=r"(?s)node ended with code 3.*the reason"):
            processes.check()


@pytest.mark.parametrize("impatient", [False, True], ids=["patient", "second Ctrl-C"])
def test_what_does_not_end_is_killed(executable, tmp_path, monkeypatch, impatient):
    executable("stubborn", STUBBORN)
    monkeypatch.setattr(processes_module, "_PATIENCE_S", 0.3)
    processes = Processes(tmp_path / "logs").__enter__()
    pid = processes.start("package", "stubborn")
    wait_for(lambda: "up" in (tmp_path / "logs/stubborn.log").read_text(), 5.0, "its start")
    if impatient:
        patient = subprocess.Popen.wait

        def interrupted(process, timeout=None):
            if timeout is not None:
                raise KeyboardInterrupt
            return patient(process)

        monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            processes.stop()
    else:
        processes.stop()
    assert not alive(pid)


@pytest.mark.parametrize("arguments", [["--seed", "-1"], ["--poses", "x"], ["--poses", "9"]])
def test_bad_options_are_a_usage_error(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert arguments[1] in capsys.readouterr().err


def test_an_output_that_can_not_be_written_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["--output", str(tmp_path / "file")]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(tmp_path / "file") in captured.err and captured.err.count("\n") == 1


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_signal_ends_the_nodes_as_well(tmp_path, number):
    demo = subprocess.Popen(
        [sys.executable, "-m", "galen_bringup.demo", "--output", str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        nodes = wait_for(
            lambda: pids if len(pids := children(demo.pid)) >= 3 else None, 60.0, "three nodes"
        )
        os.kill(demo.pid, number)
        assert demo.wait(timeout=30.0) == 128 + number
        assert not [pid for pid in nodes if alive(pid)]
    finally:
        demo.kill()
        demo.wait()
