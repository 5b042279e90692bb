"""The blind arm: nominal where the contract says so, and silent about what it hides."""

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.formats.bag import open_bag
from galen_diagnosis.blind import causes, measuring, mujoco_arm, session, unlisted
from galen_diagnosis.blind.case import STRENGTHS, Case, generate
from galen_diagnosis.blind.causes import LISTED
from galen_diagnosis.blind.measuring import Measurement, draw_tolerance, write_recording
from galen_diagnosis.blind.mujoco_arm import (
    DECAY,
    STEP_S,
    Gap,
    MujocoArm,
    Plant,
    require_mujoco,
)
from galen_diagnosis.blind.session import ADAPTER, BAGS, TOOLS, Clock, draw_session
from galen_diagnosis.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN, UNLISTED
from galen_model.arm.arm import Arm, Joint
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.errors import GalenError
from galen_model.load.inertia import inertial_wrench
from galen_model.load.model import Load, ToolGeometry
from galen_model.rotation import matrix_to_rotvec
from galen_sim_driver.effects.registry import effect_from
from galen_sim_driver.replay import Replay, Scene

CONTRACT = {
    "joint_zero_offset:roll": {"joint", "offset_rad"},
    "joint_zero_offset:tilt": {"joint", "offset_rad"},
    "joint_gain:tilt": {"joint", "gain"},
    "joint_axis_misalignment:tilt": {"joint", "about", "angle_rad"},
    "base_inclination": {"about_x_rad", "about_y_rad"},
    "sensor_mount_rotation": {"rotvec_rad"},
    "axis_gain": {"gain"},
    "crosstalk": {"from", "to", "coefficient"},
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
    "backlash": {"joint", "gap_rad"},
    "tracker_delay": {"delay_s"},
    "tracker_scale": {"gain"},
    "base_shift": {"translation_m", "rotvec_rad", "time_s"},
}
NOMINAL = draw_tolerance(0, 0.0)
TOOL = TOOLS[1]
PLANT = Plant(TOOL.body, ADAPTER, TOOL.tip_m)
POSE = np.array([0.03, -0.04, 0.45, 0.5, -0.4])


@pytest.fixture(scope="module")
def healthy():
    """An arm without tolerances in the beginning of a session of motion and pushes."""
    whole = draw_session(5, ("motion", "push"))
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
                    own = node.module.startswith("galen_diagnosis.blind")
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
        found = MujocoArm(replace(PLANT, inertial=share)).run(at_s, joints).wrench - weights
        left = np.std((found - share * expected)[later], axis=0)
        assert np.all(left < 1.5 * STEP_S * DECAY * size + 0.01 * SENSOR.noise_std)


def test_a_serial_arm_of_other_joints_is_simulated_as_well():
    x, y, z = np.eye(3)
    arm = Arm(
        "two_joints",
        (
            Joint("turn", "revolute", z, 0.2 * z, -3.0, 3.0, stiffness=800.0),
            Joint("bend", "revolute", y, 0.3 * x, -3.0, 3.0, stiffness=500.0),
        ),
        sensor_origin_m=0.2 * x,
        sensor_rotation=np.eye(3),
    )
    none = np.zeros(2)
    plant = replace(PLANT, arm=arm, zero=none, gain=none)
    joints, push = np.array([0.4, -0.3]), np.array([2.0, -1.0, 3.0, 0.1, 0.0, 0.2])
    rest, pushed = held(joints, None, plant, 4.0), held(joints, push, plant, 4.0)
    expected = weight(arm, joints[None], TOOL.body, ADAPTER)[0]
    np.testing.assert_allclose(rest.wrench[-1], expected, atol=1e-6)
    moved = arm.deflection(joints, push, TOOL.tip_m)[:3]
    found = pushed.position[-1] - rest.position[-1]
    np.testing.assert_allclose(found, moved, atol=0.02 * np.linalg.norm(moved))


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
    effect = effect_from(name.partition(":")[0], dict(cause.truth(cause.size, changed)))
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
    )


def test_every_cause_shows_and_its_truth_is_the_contracts(healthy):
    assert set(LISTED) == set(CONTRACT)
    assert len(TEST_UNKNOWN) >= 6 and not set(TEST_UNKNOWN) & set(CALIBRATION_UNKNOWN)
    for name, draw in {**LISTED, **UNLISTED}.items():
        cause = draw(np.random.default_rng(3), healthy)
        cause = cause.resized(3.0 * cause.size)
        changed = Measurement(healthy.session, NOMINAL, [cause], healthy)
        largest = 0.0
        for bag, take in healthy.session.takes.items():
            at_s = take.wrench.taken_s[::10]
            reading = changed.reading(bag, at_s) - healthy.reading(bag, at_s)
            tip = changed.tool_pose(bag, at_s)[1] - healthy.tool_pose(bag, at_s)[1]
            marker = changed.base_pose(bag, at_s)[1] - healthy.base_pose(bag, at_s)[1]
            largest = max(
                largest, np.max(np.abs(reading / SENSOR.noise_std)), np.max(np.abs(tip)) / 3e-5,
                np.max(np.abs(marker)) / 3e-5,
            )  # fmt: skip
        assert 0.3 < largest < np.inf, name
        truth = cause.truth(cause.size, changed)
        json.dumps(truth, allow_nan=False)
        assert name in UNLISTED or set(truth) == CONTRACT[name], name


def test_hysteresis_leaves_a_fraction_and_a_healthy_arm_none(healthy):
    assert healthy.residual_fraction() < 0.005
    cause = LISTED["deflection_hysteresis"](np.random.default_rng(1), healthy)
    changed = Measurement(healthy.session, NOMINAL, [cause.resized(20.0)], healthy)
    assert 0.05 < changed.residual_fraction() < 0.6


def test_courses_stay_in_the_limits():
    for seed in range(6):
        for take in draw_session(seed).takes.values():
            at_s = np.linspace(0.0, take.end_s, 1500)
            joints, rates = take.course(at_s), take.course(at_s, 1)
            assert np.all((joints > GALEN.lower) & (joints < GALEN.upper))
            assert np.max(np.abs(rates[:, 3:])) < (2.05 if take.bag == "motion" else 4.0)


def test_one_session_has_the_same_metadata_whatever_its_cause(tmp_path, healthy):
    """Names, sizes, stamps and counts of a recording depend on its seed alone."""
    motion = draw_session(7, ("motion",))
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
    whole, alone = draw_session(3).takes[bag], draw_session(3, (bag,)).takes[bag]
    np.testing.assert_array_equal(whole.wrench.stamp_s, alone.wrench.stamp_s)
    at_s = np.linspace(0.0, whole.end_s, 50)
    np.testing.assert_array_equal(whole.course(at_s), alone.course(at_s))
