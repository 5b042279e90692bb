"""The blind plant: right where the contract says so, and silent about what it hides."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import galen_diagnosis.blind.plant as plant
import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_diagnosis.blind.make import main
from galen_diagnosis.blind.plant import strength as strength_module
from galen_diagnosis.blind.plant.arm import BlindArm
from galen_diagnosis.blind.plant.case import STRENGTHS, Case, Listed, Truth, generate, work_out
from galen_diagnosis.blind.plant.causes.backlash import Backlash
from galen_diagnosis.blind.plant.causes.bias_drift import BiasStep, SensorDrift
from galen_diagnosis.blind.plant.causes.load import CableDrag, InertialLoad
from galen_diagnosis.blind.plant.causes.sensor import SensorSaturation
from galen_diagnosis.blind.plant.causes.springs import DeflectionHysteresis
from galen_diagnosis.blind.plant.course import Stops
from galen_diagnosis.blind.plant.listed import CAUSES
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import BAGS, draw_session
from galen_diagnosis.blind.plant.strength import Scale
from galen_diagnosis.blind.plant.tolerance import COUNT, Tolerance, draw_tolerance
from galen_diagnosis.blind.plant.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN, UNLISTED
from galen_model.arm.galen import ENCODER_QUANTUM, SENSOR
from galen_model.arm.kinematics import tip_pose
from galen_model.arm.pinocchio_arm import PinocchioArm
from galen_model.arm.stiffness import deflection, tip_compliance
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import Load, nominal_reading
from galen_model.load.nominal_tools import ADAPTER, ToolGeometry
from galen_model.rotation import rotvec_to_matrix
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


@pytest.fixture(scope="module")
def session():
    return draw_session(4)


@pytest.fixture(scope="module")
def scale(session):
    return Scale(session)


def test_the_plant_shares_no_code_with_simulator_and_diagnosis():
    files = list(Path(plant.__file__).parent.rglob("*.py"))
    assert len(files) > 15
    for file in files:
        names = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, file
                names.add(node.module)
        for name in names:
            assert not name.startswith("galen_sim_driver"), (file, name)
            if name.startswith("galen_diagnosis"):
                own = ("galen_diagnosis.blind.plant", "galen_diagnosis.errors")
                assert name.startswith(own), (file, name)
            # Of the model only constants, containers and files: neither kinematics nor springs.
            if name.startswith("galen_model"):
                allowed = {"arm", "arrays", "atomic_file"}
                assert name.split(".")[1] in allowed, (file, name)


def test_nominal_arm_is_the_models(session):
    rng = np.random.default_rng(1)
    tip_m = session.tool.tip_m
    pin = PinocchioArm(tip_m)
    joints = rng.uniform([-0.1, -0.1, 0.3, -1.5, -1.0], [0.1, 0.1, 0.5, 1.5, 0.9], (6, 5))
    pose = BlindArm().pose(joints)
    for k, q in enumerate(joints):
        rotation, origin = pin.pose(q)
        np.testing.assert_allclose(pose.rotation[k], rotation, atol=1e-12)
        np.testing.assert_allclose(pose.origin[k], origin, atol=1e-12)
        springs = BlindArm().springs(q, tip_m)
        compliance = springs.loads.T @ springs.give @ springs.loads
        np.testing.assert_allclose(compliance, tip_compliance(q, tip_m), rtol=1e-8, atol=1e-14)


def test_nominal_reading_is_the_contracts(session):
    machine = Machine(session)
    tool = Load(session.tool.mass_kg, session.tool.com_m)
    for bag in BAGS:
        at_s = session.takes[bag].wrench.taken_s[::50]
        joints = session.takes[bag].course.at(at_s).joints
        expected = nominal_reading(joints[:, 3], joints[:, 4], tool, ADAPTER)
        told = machine.reading(bag, at_s, hand=False) - session.zero
        np.testing.assert_allclose(told, expected, atol=1e-12)


def test_nominal_tip_is_the_models(session):
    """Under the hand's wrench and in the tracker's frame, at some samples of all four places."""
    take, tool = session.takes["push"], session.tool
    at_s = take.tracker.taken_s[::211]
    rotation, position = Machine(session).tool_pose("push", at_s)
    base_rotation, base_position = Machine(session).base_pose("push", at_s)
    joints, pushed = take.course.at(at_s).joints, take.pushes.wrench(at_s)
    assert np.count_nonzero(pushed.any(axis=1)) > 10
    for k, q in enumerate(joints):
        turned, at = tip_pose(q, tool.tip_m)
        moved = deflection(q, pushed[k], tool.tip_m)
        there = session.base_rotation @ (at + moved[:3]) + session.base_position
        np.testing.assert_allclose(position[k], there, atol=1e-9)
        turned = session.base_rotation @ rotvec_to_matrix(moved[3:]) @ turned
        np.testing.assert_allclose(rotation[k], turned, atol=1e-9)
    stand = session.base_rotation @ session.marker_position + session.base_position
    np.testing.assert_allclose(base_position, np.tile(stand, (len(at_s), 1)), atol=1e-12)
    np.testing.assert_allclose(
        base_rotation[0], session.base_rotation @ session.marker_rotation, atol=1e-12
    )


def _scene(machine, bag):
    """A bag of the machine as the simulator is driven along it."""
    session, take = machine.session, machine.session.takes[bag]
    fine_s = np.arange(0.0, take.end_s, 0.01)
    wrench_s = take.wrench.taken_s[::15]
    touched = np.zeros(len(wrench_s), dtype=bool)
    if take.pushes is not None:
        touched = take.pushes.touched(wrench_s)
    return Scene(
        bag=bag,
        start_s=take.start_s,
        joint_s=fine_s,
        joints=take.course.at(fine_s).joints,
        wrench_s=wrench_s,
        reading=machine.reading(bag, wrench_s) - session.zero,
        touched=touched,
        tracker_s=take.recorded[:, 0] + 1.0,
        tool=ToolGeometry(Load(session.tool.mass_kg, session.tool.com_m), session.tool.tip_m),
        adapter=ADAPTER,
    )


@pytest.mark.parametrize(
    ("name", "bag", "beside"),
    [
        ("joint_zero_offset:roll", "push", 0.002),
        ("joint_zero_offset:tilt", "push", 0.002),
        ("joint_gain:tilt", "push", 0.002),
        ("joint_axis_misalignment:tilt", "push", 0.002),
        ("base_inclination", "sweep", 0.002),
        ("sensor_mount_rotation", "sweep", 0.002),
        ("axis_gain", "sweep", 0.002),
        ("crosstalk", "sweep", 0.002),
        ("wrench_delay", "motion", 0.15),
        ("tool_mass_error", "sweep", 0.002),
        ("tool_com_error", "sweep", 0.002),
        ("loose_tool", "sweep", 0.3),
        ("inertial_load", "motion", 0.5),
        ("tracker_scale", "push", 0.002),
    ],
)
def test_truths_numbers_mean_what_the_simulator_takes_them_for(session, name, bag, beside):
    """The same numbers in the simulator's effect: signs, axes and units agree.

    `beside`: the share that another law than the simulator's may leave.
    """
    kind = CAUSES[name]
    cause = kind.draw(np.random.default_rng(7), session).times(3.0)
    machine, healthy = Machine(session, [cause]), Machine(session)
    effect = effect_from(name.partition(":")[0], dict(cause.parameters(machine)))
    scene, nominal = _scene(machine, bag), _scene(healthy, bag)
    sigma = SENSOR.noise_std
    there = ~scene.touched
    wanted = machine.reading(bag, scene.wrench_s, hand=False)[there] / sigma
    wanted = wanted - healthy.reading(bag, scene.wrench_s, hand=False)[there] / sigma
    got = (Replay(scene, [effect]).reading() - Replay(nominal).reading())[there] / sigma
    # Zeroing is the sensor's affair: a constant says nothing.
    wanted, got = wanted - wanted.mean(axis=0), got - got.mean(axis=0)
    if name != "tracker_scale":
        assert np.linalg.norm(wanted) > 5.0
        assert np.linalg.norm(wanted - got) < beside * np.linalg.norm(wanted)
    if bag == "push":
        replay = Replay(scene, [effect])
        frame = (session.base_rotation, session.base_position)
        seen = replay.seen_by_tracker(*replay.tip(), *frame)
        told = machine.tool_pose(bag, scene.tracker_s)
        plain = healthy.tool_pose(bag, scene.tracker_s)
        assert np.max(np.abs(told[1] - plain[1])) > 1e-4
        np.testing.assert_allclose(told[1], seen[1], atol=2e-6)
        np.testing.assert_allclose(told[0], seen[0], atol=2e-6)


def test_courses_rates_are_their_differences_and_stay_in_the_limits():
    for seed in range(8):
        for take in draw_session(seed).takes.values():
            at_s = np.linspace(0.01, take.end_s - 0.01, 1500)
            h = 1e-4
            before, here, after = (take.course.at(at_s + shift) for shift in (-h, 0.0, h))
            rate = (after.joints - before.joints) / (2.0 * h)
            change = (after.velocity - before.velocity) / (2.0 * h)
            np.testing.assert_allclose(here.velocity, rate, atol=2e-3)
            np.testing.assert_allclose(here.acceleration, change, atol=0.1)
            assert np.all(np.abs(here.joints[:, 3]) < 1.57)
            assert np.all((here.joints[:, 4] > -1.04) & (here.joints[:, 4] < 0.96))
            assert np.all(np.abs(here.joints[:, :2]) < 0.14)
            if take.bag == "motion":
                assert np.max(np.abs(here.velocity[:, 3:])) < 2.05
                assert np.max(np.abs(here.velocity[:, :3])) < 0.11


def test_inertial_forces_are_the_change_of_momentum(session):
    """Newton: the force on tool and adapter, from second differences of their centres' places."""
    machine = Machine(session, [InertialLoad(0.3)])
    at_s = np.linspace(5.0, 20.0, 40)
    h = 1e-3
    bodies = (machine.tool, machine.adapter)
    share = 0.3 / sum(body.mass_kg for body in bodies)

    def places(shift):
        pose = machine.arm.pose(session.takes["motion"].course.at(at_s + shift).joints)
        return [pose.origin + pose.rotation @ body.com_m for body in bodies], pose

    (before, _), (here, pose), (after, _) = places(-h), places(0.0), places(h)
    force = sum(
        -share * body.mass_kg * (a - 2.0 * b + c) / h**2
        for body, a, b, c in zip(bodies, before, here, after, strict=True)
    )
    told = machine.reading("motion", at_s) - Machine(session).reading("motion", at_s)
    np.testing.assert_allclose(
        told[:, :3], np.einsum("nji,nj->ni", pose.rotation, force), atol=1e-4
    )
    assert np.max(np.abs(told[:, :3])) > 0.02


