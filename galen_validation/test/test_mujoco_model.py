# SPDX-License-Identifier: Apache-2.0
"""The model that a diagnosis writes for MuJoCo: with it MuJoCo reads what the suite's own does."""

import json
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from galen_diagnosis.diagnose import main as diagnose
from galen_diagnosis.effects.forms import healthy_background
from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.observation.observation import UNKNOWNS, Observation
from galen_diagnosis.observation.recording import DiagnosticRecording, read_recording
from galen_diagnosis.observation.specification import CALIBRATED, specification_of
from galen_diagnosis.report.mujoco_model import MODEL, mujoco_model
from galen_model.load.model import ToolGeometry
from galen_model.rotation import matrix_to_rotvec
from galen_sim_driver.effects.registry import LIMITED, effect_from
from galen_sim_driver.replay import Replay, Scene, rates

from galen_validation.blind.causes import listed
from galen_validation.blind.measuring import (
    Measurement,
    draw_tolerance,
    tool_file,
    write_recording,
)
from galen_validation.blind.session import ARMS, BAGS, draw_session

LAST = {"galen": "tilt", "six_axis": "wrist_2"}


class InMujoco:
    """A written model, driven along joints as they are reported."""

    def __init__(self, text):
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        joints = self.model.actuator_trnid[:, 0]
        self.dofs, self.places = self.model.jnt_dofadr[joints], self.model.jnt_qposadr[joints]
        self.gear = self.model.actuator_gear[:, 0]

    def along(self, scene, at_s):
        """Return readings (n, 6), the tip's positions (n, 3) and rotations (n, 3, 3)."""
        model, data, found = self.model, self.data, []
        share = model.numeric("inertial_share").data[0]
        moving = (scene.joints, *rates(scene.joint_s, scene.joints))
        joints, velocities, accelerations = (
            np.stack([np.interp(at_s, scene.joint_s, axis) for axis in part.T], axis=1) / self.gear
            for part in moving
        )
        # Inertial forces are linear in accelerations and of second order in velocities.
        for now in zip(joints, np.sqrt(share) * velocities, share * accelerations, strict=True):
            data.qpos[self.places], data.qvel[self.dofs], data.qacc[self.dofs] = now
            mujoco.mj_inverse(model, data)
            tip = data.site("tip")
            found.append([*data.sensordata[:6], *tip.xpos, *tip.xmat])
        rows = np.reshape(found, (len(at_s), 18))
        reading = -rows[:, :6] - model.numeric("zero").data
        return reading, rows[:, 6:9], rows[:, 9:].reshape(-1, 3, 3)

    def settle(self, joints, push=(0.0, 0.0, 0.0)):
        """Return the tip's position under a push (3,) on it, N in the base's axes."""
        tip, load = self.data.site("tip"), self.data.body("sensed_load")
        self.data.ctrl[:] = joints
        for _ in range(1500):
            lever = tip.xpos - load.xipos
            load.xfrc_applied[:] = [*push, *np.cross(lever, push)]
            mujoco.mj_step(self.model, self.data)
        return tip.xpos.copy()

    def put(self, joints):
        """Stand at joints (n,), and drive to there."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.places] = joints / self.gear
        return self.settle(joints)


def scene_of(name):
    """A free motion of an arm, with its recording's parts that a model is made of."""
    session = draw_session(5, ("motion",), arm=ARMS[name]())
    take, file = session.takes["motion"], tool_file(session)
    fine_s, wrench_s = np.arange(0.0, 8.0, 0.01), np.arange(0.5, 7.0, 0.1)
    scene = Scene(
        bag="motion", start_s=0.0, joint_s=fine_s, joints=take.course(fine_s), wrench_s=wrench_s,
        reading=np.zeros((len(wrench_s), 6)), touched=np.zeros(len(wrench_s), dtype=bool),
        tracker_s=wrench_s, tool=ToolGeometry(file.load.load, file.tip_m),
        adapter=file.adapter.load, arm=session.arm,
    )  # fmt: skip
    limits = specification_of([CALIBRATED], dict.fromkeys(LIMITED))
    return DiagnosticRecording("made up", file, {}, (), (), session.arm, limits), scene


