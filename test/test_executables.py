"""Every executable through its installed start script, as `ros2 run` starts it."""

import json
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
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


def test_every_executable_has_a_help():
    """Two at once: each takes a second to import what it needs."""
    assert len(SCRIPTS) >= 17
    with ThreadPoolExecutor(2) as pool:
        done = dict(
            zip(SCRIPTS, pool.map(lambda one: started(one, "--help"), SCRIPTS), strict=True)
        )
    wrong = {
        f"{script.parent.name}/{script.name}": one.stdout + one.stderr
        for script, one in done.items()
        if one.returncode or one.stderr or not one.stdout.lower().startswith("usage")
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
