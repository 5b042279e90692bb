# SPDX-License-Identifier: Apache-2.0
"""Diagnoses of an arm that is not the Galen: a six-axis arm from its description."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_example import example_diagnosis
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_diagnosis.answer.answer import FoundCause, Interval
from galen_diagnosis.diagnose import main as diagnose
from galen_diagnosis.effects.forms import candidates
from galen_diagnosis.effects.registry import sought
from galen_diagnosis.experiment.next_experiment import propose, write_sweep
from galen_diagnosis.experiment.separation import Alternative
from galen_diagnosis.experiment.trial import push_trial
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.report.corrections import corrections
from galen_diagnosis.simulated_recording import main, make_recording, push_positions, sweep_poses
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import parse_calibration
from galen_sim_driver.effects.joints import BaseInclination, base_inclination
from galen_sim_driver.effects.load import InertialLoad, ToolComError, ToolMassError
from galen_sim_driver.effects.registry import effect_from
from galen_sim_driver.effects.sensor import AxisGain, SensorMountRotation
from galen_sim_driver.replay import Replay

URDF = Path(__file__).parents[2] / "galen_bringup" / "urdf" / "six_axis.urdf"
ARM = read_arm(URDF.read_text())
WALL = replace(ARM, gravity_m_s2=np.array([9.80665, 0.0, 0.0]))
POSES = sweep_poses(ARM)
FEW = POSES[:24]

TIGHT = "--specification", "galen"


def zero_of(joint, offset_rad=0.01):
    return effect_from("joint_zero_offset", {"joint": joint, "offset_rad": offset_rad}, ARM)


def made(folder, *effects, poses=FEW, arm=ARM, **options):
    make_recording(folder, effects, 11, arm=arm, poses=poses, bags=("sweep",), **options)
    return folder


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    return made(tmp_path_factory.mktemp("six") / "healthy", poses=POSES[:8])


def with_description(source, target, text):
    """Copy a bag with the arm's description as its first message."""
    raw = text.encode() + b"\0"
    with open_bag(source) as bag, BagWriter(target) as out:
        names = list(bag.topics)
        topics = [out.add_topic(name, bag.topics[name].type_name) for name in names]
        described = out.add_topic("robot_description", "std_msgs/msg/String")
        out.write(described, 1, b"\0\1\0\0" + struct.pack("<I", len(raw)) + raw)
        for block in bag.blocks(names):
            for k in range(len(block)):
                out.write(topics[block.topic[k]], int(block.log_time_ns[k]), block.message(k))


def test_the_description_may_be_in_a_bag(healthy, tmp_path):
    folder = shutil.copytree(healthy, tmp_path / "copy", ignore=shutil.ignore_patterns("sweep"))
    with_description(healthy / "sweep", folder / "sweep", ARM.urdf)
    (folder / "arm.urdf").write_text("<robot>")
    with pytest.raises(GalenError, match=r"arm\.urdf: the robot description"):
        read_recording(folder)
    (folder / "arm.urdf").unlink()
    told, other = read_recording(folder), read_recording(healthy)
    assert told.arm.difference(ARM) == "" and told.tool.arm.difference(ARM) == ""
    assert told.missing == ("motion", "push")
    np.testing.assert_array_equal(told.bags["sweep"].wrenches, other.bags["sweep"].wrenches)
    shutil.rmtree(folder / "sweep")
    shutil.copytree(healthy / "sweep", folder / "sweep")
    with pytest.raises(GalenError, match=r"six_axis.*galen"):
        read_recording(folder)


def test_poses_keep_the_limits_and_gravity_comes_from_all_sides():
    every = np.vstack([POSES, push_positions(ARM)])
    assert np.all(every > ARM.lower) and np.all(every < ARM.upper)
    gravity = ARM.gravity_in_sensor(ARM.angles(POSES)) / 9.80665
    assert np.linalg.svd(gravity, compute_uv=False)[-1] > 0.3 * np.sqrt(len(POSES) / 3)


def test_effects_are_sought_at_every_joint(healthy):
    names = sought(SimpleNamespace(arm=ARM, readings=None))
    for joint in ARM.joint_names:
        assert {f"joint_zero_offset:{joint}", f"joint_gain:{joint}"} <= set(names)
    on_galen = sought(SimpleNamespace(arm=GALEN, readings=None))
    assert "joint_zero_offset:roll" in on_galen and "joint_gain:roll" not in on_galen
    forms = [one.label for one in candidates(Observation(read_recording(healthy)))
             if one.effect == "joint_axis_misalignment:wrist_2"]  # fmt: skip
    assert forms == ["x", "y"]  # about its own axis, z, is no turn