def test_backlash_lags_by_half_the_gap(session):
    gap = 0.004
    there = np.array([[0.0, 0.0, 0.4, 0.0, -0.8], [0.0, 0.0, 0.4, 0.0, 0.8]])
    poses = np.vstack([there, there])
    arrive_s = np.arange(4) * 3.0
    take = replace(
        session.takes["sweep"], course=Stops(poses, arrive_s, arrive_s + 1.0), end_s=12.0
    )
    turned = replace(session, takes={"sweep": take})
    machine = Machine(turned, [Backlash(gap, "tilt")])
    at_s = arrive_s[1:] + 0.5
    at = machine.moment("sweep", at_s, "wrench")
    beside = machine.state(at).joints - at.going.joints
    np.testing.assert_allclose(beside[:, 4], [-gap / 2, gap / 2, -gap / 2], rtol=1e-6)
    assert not beside[:, :4].any()


@pytest.mark.parametrize("law", ["plays", pytest.param("ahead", marks=pytest.mark.slow)])
def test_hysteresis_leaves_the_fraction_that_it_tells(session, law):
    """Pushes of the session itself: what the tip keeps of the largest ones, about the fraction."""
    cause = DeflectionHysteresis(0.1, law)
    told = cause.parameters(Machine(session, [cause]))["residual_fraction"]
    take = session.takes["push"]
    largest = np.linalg.norm(take.pushes.force_n, axis=1) > 9.0
    end_s = take.pushes.end_s[largest]
    top_s = end_s - take.pushes.fall_s[largest] - 0.02
    tips = [
        Machine(session, causes).tip("push", at)
        for causes in ([cause], [])
        for at in (end_s, top_s)
    ]
    rest = Machine(session).tip("push", take.recorded[:, 0])[1][np.repeat(np.arange(4), 6)]
    left = tips[0][1] - tips[2][1]
    most = tips[1][1] - rest
    fraction = np.sqrt(np.sum(left**2) / np.sum(most**2))
    assert 0.01 < told < 0.2
    # After other pushes more or less stays than after a first one.
    assert 0.5 < fraction / told < 2.0


