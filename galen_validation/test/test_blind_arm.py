# SPDX-License-Identifier: Apache-2.0
"""The blind arm: nominal where the contract says so, and silent about what it hides."""

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.formats.bag import open_bag
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.errors import GalenError
from galen_model.load.inertia import inertial_wrench
from galen_model.load.model import Load, ToolGeometry
from galen_model.rotation import matrix_to_rotvec
from galen_sim_driver.effects.registry import effect_from
from galen_sim_driver.replay import Replay, Scene

from galen_validation.blind import causes, measuring, mujoco_arm, session, unlisted
from galen_validation.blind.case import STRENGTHS, Case, generate, observed, over_limit
from galen_validation.blind.causes import Cause, catenary, listed, twins
from galen_validation.blind.measuring import Measurement, draw_tolerance, write_recording
from galen_validation.blind.mujoco_arm import (
    DECAY,
    STEP_S,
    Gap,
    InnerMass,
    MujocoArm,
    Plant,
    Slider,
    require_mujoco,
)
from galen_validation.blind.session import (
    ADAPTER,
    ARMS,
    BAGS,
    REFERENCE,
    TOOLS,
    Clock,
    draw_session,
)
from galen_validation.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN, UNLISTED

LISTED = listed(GALEN)
SIX = ARMS["six_axis"]()
CONTRACT = {
    "joint_zero_offset:roll": {"joint", "offset_rad"},
    "joint_zero_offset:tilt": {"joint", "offset_rad"},
    "joint_gain:tilt": {"joint", "gain"},
    "joint_eccentricity:roll": {"joint", "amplitude_rad", "cycles", "phase_rad"},
    "joint_eccentricity:tilt": {"joint", "amplitude_rad", "cycles", "phase_rad"},
    "joint_axis_misalignment:tilt": {"joint", "about", "angle_rad"},
    "base_inclination": {"about_x_rad", "about_y_rad"},
    "sensor_mount_rotation": {"rotvec_rad"},
    "axis_gain": {"gain"},
    "crosstalk": {"from", "to", "coefficient"},
    "sensor_nonlinearity": {"axis", "coefficient"},
    "sensor_hysteresis": {"fraction"},
    "sensor_drift": {"rate_per_hour"},
    "bias_step": {"time_s", "step", "bag"},
    "wrench_delay": {"delay_s"},
    "sensor_saturation": {"limit", "axis"},
    "tool_mass_error": {"delta_kg"},
    "tool_com_error": {"delta_m"},
    "loose_tool": {"shift_m"},
    "cable_drag": {"tension_N"},
    "inertial_load": {"mass_kg"},
    "joint_compliance": {"stiffness"},
    "deflection_hysteresis": {"residual_fraction"},
    "deflection_creep": {"fraction", "tau_s"},
    "backlash": {"joint", "gap_rad"},
    "tracker_delay": {"delay_s"},
    "tracker_scale": {"gain"},
    "base_shift": {"translation_m", "rotvec_rad", "time_s"},
}
NOMINAL = draw_tolerance(0, 0.0, arm=GALEN)
TOOL = TOOLS[1]
PLANT = Plant(TOOL.body, ADAPTER, TOOL.tip_m, arm=GALEN)
POSE = np.array([0.03, -0.04, 0.45, 0.5, -0.4])


@pytest.fixture(scope="module")
def healthy():
    """An arm without tolerances in the beginning of a session of motion and pushes."""
    whole = draw_session(5, ("motion", "push"), arm=GALEN)
    takes = {}
    for bag, take in whole.takes.items():
        early = take.wrench.taken_s < 20.0
        wrench = Clock(take.wrench.stamp_s[early], take.wrench.taken_s[early])
        takes[bag] = replace(take, end_s=20.0, wrench=wrench)
    return Measurement(replace(whole, takes=takes), NOMINAL)


def weight(arm, joints, *bodies):
    """Of rigid bodies (n, 6) at joints (n, k), by the nominal formula."""
    gravity = arm.gravity_in_sensor(arm.angles(joints))
    return sum(
        np.concatenate([b.mass_kg * gravity, np.cross(b.com_m, b.mass_kg * gravity)], axis=1)
        for b in bodies
    )


