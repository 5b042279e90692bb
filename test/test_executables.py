# SPDX-License-Identifier: Apache-2.0
"""Every executable through its installed start script, as `ros2 run` starts it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = sorted((ROOT / "install" / "lib").glob("galen_*/*"))
BAGS = ROOT / "bags"


def started(script, *arguments, cwd=None):
    return subprocess.run(
        [str(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
        cwd=cwd,
        env={**os.environ, "COLUMNS": "100"},
    )


ALL_HELPS = """
import contextlib, io, json, runpy, sys

said = {}
for script in sys.argv[1:]:
    out, error, code = io.StringIO(), io.StringIO(), None
    sys.argv = [script, "--help"]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            code = end.code
    said[script] = code, out.getvalue(), error.getvalue()
print(json.dumps(said))
"""


def test_every_executable_has_a_help():
    """In one process, as each imports for a second; the tests below start scripts as such."""
    assert len(SCRIPTS) >= 17
    assert all(os.access(one, os.X_OK) for one in SCRIPTS)
    assert len({one.read_text().splitlines()[1] for one in SCRIPTS}) == 1  # the same Python
    done = started(sys.executable, "-c", ALL_HELPS, *SCRIPTS)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert list(said) == list(map(str, SCRIPTS))
    wrong = {
        script: text
        for script, (code, out, error) in said.items()
        for text in [out + error]
        if code or error or not out.lower().startswith("usage")
    }
    assert wrong == {}


def script(package, name):
    (found,) = (one for one in SCRIPTS if (one.parent.name, one.name) == (package, name))
    return found


def test_several_bags_go_through_two_workers():
    bags = [BAGS / "free_motion", BAGS / "swings"]
    tool = BAGS / "tools" / "retractor.json"
    evaluate = script("galen_gravcomp", "evaluate")
    done = started(evaluate, *bags, "--tool", tool, "--workers", "2", "--json")
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr
    assert {Path(row["bag"]).name for row in json.loads(done.stdout)["bags"]} == {
        "free_motion",
        "swings",
    }


def test_several_recordings_are_diagnosed_by_two_workers(tmp_path):
    for name in "ab":
        shutil.copytree(BAGS / "free_motion", tmp_path / name / "motion")
        shutil.copy(BAGS / "tools" / "retractor.json", tmp_path / name / "tool.json")
    options = ("--workers", "2", "--no-report", "--json", "--output", "found")
    diagnose = script("galen_diagnosis", "diagnose")
    done = started(diagnose, tmp_path / "a", tmp_path / "b", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["recordings"]
    assert [(one["recording"], one["verdict"]) for one in found] == [("a", "none"), ("b", "none")]
