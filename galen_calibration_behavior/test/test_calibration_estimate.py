# SPDX-License-Identifier: Apache-2.0
import json
import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from calibration_fake_arm import ADAPTER, NO_TOOL, POINTER
from galen_calibration_behavior.calibration.estimate import (
    EstimateError,
    choose_tip,
    estimate,
    format_mounting,
    mounting_fields,
)
from galen_calibration_behavior.common.commands import CalibrationCode, Measurements
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.inertia import InertiaEstimate
from galen_model.load.model import nominal_reading
from galen_model.load.mounting_worth import Calibrated
from galen_model.load.readings import StillPoses
from scipy.spatial.transform import Rotation

NAN = np.full(3, math.nan)
TIP = np.array([0.15, 0.0, 0.05])
POSES = np.array([[r, t] for r in np.linspace(-1.5, 1.5, 5) for t in np.linspace(-1.0, 0.9, 4)])


def still(tool, poses=POSES, seed=2, noise=2e-3):
    random = np.random.default_rng(seed)
    std = noise * np.array([1, 1, 1, 0.02, 0.02, 0.02])
    exact = nominal_reading(poses, tool, ADAPTER, arm=GALEN)
    wrench = exact + std * random.standard_normal(exact.shape)
    return StillPoses(poses, wrench, np.broadcast_to(std, exact.shape), arm=GALEN)


def at(start_s, sweep):
    """Return the sweep 2 s a pose from start_s (s) on."""
    return replace(sweep, time_s=start_s + 2.0 * np.random.default_rng(4).permutation(len(sweep)))


def calibrate(path, both, warnings=(), **options):
    done = estimate(path, "pointer", TIP, both, [*warnings], **options)
    done.write()
    return done


def measurements(bare, tool, **changes):
    count = len(tool)
    values = {
        "bare": bare, "tool": tool, "zero_angles": np.zeros(2),
        "bare_indices": list(range(count)), "tool_indices": list(range(count)),
        "rejected": [], "warnings": [],
    } | changes  # fmt: skip
    return Measurements(**values)


def test_two_sweeps_recover_the_load_and_write_it(tmp_path):
    path = tmp_path / "pointer.json"
    both = at(0, still(NO_TOOL, seed=1)), at(60, still(POINTER))
    done = calibrate(path, measurements(*both))
    read = read_calibration(path, arm=GALEN)
    assert read.model == "constant bias"
    plain = identify_two_sweeps(*both, np.zeros(2)).load
    assert read.load.mass_kg == pytest.approx(plain.mass_kg, abs=0.2 * plain.mass_std_kg)
    assert abs(read.load.mass_kg - 0.060) < 5 * read.load.mass_std_kg
    assert np.all(np.abs(read.load.com_m - POINTER.com_m) < 5 * read.load.com_std_m)
    assert read.tip_m == pytest.approx(TIP)
    assert read.poses_used == 20
    assert done.content.poses_rejected == ()
    assert json.loads(path.read_text())["tool"] == "pointer"


def test_a_rotation_that_is_chosen_unasked_is_warned_of(tmp_path, monkeypatch):
    turned = Rotation.from_rotvec([0.02, 0.02, 0.02]).as_matrix()
    sweeps = [still(NO_TOOL, seed=1), still(POINTER)]
    for sweep in sweeps:
        sweep.wrench[:] = (sweep.wrench.reshape(-1, 2, 3) @ turned).reshape(-1, 6)

    def choose(bare, tool, zero, _progress, _zeroed):
        found = Calibrated(bare, tool, ("sensor_rotation",), zero, None).identify()
        return replace(found, model="rotation of the sensor", reason="8 blocks")

    monkeypatch.setattr(
        "galen_calibration_behavior.calibration.estimate.choose_calibration", choose
    )
    done = calibrate(tmp_path / "pointer.json", measurements(*sweeps))
    mounting = read_calibration(done.path, arm=GALEN).mounting
    assert mounting.sensor_rotvec_rad == pytest.approx([0.02] * 3, abs=2e-3)
    assert any("by (1.1" in text and "push" in text for text in done.warnings)
    assert mounting_fields(done) == mounting.to_json()
    assert "rotation about x" in format_mounting(done)


def test_parts_of_the_old_file_that_go_are_named(tmp_path):
    path = tmp_path / "pointer.json"
    sweeps = measurements(still(NO_TOOL, seed=1), still(POINTER))
    assert not any("old file" in said for said in calibrate(path, sweeps).warnings)
    inertia = InertiaEstimate(np.array([1e-3, 2e-3, 2e-3, 0, 0, 0]), np.eye(6) * 1e-12)
    write_calibration(path, replace(read_calibration(path, arm=GALEN), inertia=inertia))
    (said,) = (s for s in estimate(path, "pointer", TIP, sweeps, []).warnings if "old file" in s)
    assert "inertia (--estimate inertia)" in said
    assert "cable" not in said


