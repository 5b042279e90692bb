# SPDX-License-Identifier: Apache-2.0
"""Orientation tables and joints: the evidence against dense densities, planted causes, commands."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.tables import OrientationTable
from galen_diagnosis.diagnose import main as diagnose
from galen_diagnosis.effects.drift import drift_columns
from galen_diagnosis.effects.table_data import TablePlant
from galen_diagnosis.tables.conclusion import diagnose_blocks
from galen_diagnosis.tables.rows import prepare_table
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.evidence.held_out import BlockEvidence, BlockRows, Columns
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import rotvec_to_matrix
from galen_sim_driver.effects.registry import EFFECTS, effect_from
from scipy.stats import multivariate_normal

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
pytestmark = pytest.mark.usefixtures("in_tmp_path")
measured = pytest.mark.skipif(not REAL.is_dir(), reason="measured data is not beside the checkout")


@pytest.fixture
def in_tmp_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def pose_table(count=10, seed=3):
    random = np.random.default_rng(seed)
    rotation = np.stack(
        [rotvec_to_matrix(np.pi * random.uniform(-1.0, 1.0, 3)) for _ in range(count)]
    )
    gravity = np.einsum("nji,j->ni", rotation, GRAVITY_M_S2)
    return OrientationTable("t.csv", gravity, np.zeros((count, 6)), None, None, "matrix", rotation)


def test_held_out_density_is_that_of_the_dense_gaussian():
    random = np.random.default_rng(0)
    count = 12
    values = random.standard_normal((count, 2, 3))
    rows = BlockRows(
        channels=("a", "b"),
        units=("N", "N"),
        residual=3.0 * random.standard_normal((count, 2)),
        floor=np.array([0.5, 2.0]),
        at_s=np.arange(float(count)),
        block=np.repeat([0, 1, 2], 4),
        labels=("0", "1", "2"),
        alike=0.6,
        memory_s=2.0,
    )
    nominal = Columns(values[:, :, :1], {})
    way = Columns(values[:, :, 1:], {})
    evidence = BlockEvidence(rows, nominal)
    found = evidence.hypothesis(("e",), [(way,)], floor_only=False)
    # the whole covariance of both channels' readings, weights of variance one
    flat = (values / rows.floor[None, :, None]).transpose(1, 0, 2).reshape(2 * count, 3)
    covariance = flat @ flat.T
    for c, form in enumerate(found.forms):
        for b in range(3):
            of = np.flatnonzero(rows.block == b)
            at = c * count + of
            covariance[np.ix_(at, at)] += evidence.forms[form].covariance(rows, rows.at_s[of])
    reading = (rows.residual / rows.floor).T.ravel()
    everything = multivariate_normal(np.zeros(2 * count), covariance).logpdf(reading)
    for b in range(3):
        others = np.flatnonzero(np.tile(rows.block != b, 2))
        part = multivariate_normal(np.zeros(len(others)), covariance[np.ix_(others, others)])
        assert found.elpd[b] == pytest.approx(everything - part.logpdf(reading[others]), abs=1e-6)
    # the best linear prediction of a block from the others is the conditional mean
    held = np.flatnonzero(np.tile(rows.block == 1, 2))
    others = np.flatnonzero(np.tile(rows.block != 1, 2))
    gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[np.ix_(others, held)]).T
    left = reading[held] - gain @ reading[others]
    assert evidence.held_out(found)[rows.block == 1].T.ravel() == pytest.approx(left, abs=1e-8)


def test_the_plant_of_a_table_reads_as_the_formulas_say():
    table = pose_table(6)
    load, offset = Load(0.8, np.array([0.01, -0.02, 0.05])), np.arange(6.0)
    plant = TablePlant(table, np.arange(6.0), load, offset)
    weight = gravity_wrench(table.gravity, load)
    assert plant.reading() == pytest.approx(weight + offset)
    gain = (0.01, -0.02, 0.03, 0.0, 0.05, -0.01)
    assert plant.change(EFFECTS["axis_gain"](gain=gain)) == pytest.approx(weight * gain)
    tilted = plant.change(EFFECTS["base_inclination"](about_x_rad=0.02))
    by_hand = rotvec_to_matrix([-0.02, 0.0, 0.0]) @ GRAVITY_M_S2
    gravity = np.einsum("nji,j->ni", table.rotation, by_hand)
    assert tilted == pytest.approx(gravity_wrench(gravity, load) - weight, abs=1e-12)


def test_a_drift_of_any_smooth_shape_lies_in_its_columns():
    at_s = np.linspace(0.0, 200.0, 80)
    course = 0.1 * np.sin(at_s / 40.0) + 0.001 * at_s
    for way in drift_columns(at_s)[2:4]:  # a quarter of the span
        shapes = np.column_stack([way.values[:, 0, :].reshape(80, -1), np.ones(80)])
        left = course - shapes @ np.linalg.lstsq(shapes, course, rcond=None)[0]
        assert np.abs(left).max() < 0.01
    way = drift_columns(at_s)[0]
    weights = np.linspace(1.0, -1.0, way.size)
    added = way.values @ weights
    rate = (added[-1] - added[0]) / 200.0 * 3600.0
    assert way.parameters["rate_per_hour"](weights) == pytest.approx(rate)


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["none", "sensor_mount_rotation", "unknown"])
def test_a_planted_cause_is_found_in_a_table(cause):
    random = np.random.default_rng([2, len(cause)])
    table, sigma = pose_table(), np.repeat([0.02, 0.001], 3)
    load = Load(0.9, np.array([0.004, -0.003, 0.045]))
    offset = np.array([9.0, -1.0, 5.0, 0.4, -0.7, -0.15])
    turned = effect_from("sensor_mount_rotation", {"rotvec_rad": [0.02, -0.02, 0.01]}, arm=GALEN)
    plant = TablePlant(table, np.arange(10.0), load, offset)
    wrench = plant.reading([turned] if cause == turned.name else [])
    if cause == "unknown":  # each stop has a constant of its own
        wrench += np.repeat([0.3, 0.012], 3) * random.standard_normal(wrench.shape)
    made = replace(table, wrench=wrench + sigma * random.standard_normal(wrench.shape))
    noise = sigma * random.standard_normal((700, 6))
    answer = diagnose_blocks(cause, *prepare_table(made, noise=noise))
    shares = dict(answer.ranking)
    assert set(shares) >= {"none", "unknown", "axis_gain", "sensor_drift", "cable_drag"}
    if cause == turned.name:
        (named,) = [one for one in answer.causes if one.effect != "unknown"]
        assert cause in (named.effect, *named.equivalent), answer.sentence
        assert answer.gap["closed_fraction"]["value"] > 0.9
    else:
        assert answer.verdict == cause, answer.sentence


def joint_runs(tmp_path, stiffness=800.0, gap_rad=0.0, delay_s=0.0, seed=0):
    """A link behind a play of width gap and a spring, its stamps late; four runs."""
    random = np.random.default_rng(seed)
    files = []
    for number, period_s in enumerate((2.7, 3.9, 5.2, 3.1)):
        at_s = np.arange(0.0, 10.0, 0.01)
        motor = 0.5 * np.sin(2.0 * np.pi * at_s / period_s) + 0.1 * np.sin(3.7 * at_s + number)
        torque = 6.0 * np.sin(1.9 * at_s + number) + 2.0 * np.cos(0.7 * at_s)
        follows = np.empty_like(motor)
        held = motor[0]
        for k, angle in enumerate(motor):
            held = np.clip(held, angle - gap_rad / 2.0, angle + gap_rad / 2.0)
            follows[k] = held
        link = np.interp(at_s - delay_s, at_s, follows - torque / stiffness)
        link += 1e-4 * random.standard_normal(len(at_s))
        file = tmp_path / f"run{number}.csv"
        rows = np.column_stack([at_s, motor, link, torque])
        np.savetxt(file, rows, delimiter=",", header="t,motor,link,torque", comments="", fmt="%.9g")
        files.append(str(file))
    return files


def test_a_joint_with_play_and_spring_and_a_rigid_late_one(tmp_path, capsys):
    files = joint_runs(tmp_path, stiffness=800.0, gap_rad=0.012)
    assert diagnose([*files, "--json", "--no-report"]) == 0
    answer = json.loads(capsys.readouterr().out)
    causes = {cause["effect"]: cause for cause in answer["causes"]}
    assert {"joint_compliance", "backlash"} <= set(causes)
    assert not {"encoder_delay", "deflection_hysteresis", "gear_error"} & set(causes)
    low, high = causes["joint_compliance"]["parameters"]["k"]["ci95"]
    assert low < 800.0 < high
    assert high < 1.1 * low
    assert causes["backlash"]["parameters"]["gap_rad"]["value"] == pytest.approx(0.012, rel=0.15)
    assert answer["gap"]["closed_fraction"]["value"] > 0.97
    assert sum(answer["where"]["channels"].values()) == pytest.approx(1.0)
    files = joint_runs(tmp_path, stiffness=1e9, delay_s=0.004)
    assert diagnose([*files, "--json", "--no-report", "--overwrite"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "identified"
    assert answer["causes"][0]["effect"] == "encoder_delay"
    assert answer["causes"][0]["parameters"]["delay_s"]["value"] == pytest.approx(0.004, abs=2e-4)


def test_a_file_that_is_not_there_is_told_in_a_line(tmp_path, capsys):
    assert diagnose([str(tmp_path / "none.csv")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "none.csv" in error


def test_a_table_of_too_few_poses_is_rejected(tmp_path, capsys):
    file = tmp_path / "few.csv"
    rows = np.column_stack([np.ones((3, 6)), np.array([[0, 0, -9.8], [0, 9.8, 0], [9.8, 0, 0]])])
    header = "fx,fy,fz,tx,ty,tz,gx,gy,gz"
    np.savetxt(file, rows, delimiter=",", header=header, comments="")
    assert diagnose([str(file)]) == 1
    assert "few.csv: 3 blocks of readings" in capsys.readouterr().err


@measured
@pytest.mark.slow
def test_an_industrial_arms_axis_and_a_grasper(capsys, tmp_path):
    names = "motor=motor_angle_3_rad,link=link_angle_3_rad,torque=motor_torque_3_Nm"
    command = [str(REAL / "kr300_joints" / "run_a.csv"), "--columns", f"t=t_s,{names}"]
    assert diagnose([*command, "--torque-gear", "252.333"]) == 0
    folder = tmp_path / "diagnosis_run_a"
    answer = json.loads((folder / "diagnosis.json").read_text())
    assert answer["sentence"][:30] in (folder / "report.html").read_text().replace("&#39;", "'")
    causes = {cause["effect"]: cause for cause in answer["causes"]}
    delay = causes["encoder_delay"]
    assert delay["probability"] > 0.9
    assert 2.5e-3 < delay["parameters"]["delay_s"]["value"] < 3.2e-3
    assert delay["gap_closed"]["value"] > 0.95
    assert "unknown" in causes  # fifteen times the noise is left
    files = [str(file) for file in sorted((REAL / "davinci_tool").glob("*.csv"))]
    names = "t=t_s,motor=output_angle_rad,link=input_angle_rad,torque=input_torque_Nm"
    options = ["--opposite", "--time-scale", "1000", "--columns", names, "--json", "--no-report"]
    capsys.readouterr()
    assert diagnose([*files, *options]) == 0
    answer = json.loads(capsys.readouterr().out)
    shares = {one["effect"]: one["probability"] for one in answer["ranking"]}
    assert min(shares["backlash"], shares["joint_compliance"], shares["gear_error"]) > 0.5
