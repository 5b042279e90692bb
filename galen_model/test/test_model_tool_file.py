# SPDX-License-Identifier: Apache-2.0
"""Calibration files: read back what was written, reject what is not one, survive a kill."""

import json

import numpy as np
import pytest
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError
from galen_model.files.calibration_file import (
    calibration_path,
    read_calibration,
    write_calibration,
    zeroed_at,
)
from galen_model.load.model import ADAPTER, TOOLS, Load, nominal_reading
from model_files import SIX_AXIS_URDF, calibration, read_content


def zeroing(joints, gravity=(0, 0, -9.80665)):
    return {"zeroing": {"joints": joints, "gravity_in_sensor_m_s2": gravity}}


def other_arm(name, *joints, sha256="0"):
    return {"arm": {"name": name, "joints": joints, "urdf_sha256": sha256}}


def load(mass_kg, com_m=(0, 0, 0)):
    return {"load": {"mass_kg": mass_kg, "com_m": com_m, "covariance": np.eye(4).tolist()}}


def test_what_is_written_is_read_back(tmp_path):
    path = calibration_path(tmp_path, "pointer")
    tool = calibration(
        residual_offset=np.arange(6) * 0.01, poses_rejected=("with the tool, pose 3: x",)
    )
    write_calibration(path, tool)
    again = read_calibration(path, arm=GALEN)
    assert again.to_json() == tool.to_json()
    assert "unresolved" not in json.loads(path.read_text())
    angles = np.array([[0.3, 0.1], [-1.0, 0.7]])
    weight = nominal_reading(angles, TOOLS["pointer"].load, ADAPTER, arm=GALEN)
    np.testing.assert_allclose(again.predict(angles), weight + tool.residual_offset, atol=1e-14)


def test_the_model_chosen_is_kept_and_may_lack(tmp_path):
    path = tmp_path / "pointer.json"
    words = {"model": "drifting bias", "model_reason": "8 blocks: 1.0 ± 0.1"}
    write_calibration(path, calibration(**words))
    content = json.loads(path.read_text())
    assert words.items() <= content.items()
    assert read_calibration(path, arm=GALEN).model_reason == words["model_reason"]
    before = {key: value for key, value in content.items() if key not in words}
    assert read_content(tmp_path, before).model_reason == ""


def schema_1(roll=0.3, tilt=-0.2, gravity=-9.8):
    """A file as it was written before the arm and the zeroing were in it."""
    content = calibration(gravity_m_s2=np.array([0.0, 0.0, gravity])).to_json()
    for key in ("arm", "zeroing"):
        del content[key]
    return content | {
        "schema_version": 1,
        "bias": content.pop("adapter"),
        "bias_pose_rad": {"roll": roll, "tilt": tilt},
    }


def test_a_file_of_schema_1_is_read_as_before(tmp_path):
    path, file = tmp_path / "pointer.json", read_content(tmp_path, schema_1())
    assert file.zero_angles.tolist() == [0.3, -0.2]
    assert file.arm.name == "galen" and not file.arm_warning
    angles = np.array([[0.3, 0.1], [-1.0, 0.7]])
    reading = nominal_reading(angles, TOOLS["pointer"].load, ADAPTER, (0.3, -0.2), arm=GALEN)
    np.testing.assert_allclose(file.predict(angles), reading * 9.8 / 9.80665, atol=1e-14)
    write_calibration(path, file)
    assert json.loads(path.read_text())["schema_version"] == 2
    again = read_calibration(path, arm=GALEN)
    np.testing.assert_array_equal(again.predict(angles), file.predict(angles))


def test_a_field_that_schema_1_lacks_is_named_as_there(tmp_path):
    content = schema_1()
    del content["bias"]
    with pytest.raises(CalibrationFileError, match="bias is missing"):
        read_content(tmp_path, content)


def test_another_urdf_of_the_same_arm_is_a_warning(tmp_path):
    content = calibration().to_json()
    content["arm"]["urdf_sha256"] = "ab" * 32
    warning = read_content(tmp_path, content).arm_warning
    assert "another URDF of the arm 'galen' (abababababab," in warning
    content["arm"]["urdf_sha256"] = ""  # not known: nothing to compare
    assert read_content(tmp_path, content).arm_warning == ""


def test_without_a_zeroing_the_adapter_is_weighed_like_the_tool(tmp_path):
    path = tmp_path / "pointer.json"
    write_calibration(path, calibration(zeroing=None))
    both = nominal_reading((0.3, 0.1), TOOLS["pointer"].load, Load(0.0), arm=GALEN)
    both = both + nominal_reading((0.3, 0.1), ADAPTER, Load(0.0), arm=GALEN)
    found = read_calibration(path, arm=GALEN).predict((0.3, 0.1))
    np.testing.assert_allclose(found, both, atol=1e-14)