def effects_of(name, arm):
    joint = LAST[name]
    numbers = {
        "joint_zero_offset": {"joint": joint, "offset_rad": 0.1},
        "joint_gain": {"joint": joint, "gain": 0.05},
        "joint_axis_misalignment": {"joint": joint, "about": "x", "angle_rad": 0.1},
        "base_inclination": {"about_x_rad": 0.1, "about_y_rad": -0.2},
        "sensor_mount_rotation": {"rotvec_rad": [0.1, 0.2, -0.1]},
        "tool_mass_error": {"delta_kg": 0.02},
        "tool_com_error": {"delta_m": [0.01, -0.02, 0.03]},
        "inertial_load": {"mass_kg": 0.15},
    }
    return [effect_from(key, values, arm) for key, values in numbers.items()]


@pytest.mark.parametrize("name", LAST)
def test_mujoco_reads_with_the_model_what_the_simulator_reads(name):
    recording, scene = scene_of(name)
    effects = effects_of(name, recording.arm)
    # The simulator's inertial forces leave out how an axis is turned.
    aligned = [effect for effect in effects if effect.name != "joint_axis_misalignment"]
    every = [[], *([effect] for effect in effects), effects[:-1], aligned]
    nominal = Replay(scene).reading()
    for some in every:
        found, *tip = InMujoco(mujoco_model(recording, some)).along(scene, scene.wrench_s)
        replay = Replay(scene, some)
        np.testing.assert_allclose(found, replay.reading(), atol=2e-5, err_msg=str(some))
        rotation, position = replay.tip(np.zeros_like(found))
        np.testing.assert_allclose(tip[0], position, atol=1e-9)
        np.testing.assert_allclose(tip[1], rotation, atol=1e-9)
        assert not some or np.abs(found - nominal).max() > 0.005


@pytest.mark.parametrize("name", LAST)
def test_drives_give_as_the_joint_does_and_friction_keeps_some_of_it(name):
    recording, _ = scene_of(name)
    arm, joint = recording.arm, LAST[name]
    spring = effect_from("joint_compliance", {"stiffness": {joint: 500.0}}, arm)
    stays = effect_from("deflection_hysteresis", {"residual_fraction": 0.1}, arm)
    sprung, rubbing = (
        InMujoco(mujoco_model(recording, effects)) for effects in ([spring], [spring, stays])
    )
    column = arm.tip_jacobian(arm.home, recording.tool.tip_m)[:3, arm.joint_names.index(joint)]
    push = 10.0 * column / np.linalg.norm(column)
    np.testing.assert_array_equal(sprung.model.key("home").ctrl, arm.home)
    rest = sprung.put(arm.home)
    np.testing.assert_allclose(rest, arm.tip_pose(arm.home, recording.tool.tip_m)[1], atol=1e-6)
    moved = sprung.settle(arm.home, push) - rest
    assert moved @ push == pytest.approx((column @ push) ** 2 / 500.0, rel=0.05)
    rest = rubbing.put(arm.home)
    under, after = (rubbing.settle(arm.home, one) - rest for one in (push, 0.0 * push))
    assert after @ push == pytest.approx(0.1 * under @ push, rel=0.1)


def test_a_gap_is_a_second_joint():
    recording, _ = scene_of("galen")
    gap = effect_from("backlash", {"joint": "tilt", "gap_rad": 0.01}, recording.arm)
    arm, at = InMujoco(mujoco_model(recording, [gap])), recording.arm.home
    plain, turned = InMujoco(mujoco_model(recording, [])), []
    for force in (6.0, -6.0):
        push = np.array([0.0, 0.0, force])
        for one in (arm, plain):
            one.put(at)
            one.settle(at, push)
        turn = arm.data.site("tip").xmat.reshape(3, 3) @ plain.data.site("tip").xmat.reshape(3, 3).T
        turned.append(matrix_to_rotvec(turn)[1])
    assert abs(turned[1] - turned[0]) == pytest.approx(0.01, rel=0.1)


def test_what_mujoco_lacks_is_a_comment_with_its_numbers_and_the_formula():
    recording, _ = scene_of("galen")
    effects = [
        effect_from("axis_gain", {"gain": [0.01, 0.0, -0.02, 0.0, 0.0, 0.0]}, recording.arm),
        effect_from("tool_mass_error", {"delta_kg": 0.02}, recording.arm),
    ]
    text = mujoco_model(recording, effects)
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(text, parser)
    notes = [one.text.strip() for one in root if one.tag is ElementTree.Comment]
    gain, mass = (next(n for n in notes if n.startswith(effect.name)) for effect in effects)
    assert "[0.01, 0.0, -0.02, 0.0, 0.0, 0.0]" in gain
    assert f"no such thing in MuJoCo: {RECORDS['axis_gain'].mujoco}" in gain
    assert "no such thing" not in mass and RECORDS["tool_mass_error"].mujoco in mass
    plain = mujoco.MjModel.from_xml_string(mujoco_model(recording, []))
    found = mujoco.MjModel.from_xml_string(text)
    assert found.body("sensed_load").mass - plain.body("sensed_load").mass == pytest.approx(0.02)


