# SPDX-License-Identifier: Apache-2.0
"""Measured tables as bags: gravity's direction by roll and tilt, stamps, errors by name."""

from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_bags.convert import angles_of, main, stamps_ns
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import matrix_to_quaternion, quaternion_to_matrix, rotvec_to_matrix
from scipy.spatial.transform import Rotation

LOAD = Load(0.9, np.array([0.002, -0.001, 0.044]))
OFFSET = np.array([9.0, -1.0, 10.0, 0.4, -0.7, -0.2])
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="measured data is not beside the checkout"
)


def turning(count=50, seed=1):
    """R_base_sensor (n, 3, 3) of a sensor that turns about all axes, slowly."""
    rng = np.random.default_rng(seed)
    return rotvec_to_matrix(np.cumsum(0.1 * rng.standard_normal((count, 3)), axis=0) + [0, 2.5, 0])


def reading(rotation, wrench_frame="sensor"):
    gravity = np.einsum("nji,j->ni", rotation, GRAVITY_M_S2)
    wrench = gravity_wrench(gravity, LOAD) + OFFSET
    if wrench_frame == "base":
        return np.concatenate(
            [np.einsum("nij,nj->ni", rotation, part) for part in np.split(wrench, 2, axis=1)], 1
        )
    return wrench


def write(path, names, *columns):
    rows = np.column_stack(columns)
    lines = [",".join(names), *(",".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


WRENCH = ["fx", "fy", "fz", "tx", "ty", "tz"]
QUATERNION = ["qx", "qy", "qz", "qw"]


def residual(bag):
    """The recording's wrenches less what the load reads at its roll and tilt."""
    recording = read_arm(bag, arm=GALEN)
    gravity = GALEN.gravity_in_sensor(recording.joints[:, 3:])
    return recording.wrenches - gravity_wrench(gravity, LOAD) - OFFSET


@pytest.mark.parametrize("frame", ["sensor", "base"])
def test_a_known_load_is_compensated_to_zero(tmp_path, frame, capsys):
    rotation = turning()
    time = 100.0 + 0.01 * np.arange(len(rotation))
    table = write(
        tmp_path / "t.csv",
        ["t", *QUATERNION, *WRENCH],
        time, matrix_to_quaternion(rotation), reading(rotation, frame),
    )  # fmt: skip
    bag = tmp_path / "bag"
    assert main([table, "-o", str(bag), "--wrench-frame", frame]) == 0
    assert "wrench_raw: 50 messages over 0.490 s, 100.0 Hz" in capsys.readouterr().out
    assert np.abs(residual(bag)).max() < 1e-9
    recording = read_arm(bag, arm=GALEN)
    assert recording.frame_ids == ("ft_sensor",)
    assert recording.joints[:, :3] == pytest.approx(np.tile(GALEN.home[:3], (50, 1)))
    expected_ns = 100_000_000_000 + 10_000_000 * np.arange(50)
    assert recording.joint_stamp_ns.tolist() == expected_ns.tolist()
    assert recording.wrench_stamp_ns.tolist() == expected_ns.tolist()
    assert recording.wrench_log_ns.tolist() == expected_ns.tolist()
    assert recording.joint_velocities[1:-1] == pytest.approx(
        (recording.joints[2:] - recording.joints[:-2]) / 0.02
    )


def test_two_tables_keep_their_own_rates_and_stamps(tmp_path):
    rotation = turning()
    start_us = 1_708_857_503_929_122
    wrench_us = start_us + 1_433 * np.arange(200)
    orientation_us = start_us + 117 + 10_085 * np.arange(50)
    wrenches = write(tmp_path / "w.csv", ["t", *WRENCH], wrench_us, np.ones((200, 6)))
    orientations = write(
        tmp_path / "o.csv", ["t", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))],
        orientation_us, rotation.reshape(-1, 9),
    )  # fmt: skip
    bag = tmp_path / "bag"
    files = ["--wrench", wrenches, "--orientations", orientations]
    assert main([*files, "--time-unit", "us", "-o", str(bag)]) == 0
    recording = read_arm(bag, arm=GALEN)
    assert recording.wrench_stamp_ns.tolist() == (1000 * wrench_us).tolist()
    assert recording.joint_stamp_ns.tolist() == (1000 * orientation_us).tolist()
    gravity = GALEN.gravity_in_sensor(recording.joints[:, 3:])
    assert gravity == pytest.approx(np.einsum("nji,j->ni", rotation, GRAVITY_M_S2), abs=1e-9)


def test_stamps_that_step_back_stay_as_they_are(tmp_path, capsys):
    time = [1.0, 1.1, 1.05, 1.05, 1.2]
    table = write(
        tmp_path / "t.csv", ["t", "roll", "tilt", *WRENCH], time, np.zeros((5, 2)), np.eye(5, 6)
    )
    assert main([table, "-o", str(tmp_path / "bag")]) == 0
    assert "wrench_raw: 2 stamps are not after the one before them" in capsys.readouterr().out
    recording = read_arm(tmp_path / "bag", arm=GALEN)
    assert (recording.wrench_stamp_ns / 1e9).tolist() == time
    assert (recording.wrench_log_ns / 1e9).tolist() == [1.0, 1.1, 1.1, 1.1, 1.2]
    assert np.argmax(recording.wrenches, axis=1).tolist() == [0, 1, 2, 3, 4]
    assert np.all(np.isfinite(recording.joint_velocities))


