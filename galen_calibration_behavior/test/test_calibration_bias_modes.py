"""`calibrate_from_bag --bias`, from the options to the file, on a recording made in memory."""

import dataclasses
import json

import numpy as np
import pytest
from calibration_tape import POINTER, Tape, grid
from galen_calibration_behavior.calibrate_from_bag import main
from galen_model.files.calibration_file import read_calibration

UNITS = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])


@pytest.fixture(scope="module")
def recording():
    """Both sweeps of 18 poses; the bias creeps by 0.3 N, 6 mN.m over them, ever faster."""
    poses = grid(rolls=(-1.2, -0.7, -0.2, 0.3, 0.8, 1.3))
    tape = Tape(5).calibration(POINTER, poses).recording()
    creep = 0.3 * UNITS * np.linspace(0.0, 1.0, len(tape.wrenches))[:, None] ** 2
    return dataclasses.replace(tape, wrenches=tape.wrenches + creep), creep


@pytest.mark.slow
def test_the_file_says_the_bias_at_the_end(recording, monkeypatch, capsys, tmp_path):
    """How good the load is, over many sweeps, is test_model_drifting_bias.py's."""
    tape, creep = recording
    monkeypatch.setattr("galen_calibration_behavior.from_bag.loads.read_arm", lambda *_: tape)
    file, off = {}, {}
    for mode in ("constant", "drifting"):
        main(["pointer", "tape", "--json", "--bias", mode, "--tools-dir", str(tmp_path)])
        found = json.loads(capsys.readouterr().out)
        assert (found["bias"] is None) == (mode == "constant")
        file[mode] = read_calibration(tmp_path / "pointer.json")
        off[mode] = np.linalg.norm((file[mode].residual_offset - creep[-1])[:3])
    assert any("drifted" in text for text in found["warnings"])
    assert found["bias_mass_growth"] > 1.0
    assert off["drifting"] < 0.5 * off["constant"]