def held(joints, push=None, plant=PLANT, duration_s=2.0):
    """What a standing arm does at the end of a push that has come slowly."""
    at_s = np.arange(0.0, duration_s, STEP_S)
    share = np.clip(at_s / duration_s * 2.0, 0.0, 1.0) ** 2
    pushes = None if push is None else np.outer(share, push)
    nominal = plant.arm if plant.arm.delta is None else GALEN
    return MujocoArm(plant, nominal).run(at_s, np.tile(joints, (len(at_s), 1)), pushes)


def test_the_arm_shares_no_code_with_simulator_and_diagnosis():
    for module in (causes, measuring, mujoco_arm, session, unlisted):
        tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                assert not node.module.startswith("galen_sim_driver"), module
                if node.module.startswith("galen_diagnosis"):
                    own = node.module.startswith("galen_validation.blind")
                    assert own, (module, node.module)


def test_reading_and_deflection_at_rest_are_the_models():
    push = np.array([3.0, -5.0, 8.0, 0.1, 0.2, -0.3])
    rest, pushed = held(POSE), held(POSE, push)
    expected = weight(GALEN, POSE[None], TOOL.body, ADAPTER)[0]
    np.testing.assert_allclose(rest.wrench[-1], expected, atol=1e-6)
    rotation, tip = GALEN.tip_pose(POSE, TOOL.tip_m)
    np.testing.assert_allclose(rest.position[-1], tip, atol=1e-8)
    np.testing.assert_allclose(rest.rotation[-1], rotation, atol=1e-8)
    # The load turns with what it bends.
    np.testing.assert_allclose(pushed.wrench[-1] - expected, push, atol=0.01)
    moved = GALEN.deflection(POSE, push, TOOL.tip_m)
    turned = matrix_to_rotvec(pushed.rotation[-1] @ rest.rotation[-1].T)
    found = np.concatenate([pushed.position[-1] - rest.position[-1], turned])
    np.testing.assert_allclose(found, moved, atol=0.01 * np.max(np.abs(moved)))
    assert np.linalg.norm(moved[:3]) > 3e-4


def test_forces_in_motion_are_the_inertial_formula():
    at_s = np.arange(0.0, 10.0, STEP_S)
    fade = np.clip(at_s / 2.0, 0.0, 1.0)
    fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2)
    wave = np.sin(np.outer(at_s, [1.3, 0.9, 1.6, 1.9, 2.2]))
    joints = GALEN.home + fade[:, None] * np.array([0.05, 0.04, 0.05, 0.9, 0.6]) * wave
    rotation, origin = GALEN.sensor_pose(joints)

    def rate(values):
        return np.gradient(values, STEP_S, axis=0)

    spin = np.swapaxes(rotation, 1, 2) @ rate(rotation)
    omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    acceleration = np.einsum("nji,nj->ni", rotation, rate(rate(origin)))
    expected = np.zeros((len(at_s), 6))
    for body in (TOOL.body, ADAPTER):
        com = body.com_m
        about = body.inertia_kg_m2 + body.mass_kg * (com @ com * np.eye(3) - np.outer(com, com))
        numbers = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        moments = Load(body.mass_kg, com).moments
        expected += inertial_wrench(-acceleration, omega, rate(omega), moments, numbers)
    weights = weight(GALEN, joints, TOOL.body, ADAPTER)
    later = slice(2500, -50)
    size = np.std(expected[later], axis=0)
    assert size[0] > 3.0 * SENSOR.noise_std[0]
    for share in (0.0, 1.0):
        found = (
            MujocoArm(replace(PLANT, inertial=share), nominal=GALEN).run(at_s, joints).wrench
            - weights
        )
        left = np.std((found - share * expected)[later], axis=0)
        assert np.all(left < 1.5 * STEP_S * DECAY * size + 0.01 * SENSOR.noise_std)