def test_where_tilt_has_no_meaning_the_last_one_is_kept():
    half_pi = np.pi / 2
    roll = np.array([half_pi, half_pi, 1.5, half_pi, 1.5, -half_pi, -1.5])
    tilt = np.array([0.0, 0.0, 0.4, 0.0, 0.5, 0.0, -0.6])
    found, lost = angles_of(GALEN.gravity_in_sensor(np.stack([roll, tilt], axis=-1)))
    assert found[:, 0] == pytest.approx(roll)
    assert found[:, 1] == pytest.approx([0.4, 0.4, 0.4, 0.4, 0.5, 0.5, -0.6])
    assert lost.tolist() == [True, True, False, True, False, True, False]
    found, lost = angles_of(np.array([[0.0, -9.8, 0.0]] * 3))
    assert found[:, 0] == pytest.approx([half_pi] * 3)
    assert found[:, 1].tolist() == [0.0] * 3
    assert lost.all()


def test_gravity_is_the_options_and_a_wrong_one_is_named(tmp_path, capsys):
    """On a wall gravity is along x of the base; readings one by one don't wind tilt up."""
    rng = np.random.default_rng(3)
    rotation = Rotation.random(24, rng).as_matrix()
    down = np.einsum("nji,j->ni", rotation, [9.80665, 0.0, 0.0])
    wrench = gravity_wrench(down, LOAD) + 0.01 * rng.normal(size=(24, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    quaternion = Rotation.from_matrix(rotation).as_quat()
    table = tmp_path / "t.csv"
    write(table, ["qx", "qy", "qz", "qw", *WRENCH], quaternion, wrench)
    bag = tmp_path / "bag"
    command = [str(table), "--rate-hz", "1", "-o", str(bag)]
    assert main(command) == 1
    assert "--gravity 9.80665 0 0" in capsys.readouterr().err
    assert not bag.exists()
    assert main([*command, "--gravity", "9.80665", "0", "0"]) == 0
    recording = read_arm(bag, arm=GALEN)
    turned = GALEN.gravity_in_sensor(GALEN.angles(recording.joints))
    np.testing.assert_allclose(turned, down, atol=1e-6)
    assert np.all(np.abs(recording.joints) < 3.2)


@pytest.mark.parametrize(
    ("times", "unit", "expected"),
    [
        ([0.0952829, 0.195285], "s", [95_282_900, 195_285_000]),
        ([5.0, 5.25], "ms", [5_000_000, 5_250_000]),
        ([-1.0, 0.0], "s", [1_000_000_000, 2_000_000_000]),
        ([1_700_000_000_123_457.0], "us", [1_700_000_000_123_457_000]),
    ],
)
def test_times_become_stamps_to_the_nanosecond(times, unit, expected):
    (found,) = stamps_ns([np.array(times)], unit)
    assert found.tolist() == expected


def test_times_that_no_stamp_can_hold():
    with pytest.raises(ValueError, match=r"go up to 1.7e\+15 s, beyond any stamp: are they in s"):
        stamps_ns([np.array([1.7e15])])


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["roll", "tilt", *WRENCH], [], "t.csv: no column 't'; give the readings' --rate-hz"),
        (["t", "roll", *WRENCH], [], "t.csv: no orientation"),
        (["t", "roll", "tilt", *WRENCH], ["--rate-hz", "5"], "t.csv: has a column 't'"),
    ],
)
def test_a_table_that_can_not_be_converted_leaves_no_bag(tmp_path, capsys, names, options, message):
    table = write(tmp_path / "t.csv", names, np.zeros((3, len(names))))
    assert main([table, "-o", str(tmp_path / "bag"), *options]) == 1
    assert capsys.readouterr().err.strip().startswith(f"convert: {tmp_path}/{message}")
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["t.csv", "--wrench", "w.csv", "--orientations", "o.csv"],
        ["--wrench", "w.csv"],
        ["--wrench", "w.csv", "--orientations", "o.csv", "--wrench-frame", "base"],
        ["--wrench", "w.csv", "--orientations", "o.csv", "--rate-hz", "10"],
        ["--wrench", "w.csv", "--orientations", "o.csv", "--columns", "t,roll,tilt"],
        ["t.csv", "--rate-hz", "0"],
    ],
)
def test_wrong_arguments_are_a_matter_of_usage(options):
    with pytest.raises(SystemExit) as end:
        main(["-o", "bag", *options])
    assert end.value.code == 2


@needs_shared
def test_the_axia80_over_time(tmp_path):
    table = SHARED / "axia80" / "GP2025-07-22-22-06-02.txt"
    names = "t,fx,fy,fz,tx,ty,tz,qx,qy,qz,qw"
    assert main([str(table), "--columns", names, "-o", str(tmp_path / "bag")]) == 0
    recording = read_arm(tmp_path / "bag", arm=GALEN)
    values = np.loadtxt(table, delimiter=",")
    assert recording.wrenches == pytest.approx(values[:, 1:7], abs=0)
    assert recording.wrench_stamp_ns * 1e-9 == pytest.approx(values[:, 0], abs=1e-9)
    gravity = GALEN.gravity_in_sensor(recording.joints[:, 3:])
    expected = np.einsum("nji,j->ni", quaternion_to_matrix(values[:, 7:]), GRAVITY_M_S2)
    assert gravity == pytest.approx(expected, abs=1e-9)