@pytest.mark.slow
def test_the_zero_of_a_wrist_joint_is_found_from_still_poses_alone(tmp_path, capsys):
    folder = made(tmp_path / "made", zero_of("wrist_2"))
    out = tmp_path / "out"
    assert diagnose([str(folder), *TIGHT, "--output", str(out), "--next", str(tmp_path / "n")]) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"] == "identified"
    (cause,) = found["causes"]
    assert (cause["effect"], cause["joint"]) == ("joint_zero_offset", "wrist_2")
    low, high = cause["parameters"]["offset_rad"]["ci95"]
    assert low < 0.01 < high and high - low < 0.0015  # beside an eccentricity within its limit
    assert "shoulder_pan" in found["where"]["poses"][0]["joints"]
    assert (out / "pictures" / "gap.png").exists()
    assert "wrist_2" in capsys.readouterr().out
    driver = (out / "found_effect.yaml").read_text()
    assert "-p urdf_file:=ARM.urdf" in driver and "joint_zero_offset_wrist_2_rad: 0.0" in driver
    # With what the output corrects nothing is left.
    assert [line.partition(":")[0] for line in found["corrections"]] == ["corrected.urdf"]
    shutil.copy(out / "corrected.urdf", folder / "arm.urdf")
    shutil.copy(out / "corrected_pointer.json", folder / "tool.json")
    assert diagnose([str(folder), *TIGHT, "--output", str(tmp_path / "again"), "--no-report"]) == 0
    again = json.loads((tmp_path / "again" / "diagnosis.json").read_text())
    assert again["verdict"] == "none"
    floor = again["gap"]["floor"]["mean_square"]
    assert found["gap"]["before"]["mean_square"] > 1.05 * floor
    assert again["gap"]["before"]["mean_square"] == pytest.approx(floor, rel=0.03)
    assert again["gap"]["before"]["mean_square"] < found["gap"]["before"]["mean_square"]


CORRECTED = {
    "zero": [zero_of("wrist_2", 0.2)],
    "axis": [
        effect_from(
            "joint_axis_misalignment", {"joint": "wrist_1", "about": "x", "angle_rad": 0.1}, ARM
        )
    ],
    "base": [BaseInclination(0.1, -0.2)],
    "sensor": [AxisGain((0.1, 0.0, -0.1, 0.0, 0.2, 0.0)), SensorMountRotation((0.1, 0.2, -0.1))],
    "tool": [ToolMassError(0.02), ToolComError((0.01, -0.02, 0.03))],
}
CORRECTED["all"] = [*(effect for one in CORRECTED.values() for effect in one), zero_of("wrist_1")]


def found_as(effects):
    """A diagnosis that identified the effects, each number within 0.001 two standard deviations."""
    causes = []
    for effect in effects:
        numbers = {}
        for part in effect.fitted:
            values = np.atleast_1d(getattr(effect, part.name))
            intervals = [Interval(value, value - 1.96e-3, value + 1.96e-3) for value in values]
            numbers[part.name] = intervals if part.size > 1 else intervals[0]
        joint = getattr(effect, "joint", None)
        causes.append(FoundCause(effect.name, 1.0, numbers, (), None, joint))
    made_up = example_diagnosis()
    answer = replace(made_up.answer, causes=tuple(causes))
    return replace(made_up, answer=answer, effects=tuple(effects))


@pytest.mark.slow
def test_the_base_of_an_arm_on_a_wall_is_found_about_y_and_z(tmp_path):
    inclined = base_inclination(WALL.gravity_m_s2)(about_y_rad=0.02, about_z_rad=-0.01)
    recording = read_recording(made(tmp_path / "made", inclined, arm=WALL), specification=["galen"])
    found = diagnose_recording(recording)
    (cause,) = found.answer.causes
    assert cause.effect == "base_inclination" and set(cause.parameters) == {
        "about_y_rad", "about_z_rad",
    }  # fmt: skip
    for name, value in cause.parameters.items():
        assert value.low < getattr(inclined, name) < value.high and value.high - value.low < 2e-3
    assert "about y and -0.57" in found.answer.sentence and "about z" in found.answer.sentence
    files = corrections(recording, found).files
    again = parse_calibration("again", files["corrected_pointer.json"].encode(), WALL)
    about = again.mounting.base_inclination_rad
    np.testing.assert_allclose(about, [0.0, 0.02, -0.01], atol=1e-3)
    assert np.flatnonzero(again.mounting.std).tolist() == [10, 11]