def test_what_is_told_of_causes_is_what_they_do(session):
    machine = Machine(session)
    drift = SensorDrift.draw(np.random.default_rng(3), session).times(20.0)
    drifted = Machine(session, [drift])
    ends = [("sweep", np.zeros(1)), ("push", session.takes["push"].wrench.taken_s[-1:])]
    first, last = (drifted.reading(*end) - machine.reading(*end) for end in ends)
    hours = (session.takes["push"].start_s + ends[1][1][0]) / 3600.0
    told = drift.parameters(drifted)["rate_per_hour"]
    np.testing.assert_allclose(told, (last - first)[0] / hours, rtol=0.02)

    step = BiasStep(20.0, bag="motion", time_s=7.0)
    stepped = Machine(session, [step])
    told = step.parameters(stepped)
    at_s = np.array([told["time_s"] - 0.05, told["time_s"] + 0.05])
    jump = stepped.reading("motion", at_s) - machine.reading("motion", at_s)
    np.testing.assert_allclose(jump, [np.zeros(6), told["step"]], atol=1e-12)
    after = stepped.reading("push", at_s) - machine.reading("push", at_s)
    np.testing.assert_allclose(after, [told["step"]] * 2, atol=1e-12)

    cable = CableDrag.draw(np.random.default_rng(1), session).times(10.0)
    with_cable = Machine(session, [replace(cable, weight_share=0.0, friction=0.0)])
    pulls = [
        np.linalg.norm(
            (with_cable.reading(bag, s, hand=False) - machine.reading(bag, s, hand=False))[:, :3],
            axis=1,
        )
        for bag, s in ((bag, take.wrench.taken_s[::20]) for bag, take in session.takes.items())
    ]
    told = cable.parameters(Machine(session, [cable]))["tension_N"]
    assert np.mean(np.concatenate(pulls)) == pytest.approx(told, rel=0.01)