def test_one_sweep_says_what_it_cannot_know(tmp_path):
    done = calibrate(tmp_path / "pointer.json", measurements(None, still(POINTER)), ["before"])
    assert done.warnings[0] == "before"
    assert any("only their sum" in text for text in done.warnings)
    assert read_calibration(done.path, arm=GALEN).unresolved


def test_the_time_is_the_measurement_s_where_it_is_given(tmp_path):
    path = tmp_path / "pointer.json"
    both = measurements(still(NO_TOOL, seed=1), still(POINTER))
    moment = datetime(2019, 5, 2, 14, 0, 7, 900_000, timezone(timedelta(hours=2)))
    done = estimate(path, "pointer", TIP, both, [], calibrated_at=moment)
    assert done.content.calibrated_at == "2019-05-02T14:00:07+02:00"
    assert not path.exists()
    calibrate(path, both, calibrated_at=moment)
    assert read_calibration(path, arm=GALEN).calibrated_at == done.content.calibrated_at
    began = datetime.now(UTC) - timedelta(seconds=1)
    calibrate(path, both)
    assert datetime.fromisoformat(read_calibration(path, arm=GALEN).calibrated_at) > began


def test_an_outlier_is_named_by_its_place_in_the_sweep(tmp_path):
    tool = still(POINTER)
    tool.wrench[7, 1] += 0.5
    numbers = {"tool_indices": list(range(100, 120)), "rejected": ["bare/3: moved"]}
    both = measurements(still(NO_TOOL, seed=1), tool, **numbers)
    done = calibrate(tmp_path / "pointer.json", both)
    assert done.content.poses_rejected[0] == "bare/3: moved"
    (outlier,) = done.content.poses_rejected[1:]
    assert outlier.startswith("tool/107: ")
    assert "sigma" in outlier


@pytest.mark.parametrize(
    ("bare", "tool", "code"),
    [
        (still(NO_TOOL, seed=1), still(NO_TOOL), CalibrationCode.IMPLAUSIBLE),
        (still(NO_TOOL, seed=1), still(POINTER, POSES[:3]), CalibrationCode.NOT_EXCITED),
        (
            still(NO_TOOL, seed=1),
            still(POINTER, np.tile([[0.3, 0.2]], (20, 1))),
            CalibrationCode.NOT_EXCITED,
        ),
    ],
)
def test_what_can_not_be_estimated_leaves_the_old_file(tmp_path, bare, tool, code):
    path = tmp_path / "pointer.json"
    path.write_text("old")
    with pytest.raises(EstimateError) as error:
        calibrate(path, measurements(bare, tool))
    assert error.value.code == code
    assert str(error.value)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_tip_is_taken_kept_or_zero(tmp_path):
    path = tmp_path / "pointer.json"
    assert choose_tip(TIP, path, arm=GALEN)[0] is TIP
    tip, warnings = choose_tip(NAN, path, arm=GALEN)
    assert tip.tolist() == [0, 0, 0]
    assert "not known" in warnings[0]
    calibrate(path, measurements(still(NO_TOOL, seed=1), still(POINTER)))
    assert choose_tip(NAN, path, arm=GALEN)[0] == pytest.approx(TIP)
    path.write_text("{")
    tip, warnings = choose_tip(NAN, path, arm=GALEN)
    assert tip.tolist() == [0, 0, 0]
    assert "pointer.json" in warnings[0]
    with pytest.raises(GalenError, match="nan"):
        choose_tip(np.array([0.1, math.nan, 0.0]), path, arm=GALEN)
    with pytest.raises(GalenError, match=r"at most 2 m along an axis; is it in m\?"):
        choose_tip(np.array([5.0, 0.0, 0.0]), path, arm=GALEN)


def test_torques_in_another_unit_are_written_only_where_it_is_said(tmp_path):
    bare, tool = (
        replace(sweep, wrench=sweep.wrench * [1, 1, 1, 1e3, 1e3, 1e3])
        for sweep in (still(NO_TOOL), still(POINTER, seed=3))
    )
    path = tmp_path / "pointer.json"
    with pytest.raises(EstimateError, match="torques are in N") as raised:
        calibrate(path, measurements(bare, tool))
    assert raised.value.code is CalibrationCode.IMPLAUSIBLE
    assert not path.exists()
    calibrate(path, measurements(bare, tool), check_setup=False)
    assert path.exists()
