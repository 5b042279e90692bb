# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag` from recordings made in memory to file and page."""

import dataclasses
import html
import json
import re

import numpy as np
import pytest
from calibration_tape import POINTER, Tape, grid
from galen_calibration_behavior.calibrate_from_bag import main
from galen_calibration_behavior.from_bag import page
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration

UNITS = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
POSES = grid(rolls=(-1.2, -0.7, -0.2, 0.3, 0.8, 1.3))
TOPICS = ("/joint_states", "/ft/wrench", "/ft/temperature")


@pytest.fixture
def calibrate(monkeypatch, capsys, tmp_path):
    """Calibrate a recording; its result, its page's text and how many pictures that has."""

    def run(recording, *arguments):
        topics = TOPICS if len(recording.temperature_c) else TOPICS[:2]
        recording = dataclasses.replace(recording, topics=topics)
        read = "galen_calibration_behavior.from_bag.loads.read_arm"
        monkeypatch.setattr(read, lambda *_, **_options: recording)
        code = main(["pointer", "tape", "--json", "--tools-dir", str(tmp_path), *arguments])
        printed = capsys.readouterr()
        assert code == 0, printed.err
        found = json.loads(printed.out)
        assert found["page"] == str(tmp_path / "pointer.html")
        written = (tmp_path / "pointer.html").read_text()
        shown = re.sub(r"<[^>]*>", " ", re.sub(r"<style>.*</style>", "", written, flags=re.DOTALL))
        return found, " ".join(html.unescape(shown).split()), written.count("data:image/png")

    return run


def test_a_bias_that_creeps_is_found_by_default_and_drawn(calibrate, tmp_path):
    """Both sweeps of 18 poses; the bias creeps by 0.3 N, 6 mN.m over them, ever faster."""
    tape = Tape(5).calibration(POINTER, POSES).recording()
    part = np.linspace(0.0, 1.0, len(tape.wrenches))
    creep = 0.3 * UNITS * part[:, None] ** 2
    warm = {
        "temperature_stamp_ns": tape.wrench_stamp_ns[::100],
        "temperature_c": 25.0 + 3.0 * part[::100],
    }
    tape = dataclasses.replace(tape, wrenches=tape.wrenches + creep, **warm)
    found, text, pictures = calibrate(tape)
    assert "drift" in found["model"] and found["model_reason"]
    assert any("drifted" in warning for warning in found["warnings"])
    file = read_calibration(tmp_path / "pointer.json", arm=GALEN)
    assert file.model == found["model"]
    off = np.linalg.norm((file.residual_offset - creep[-1])[:3])
    assert off < 0.5 * np.linalg.norm(creep[-1, :3])
    assert found["model"] in text and found["model_reason"] in text
    assert re.search(r"temperature changed by 2\.\d K while its bias drifted", text)
    assert pictures == 4


@pytest.mark.usefixtures("plain_fit")
def test_a_healthy_recording_has_no_remarks_but_of_the_order_of_its_poses(calibrate):
    tip = ("--tip", "0.15", "0", "0.05")
    mixed = [POSES[k] for k in np.random.default_rng(3).permutation(len(POSES))]
    found, text, pictures = calibrate(Tape(5).calibration(POINTER, mixed).recording(), *tip)
    assert "no remarks" in text and "do better" not in text
    serpentine = Tape(5).calibration(POINTER, POSES).recording()
    _, other, _ = calibrate(serpentine, *tip, "--replace-newer")
    assert "1 remark" in other and "in the order of these poses a drift" in other
    assert pictures == 3  # none of a bias that is constant
    assert f"{1e3 * found['mass_kg']:.2f} ± {1e3 * found['mass_std_kg']:.2f} g" in text
    for told in (*TOPICS[:2], "poses with the tool 18 used of 18", "tool came on between"):
        assert told in text


@pytest.mark.usefixtures("plain_fit")
def test_what_was_not_good_is_told_with_its_number(calibrate):
    tape = Tape(5)
    tape.bias = -0.4 * UNITS  # never zeroed
    tape.stay(1.5).sweep(POSES[:8], still_s=0.6)
    tape.sweep(POSES[2:10], still_s=3.0).stay(3.0)
    tape.tool = POINTER
    tape.sweep(POSES, still_s=3.0)
    tape.touch = lambda time_s: np.array([0.2 * (time_s > 0.6), 0, 0, 0, 0, 0])
    tape.move(POSES[0]).stay(2.0)
    recording = tape.recording()
    kept = np.random.default_rng(1).random(len(recording.joints)) > 0.05
    rows = {
        name: getattr(recording, name)[kept]
        for name in ("joints", "joint_velocities", "joint_stamp_ns", "joint_log_ns")
    }
    wrenches = recording.wrenches.copy()
    noise = np.random.default_rng(2).standard_normal(len(wrenches))
    wrenches[:, 1] += 0.1 * noise
    recording = dataclasses.replace(recording, **rows, wrenches=wrenches)
    _, text, _ = calibrate(recording)
    for told in (
        r"sweep without the tool has \d+ poses: from 12 on",
        r"\d+ stops lasted at most 0\.59 s and give no pose: hold each for the 0\.8 s",
        r"1 of \d+ poses were not still \(fx scattered \d\.\d times as much",
        r"not zeroed: in the pose of the zeroing it read \d\.\d+ N \(fx\), more than 0\.1 N",
        r"fy is \d\.\d times as noisy as the other axes \(\d+\.?\d* mN an average\)",
        r"\d+ of \d+ samples of /joint_states are missing, up to 0\.0\d s at once",
        r"held for 2\.\d s and more: -p average_s:=2\.\d lowers white noise by 5\d%",
    ):
        assert re.search(told, text), (told, text)


@pytest.mark.usefixtures("plain_fit")
def test_a_missing_orientation_is_named_with_what_it_is_worth(calibrate):
    few = [pose for pose in POSES if pose[1] > -0.5][:8]
    _, text, _ = calibrate(Tape(5).calibration(POINTER, few).recording())
    assert re.search(r"one more pose with [+-][xyz] .*of ft_sensor down", text)
    assert re.search(r"would lower the error of the compensation by \d\d%", text)


@pytest.mark.slow
def test_residuals_of_the_page_are_the_fit_s(calibrate, monkeypatch):
    tables = []
    of = page.pose_table
    monkeypatch.setattr(page, "pose_table", lambda *all: tables.append(of(*all)) or tables[-1])
    tape = Tape(5).calibration(POINTER, POSES).recording()
    for arguments in ((), ("--estimate", "sensor_rotation"), ("--one-sweep",)):
        if "--one-sweep" in arguments:
            zeroed = Tape(6).stay(1.5).zero()
            zeroed.tool = POINTER
            tape = zeroed.stay(1.0).sweep(POSES).recording()
        found, *_ = calibrate(tape, *arguments, "--replace-newer")
        table = tables.pop()
        used = table.used & ~table.bare
        rmse = np.sqrt(np.mean(table.residual[used] ** 2, axis=0))
        assert rmse == pytest.approx([*found["rmse_force_n"], *found["rmse_torque_nm"]], rel=1e-6)
