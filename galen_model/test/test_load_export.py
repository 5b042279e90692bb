# SPDX-License-Identifier: Apache-2.0
"""Loads handed on to robots: every format is read back and is the same body in the frame."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest
import yaml
from galen_model.arm.description import read_arm
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.files.export import FORMATS, export_load, hung_load, principal_axes
from galen_model.load.frames import FrameNeedsJointsError, sensor_in_frame
from galen_model.load.inertia import (
    InertiaEstimate,
    inertia_matrix,
    inertia_numbers,
    point_mass_inertia,
)
from galen_model.load.model import LoadEstimate
from galen_model.rotation import rot_x, rot_y, rot_z
from model_files import SIX_AXIS_URDF, calibration
from scipy.spatial.transform import Rotation

# A flange that is turned against the sensor, so that axes can't be confused.
TURNED = '<origin xyz="0.01 -0.02 0.03" rpy="0.3 -0.2 1.1"/>'
ARM = read_arm(SIX_AXIS_URDF.replace('<origin xyz="0 0 0.02" rpy="0 0 0"/>', TURNED))
OWN_INERTIA = rot_z(0.4) @ rot_x(0.2) @ np.diag([4e-4, 9e-4, 7e-4]) @ rot_x(-0.2) @ rot_z(-0.4)
FRAMES = ("", "tool0", "wrist_3_link")


def calibrated(
    own_inertia: np.ndarray | None = OWN_INERTIA, name: str = "grip-per--2"
) -> CalibrationFile:
    rng = np.random.default_rng(5)
    load, adapter = (
        LoadEstimate(
            mass,
            np.array(com),
            np.cov(rng.normal(size=(4, 20)).T * [1e-2, 1e-4, 1e-4, 1e-4], rowvar=False),
        )
        for mass, com in ((0.81, (0.02, -0.011, 0.093)), (0.23, (0.001, 0.002, 0.021)))
    )
    file = calibration(
        name, load=load, adapter=adapter, tip_m=np.zeros(3), arm=ARM,
        zeroing=zeroed_at(np.full(6, 0.3), arm=ARM),
        residual_offset=np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]),
    )  # fmt: skip
    if own_inertia is None:
        return file
    at_sensor = inertia_numbers(own_inertia) + point_mass_inertia(hung_load(file).load)
    return replace(file, inertia=InertiaEstimate(at_sensor, np.eye(6) * 1e-12))


TOOL = calibrated()


def body(frame: str, tool: CalibrationFile = TOOL) -> pinocchio.Inertia:
    """By Pinocchio: both bodies at the sensor, added, and moved to the frame."""
    parts = [
        pinocchio.Inertia(part.mass_kg, part.com_m, np.zeros((3, 3)))
        for part in (tool.load, tool.adapter)
    ]
    whole = parts[0] + parts[1]
    whole = pinocchio.Inertia(whole.mass, whole.lever, OWN_INERTIA)
    place = sensor_in_frame(frame or "ft_sensor", tool.tip_m, None, arm=ARM)
    return pinocchio.SE3(place.rotation, place.origin_m).act(whole)


def assert_same(mass: float, com: object, inertia: object, frame: str) -> None:
    expected = body(frame)
    assert mass == pytest.approx(expected.mass, abs=1e-9)
    np.testing.assert_allclose(com, expected.lever, atol=1e-9)
    np.testing.assert_allclose(inertia, expected.inertia, atol=1e-9)


def exported(form: str, frame: str = "", tool: CalibrationFile = TOOL) -> str:
    return str(export_load(tool, form, frame)["text"])


def numbers(text: str) -> list[float]:
    return [float(value) for value in re.findall(r"-?\d+\.\d+", text)]


@pytest.mark.parametrize("frame", FRAMES)
def test_the_urscript_and_its_service_call_hold_the_body(frame):
    text = exported("ur", frame)
    (script,) = [line for line in text.splitlines() if line and not line.startswith("#")]
    call = re.fullmatch(r"set_target_payload\((.*?), \[(.*?)\], \[(.*?)\]\)", script)
    assert call is not None
    six = numbers(call[3])
    assert_same(float(call[1]), numbers(call[2]), inertia_matrix(six), frame)
    request = re.search(r'ur_msgs/srv/SetPayload "(.*)"', text)
    assert request is not None
    fields = yaml.safe_load(request[1])
    assert [fields["mass"], *fields["center_of_gravity"].values()] == [
        float(call[1]), *numbers(call[2]),
    ]  # fmt: skip
    assert [fields[f"i{name}"] for name in ("xx", "yy", "zz", "xy", "xz", "yz")] == six
    (plain,) = [
        line for line in exported("ur", frame, calibrated(None)).splitlines() if line[0] != "#"
    ]
    assert plain == f"set_payload({call[1]}, [{call[2]}])" and plain in text


@pytest.mark.parametrize("frame", FRAMES)
def test_the_request_of_franka_holds_the_body(frame):
    text = exported("franka", frame)
    request = yaml.safe_load(text)
    inertia = np.reshape(request["load_inertia"], (3, 3), order="F")
    assert_same(request["mass"], request["center_of_mass"], inertia, frame)
    call = re.search(r'franka_msgs/srv/SetLoad "(.*)"', text)
    assert call is not None and yaml.safe_load(call[1]) == request
    assert yaml.safe_load(exported("franka", frame, calibrated(None)))["load_inertia"] == [0.0] * 9


@pytest.mark.parametrize("frame", FRAMES)
def test_the_load_data_of_kuka_hold_the_body(frame):
    text = exported("kuka", frame)
    (line,) = [line for line in text.splitlines() if not line.startswith(";")]
    found = re.fullmatch(r"\$LOAD=\{M (.*?),CM \{(X .*?,C .*?)\},J \{(X .*?)\}\}", line)
    assert found is not None and "E" not in found[2] + found[3]
    x, y, z, a, b, c = numbers(found[2])
    turn = rot_z(np.radians(a)) @ rot_y(np.radians(b)) @ rot_x(np.radians(c))
    inertia = turn @ np.diag(numbers(found[3])) @ turn.T
    assert_same(float(found[1]), np.array([x, y, z]) * 1e-3, inertia, frame)
    assert "A 0.0,B 0.0,C 0.0},J {X 0.0,Y 0.0,Z 0.0}}" in exported("kuka", frame, calibrated(None))


@pytest.mark.parametrize("frame", FRAMES)
def test_the_inertial_element_is_the_body_in_pinocchio(frame):
    element = exported("urdf", frame)
    assert ElementTree.fromstring(element).tag == "inertial"
    joint = '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
    joint += '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    robot = f'<robot name="r"><link name="a"/>{joint}<link name="b">{element}</link></robot>'
    found = pinocchio.buildModelFromXML(robot).inertias[1]
    assert_same(found.mass, found.lever, found.inertia, frame)


def test_without_an_inertia_the_element_has_a_ball_of_steel_and_says_so():
    text = exported("urdf", "tool0", calibrated(None))
    assert (
        "not measured: a solid steel ball" in text
        and "No inertia: the calibration holds no" in text
    )
    inertia = ElementTree.fromstring(text).find("inertia")
    assert inertia is not None
    size = float(inertia.attrib["ixx"])
    radius = np.sqrt(size / (0.4 * 1.04))
    assert 4.0 / 3.0 * np.pi * radius**3 * 7850.0 == pytest.approx(1.04, rel=1e-6)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_filter_of_control_toolbox_leaves_only_the_constant_that_the_text_names(
    frame,
):
    """As `update` of its gravity_compensation.cpp does it, on the calibration's own readings."""
    text = exported("control_toolbox", frame)
    chain = yaml.safe_load(text)["sensor_filter_chain"]["filter1"]
    assert chain["type"] == "control_filters/GravityCompensationWrench"
    params, tool = chain["params"], chain["params"]["tool"]
    assert params["world_frame"] == "base_link" and params["sensor_frame"] == (frame or "ft_sensor")
    assert set(tool) == {"CoG", "gravity_field", "mass"}
    assert tool["mass"] == pytest.approx(body(frame).mass, abs=1e-9)
    np.testing.assert_allclose(tool["CoG"], body(frame).lever, atol=1e-9)
    assert tool["gravity_field"] == [0.0, 0.0, -9.80665]
    constant = re.search(r"reads \((.*?)\) N", text)
    assert constant is not None
    place = sensor_in_frame(params["sensor_frame"], TOOL.tip_m, None, arm=ARM)
    for angles in np.random.default_rng(2).uniform(-2.0, 2.0, (5, 6)):
        gravity = ARM.gravity_in_sensor(angles)
        reading = TOOL.predict_under(gravity) - numbers(constant[1])
        force = tool["mass"] * place.rotation @ gravity
        expected = np.concatenate([force, np.cross(tool["CoG"], force)])
        np.testing.assert_allclose(place.wrench(reading), expected, atol=1e-9)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_controllers_of_ros2_control_leave_nothing_of_the_calibrations_readings(
    frame,
):
    """As `apply_sensor_offset` and `process_wrench_measurements` of the controllers do it."""
    text = exported("ros2_control", frame)
    content = {name: node["ros__parameters"] for name, node in yaml.safe_load(text).items()}
    broadcaster, admittance = content.values()
    assert list(content) == ["force_torque_sensor_broadcaster", "admittance_controller"]
    chain = yaml.safe_load(exported("control_toolbox", frame))["sensor_filter_chain"]
    assert broadcaster["sensor_filter_chain"] == chain
    assert broadcaster["frame_id"] == "ft_sensor"
    offset = [broadcaster["offset"][part][axis] for part in ("force", "torque") for axis in "xyz"]
    sent = yaml.safe_load(re.search(r"wrench_reference \S+ '(.*)'", text)[1])["wrench"]
    assert sent == broadcaster["offset"]
    assert admittance["ft_sensor"]["frame"]["id"] == "ft_sensor"
    assert admittance["gravity_compensation"]["frame"]["id"] == "ft_sensor"
    assert admittance["fixed_world_frame"]["frame"]["id"] == "base_link"
    centre = admittance["gravity_compensation"]["CoG"]
    weight = np.array([0.0, 0.0, -centre["force"]])
    for angles in np.random.default_rng(2).uniform(-2.0, 2.0, (5, 6)):
        reading = TOOL.predict(angles) + offset
        turn = ARM.rotation(angles)
        np.testing.assert_allclose(turn @ reading[:3] - weight, 0.0, atol=1e-9)
        torque = turn @ reading[3:] - np.cross(turn @ centre["pos"], weight)
        np.testing.assert_allclose(torque, 0.0, atol=1e-9)