def test_an_arm_of_a_description_is_rigid_but_for_what_is_made_soft():
    none = np.zeros(len(SIX.joints))
    plant = replace(PLANT, arm=SIX, zero=none, gain=none)
    joints = SIX.home + np.array([0.3, -0.2, 0.1, 0.2, -0.3, 0.4])
    push = np.array([2.0, -1.0, 3.0, 0.1, 0.0, 0.2])
    rest, pushed = held(joints, None, plant), held(joints, push, plant)
    expected = weight(SIX, joints[None], TOOL.body, ADAPTER)[0]
    np.testing.assert_allclose(rest.wrench[-1], expected, atol=1e-4)
    assert np.linalg.norm(pushed.position[-1] - rest.position[-1]) < 2e-6
    soft = SIX.with_stiffness({"elbow": 3e3, "wrist_2": 2e4})
    moved = soft.deflection(joints, push, TOOL.tip_m)[:3]
    plant = replace(plant, arm=soft)
    found = held(joints, push, plant).position[-1] - held(joints, None, plant).position[-1]
    np.testing.assert_allclose(found, moved, atol=0.03 * np.linalg.norm(moved))


def test_the_six_joint_arm_moves_as_its_reported_joints_do():
    whole = draw_session(5, ("motion",), arm=SIX)
    take = replace(whole.takes["motion"], end_s=15.0)  # where it stops at once
    measured = Measurement(replace(whole, takes={"motion": take}), draw_tolerance(5, 0.0, arm=SIX))
    trace = measured.trace("motion")
    before = trace.at_s < 14.9
    rotation, position = SIX.tip_pose(take.course(trace.at_s[before]), whole.tool.tip_m)
    assert np.ptp(position, axis=0).max() > 0.3
    np.testing.assert_allclose(trace.position[before], position, atol=1e-5)
    np.testing.assert_allclose(trace.rotation[before], rotation, atol=1e-5)


@pytest.mark.parametrize("arm", [GALEN, SIX])
def test_a_mass_without_play_is_the_tools_own(arm):
    session = draw_session(901, ("motion",), arm=arm)
    healthy = Measurement(session, draw_tolerance(0, 0.0, arm=arm))
    play = Measurement(session, healthy.tolerance)
    play.plant = replace(healthy.plant, inner=InnerMass(0.02, (0.0, 1e-6, 0.0)))
    at_s = np.arange(1.0, 20.0, 0.01)
    off = play.reading("motion", at_s) - healthy.reading("motion", at_s)
    assert np.all(np.std(off, axis=0) < 0.15 * SENSOR.noise_std)


def test_a_hanging_cable_holds_its_weight_and_its_form():
    anchor, length, weight = np.array([0.3, 0.4, 1.1]), 1.6, 2.0
    ends = np.array([[0.0, 0.0, 0.5], [0.2, 0.5, 0.6], [-0.4, 0.1, 0.9], [0.3, 0.42, 0.2]])
    for at, force in zip(ends, catenary(ends, anchor, length, weight), strict=True):
        # A chain of pieces that begins with this force ends at the anchor.
        pieces = 4000
        line = np.tile(-force, (pieces, 1))
        line[:, 2] -= weight * (np.arange(pieces) + 0.5) / pieces
        steps = -length / pieces * line / np.linalg.norm(line, axis=1, keepdims=True)
        np.testing.assert_allclose(at + steps.sum(axis=0), anchor, atol=2e-3)


def test_sliders_beside_a_spring_leave_a_part_of_its_way():
    """And below their friction they are springs."""
    measured = Measurement(draw_session(5, ("push",), arm=GALEN), NOMINAL)
    arm = GALEN.with_stiffness({"tilt": 1100.0})
    left = []
    for friction in (0.2, 5.0):
        measured = Measurement(measured.session, NOMINAL)
        sliders = (Slider("tilt", 400.0, friction),)
        measured.plant = replace(measured.plant, arm=arm, sliders=sliders)
        left.append(measured.residual_fraction())
    assert left[0] > 0.012 and left[1] < 0.003