def rows_in_mujoco(observation, text):
    """Return a recording's rows (N,), measured less what MuJoCo reads with a model."""
    change, one = [], InMujoco(text)
    for view in observation.views.values():
        scene, replay = view.scene, Replay(view.scene)
        parts = [one.along(scene, scene.wrench_s)[0] - replay.reading()]
        if view.tracks:
            _, position, rotation = one.along(scene, scene.tracker_s)
            own, at = replay.tip(np.zeros_like(scene.reading))
            turn = matrix_to_rotvec(rotation @ np.swapaxes(own, 1, 2))
            parts += [np.hstack([position - at, turn]), np.zeros((len(at), 6))]
        led = [
            p if lead is None else lead.of(p) for p, lead in zip(parts, view.leads, strict=False)
        ]
        led[0] = led[0][view.shows]
        change += [(gain * part).ravel() for gain, part in zip(view.gains, led, strict=False)]
    return observation.nominal - np.concatenate(change)


def gap_in_mujoco(folder, output):
    """Return the gap before and after as MuJoCo has it, mean squares, and a healthy arm's part.

    As in the report unknowns are fitted to both, and a healthy arm's tolerances to the latter: the
    part is the largest of these over its standard deviation.
    """
    recording = read_recording(folder, specification=[CALIBRATED])
    observation = Observation(recording)
    texts = mujoco_model(recording, recording.nominal_effects), (output / MODEL).read_text()
    before, after = (rows_in_mujoco(observation, text) for text in texts)
    behind = healthy_background(observation)
    fitted = behind.fit(after)
    unknowns = behind.first(observation.unknowns)
    before = before - behind.columns[:, UNKNOWNS:] @ fitted[UNKNOWNS:]
    before = before - unknowns.columns @ unknowns.fit(before)
    after = after - behind.columns @ fitted
    healthy = np.max(np.abs(fitted[UNKNOWNS:]) / behind.prior_std[UNKNOWNS:])
    return float(np.mean(before**2)), float(np.mean(after**2)), float(healthy)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bags", "causes"),
    [
        ("galen", BAGS, {"joint_zero_offset:tilt": 0.002, "base_inclination": 0.005}),
        ("galen", BAGS[:2], {"joint_zero_offset:tilt": 0.01, "tool_mass_error": 0.005}),
        ("six_axis", BAGS[:2], {"base_inclination": 0.01, "tool_com_error": 0.001}),
    ],
)
def test_the_gap_of_the_blind_check_s_arm_is_in_mujoco_what_the_report_has(
    tmp_path, name, bags, causes
):
    arm, made = ARMS[name](), tmp_path / "made"
    session = draw_session(7, bags, arm=arm)
    tolerance, causes_of = draw_tolerance(7, 1.0, arm=arm), listed(arm)
    plain = Measurement(session, tolerance)
    hidden = [
        causes_of[cause](np.random.default_rng(3), plain).resized(size)
        for cause, size in causes.items()
    ]
    made.mkdir()
    write_recording(made, Measurement(session, tolerance, hidden))
    options = ["--no-report", "--output", str(tmp_path / "out"), "--specification", CALIBRATED]
    assert diagnose([str(made), *options]) == 0
    answer = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert answer["verdict"] == "identified"
    gap = answer["gap"]
    known = {name: gap[name]["mean_square"] for name in ("before", "after", "floor")}
    before, after, healthy = gap_in_mujoco(made, tmp_path / "out")
    assert healthy < 4.0  # else the fit and not the model closes the gap
    assert known["before"] > 2.0 * known["floor"]
    assert (before, after) == pytest.approx((known["before"], known["after"]), rel=0.03)
    closed = (before - after) / (before - known["floor"])
    assert closed == pytest.approx(gap["closed_fraction"]["value"], rel=0.03)