def test_the_old_file_is_kept_as_bak(tmp_path):
    path = calibration_path(tmp_path, "pointer")
    write_calibration(path, calibration(mass_kg=0.06))
    assert not path.with_name("pointer.json.bak").exists()
    write_calibration(path, calibration(mass_kg=0.07))
    assert read_calibration(path, arm=GALEN).load.mass_kg == 0.07
    assert read_calibration(path.with_name("pointer.json.bak"), arm=GALEN).load.mass_kg == 0.06
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pointer.json", "pointer.json.bak"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": 3}, "schema_version is 3"),
        ({"schema_version": True}, "schema_version is True"),
        (other_arm("galen", *GALEN.joint_names, sha256=None), "arm.urdf_sha256 is None"),
        (load(0.0), "load.mass_kg"),
        (load(1e308), "load.mass_kg"),
        ({"adapter": load(-1e-9)["load"]}, "adapter.mass_kg"),
        (load(1.0, com_m=(0, 0)), "load.com_m has shape"),
        ({"tip_m": [0, 0, None]}, "tip_m does not hold numbers"),
        ({"residual_offset": {"force_N": [0, 0, 0]}}, "torque_Nm is missing"),
        ({"gravity_m_s2": [0, 0, 9.8]}, "gravity_m_s2"),
        ({"poses_used": -1}, "poses_used"),
        ({"poses_rejected": "all"}, "poses_rejected is not a list"),
        ({"model": ["constant"]}, "model is .'constant'.; expected one line"),
        ({"model_reason": "a" * 1001}, "model_reason has 1001 characters; at most 1000"),
        ({"model_reason": "two\nlines"}, "model_reason is .* expected one line"),
        ({"calibrated_at": "yesterday"}, "RFC 3339"),
        ({"calibrated_at": "2026-01-01T00:00:00"}, "time zone"),
        ({"tool": "../x"}, "letters, digits"),
        (zeroing({"roll": float("nan")}), "zeroing.joints.roll"),
        ({"sensor_frame": ""}, "sensor_frame"),
        (zeroing({"roll": 10**400}), "zeroing.joints.roll"),
        (zeroing({"pan": 0.0}), "zeroing.joints holds 'pan'; joints are delta_x"),
        (zeroing({}, gravity=(0, 0, -9.0)), "_m_s2 is 9 m/s.2 long; expected 9.80665"),
        ({"zeroing": []}, "zeroing is not an object"),
        (other_arm("ur5e", "pan"), "the arm 'ur5e' with the joints pan; this arm is 'galen'"),
        ({"tip_m": [10**400, 0, 0]}, "tip_m"),
        ({"tip_m": ["0.1", "0", "0"]}, "tip_m does not hold numbers"),
        ({"tip_m": [True, 0, 0]}, "tip_m does not hold numbers"),
        ({"tip_m": [1e200, 0, 0]}, "tip_m holds a value that"),
    ],
)
def test_a_wrong_field_is_named_with_the_file(tmp_path, change, message):
    with pytest.raises(CalibrationFileError, match=message) as error:
        read_content(tmp_path, calibration().to_json() | change)
    assert str(tmp_path / "pointer.json") in str(error.value)


@pytest.mark.parametrize("field", list(calibration().to_json()))
def test_a_missing_field_is_named(tmp_path, field):
    content = calibration().to_json()
    del content[field]
    with pytest.raises(CalibrationFileError, match=f"{field} is missing"):
        read_content(tmp_path, content)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_what_is_no_json_object_is_rejected(tmp_path, text):
    path = tmp_path / "pointer.json"
    path.write_bytes(text)
    with pytest.raises(CalibrationFileError, match=r"pointer\.json"):
        read_calibration(path, arm=GALEN)


@pytest.mark.parametrize("field", ["tip_m", "zeroing", "model"])
@pytest.mark.parametrize("depth", [400, 970])
def test_what_is_nested_too_deep_is_rejected(tmp_path, field, depth):
    content = {**calibration().to_json(), field: "HERE"}
    path = tmp_path / "pointer.json"
    path.write_text(json.dumps(content).replace('"HERE"', "[" * depth + "]" * depth))
    with pytest.raises(CalibrationFileError, match=r"pointer\.json"):
        read_calibration(path, arm=GALEN)


def test_what_can_not_be_read_is_not_written(tmp_path):
    path = calibration_path(tmp_path, "pointer")
    write_calibration(path, calibration())
    before = path.read_bytes()
    with pytest.raises(CalibrationFileError, match="not written"):
        write_calibration(path, calibration(mass_kg=float("nan")))
    with pytest.raises(CalibrationFileError, match="not written"):
        write_calibration(path, calibration(mass_kg=-1.0))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["pointer.json"]


def test_a_file_that_is_not_there_is_told_from_a_bad_one(tmp_path):
    with pytest.raises(CalibrationFileError, match="can't be read: No such file") as stop:
        read_calibration(tmp_path / "absent.json", arm=GALEN)
    assert isinstance(stop.value.__cause__, FileNotFoundError)
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(CalibrationFileError, match="not JSON") as stop:
        read_calibration(tmp_path / "bad.json", arm=GALEN)
    assert not isinstance(stop.value.__cause__, OSError)


STAND = (
    '<link name="stand"/><joint name="stood" type="fixed"><parent link="stand"/>'
    '<child link="base_link"/><origin rpy="0.3 0 0"/></joint><link name="base_link">'
)
STOOD = SIX_AXIS_URDF.replace('<link name="base_link">', STAND)


@pytest.mark.parametrize(
    ("text", "base_frame", "angle"),
    [
        (STOOD, "stand", "0.300"),
        (
            STOOD.replace('xyz="0 0 0.392" rpy="0 1.5707', 'xyz="0 0 0.4" rpy="0 1.4'),
            "base_link",
            "",
        ),
    ],
)
def test_a_file_of_another_base_or_geometry_is_rejected(tmp_path, text, base_frame, angle):
    arm = read_arm(STOOD, base_frame="base_link")
    at = np.array([0.2, -1.2, 1.6, -1.2, -1.57, 0.3])
    path = tmp_path / "pointer.json"
    write_calibration(path, calibration(arm=arm, zeroing=zeroed_at(at, arm=arm)))
    assert read_calibration(path, arm).zero_angles.tolist() == at.tolist()
    other = read_arm(text, base_frame=base_frame)
    with pytest.raises(CalibrationFileError, match=rf"{angle} rad off .* at most 0.02 rad"):
        read_calibration(path, other)
    content = json.loads(path.read_text())
    del content["zeroing"]["joints"]["elbow"]
    assert read_content(tmp_path, content, other).tool == "pointer"  # no more can be told