@pytest.mark.parametrize(("joint", "gap"), [("roll", 2e-5), ("tilt", 0.08)])
@pytest.mark.parametrize(("soft", "friction"), [(0.0, 0.0), (0.0, 0.1), (0.6, 0.0)])
def test_gaps_of_any_size_are_stable(joint, soft, friction, gap):
    plant = replace(PLANT, gap=Gap(joint, gap, soft / gap, friction))
    trace = held(GALEN.home, np.array([4.0, 4.0, 0.0, 0.0, 0.3, 0.0]), plant, 1.0)
    turn = np.linalg.norm(matrix_to_rotvec(trace.rotation[-1] @ trace.rotation[0].T))
    assert turn < 0.01 + gap


@pytest.mark.parametrize(("soft", "friction"), [(0.0, 0.0), (0.0, 0.05), (100.0, 0.0)])
def test_a_gap_is_crossed_by_the_moment_on_it(soft, friction):
    gap = 0.004
    plant = replace(PLANT, gap=Gap("tilt", gap, soft, friction))
    turned = []
    for way in (-1.0, 1.0):
        there = held(GALEN.home, np.array([way * 8.0, 0.0, 0.0, 0.0, way * 0.3, 0.0]), plant)
        nominal = held(GALEN.home, np.array([way * 8.0, 0.0, 0.0, 0.0, way * 0.3, 0.0]))
        turn = there.rotation[-1] @ nominal.rotation[-1].T
        turned.append(matrix_to_rotvec(turn)[1])
    assert turned[1] - turned[0] == pytest.approx(gap, rel=0.12)


@pytest.mark.parametrize(
    ("name", "beside", "tip"),
    [
        ("joint_zero_offset:roll", 0.02, True),
        ("joint_zero_offset:tilt", 0.02, True),
        ("joint_gain:tilt", 0.02, True),
        ("joint_axis_misalignment:tilt", 0.02, True),
        ("base_inclination", 0.02, False),
        ("sensor_mount_rotation", 0.02, False),
        ("axis_gain", 0.02, False),
        ("crosstalk", 0.02, False),
        ("wrench_delay", 0.15, False),
        ("tool_mass_error", 0.02, False),
        ("tool_com_error", 0.02, False),
        ("loose_tool", 0.3, False),
        ("inertial_load", 0.5, False),
        ("tracker_scale", None, True),
    ],
)
def test_truths_numbers_mean_what_the_simulator_takes_them_for(healthy, name, beside, tip):
    """Signs, axes and units agree; `beside`: the share of a reading that models may differ by."""
    cause = LISTED[name](np.random.default_rng(7), healthy)
    changed = Measurement(healthy.session, NOMINAL, [cause.resized(3.0 * cause.size)], healthy)
    cause = changed.causes[0]
    effect = effect_from(name.partition(":")[0], dict(cause.truth(cause.size, changed)), arm=GALEN)
    if beside is not None:
        scene = _scene(healthy, "motion")
        wanted = changed.reading("motion", scene.wrench_s) - scene.reading - healthy.session.zero
        got = Replay(scene, [effect]).reading() - Replay(scene).reading()
        # The zeroing shows as a constant.
        wanted, got = ((one - one.mean(axis=0)) / SENSOR.noise_std for one in (wanted, got))
        assert np.linalg.norm(wanted) > 5.0
        assert np.linalg.norm(wanted - got) < beside * np.linalg.norm(wanted)
    if tip:
        scene = _scene(healthy, "push")
        seen = [
            replay.seen_by_tracker(*replay.tip(), *healthy.session.base)[1]
            for replay in (Replay(scene, [effect]), Replay(scene))
        ]
        found = changed.tool_pose("push", scene.tracker_s)[1]
        found = found - healthy.tool_pose("push", scene.tracker_s)[1]
        assert np.max(np.abs(found)) > 1e-4
        np.testing.assert_allclose(found, seen[0] - seen[1], atol=0.02 * np.max(np.abs(found)))


