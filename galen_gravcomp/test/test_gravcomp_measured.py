# SPDX-License-Identifier: Apache-2.0
"""Measured wrenches through the node: a KUKA with an ATI Gamma, its tool from still poses."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import ArmTopics, read_arm
from galen_bags.convert import main as convert
from galen_gravcomp.evaluate.bag import evaluate_bag
from galen_gravcomp.evaluate.command import main as evaluate
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration

KUKA = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "kuka_ati_gamma"
pytestmark = pytest.mark.skipif(
    not KUKA.is_dir(), reason="measured data is not beside the checkout"
)


@pytest.fixture(scope="module")
def baseline(tmp_path_factory):
    """The run as a bag, the tool's file from the still poses, and what was said of them."""
    folder = tmp_path_factory.mktemp("kuka")
    bag, file = folder / "baseline", folder / "kuka.json"
    files = [
        "--wrench", str(KUKA / "1-baseline_wrench.csv"),
        "--orientations", str(KUKA / "1-baseline_orientations.csv"),
    ]  # fmt: skip
    assert convert([*files, "--time-unit", "us", "-o", str(bag)]) == 0
    table = KUKA / "0-calibration_fts-accel.csv"
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert evaluate([str(table), "--write-tool", str(file), "--json"]) == 0
    return bag, file, json.loads(said.getvalue())


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


def test_the_static_model_leaves_the_forces_of_acceleration(baseline, tmp_path):
    bag, file, _ = baseline
    out = tmp_path / "out"
    evaluate_bag(bag, read_calibration(file, arm=GALEN), write_to=out)
    wrenches = read_arm(out, ArmTopics(wrench_raw="wrench_compensated"), arm=GALEN).wrenches
    assert len(wrenches) == 4370  # the last orientation is 7 ms older than the last wrench
    assert rms(read_arm(bag, arm=GALEN).wrenches)[0] == pytest.approx(12.84, abs=0.02)
    # 1.2 N along x is known of this run, from elsewhere
    assert rms(wrenches)[0] == pytest.approx(1.22, abs=0.02)
    assert np.all(rms(wrenches)[1:3] < 0.6)
    assert np.all(rms(wrenches)[3:] < 0.08)


def test_the_still_poses_give_the_known_load(baseline):
    """0.932 kg, centre z 43.9 mm: computed independently for the data's description."""
    _, file, said = baseline
    load = read_calibration(file, arm=GALEN).load
    assert load.mass_kg == pytest.approx(0.932, abs=0.002)
    assert load.com_m[2] == pytest.approx(0.0439, abs=0.0003)
    for models in said["scores"].values():
        rmse = [models["galen"]["rmse"][axis] for axis in ("fx", "fy", "fz")]
        np.testing.assert_allclose(rmse, [0.136, 0.049, 0.061], rtol=0.05)
