# SPDX-License-Identifier: Apache-2.0
"""A recording as another robot's driver makes it: other topics, frame and joints, and its URDF."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import ArmTopics, arm_of_bag
from galen_bags.arrays.arm_recording import read_arm as read_recording
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibrate_from_bag import main
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.visits import find_visits
from galen_common.arm import ArmParameters
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_model.arm.description import read_arm
from galen_model.arm.galen import SENSOR
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, TOOLS, gravity_wrench

URDF = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
ARM = read_arm(URDF, sensor_frame="tool0")
JOINTS, WRENCH, TEXT, TEMPERATURE, TF = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/WrenchStamped",
    "std_msgs/msg/String",
    "sensor_msgs/msg/Temperature",
    "tf2_msgs/msg/TFMessage",
)
FORCES = "/force_torque_sensor_broadcaster/wrench"
NS = 1_000_000_000
pytestmark = pytest.mark.usefixtures("plain_fit")
START = np.array([0.1, -1.2, 1.4, 0.2, 0.3, 0.0])


def text_bytes(text):
    data = text.encode() + b"\0"
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(data)) + data


def temperature_bytes(stamp, degrees):
    head = struct.pack("<iI", *divmod(stamp, NS)) + struct.pack("<I", 8) + b"ft_sens\0"
    return b"\x00\x01\x00\x00" + head + struct.pack("<4x2d", degrees, 0.0)


def write_robot(
    folder,
    *,
    poses=5,
    still_s=1.2,
    joints_topic="/joint_states",
    wrench_topics=(FORCES,),
    frame="tool0",
    order=range(6),
    described=True,
    degrees=None,
    others=(),
    seed=1,
    in_base=False,
    stamped=True,
):
    """Poses without the tool and the same with it, at 100 Hz, moved in between.

    degrees: of the sensor, by time in s. in_base: wrenches are in the axes of the base; stamped:
    whether they have a stamp.
    """
    rng = np.random.default_rng(seed)
    visited = [START, *(START + np.r_[0, 0, 0, rng.uniform(-1.3, 1.3, 3)] for _ in range(poses))]
    zero = gravity_wrench(ARM.gravity_in_sensor(START), ADAPTER)
    begin = stamp = 1_700_000_000 * NS
    now, order = START, list(order)
    with BagWriter(folder) as writer:
        joints = joints_topic and writer.add_topic(joints_topic, JOINTS)
        wrenches = [writer.add_topic(name, WRENCH) for name in wrench_topics]
        warm = degrees and writer.add_topic("/ft/temperature", TEMPERATURE)
        for name, kind in others:
            writer.write(writer.add_topic(name, kind), stamp, b"\x00\x01\x00\x00" + bytes(8))
        if described:
            topic = writer.add_topic("/robot_description", TEXT)
            writer.write(topic, stamp, text_bytes(URDF))
        states = joint_state_bytes([ARM.joint_names[k] for k in order])
        forces = wrench_bytes(frame)
        for tool in (False, True):
            for pose in visited:
                x = np.linspace(0.0, 1.0, 50)
                way = now + np.outer(x**3 * (10 - 15 * x + 6 * x**2), pose - now)
                for k, q in enumerate([*way, *[pose] * round(100 * still_s)]):
                    stamp += NS // 100
                    time_s = (stamp - begin) / NS
                    gravity = ARM.gravity_in_sensor(q)
                    wrench = gravity_wrench(gravity, ADAPTER) - zero
                    if tool:
                        wrench = wrench + gravity_wrench(gravity, TOOLS["retractor"].load)
                    noisy = wrench + SENSOR.noise_std * rng.standard_normal(6)
                    if in_base:
                        turn = ARM.rotation(q)
                        noisy = np.concatenate([turn @ noisy[:3], turn @ noisy[3:]])
                    if joints_topic:
                        data = states.fill(stamp, q[order].tolist(), [0.0] * 6)
                        writer.write(joints, stamp, data)
                    for topic in wrenches:
                        own = stamp if stamped else 0
                        writer.write(topic, stamp, forces.fill(own, noisy.tolist()))
                    if degrees and k % 50 == 0:
                        writer.write(warm, stamp, temperature_bytes(stamp, degrees(time_s)))
                now = pose
    return folder


def run(capsys, folder, *arguments):
    """Return exit code, the JSON printed, standard error."""
    code = main(
        ["gripper", str(folder), "--tools-dir", str(folder / "tools"), "--json", *arguments]
    )
    captured = capsys.readouterr()
    return code, json.loads(captured.out) if captured.out else {}, captured.err


def check_found(found):
    for name, true in (("", TOOLS["retractor"].load), ("adapter_", ADAPTER)):
        error = abs(found[f"{name}mass_kg"] - true.mass_kg)
        assert error < 4.0 * found[f"{name}mass_std_kg"], name
        centre = np.abs(np.array(found[f"{name}com_m"]) - true.com_m)
        assert np.all(centre < 4.5 * np.array(found[f"{name}com_std_m"])), name


def test_arm_frame_and_topics_are_found_in_the_recording(tmp_path, capsys):
    bag = write_robot(
        tmp_path / "robot", joints_topic="/lab/arm/joint_states", order=(2, 1, 0, 5, 4, 3)
    )
    code, found, error = run(capsys, bag)
    assert (code, error) == (0, "")
    check_found(found)
    file = json.loads((bag / "tools/gripper.json").read_text())
    assert file["sensor_frame"] == "tool0"
    assert file["arm"]["joints"] == list(ARM.joint_names)


@pytest.mark.parametrize("place", ["recording/sweep", "recording"])
def test_the_arm_of_a_bag_is_described_by_a_file_in_it_or_above(tmp_path, place):
    bag = write_robot(tmp_path / "recording/sweep", poses=1, described=False)
    (tmp_path / place / "arm.urdf").write_text(URDF)
    with open_bag(bag) as opened:
        found = arm_of_bag(opened, ArmParameters())
    assert not found.difference(read_arm(URDF, sensor_frame="tool0"))
    (tmp_path / place / "arm.urdf").write_bytes(b"\xff")
    with open_bag(bag) as opened, pytest.raises(GalenError, match=r"arm.urdf: can't be read"):
        arm_of_bag(opened, ArmParameters())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"wrench_topics": ("/left/ft", "/right/ft")},
            "it has /left/ft, /right/ft; name the one to read: --wrench-raw TOPIC",
        ),
        ({"wrench_topics": ("/ft/compensated",)}, "record the sensor's own readings"),
        (
            {"joints_topic": "", "others": [("/tf", TF)]},
            "no topic of type sensor_msgs/msg/JointState; it has .*: tf does not hold",
        ),
        (
            {"described": False},
            "joint state lacks roll, tilt; it has shoulder_pan, .* needs its description "
            "(robot_description in the bag, or --urdf FILE)",
        ),
        ({"frame": "flange"}, "has no frame 'flange'; its frames are .*; --sensor-frame names"),
        ({"frame": ""}, "has frame_id ''; it must be 'ft_sensor': --sensor-frame"),
        (
            {"still_s": 0.3},
            "still for the 0.8 s that .* longest 0.78 s): hold each pose for longer",
        ),
        ({}, "5 still poses are too few .*: 6 in all, 1 where it was zeroed"),
    ],
)
def test_what_a_recording_lacks_is_one_sentence_with_a_remedy(tmp_path, capsys, given, words):
    bag = write_robot(tmp_path / "robot", **{"poses": 2, **given})
    try:
        code, _, error = run(capsys, bag)
    except SystemExit as end:  # of its description, before the work
        code, error = end.code, capsys.readouterr().err
    assert code == 1 and error.count("\n") == 1
    assert re.search(".*".join(map(re.escape, words.split(".*"))), error), error


def test_a_frame_that_is_named_is_that_of_the_wrenches(tmp_path, capsys):
    bag = write_robot(tmp_path / "robot", poses=5, frame="ft")
    code, found, error = run(capsys, bag, "--sensor-frame", "tool0")
    assert (code, error) == (0, "")
    check_found(found)
    assert f"{FORCES} has frame_id 'ft'; its wrenches are taken as written in 'tool0'" in " ".join(
        found["warnings"]
    )


@pytest.mark.parametrize("log_times", [False, True])
def test_temperature_beside_the_wrenches_is_that_of_each_pose(tmp_path, monkeypatch, log_times):
    if log_times:  # stamps of another clock
        stamped = temperature_bytes
        monkeypatch.setattr(
            f"{__name__}.temperature_bytes", lambda stamp, degrees: stamped(stamp % NS, degrees)
        )
    bag = write_robot(tmp_path / "robot", poses=3, degrees=lambda time_s: 20.0 + 0.1 * time_s)
    recording = read_recording(bag, ArmTopics(log_times=log_times), arm=ARM)
    assert recording.topics[2] == "/ft/temperature"
    settings = CalibrationParameters(arm=ARM)
    for visit in find_visits(recording, settings).visits:
        true = 20.0 + 0.1 * (visit.outcome.stamp_ns / NS - 1_700_000_000)
        assert visit.outcome.temperature_c == pytest.approx(true, abs=1e-3)


def test_wrenches_in_the_axes_of_the_base_are_turned_back_where_it_is_said(tmp_path, capsys):
    bag = write_robot(tmp_path / "robot", frame="base_link", in_base=True)
    with pytest.raises(SystemExit):
        run(capsys, bag)
    error = capsys.readouterr().err
    assert "has frame_id 'base_link'" in error and "--wrench-frame base" in error
    code, _, error = run(capsys, bag, "--sensor-frame", "tool0")
    assert code == 1 and "written in the axes of base_link" in error
    code, found, error = run(capsys, bag, "--sensor-frame", "tool0", "--wrench-frame", "base")
    assert (code, error) == (0, "")
    check_found(found)


def test_wrenches_without_stamps_are_named_and_log_times_taken_where_it_is_said(tmp_path, capsys):
    bag = write_robot(tmp_path / "robot", stamped=False)
    code, _, error = run(capsys, bag)
    assert code == 1 and "wrench is not stamped" in error and "--log-times" in error
    code, found, error = run(capsys, bag, "--log-times")
    assert (code, error) == (0, "")
    check_found(found)
