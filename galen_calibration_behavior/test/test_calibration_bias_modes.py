"""`calibrate_from_bag --bias`, from the options to the file, on a recording made in memory."""

import dataclasses
import json

import numpy as np
import pytest
from calibration_tape import POINTER, Tape, grid
from galen_calibration_behavior.calibrate_from_bag import main
from galen_model.tool_file import read_tool

UNITS = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])


@pytest.fixture(scope="module")
def recording():
    """Both sweeps of 18 poses; the bias walks 0.3 N, 6 mN.m far over them."""
    poses = grid(rolls=(-1.2, -0.7, -0.2, 0.3, 0.8, 1.3))
    tape = Tape(5).calibration(POINTER, poses).recording()
    steps = np.random.default_rng(5).standard_normal(tape.wrenches.shape) * UNITS
    walk = 0.3 * np.cumsum(steps, axis=0) / np.sqrt(len(steps))
    return dataclasses.replace(tape, wrenches=tape.wrenches + walk), walk


@pytest.mark.slow
def test_a_strong_wander_is_found_and_the_file_says_the_bias_at_the_end(
    recording, monkeypatch, capsys, tmp_path
):
    tape, walk = recording
    monkeypatch.setattr("galen_calibration_behavior.calibrate_from_bag.read_arm", lambda *_: tape)
    error, offset = {}, {}
    for mode in ("constant", "auto"):
        main(["pointer", "tape", "--json", "--bias", mode, "--tools-dir", str(tmp_path)])
        found = json.loads(capsys.readouterr().out)
        assert (found["bias"] is None) == (mode == "constant")
        load = read_tool(tmp_path / "pointer.json")
        error[mode] = abs(load.load.mass_kg - POINTER.mass_kg)
        offset[mode] = load.residual_offset
    assert "walk" in found["bias"]
    assert any("wandered" in text for text in found["warnings"])
    assert found["bias_mass_growth"] > 1.0
    assert error["auto"] < 0.4 * error["constant"]
    assert error["auto"] < 3.0 * load.load.mass_std_kg
    off = {mode: np.linalg.norm((offset[mode] - walk[-1])[:3]) for mode in offset}
    assert off["auto"] < 0.5 * off["constant"]