@pytest.mark.parametrize("name", CORRECTED)
def test_corrected_files_say_what_the_effects_do(healthy, tmp_path, name):
    effects, recording = CORRECTED[name], read_recording(healthy)
    found = corrections(recording, found_as(effects))
    folder = shutil.copytree(healthy, tmp_path / "made")
    for file, text in found.files.items():
        (folder / ("arm.urdf" if file == "corrected.urdf" else "tool.json")).write_text(text)
    told = read_recording(folder)
    assert not told.tool.arm_warning and "Corrected by the diagnosis" in told.tool.model_reason
    scene, other = (Observation(one).views["sweep"].scene for one in (recording, told))
    expected, nominal = Replay(scene, effects).reading(), Replay(scene).reading()
    assert np.abs(expected - nominal).max() > 0.01
    # Of two inclinations and rotations in a file the sum or product is exact from none.
    np.testing.assert_allclose(Replay(other).reading(), expected, atol=1e-9)
    # The compensation of a tool reads the same file by another way.
    angles = ARM.angles(scene.joints)
    at_joints = replace(scene, wrench_s=scene.joint_s, reading=np.zeros((len(angles), 6)))
    np.testing.assert_allclose(
        told.tool.predict(angles), Replay(at_joints, effects).reading(), atol=1e-9
    )
    if name in ("tool", "all"):
        grown = np.diag(told.tool.load.covariance - recording.tool.load.covariance)
        np.testing.assert_allclose(grown, 1e-6, rtol=1e-6)
    unsure = replace(found_as(effects).answer, verdict="ambiguous")
    assert corrections(recording, replace(found_as(effects), answer=unsure)) == ({}, ())


def test_what_no_file_holds_is_told(healthy):
    gain = effect_from("joint_gain", {"joint": "elbow", "gain": 0.02}, ARM)
    found = corrections(read_recording(healthy), found_as([gain, InertialLoad(0.1)]))
    assert not found.files
    assert "have the driver report 1.020000 times its angle" in found.sentences[0]
    assert "--inertial-forces" in found.sentences[1]


@pytest.mark.slow
def test_zeros_of_parallel_joints_are_one_ambiguous_set_that_a_tracker_separates(tmp_path):
    """Gravity feels the sum of the angles about parallel axes, not which of them it is."""
    recording = read_recording(made(tmp_path / "made", zero_of("elbow")), specification=["galen"])
    shares = []
    answer = diagnose_recording(recording, progress=lambda _, share: shares.append(share)).answer
    assert answer.verdict == "ambiguous" and shares == sorted(shares)
    parallel = {f"joint_zero_offset:{joint}" for joint in ("shoulder_lift", "elbow", "wrist_1")}
    (cause,) = answer.causes
    assert cause.probability > 0.95
    assert {cause.label, *cause.equivalent} == parallel
    assert set(answer.next_experiment["separates"]) == parallel
    assert answer.next_experiment["kind"] == "tracker at rest"


@pytest.mark.slow
def test_the_zero_of_a_joint_about_gravity_is_no_gap(tmp_path):
    folder = made(tmp_path / "made", zero_of("shoulder_pan", 0.05))
    assert diagnose_recording(read_recording(folder)).answer.verdict == "none"


def test_a_spring_of_one_joint_is_not_taken_for_another_s(healthy):
    trial = push_trial(FEW[:1], (5.0,), read_recording(healthy).tool)
    lift, elbow = (
        effect_from("joint_compliance", {"stiffness": {joint: 5e3}}, ARM)
        for joint in ("shoulder_lift", "elbow")
    )
    rigid, *moved = (Replay(trial.scene, of).tip(trial.pushed)[1] for of in ((), [lift], [elbow]))
    for one in moved:
        assert np.abs(one - rigid).max() > 1e-5
    assert np.abs(moved[0] - moved[1]).max() > 1e-5


def test_experiments_go_only_where_the_arm_was_seen(healthy, tmp_path):
    tool = read_recording(healthy).tool
    both = [Alternative((zero_of(joint),), 0.5, np.diag([1e-8])) for joint in ("elbow", "wrist_1")]
    found = propose(both, tool, FEW)
    away = np.abs(found.proposal.poses[:, None] - FEW[None]).max(axis=2).min(axis=1)
    assert away.max() < 1e-3
    write_sweep(found, tmp_path / "next.yaml", ARM)
    text = (tmp_path / "next.yaml").read_text()
    assert "urdf_file:=ARM.urdf" in text and "Xhome" not in text
    still = replace(found.proposal, program="collection")
    write_sweep(replace(found, proposal=still), tmp_path / "push.yaml", ARM)
    assert "positions" in (tmp_path / "push.yaml").read_text()


@pytest.mark.slow
def test_the_command_makes_a_recording_of_an_arm_with_an_effect(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("galen_diagnosis.simulated_recording._POSES", 3)
    out, arm = tmp_path / "made", ["--urdf", str(URDF)]
    assert main(["tilt", "--output", str(out), *arm]) == 1
    assert "no story 'tilt' of the arm six_axis; there are joint_zero_offset:shoulder_pan" in (
        capsys.readouterr().err
    )
    assert main(["joint_gain:wrist_1", "--output", str(out), *arm]) == 0
    truth = json.loads((out / "truth.json").read_text())
    told = {"joint": "wrist_1", "gain": 0.02}
    assert truth == {"effects": [{"effect": "joint_gain", "parameters": told}]}
    recording = read_recording(out)
    assert list(recording.bags) == ["sweep", "motion", "push"]
    assert recording.bags["push"].tool_marker is not None
    motion = recording.bags["motion"].joints
    assert np.all(np.ptp(motion, axis=0) > 0.3)
