# SPDX-License-Identifier: Apache-2.0
"""`galen ...`: the commands of `pip install .` work on a Python without ROS."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from galen_common.offline import COMMANDS

ROOT = Path(__file__).resolve().parent.parent

WITHOUT_ROS = """
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "ament_index_python", "std_srvs") or top.endswith(
            ("_msgs", "_interfaces")
        ):
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, NoRos())
from galen_common import offline
"""


def galen(code, *arguments):
    """Run ``code`` where no part of ROS can be imported."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS + code, *arguments],
        cwd=ROOT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def test_every_command_imports_without_ros():
    done = galen("for module, _ in offline.COMMANDS.values(): importlib.import_module(module)")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("evaluate", "bags/free_motion", "--tool", "bags/tools/retractor.json", "--json"),
        pytest.param(
            ("calibrate_from_bag", "pointer", "bags/pointer_calibration", "--dry-run", "--json"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_recording_is_read_without_ros(arguments):
    done = galen("sys.exit(offline.main())", *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(("{", "["))


def test_a_missing_extra_is_one_line_with_the_remedy(tmp_path):
    code = "sys.modules['matplotlib'] = None; sys.exit(offline.main())"
    arguments = ("--tool", "bags/tools/retractor.json", "--plots", str(tmp_path))
    done = galen(code, "evaluate", "bags/free_motion", *arguments)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "galen evaluate: matplotlib is not installed: pip install '.[plots]' in the suite's folder"
    )


def test_the_commands_are_listed_and_an_unknown_one_is_rejected():
    done = galen("sys.exit(offline.main())", "--help")
    assert done.returncode == 0
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)
    assert galen("sys.exit(offline.main())", "gravcomp_node").returncode == 2
    slip = galen("sys.exit(offline.main())", "evalute")
    assert slip.returncode == 2 and "did you mean evaluate?" in slip.stderr


@pytest.mark.slow
def test_the_wheel_holds_modules_and_data_of_the_offline_packages(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for path in [*ROOT.glob("galen_*"), *(ROOT / n for n in ("pyproject.toml", "LICENSE"))]:
        copy = shutil.copytree if path.is_dir() else shutil.copy
        copy(path, source / path.name)
    shutil.copy(ROOT / "README.md", source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    command += ["--no-index", "-w", str(tmp_path), str(source)]
    subprocess.run(command, check=True, capture_output=True, timeout=100)
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    for package in {module.partition(".")[0] for module, _ in COMMANDS.values()} | {"galen_common"}:
        for path in (ROOT / package / package).rglob("*"):
            if path.suffix in (".py", ".html", ".css", ".json"):
                assert str(path.relative_to(ROOT / package)) in held
    assert not [name for name in held if name.startswith(("test/", "galen_panel/"))]