@pytest.mark.parametrize("raw", [False, True])
def test_saturation_clips_where_it_tells(session, raw):
    clip = SensorSaturation(0.5, axis=0, peak=11.0, raw=raw)
    machine = Machine(session, [clip])
    limit = clip.parameters(machine)["limit"]
    shown = machine.reading("push", session.takes["push"].wrench.taken_s)[:, 0] - session.zero[0]
    sides = [np.max(shown), -np.min(shown)]
    assert min(abs(side - limit) for side in sides) < 0.02


def test_strength_counts_neither_nuisances_nor_more_than_tolerances(scale):
    for column in scale._columns:
        assert scale.strength(column) < 1e-4 * np.linalg.norm(column)
    for sigmas in np.eye(COUNT)[::9]:
        alone = scale.difference((), Tolerance(sigmas))
        assert scale.strength(alone) <= 1.0 + 1e-6


def test_strength_is_that_of_all_samples(session, monkeypatch):
    """Every k-th sample counts k times: the same D as from more, and it grows in proportion."""
    cause = CAUSES["wrench_delay"].draw(np.random.default_rng(2), session)
    scale = Scale(session, 0.0)
    few = scale.strength(scale.difference([cause]))
    monkeypatch.setattr(strength_module, "_SAMPLES_A_TOPIC", 2600)
    finer = Scale(session, 0.0)
    assert few == pytest.approx(finer.strength(finer.difference([cause])), rel=0.05)
    assert scale.strength(scale.difference([cause.times(2.0)])) == pytest.approx(2 * few, rel=0.02)


def test_unlisted_kinds_are_none_of_the_contracts_and_disjoint():
    assert set(CAUSES) == set(CONTRACT)
    assert not set(UNLISTED) & set(CAUSES)
    assert not set(CALIBRATION_UNKNOWN) & set(TEST_UNKNOWN)
    assert min(len(CALIBRATION_UNKNOWN), len(TEST_UNKNOWN)) >= 6


