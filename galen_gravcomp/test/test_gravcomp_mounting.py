# SPDX-License-Identifier: Apache-2.0
"""A mis-mounted sensor through the compensator and through tables of readings."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_files import tool_file
from galen_bags.arrays.tables import read_table
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.evaluate.command import main
from galen_gravcomp.evaluate.table_scores import evaluate_table, table_prediction, tool_from_table
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN
from galen_model.calibrated.prediction import Prediction
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration
from galen_model.load.mounting import Mounting
from galen_model.load.mounting_worth import MOUNTED, PLAIN
from sample_blocks import topic
from scipy.spatial.transform import Rotation

TURNED = replace(
    Mounting.of(GALEN),
    sensor_rotvec_rad=np.array([0.1, -0.2, 0.15]),
    axis_gain=np.array([0.02, -0.03, 0.01, 0.04, -0.02, 0.03]),
    base_inclination_rad=np.array([0.05, -0.08, 0.0]),
    joint_zero_rad=np.array([0.03, 0.06]),
)
TOOL = tool_file(
    residual_offset=np.array([0.01, -0.02, 0.03, 1e-3, -2e-3, 3e-3]),
    gravity_m_s2=np.array([0.0, 0.0, -9.81]),
    mounting=TURNED,
)
PUSH = np.array([5.0, -3.0, 2.0, 0.1, 0.2, -0.3])
NOISE = np.array([2e-3, 2e-3, 3e-3, 4e-5, 4e-5, 4e-5])


def sensed(wrench):
    """A wrench in ft_sensor as the turned element with its gains reads it, by rotations."""
    turn = Rotation.from_rotvec(TURNED.sensor_rotvec_rad).inv()
    axes = np.concatenate([turn.apply(wrench[:3]), turn.apply(wrench[3:])])
    return axes * (1.0 + TURNED.axis_gain)


@pytest.mark.parametrize("tool", [TOOL, replace(TOOL, mounting=None)])
def test_the_fast_prediction_is_the_tools_own(tool):
    prediction = Prediction(tool, arm=GALEN)
    angles = np.random.default_rng(0).uniform(-4.0, 4.0, (40, 2))
    expected = tool.predict(angles)
    np.testing.assert_allclose(prediction.readings(angles), expected, atol=1e-13)
    assert prediction.readings(angles[:0]).shape == (0, 6)
    found = [prediction.reading(one) for one in angles.tolist()]
    np.testing.assert_allclose(found, expected, atol=1e-13)


@pytest.mark.parametrize("as_arrays", [False, True])
def test_a_push_on_a_mismounted_sensor_comes_out_right_one_by_one_and_in_blocks(as_arrays):
    """With the monitor a block is pushed one by one."""
    count = 60
    stamps = 10**9 + 2_000_000 * np.arange(count)
    walk = np.random.default_rng(1).normal(size=(count, 2))
    angles = np.cumsum(walk, axis=0) * 1e-3 + [0.4, -0.3]
    raw = TOOL.predict(angles) + sensed(PUSH)
    made = Compensator(GravcompParameters(calibration_monitor=not as_arrays), arm=GALEN)
    made.set_tool(TOOL)
    out = made.push_block(np.tile([False, True], count), topic(stamps, angles), topic(stamps, raw))
    assert (made.pushed_as_arrays > 0) == as_arrays
    np.testing.assert_allclose(out.wrench, np.tile(PUSH, (count, 1)), atol=1e-12)


def write_table(path, turn_deg=2.0, rows=28):
    """Readings of a sensor whose element is turned about z, under random orientations."""
    rng = np.random.default_rng(2)
    quaternions = Rotation.random(rows, random_state=rng).as_quat()
    gravity = Rotation.from_quat(quaternions).inv().apply([0.0, 0.0, -9.80665])
    force = 0.5 * gravity
    torque = np.cross([0.05, 0.02, 0.06], force)
    turn = Rotation.from_euler("z", turn_deg, degrees=True).inv()
    wrench = np.concatenate([turn.apply(force), turn.apply(torque)], axis=1) + 0.2
    wrench += NOISE * rng.standard_normal(wrench.shape)
    table = np.column_stack([wrench, quaternions])
    names = "fx,fy,fz,tx,ty,tz,qx,qy,qz,qw"
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.9g")


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "readings.csv"
    write_table(path)
    return str(path)


def test_a_model_with_the_mounting_wins_on_held_out_readings_of_a_turned_sensor(table):
    readings = read_table(table, arm=GALEN)
    readings = replace(readings, block=np.arange(len(readings)) * 4 // len(readings))
    result = evaluate_table(readings, mounting=("sensor_rotation",))
    found, scores = result.mounted, result.scores["leave one block out"]
    std = np.degrees(found.mounting.std[:3])
    assert np.all(np.abs(np.degrees(found.mounting.vector[:3]) - [0.0, 0.0, 2.0]) < 4.0 * std)
    assert result.worth.pays
    assert scores[MOUNTED].rmse[0] < 0.1 * scores[PLAIN].rmse[0]
    assert np.all(scores[MOUNTED].rmse < 1.5 * NOISE)
    file = tool_from_table("gripper", readings, found, found)
    assert file.mounting is not None
    left = readings.wrench - table_prediction(file, readings)
    np.testing.assert_allclose(np.sqrt(np.mean(left**2, axis=0)), file.rmse, rtol=1e-9)
    assert np.all(file.rmse < 1.4 * NOISE)


@pytest.mark.slow
def test_the_command_shows_the_mounting_beside_the_other_models(tmp_path, capsys):
    path, file = tmp_path / "readings.csv", tmp_path / "gripper.json"
    write_table(path, rows=9)
    arguments = [str(path), "--estimate", "sensor_rotation"]
    assert main([*arguments, "--write-tool", str(file)]) == 0
    assert "the mounting's parameters pay" in " ".join(capsys.readouterr().out.split())
    assert read_calibration(file, arm=GALEN).mounting.estimated == ("sensor_rotation",)


def test_a_table_rejects_what_it_can_not_tell(table, capsys):
    assert main([table, "--estimate", "axis_gain"]) == 1
    assert "the common force gain and the masses" in capsys.readouterr().err
    assert main([table, "--estimate", "roll_zero"]) == 1
    assert "not identifiable from these poses: the roll joint's zero" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([table, "--estimate", "everything"])
    assert "'everything' can't be estimated" in capsys.readouterr().err
    with pytest.raises(GalenError, match="holds zeros of joints"):
        table_prediction(TOOL, read_table(table, arm=GALEN))


def test_an_inclined_base_is_followed_in_a_table_of_angles(tmp_path):
    only = replace(Mounting.of(GALEN), base_inclination_rad=np.array([0.05, -0.08, 0.0]))
    tool = replace(TOOL, mounting=only, gravity_m_s2=np.array([0.0, 0.0, -9.80665]))
    path = tmp_path / "angles.csv"
    roll, tilt = np.random.default_rng(3).uniform(-1.0, 0.9, (2, 16))
    wrench = tool.predict(np.stack([roll, tilt], axis=-1))
    rows = np.column_stack([wrench, roll, tilt])
    np.savetxt(path, rows, delimiter=",", header="fx,fy,fz,tx,ty,tz,roll,tilt", comments="")
    readings = read_table(path, arm=GALEN)
    np.testing.assert_allclose(table_prediction(tool, readings), wrench, atol=1e-9)
    level = replace(readings, rotation=None)
    with pytest.raises(GalenError, match="inclination of the base, which needs"):
        table_prediction(tool, level)
