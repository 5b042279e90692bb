# SPDX-License-Identifier: Apache-2.0
"""Orientation tables and joints: the evidence against dense densities, planted causes, commands."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.tables import OrientationTable
from galen_diagnosis.diagnose import main as diagnose
from galen_diagnosis.effects.joint_terms import Columns
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.tables.joint_evidence import BlockEvidence, LagRows
from galen_diagnosis.tables.orientations import table_recording
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import rotvec_to_matrix
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
    values = random.standard_normal((count, 3))
    nominal, way = Columns(values[:, :1]), Columns(values[:, 1:])
    rows = LagRows(
        residual=3.0 * random.standard_normal(count),
        floor=0.5,
        at_s=np.arange(float(count)),
        block=np.repeat([0, 1, 2], 4),
        labels=("0", "1", "2"),
        memories_s=(2.0,),
        nominal=nominal,
        effects={"e": (way,)},
    )
    evidence = BlockEvidence(rows)
    found = evidence.hypothesis(("e",), [(way,)], floor_only=False)
    # the whole covariance of the readings, weights of variance one
    scaled = values / rows.floor
    covariance = scaled @ scaled.T
    for b in range(3):
        of = np.flatnonzero(rows.block == b)
        covariance[np.ix_(of, of)] += evidence.forms[found.form].covariance(rows.at_s[of])
    reading = rows.residual / rows.floor
    everything = multivariate_normal(np.zeros(count), covariance).logpdf(reading)
    for b in range(3):
        others = np.flatnonzero(rows.block != b)
        part = multivariate_normal(np.zeros(len(others)), covariance[np.ix_(others, others)])
        assert found.elpd[b] == pytest.approx(everything - part.logpdf(reading[others]), abs=1e-6)
    # the best linear prediction of a block from the others is the conditional mean
    held, others = (np.flatnonzero((rows.block == 1) == one) for one in (True, False))
    gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[np.ix_(others, held)]).T
    left = reading[held] - gain @ reading[others]
    assert evidence.held_out(found)[held] == pytest.approx(left, abs=1e-8)


def test_a_wrist_turns_as_the_table_says():
    for rotation in (True, False):
        table = pose_table(12)
        if not rotation:
            table = replace(table, rotation=None)
        load = Load(0.8, np.array([0.01, -0.02, 0.05]))
        wrench = gravity_wrench(table.gravity, load) + np.arange(6.0)
        noise = 0.01 * np.random.default_rng(0).standard_normal((200, 6))
        recording = table_recording(replace(table, wrench=wrench), noise=noise)
        (bag,) = recording.bags.values()
        found, _ = recording.arm.sensor_pose(bag.joints)
        gravity = recording.arm.gravity_m_s2 @ found
        assert gravity == pytest.approx(table.gravity, abs=1e-9)
        if rotation:
            assert found == pytest.approx(table.rotation, abs=1e-9)
        observation = Observation(recording)
        rows = observation.nominal.reshape(12, 6) * recording.readings.noise_std
        assert rows == pytest.approx(rows.mean(axis=0) * np.ones((12, 1)), abs=1e-6)
        # the load that is fitted beside every cause takes a wrong mass whole
        heavy = replace(load, mass_kg=1.1)
        change = (
            gravity_wrench(table.gravity, heavy) - gravity_wrench(table.gravity, load)
        ).ravel()
        rows = change / np.tile(recording.readings.noise_std, 12)
        left = (
            rows - observation.unknown @ np.linalg.lstsq(observation.unknown, rows, rcond=None)[0]
        )
        assert np.abs(left).max() < 1e-9 * np.abs(rows).max()


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["none", "sensor_mount_rotation", "unknown"])
def test_a_planted_cause_is_found_in_a_table(cause):
    random = np.random.default_rng([2, len(cause)])
    table, sigma = pose_table(), np.repeat([0.02, 0.001], 3)
    load = Load(0.9, np.array([0.004, -0.003, 0.045]))
    offset = np.array([9.0, -1.0, 5.0, 0.4, -0.7, -0.15])
    turn = rotvec_to_matrix(
        [0.05, -0.04, 0.03] if cause == "sensor_mount_rotation" else np.zeros(3)
    )
    weight = gravity_wrench(table.gravity, load)
    wrench = np.hstack([weight[:, :3] @ turn, weight[:, 3:] @ turn]) + offset
    if cause == "unknown":  # each stop has a constant of its own
        wrench += np.repeat([0.3, 0.012], 3) * random.standard_normal(wrench.shape)
    made = replace(table, wrench=wrench + sigma * random.standard_normal(wrench.shape))
    noise = sigma * random.standard_normal((700, 6))
    answer = diagnose_recording(table_recording(made, noise=noise)).answer
    shares = dict(answer.ranking)
    assert set(shares) >= {"none", "unknown", "axis_gain", "sensor_drift", "cable_drag"}
    if cause == "sensor_mount_rotation":
        (named,) = answer.causes
        assert cause in (named.effect, *named.equivalent), answer.sentence
        assert answer.gap["closed_fraction"]["value"] > 0.9
    else:
        assert answer.verdict == cause, answer.sentence


@pytest.mark.slow
def test_what_is_healthy_decides_of_a_table_too(tmp_path, capsys):
    """3 % of fz in fx is within 2 deviations of a usual sensor's, and far beyond a better one's."""
    random = np.random.default_rng(5)
    table, sigma = pose_table(24), np.repeat([0.02, 0.001], 3)
    wrench = gravity_wrench(table.gravity, Load(0.9, np.array([0.004, -0.003, 0.045])))
    wrench[:, 0] += 0.03 * wrench[:, 2]
    rows = np.hstack([wrench + sigma * random.standard_normal(wrench.shape), table.gravity])
    noise = sigma * random.standard_normal((200, 6))
    names = "fx,fy,fz,tx,ty,tz"
    for file, values, header in (("t.csv", rows, f"{names},gx,gy,gz"), ("n.csv", noise, names)):
        np.savetxt(file, values, delimiter=",", header=header, comments="")
    limits = dict.fromkeys(("axis_gain", "crosstalk", "sensor_mount_rotation"), 0.001)
    own = {"schema_version": 1, "name": "calibrated", "limits": limits}
    Path("own.json").write_text(json.dumps(own))
    command = ["t.csv", "--noise", "n.csv", "--json", "--overwrite"]
    assert diagnose(command) == 0
    assert Path("diagnosis_t/pictures/budget.png").stat().st_size > 5000
    assert "24 readings" in Path("diagnosis_t/report.html").read_text()
    usual = json.loads(capsys.readouterr().out)
    assert usual["verdict"] == "none"
    parts = [one for one in usual["budget"] if one["effect"] == "crosstalk"]
    assert {one["specification"] for one in parts} <= {"within", "undecided"} and parts
    assert diagnose([*command, "--no-report", "--specification", "own.json"]) == 0
    better = json.loads(capsys.readouterr().out)
    assert better["specification"]["name"] == "calibrated"
    (cause,) = better["causes"]
    assert (cause["parameters"]["from"], cause["parameters"]["to"]) == ("fz", "fx")
    low, high = cause["parameters"]["coefficient"]["ci95"]
    assert low < 0.03 < high


@measured
@pytest.mark.slow
def test_a_sensor_that_creeps_at_six_stops_is_nothing_listed(tmp_path):
    readings = (REAL / "axia80" / "GP2025-07-22-22-06-02.txt").read_text().replace(" ", "")
    table = tmp_path / "axia80.csv"
    table.write_text("t,fx,fy,fz,tx,ty,tz,qx,qy,qz,qw\n" + readings)
    assert diagnose([str(table), "--specification", "ati_axia80", "--no-report"]) == 0
    answer = json.loads((tmp_path / "diagnosis_axia80" / "diagnosis.json").read_text())
    assert answer["verdict"] == "unknown"
    # What is fitted to five stops doesn't hold at the sixth: nothing is said to be a part of it.
    shares = {one["effect"]: one["share"]["value"] for one in answer["budget"]}
    assert sum(shares.values()) == pytest.approx(1.0) and shares["residual"] <= 1.0


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


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        (
            np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0], [-1, 0, 0]]),
            "4 readings are too few to show",
        ),
        (np.tile([0.0, 0.6, 0.8], (8, 1)), "all readings have gravity along one direction"),
    ],
)
def test_a_table_that_can_not_tell_its_load_or_noise_is_rejected(capsys, directions, message):
    gravity = 9.81 * directions
    rows = np.hstack([gravity_wrench(gravity, Load(0.8, np.array([0.01, 0.0, 0.05]))), gravity])
    rows[:, :6] += 0.01 * np.random.default_rng(0).standard_normal((len(rows), 6))
    np.savetxt("t.csv", rows, delimiter=",", header="fx,fy,fz,tx,ty,tz,gx,gy,gz", comments="")
    assert diagnose(["t.csv"]) == 1
    assert f"t.csv: {message}" in capsys.readouterr().err


def test_a_table_without_any_noise_is_no_gap(capsys):
    gravity = pose_table(9).gravity
    rows = np.hstack([gravity_wrench(gravity, Load(0.8, np.array([0.01, 0.0, 0.05]))), gravity])
    np.savetxt("t.csv", rows, delimiter=",", header="fx,fy,fz,tx,ty,tz,gx,gy,gz", comments="")
    assert diagnose(["t.csv", "--no-report", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "none"


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
