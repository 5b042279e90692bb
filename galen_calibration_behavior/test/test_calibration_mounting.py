# SPDX-License-Identifier: Apache-2.0
"""Sensor and mounting in a calibration: written, told, rejected."""

import numpy as np
import pytest
from calibration_fake_arm import ADAPTER, NO_TOOL, POINTER
from galen_calibration_behavior.calibrate_from_bag import main
from galen_calibration_behavior.calibration.estimate import (
    EstimateError,
    MountingRequest,
    estimate,
    format_mounting,
    mounting_fields,
)
from galen_calibration_behavior.common.commands import CalibrationCode, Measurements
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_model.arm.galen import GALEN
from galen_model.errors import IdentificationError
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import nominal_reading
from galen_model.load.readings import StillPoses

ZERO = np.array([0.008, -0.006])
POSES = np.array([[r, t] for r in np.linspace(-1.5, 1.5, 5) for t in np.linspace(-1.0, 0.9, 4)])
STD = 2e-3 * np.array([1, 1, 1, 0.02, 0.02, 0.02])


def still(tool, seed, zero):
    """Readings at the true angles, reported ones beside them."""
    true = POSES + zero
    exact = nominal_reading(true, tool, ADAPTER, np.stack(zero, axis=-1), arm=GALEN)
    wrench = exact + STD * np.random.default_rng(seed).standard_normal(exact.shape)
    return StillPoses(POSES, wrench, np.broadcast_to(STD, exact.shape), arm=GALEN)


def measured(zero):
    indices = list(range(len(POSES)))
    bare, tool = still(NO_TOOL, 1, zero), still(POINTER, 2, zero)
    return Measurements(bare, tool, np.zeros(2), indices, indices, [], [])


def test_joint_zeros_are_written_and_told(tmp_path):
    path = tmp_path / "pointer.json"
    request = MountingRequest(("joint_zero",))
    done = estimate(path, "pointer", np.zeros(3), measured(ZERO), [], mounting=request)
    done.write()
    mounting = read_calibration(path, arm=GALEN).mounting
    error = mounting.joint_zero_rad - ZERO
    assert np.all(np.abs(error) < 4.0 * mounting.std[12:])
    assert done.worth.pays
    assert not any("do not pay" in text for text in done.warnings)
    text = format_mounting(done)
    assert "the roll joint's zero" in text
    assert "plain least squares" in text
    fields = mounting_fields(done)
    assert fields["held_out"]["pays"] is True
    assert fields["joint_zero_rad"]["roll"] == pytest.approx(mounting.joint_zero_rad[0])


def test_joint_zeros_that_do_not_pay_are_warned_of(tmp_path):
    request, healthy = MountingRequest(("joint_zero",)), measured(np.zeros(2))
    path = tmp_path / "pointer.json"
    done = estimate(path, "pointer", np.zeros(3), healthy, [], mounting=request)
    assert not done.worth.pays
    assert any("do not pay" in text for text in done.warnings)


def test_what_the_poses_can_not_tell_writes_nothing(tmp_path):
    path = tmp_path / "pointer.json"
    request = MountingRequest(("joint_zero", "base_inclination"))
    with pytest.raises(EstimateError, match=r"not identifiable .* roll joint's zero") as rejected:
        estimate(path, "pointer", np.zeros(3), measured(ZERO), [], mounting=request)
    assert rejected.value.code is CalibrationCode.NOT_EXCITED
    assert not path.exists()


def test_the_command_and_the_node_reject_what_they_can_not_use(capsys):
    for arguments in (
        ["--estimate", "gains"],
        ["--known-mass-kg", "0.1"],
        ["--known-mass-kg", "0.1", "--known-mass-std-kg", "1e-4"],
        ["--estimate", "axis_gain", "--known-com-m", "0", "0", "0", "--known-com-std-m", "1e-3"],
    ):
        with pytest.raises(SystemExit) as end:
            main(["pointer", "nowhere", *arguments])
        assert end.value.code == 2
    capsys.readouterr()
    with pytest.raises(IdentificationError, match="'gains' can't be estimated"):
        CalibrationParameters(estimate=("gains",)).validate()