def test_an_inclined_arm_gets_no_parameters_of_the_admittance_controller():
    tool = replace(TOOL, gravity_m_s2=np.array([9.80665, 0.0, 0.0]))
    content = export_load(tool, "ros2_control")
    assert list(yaml.safe_load(content["text"])) == ["force_torque_sensor_broadcaster"]
    assert "along -z of its base alone" in content["text"]


def test_the_deviations_of_the_whole_are_those_of_drawn_parts():
    rng = np.random.default_rng(3)
    drawn = [
        rng.multivariate_normal([part.mass_kg, *part.com_m], part.covariance, 20000)
        for part in (TOOL.load, TOOL.adapter)
    ]
    mass = drawn[0][:, 0] + drawn[1][:, 0]
    com = sum(part[:, :1] * part[:, 1:] for part in drawn) / mass[:, None]
    said = hung_load(TOOL).covariance
    scale = np.sqrt(np.diag(said))
    sampled = np.cov(np.column_stack([mass, com]).T)
    np.testing.assert_allclose(
        sampled / np.outer(scale, scale), said / np.outer(scale, scale), atol=0.04
    )
    content = export_load(TOOL, "ur", "tool0")
    assert content["mass_std_kg"] == pytest.approx(scale[0])
    assert f"mass {scale[0]:.2g} kg" in content["text"]


