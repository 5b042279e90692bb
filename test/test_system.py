# SPDX-License-Identifier: Apache-2.0
"""The suite as a lab runs it: separate processes over DDS, calibration through the action."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import ADAPTER, TOOLS


def demonstrate(folder, *arguments):
    command = ["ros2", "run", "galen_bringup", "demo", "--output", folder, "--json", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=580.0, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_demonstration_calibrates_compensates_and_draws(tmp_path):
    content = demonstrate(tmp_path, "--poses", "10", "--sweep", "3", "4")
    assert set(content["tools"]) == set(TOOLS)
    for tool, found in content["tools"].items():
        calibration = found["calibration"]
        file = read_calibration(tmp_path / "tools" / f"{tool}.json", arm=GALEN)
        assert calibration["file"] == str(tmp_path / "tools" / f"{tool}.json")
        assert calibration["mass_kg"] == file.load.mass_kg
        assert file.poses_used + len(file.poses_rejected) >= 12
        np.testing.assert_allclose(file.tip_m, TOOLS[tool].tip_m)
        for estimate, truth in ((file.load, TOOLS[tool].load), (file.adapter, ADAPTER)):
            error = np.concatenate(
                [[estimate.mass_kg - truth.mass_kg], estimate.com_m - np.asarray(truth.com_m)]
            )
            assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(estimate.covariance))), tool
        assert found["poses"] >= 8
        # 10 poses tell a root mean square to 22 %; a zero from 12 poses is off in all of them
        assert np.all(np.array(found["over_noise"]) < 3.0), tool
        assert np.all(np.array(found["raw_rmse"][:3]) > 0.3), tool
    assert content["drift"]["on"]["largest_m"] < 0.05 * content["drift"]["off"]["largest_m"]
    assert len(content["figures"]) == 3
    for figure in content["figures"]:
        assert Path(figure).read_bytes().startswith(b"\x89PNG")
