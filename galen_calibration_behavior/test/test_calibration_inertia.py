# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag --estimate inertia`: the file gets it and keeps the rest, or is as it was."""

import json

import numpy as np
import pytest
from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibrate_from_bag import main
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_common.command import EXIT_FAILED, EXIT_USAGE
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.files.calibration_file import (
    CalibrationFile,
    read_calibration,
    write_calibration,
    zeroed_at,
)
from galen_model.load.inertia import inertial_wrench, point_mass_inertia
from galen_model.load.model import ADAPTER, TOOLS, LoadEstimate

LOAD = TOOLS["retractor"].load
INERTIA = point_mass_inertia(LOAD, ADAPTER) + np.array([3e-4, 5e-4, 4e-4, 2e-5, -4e-5, 1e-5])
RATES = np.array([3.1, 4.0, 3.6, 2.9, 3.7])


def write_recording(path, size):
    """26 s of swings at 100 Hz, each joint by its own size."""
    times = np.arange(0.0, 26.0, 0.01)
    angle = np.outer(times, RATES) + np.arange(5.0)
    q = GALEN.home + size * np.sin(angle)
    moving = sensor_motion(
        q, size * RATES * np.cos(angle), -size * RATES**2 * np.sin(angle), arm=GALEN
    )
    moments = LOAD.moments + ADAPTER.moments
    felt = GALEN.gravity_in_sensor(q[:, 3:]) - moving[2]
    wrenches = inertial_wrench(felt, moving[0], moving[1], moments, INERTIA)
    wrenches += SENSOR.noise_std * np.random.default_rng(1).standard_normal(wrenches.shape)
    joints = np.round(q / ENCODER_QUANTUM) * ENCODER_QUANTUM
    with BagWriter(path) as bag:
        joint_topic = bag.add_topic("joint_states", "sensor_msgs/msg/JointState")
        wrench_topic = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        states, forces = joint_state_bytes(GALEN.joint_names), wrench_bytes("ft_sensor")
        for time_s, joint, wrench in zip(times, joints, wrenches, strict=True):
            stamp = 1_790_000_000_000_000_000 + round(time_s * 1e9)
            bag.write(joint_topic, stamp, states.fill(stamp, joint, np.zeros(5)))
            bag.write(wrench_topic, stamp + 1000, forces.fill(stamp, wrench))


@pytest.fixture
def tools(tmp_path):
    def estimate(load):
        return LoadEstimate(load.mass_kg, load.com_m, np.diag([1e-5, 2e-5, 2e-5, 2e-5]) ** 2)

    tool = CalibrationFile(
        tool="retractor",
        load=estimate(LOAD),
        adapter=estimate(ADAPTER),
        tip_m=np.array([0.18, 0.01, 0.05]),
        rmse=np.full(6, 1e-3),
        poses_used=56,
        calibrated_at="2026-09-21T12:00:00+00:00",
        residual_offset=np.arange(6) * 1e-3,
        arm=GALEN,
        zeroing=zeroed_at(arm=GALEN),
    )
    write_calibration(tmp_path / "retractor.json", tool)
    return tmp_path


def run(capsys, *arguments):
    try:
        code = main([str(a) for a in (*arguments, "--estimate", "inertia")])
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_file_gets_the_inertia_and_keeps_the_rest(tools, capsys):
    write_recording(tools / "bag", np.array([0.04, 0.04, 0.04, 0.45, 0.35]))
    before = json.loads((tools / "retractor.json").read_text())
    args = ("retractor", tools / "bag", "--tools-dir", tools)
    code, out, _ = run(capsys, *args, "--dry-run", "--json")
    assert code == 0 and json.loads((tools / "retractor.json").read_text()) == before
    found = json.loads(out)
    assert found["agrees_with_file"] and found["blocks_left_out"] == 0
    code, out, _ = run(capsys, *args)
    assert code == 0 and "one standard deviation" in out and "written" in out
    estimate = read_calibration(tools / "retractor.json", arm=GALEN).inertia
    error = estimate.about_sensor_kg_m2 - INERTIA
    assert np.all(np.abs(error) < 4.5 * estimate.std_kg_m2)
    after = json.loads((tools / "retractor.json").read_text())
    assert after.pop("inertia") and after == before


def test_what_is_not_told_or_not_there_is_one_line_and_nothing_is_written(tools, capsys):
    write_recording(tools / "bag", np.array([0.04, 0.04, 0.04, 0.0, 0.35]))
    before = (tools / "retractor.json").read_bytes()
    for args, message in (
        (("retractor", tools / "bag"), "does not tell the inertia's xx"),
        (("pointer", tools / "bag"), "pointer.json: can't be read"),
        (("retractor", tools / "no_bag"), "no_bag"),
    ):
        code, out, err = run(capsys, *args, "--tools-dir", tools)
        assert (code, out) == (EXIT_FAILED, "")
        assert message in err and err.count("\n") == 1
    assert run(capsys, "../x", tools / "bag")[0] == EXIT_USAGE
    assert (tools / "retractor.json").read_bytes() == before