def test_principal_axes_turn_the_frame_by_less_than_90_degrees():
    for moments in ((3.0, 1.0, 2.0), (2.0, 2.0, 2.0), (0.0, 0.0, 0.0)):
        found, axes = principal_axes(np.diag(moments))
        np.testing.assert_array_equal(found, moments)
        np.testing.assert_array_equal(axes, np.eye(3))
    for turn in Rotation.random(200, random_state=4).as_matrix():
        inertia = turn @ np.diag([3.0, 1.0, 2.0]) @ turn.T
        found, axes = principal_axes(inertia)
        np.testing.assert_allclose(axes @ np.diag(found) @ axes.T, inertia, atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0) and np.trace(axes) > 1.0


def test_names_from_files_end_no_comment():
    unresolved = ("x --> <inertial>\n$LOAD={M 5}\nset_payload(9, [0, 0, 0])",)
    tool = replace(TOOL, unresolved=unresolved)
    for form, (_, comment) in FORMATS.items():
        lines = exported(form, "", tool).splitlines()
        own = exported(form).splitlines()
        mark = comment.split("{}")[0]
        assert [line for line in lines if not line.startswith(mark)] == [
            line for line in own if not line.startswith(mark)
        ]
    ElementTree.fromstring(exported("urdf", "", tool))
    assert "grip-per- -2" in exported("urdf")


def test_what_is_known_and_what_is_not_stands_in_every_format():
    impossible = calibrated(np.diag([1e-4, 1e-4, 9e-4]))
    for form in FORMATS:
        text = exported(form, "tool0", impossible)
        assert "tool and adapter as one body" in text and "sensor's own mass" in text
        assert "Frame: tool0. ft_sensor lies in it at (0.01 -0.02 0.03) m" in text
        assert ("is that of no rigid body" in text) == (
            form not in ("control_toolbox", "ros2_control")
        )
        assert "export again" not in text
        content = export_load(TOOL, form)
        robots = ("ur", "franka", "franka-desk", "xarm", "kuka")
        assert ("export again" in content["text"]) == (form in robots)
        assert json.loads(json.dumps(content)) == content
    with pytest.raises(FrameNeedsJointsError, match="'wrist_2_link' depends on wrist_3"):
        exported("ur", "wrist_2_link")


@pytest.mark.parametrize("frame", FRAMES)
def test_an_xarm_takes_kg_and_mm_and_desk_an_end_effector_in_si(frame):
    content = export_load(TOOL, "xarm", frame)
    call = re.search(r"set_tcp_load\(weight=(.*), center_of_gravity=\[(.*)\]\)", content["text"])
    assert float(call[1]) == pytest.approx(content["mass_kg"], abs=1e-9)
    millimetres = [float(value) for value in call[2].split(",")]
    np.testing.assert_allclose(millimetres, 1e3 * np.array(content["com_m"]), atol=1e-6)
    text = exported("franka-desk", frame)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    body = json.loads("\n".join(lines))
    inertia = np.reshape(body["inertia"], (3, 3), order="F")
    assert_same(body["mass"], body["centerOfMass"], inertia, frame)
    assert body["mass"] == pytest.approx(content["mass_kg"], abs=1e-6)
    assert np.reshape(body["transformation"], (4, 4)).tolist() == np.eye(4).tolist()
