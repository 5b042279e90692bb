"""The benchmark of the panel: what it runs, and how it tells it."""

import io
import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks.speed import panel as panel_benchmark
from benchmarks.speed.nodes import Measurement
from benchmarks.speed.panel import browser_lacks, measure, subjects, table

BUSY = """
import subprocess, sys, time
if len(sys.argv) == 1:
    subprocess.Popen([sys.executable, __file__, "child"])
until_s = time.process_time() + 0.3
while time.process_time() < until_s:
    pass
print("busy enough", flush=True)
time.sleep(60)
"""


def measured(subject, number, percent, beside):
    return Measurement(subject, 500.0, number, 4000, 0, 1.0, percent, 0.5, 3.0, 5.0, 9.0, beside)


def test_the_table_tells_what_ran_beside():
    found = [
        measured("relay", 0, 20.0, {}),
        measured("gravcomp, page", 0, 30.0, {"panel": 4.0, "browser": 50.0}),
        measured("gravcomp, page", 1, 30.0, {"panel": 6.0, "browser": 52.0}),
    ]
    shown = io.StringIO()
    Console(width=190, file=shown).print(table(found))
    relay, page = shown.getvalue().splitlines()[1:]
    assert relay.split() == ["relay", "0", "of", "4000", "20.0", "1.00", "0.50", "3.00", "1.00"]
    assert page.split()[-2:] == ["4.0/5.0/6.0", "50.0/51.0/52.0"] and " 1.50 " in page


def test_without_a_browser_no_page_is_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(panel_benchmark.shutil, "which", lambda _name: None)
    assert browser_lacks() == "chromium and chromedriver not found: make browser"
    assert [one.name for one in subjects(tmp_path)] == [
        "relay", "gravcomp", "gravcomp, panel without a page",
    ]  # fmt: skip


def test_cpu_of_a_process_is_that_of_its_children_too(tmp_path):
    script = tmp_path / "busy.py"
    script.write_text(BUSY)
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    try:
        for _ in range(2):
            assert process.stdout.readline() == "busy enough\n"
        both_s = panel_benchmark._tree_cpu_s(process.pid)
        assert both_s - panel_benchmark.cpu_s(process.pid) >= 0.28
        assert both_s >= 0.58
    finally:
        for pid in children(process.pid):
            os.kill(pid, 9)
        process.kill()
        process.wait()
    assert panel_benchmark._tree_cpu_s(process.pid) == 0.0


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_it_measures_and_leaves_nothing_behind(monkeypatch):
    # NiceGUI would serve a test of its own kind.
    monkeypatch.delenv("PYTEST_CURRENT_TEST")
    before = children(os.getpid())
    options = Namespace(seconds=1.0, rounds=1)
    found = {one.subject: one for one in measure(options, print)}
    assert set(children(os.getpid())) <= set(before)
    assert set(found["gravcomp"].beside_percent) == set()
    assert set(found["gravcomp, panel without a page"].beside_percent) == {"panel"}
    if not browser_lacks():
        for page in ("page that plots", "page that plots, not drawn here"):
            beside = found[f"gravcomp, {page}"].beside_percent
            assert beside["panel"] > 0.0 and beside["browser"] > 0.0
