# SPDX-License-Identifier: Apache-2.0
"""The suite as a lab runs it: separate processes over DDS, calibration through the action."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from galen_bringup.measurements import random_poses, visit
from galen_bringup.processes import (
    AVERAGE_S,
    Processes,
    calibrate,
    connected_arm,
    ros_world,
    start_suite,
)
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import ADAPTER, TOOLS
from rich.console import Console
from rich.progress import Progress


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_tool_is_calibrated_through_the_action_and_its_weight_compensated(tmp_path):
    tool = TOOLS["retractor"]
    with ros_world(), Processes(tmp_path / "logs") as processes:
        start_suite(processes, tmp_path / "tools", speed=6.0, seed=7)
        result = calibrate(processes, "retractor", ["--iters-t", "3", "--iters-r", "5"])
        with connected_arm(processes) as arm, Progress(console=Console(quiet=True)) as progress:
            answer = arm.set_tool("retractor")
            poses = random_poses(12, np.random.default_rng(1))
            readings = visit(arm, poses, AVERAGE_S, progress, "poses")

    file = read_calibration(tmp_path / "tools" / "retractor.json", arm=GALEN)
    assert result["file"] == str(tmp_path / "tools" / "retractor.json")
    assert result["mass_kg"] == answer.mass_kg == file.load.mass_kg
    assert file.poses_used + len(file.poses_rejected) >= 15
    np.testing.assert_allclose(file.tip_m, tool.tip_m)
    for estimate, truth in ((file.load, tool.load), (file.adapter, ADAPTER)):
        error = np.concatenate(
            [[estimate.mass_kg - truth.mass_kg], estimate.com_m - np.asarray(truth.com_m)]
        )
        assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(estimate.covariance)))
    # the weight is gone: newtons before, the averaged reading's noise after
    assert len(readings.raw) >= 10
    assert np.all(np.sqrt(np.mean(readings.raw[:, :3] ** 2, axis=0)) > 0.3)
    # 12 poses tell a root mean square to 20 %; the error of a zero from 15 poses is in all of them
    assert np.all(readings.rmse < 3.0 * readings.noise)


def demonstrate(folder, *arguments):
    command = ["ros2", "run", "galen_bringup", "demo", "--output", folder, "--json", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=580.0, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_demonstration_calibrates_compensates_and_draws(tmp_path):
    content = demonstrate(tmp_path, "--poses", "10", "--sweep", "3", "5")
    assert set(content["tools"]) == set(TOOLS)
    for tool, found in content["tools"].items():
        calibration = found["calibration"]
        error_kg = abs(calibration["mass_kg"] - TOOLS[tool].load.mass_kg)
        assert error_kg < 5 * calibration["mass_std_kg"], tool
        assert found["poses"] >= 8
        # 10 poses tell a root mean square to 22 %; a zero from 15 poses is off in all of them
        assert np.all(np.array(found["over_noise"]) < 3.0), tool
        assert np.all(np.array(found["raw_rmse"][:3]) > 0.3), tool
    assert content["drift"]["on"]["largest_m"] < 0.05 * content["drift"]["off"]["largest_m"]
    assert len(content["figures"]) == 3
    for figure in content["figures"]:
        assert Path(figure).read_bytes().startswith(b"\x89PNG")