def _scene(healthy, bag):
    """A bag as the simulator is driven along it."""
    take, tool = healthy.session.takes[bag], healthy.session.tool
    fine_s = np.arange(0.0, take.end_s, 0.01)
    wrench_s = take.wrench.taken_s[::15]
    touched = np.zeros(len(wrench_s), dtype=bool)
    if take.pushes is not None:
        touched = np.any(take.pushes.wrench(wrench_s) != 0.0, axis=1)
    return Scene(
        bag=bag,
        start_s=take.start_s,
        joint_s=fine_s,
        joints=take.course(fine_s),
        wrench_s=wrench_s,
        reading=healthy.reading(bag, wrench_s) - healthy.session.zero,
        touched=touched,
        tracker_s=np.zeros(0) if take.recorded is None else np.arange(1.0, 20.0, 3.0),
        tool=ToolGeometry(Load(tool.mass_kg, tool.com_m), tool.tip_m),
        adapter=Load(ADAPTER.mass_kg, ADAPTER.com_m),
        arm=GALEN,
    )


def shown(changed, healthy):
    """The largest change of reading, tip or marker in noises."""
    found = 0.0
    for bag, take in healthy.session.takes.items():
        at_s = take.wrench.taken_s[::10]
        reading = changed.reading(bag, at_s) - healthy.reading(bag, at_s)
        tip = changed.tool_pose(bag, at_s)[1] - healthy.tool_pose(bag, at_s)[1]
        marker = changed.base_pose(bag, at_s)[1] - healthy.base_pose(bag, at_s)[1]
        found = max(
            found, np.max(np.abs(reading / SENSOR.noise_std)), np.max(np.abs(tip)) / 3e-5,
            np.max(np.abs(marker)) / 3e-5,
        )  # fmt: skip
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [*LISTED, *UNLISTED])
def test_every_model_of_a_cause_shows_and_its_truth_is_the_contracts(healthy, name):
    members = set()
    for seed in range(8):
        cause = {**LISTED, **UNLISTED}[name](np.random.default_rng(seed), healthy)
        if seed and cause.member in members:
            continue
        members.add(cause.member)
        cause = cause.resized(3.0 * cause.size)
        changed = Measurement(healthy.session, NOMINAL, [cause], healthy)
        assert 0.3 < shown(changed, healthy) < np.inf, cause.member
        truth = cause.truth(cause.size, changed)
        json.dumps(truth, allow_nan=False)
        assert name in UNLISTED or set(truth) == CONTRACT[name]
    of_more = {"deflection_hysteresis", "backlash", "sensor_drift", "cable_drag"}
    assert (len(members) > 1) == (name in of_more)


def test_effects_of_the_contract_and_unlisted_causes_are_apart():
    assert set(LISTED) == set(CONTRACT)
    assert len(TEST_UNKNOWN) >= 10 and not set(TEST_UNKNOWN) & set(CALIBRATION_UNKNOWN)
    joints = SIX.turning_names[1:]  # the first one's zero is where the tracker stands
    assert {f"joint_zero_offset:{joint}" for joint in joints} < set(listed(SIX))
    parallel = ("shoulder_lift", "elbow", "wrist_1")
    assert set(twins(SIX)) == {f"joint_zero_offset:{joint}" for joint in parallel}


@pytest.mark.slow
def test_a_case_of_the_six_joint_arm_is_read_as_it_was_made(tmp_path):
    asked = Case(31, "single", ("joint_compliance",), "clear", ("motion", "push"), arm="six_axis")
    truth = generate(asked, tmp_path / "r")
    (joint,) = truth.effects[0]["parameters"]["stiffness"]
    assert joint in SIX.turning_names
    assert STRENGTHS["clear"] / 1.3 < truth.d[0] < STRENGTHS["clear"] * 1.3
    recording = read_recording(tmp_path / "r")
    assert recording.arm.joint_names == SIX.joint_names and not recording.problems
    with pytest.raises(GalenError, match="no cause of the arm six_axis"):
        generate(replace(asked, effects=("joint_gain:tilt",)), tmp_path / "other")
    with pytest.raises(GalenError, match="no arm of the blind check"):
        generate(replace(asked, arm="seven"), tmp_path / "other")