def _shape(folder):
    """All that a look at files without their contents tells."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            found[str(path.relative_to(folder))] = path.stat().st_size
    metadata = {p.name: p.read_bytes() for p in folder.rglob("metadata.yaml")}
    return found, metadata, (folder / "tool.json").read_bytes()


def test_files_tell_nothing_about_the_cause(tmp_path):
    """Of one seed: same names, sizes, stamps, counts and tool's file, whatever is hidden."""
    shapes, stamps = [], []
    for number, (kind, effects) in enumerate([("none", ()), ("single", ("wrench_delay",))]):
        folder = tmp_path / str(number)
        generate(Case(9, kind, effects, bags=("sweep",)), folder)
        shapes.append(_shape(folder))
        arm = read_arm(folder / "sweep")
        stamps.append((arm.joint_stamp_ns, arm.wrench_stamp_ns, arm.joints))
    assert shapes[1] == shapes[0]
    for other in stamps[1:]:
        for a, b in zip(stamps[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_truth_comes_from_the_seed_and_survives_its_file(tmp_path, capsys):
    case = Case(12, "single", bags=("motion",))
    first, again = work_out(case).truth, work_out(case).truth
    assert first == again
    assert Truth.from_json(json.loads(json.dumps(first.to_json()))) == first
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert main(["--seed", "12", "-o", str(tmp_path / "full")]) == 1
    assert "isn't empty" in capsys.readouterr().err


@pytest.mark.slow
def test_every_cause_reaches_its_strength(session, scale):
    listed = Listed(session, scale)
    for name, kind in (CAUSES | UNLISTED).items():
        measure = listed.left_by_best if name in UNLISTED else scale.strength
        for strength in (STRENGTHS["clear"], STRENGTHS["gross"]):
            cause = kind.draw(np.random.default_rng([5, 1]), session)
            found, reached = scale.sized(cause, strength, measure)
            assert reached == pytest.approx(strength, rel=0.03), (name, strength)
            assert abs(found.size) <= found.largest
        if name in CAUSES:
            told = found.parameters(Machine(session, [found]))
            assert set(told) <= CONTRACT[name], name
            json.dumps(told, allow_nan=False)
            # Its own name explains some of it, by the linear look of another law of its kind; of
            # a gross delay the least, whose beat no constant delay has.
            rest = listed.left(scale.difference([found]))[name]
            assert rest < 0.85 * STRENGTHS["gross"], (name, rest)


@pytest.mark.slow
def test_twins_without_the_tracker_are_one_set(session):
    made = work_out(Case(21, "ambiguous", ("joint_zero_offset:roll",)))
    assert "push" not in made.session.takes
    assert set(made.truth.acceptable[0]) == {"joint_zero_offset:roll", "base_inclination"}
    assert made.truth.expected_verdict == "ambiguous"
    whole = Scale(draw_session(21))
    inclined = CAUSES["base_inclination"].spans(made.session)[0]
    difference = whole.difference(made.causes)
    rest = whole.family(inclined).left(difference, whole.strength(difference))
    assert rest > 3.0 * strength_module.TELLABLE


@pytest.mark.slow
def test_a_healthy_recording_is_noise_about_the_nominal_arm(tmp_path):
    """Read back from its files: noise as it was drawn, nominal within the tolerances."""
    truth = generate(Case(3, "none"), tmp_path / "r")
    assert truth.effects == []
    assert truth.expected_verdict == "none"
    session = draw_session(3)
    tool = read_calibration(tmp_path / "r" / "tool.json")
    assert 1e-5 < tool.load.mass_std_kg < 1e-4
    arm_of_seed = Machine(session, (), draw_tolerance(3))
    for bag in BAGS:
        arm = read_arm(tmp_path / "r" / bag)
        assert arm.problems == ()
        take = session.takes[bag]
        full = arm_of_seed.reading(bag, take.wrench.taken_s)
        noise = arm.wrenches - full
        expected = np.sqrt(session.wrench_std**2 + SENSOR.quantum**2 / 12.0)
        np.testing.assert_allclose(np.std(noise, axis=0) / expected, 1.0, atol=0.05)
        assert np.all(np.abs(np.mean(noise, axis=0)) < 0.2 * session.wrench_std)
        untouched = np.ones(len(noise), dtype=bool)
        if take.pushes is not None:
            untouched = ~take.pushes.touched(take.wrench.taken_s)
        roll, tilt = take.course.at(take.wrench.taken_s).joints[untouched, 3:].T
        beside = full[untouched] - tool.predict(roll, tilt) - session.zero
        # Tolerances: less than a quarter of a sample's noise.
        assert np.max(np.abs(beside - np.mean(beside, axis=0)) / SENSOR.noise_std) < 0.25
        reported = take.course.at(take.joints.taken_s).joints
        assert np.all(np.abs(arm.joints - reported) <= 0.51 * ENCODER_QUANTUM)
    healthy = Scale(session)
    own = healthy.difference((), draw_tolerance(3))
    # Of COUNT unit normals about sqrt(COUNT) at most is left after what they mimic of each other.
    assert healthy.strength(own) < np.sqrt(COUNT) + 2.0