def test_what_is_observed_without_a_file_is_what_a_file_holds(tmp_path):
    measured = Measurement(draw_session(7, ("push",), arm=GALEN), NOMINAL)
    write_recording(tmp_path / "r", measured)
    read, told = read_recording(tmp_path / "r"), observed(measured)
    one, other = read.bags["push"], told.bags["push"]
    np.testing.assert_allclose(one.wrench_s, other.wrench_s, atol=1e-9)
    np.testing.assert_allclose(one.wrenches, other.wrenches, atol=1e-12)
    np.testing.assert_allclose(one.joints, other.joints, atol=1e-12)
    for here, there in ((one.tool_marker, other.tool_marker), (one.base_marker, other.base_marker)):
        np.testing.assert_allclose(here.rotation, there.rotation, atol=1e-12)
        np.testing.assert_allclose(here.position, there.position, atol=1e-12)
    assert read.tool.to_json() == told.tool.to_json()


def test_friction_in_the_rods_leaves_a_fraction_and_a_healthy_arm_none(healthy):
    assert healthy.residual_fraction() < 0.005
    changed = Measurement(healthy.session, NOMINAL)
    changed.plant = replace(healthy.plant, rod_friction_n=20.0 * np.ones(6))
    assert 0.05 < changed.residual_fraction() < 0.6


def test_a_creeping_arm_goes_on_as_its_truth_tells(healthy):
    """dc/dt = (fraction e - c) / tau, by differences of what the tracker sees."""
    creep = LISTED["deflection_creep"](np.random.default_rng(2), healthy).resized(0.4)
    truth = creep.truth(creep.size, healthy)
    at_s, moved = healthy.pushed_by("push")
    crept = creep.slip(creep.size, causes.Moment("push", at_s, at_s))
    slope = np.gradient(crept, at_s, axis=0)
    expected = (truth["fraction"] * moved - crept) / truth["tau_s"]
    assert np.max(np.abs(slope - expected)) < 0.02 * np.max(np.abs(expected))
    creeping = Measurement(healthy.session, NOMINAL, [creep], healthy)
    (_, before), (turned, after) = (
        one.tool_pose("push", at_s[::50]) for one in (healthy, creeping)
    )
    shift = np.einsum("nji,nj->ni", turned, after - before)
    np.testing.assert_allclose(shift, crept[::50, :3], atol=2e-6)


@pytest.mark.parametrize("arm", [GALEN, SIX])
def test_courses_stay_in_the_limits(arm):
    for seed in range(6):
        for take in draw_session(seed, BAGS, arm=arm).takes.values():
            at_s = np.linspace(0.0, take.end_s, 1500)
            joints, rates = take.course(at_s), arm.angles(take.course(at_s, 1))
            assert np.all((joints > arm.lower) & (joints < arm.upper))
            assert np.max(np.abs(rates)) < (2.05 if take.bag == "motion" else 4.0)


def test_one_session_has_the_same_metadata_whatever_its_cause(tmp_path, healthy):
    """Names, sizes, stamps and counts of a recording depend on its seed alone."""
    motion = draw_session(7, ("motion",), arm=GALEN)
    plain = Measurement(motion, NOMINAL)
    found = []
    for name in ("", "joint_zero_offset:tilt", "sensor_saturation", "wrench_delay"):
        hidden = [LISTED[name](np.random.default_rng(1), plain).resized(2.0)] if name else []
        folder = tmp_path / (name.replace(":", "_") or "none")
        folder.mkdir()
        write_recording(folder, Measurement(motion, NOMINAL, hidden, plain))
        sizes = {str(p.relative_to(folder)): p.stat().st_size for p in folder.rglob("*.*")}
        with open_bag(folder / "motion") as bag:
            stamps = [block.log_time_ns.tolist() for block in bag.blocks(sorted(bag.topics))]
        found.append((sizes, stamps, (folder / "tool.json").read_text()))
    assert all(one == found[0] for one in found[1:])


@pytest.mark.slow
def test_a_hidden_cause_has_the_strength_and_the_truth_that_its_label_tells(tmp_path):
    asked = Case(31, "single", ("joint_zero_offset:tilt",), "clear", ("motion",))
    truth = generate(asked, tmp_path / "r")
    assert STRENGTHS["clear"] / 1.3 < truth.d[0] < STRENGTHS["clear"] * 1.3
    assert truth.acceptable[0][0] == "joint_zero_offset:tilt"
    assert truth.effects[0]["parameters"]["joint"] == "tilt"
    with pytest.raises(GalenError, match="isn't empty"):
        generate(asked, tmp_path / "r")
    with pytest.raises(GalenError, match="no kind of case"):
        generate(Case(31, "double", (), "clear", ("motion",)), tmp_path / "other")


def test_twins_without_the_tracker_are_one_set(tmp_path):
    truth = generate(Case(21, "ambiguous", ("base_inclination",), bags=("motion",)), tmp_path / "r")
    assert {"joint_zero_offset:roll", "base_inclination"} <= set(truth.acceptable[0])


def test_without_mujoco_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(GalenError, match=r"needs MuJoCo: pip install -r requirements/dev\.txt"):
        require_mujoco()


@pytest.mark.parametrize("bag", BAGS)
def test_a_session_depends_on_its_seed_and_not_on_the_bags_recorded(bag):
    whole, alone = (
        draw_session(3, arm=GALEN).takes[bag],
        draw_session(3, (bag,), arm=GALEN).takes[bag],
    )
    np.testing.assert_array_equal(whole.wrench.stamp_s, alone.wrench.stamp_s)
    at_s = np.linspace(0.0, whole.end_s, 50)
    np.testing.assert_array_equal(whole.course(at_s), alone.course(at_s))


def test_a_usual_arm_is_drawn_within_the_limits_that_its_recording_states(tmp_path):
    generate(Case(5, "none", bags=("sweep",), arm="galen_usual"), tmp_path / "made")
    specification = read_recording(tmp_path / "made").specification
    drawn = draw_tolerance(5, arm=GALEN, usual=True)
    for effect, kind in (("axis_gain", "sensor_gain"), ("joint_zero_offset", "zero_rad")):
        limit = specification.limit(effect)
        assert 0.1 * limit < np.max(np.abs(drawn[kind])) <= limit
    assert specification.limit("axis_gain") == pytest.approx(4e-3)
    assert np.max(np.abs(drawn["crosstalk"])) > 0.0 == np.max(np.abs(NOMINAL["crosstalk"]))


@pytest.mark.slow
def test_a_change_since_a_reference_is_of_the_same_arm_on_another_day(tmp_path):
    folder = tmp_path / "made"
    asked = Case(6, "changed", ("axis_gain",), bags=("sweep",), arm="galen_usual")
    truth = generate(asked, folder)
    later, earlier = read_recording(folder), read_recording(folder / REFERENCE)
    assert earlier.tool.load.load.mass_kg == later.tool.load.load.mass_kg
    assert earlier.specification == later.specification
    assert len(earlier.bags["sweep"].wrench_s) != len(later.bags["sweep"].wrench_s)
    (effect,) = truth.effects
    gain = np.max(np.abs(effect["parameters"]["gain"]))
    assert gain > 0.2 * later.specification.limit("axis_gain")
    found = diagnose_recording(later, references=[earlier]).answer
    assert found.causes[0].label == "axis_gain"
    told = found.causes[0].parameters["gain"]
    for one, true in zip(told, effect["parameters"]["gain"], strict=True):
        assert one.low <= true <= one.high


@pytest.mark.parametrize(
    ("name", "size", "truth", "over"),
    [
        ("joint_zero_offset:tilt", -0.003, {"joint": "tilt", "offset_rad": -0.003}, 3.0),
        ("axis_gain", 0.02, {"gain": [0.0, -0.02, 0.01, 0.0, 0.0, 0.0]}, 5.0),
        # Of a force to a torque a limit counts with a lever of 0.1 m.
        ("crosstalk", 1.0, {"from": "fx", "to": "tz", "coefficient": 0.0004}, 2.0),
        ("crosstalk", 1.0, {"from": "tx", "to": "fz", "coefficient": 0.04}, 2.0),
        ("bias_step", 4.0, {}, np.inf),
    ],
)
def test_how_many_times_its_limit_a_cause_is(name, size, truth, over):
    limits = {"joint_zero_offset": 0.001, "axis_gain": 0.004, "crosstalk": 0.002}
    cause = Cause(name, size, 10.0, lambda size, measured: truth)
    assert over_limit(cause, truth, limits) == pytest.approx(over)
    assert over_limit(cause, truth, None) == np.inf
