"""Hysteresis of the deflection: Dahl's law itself, in the joints, and in the plant."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, HOME
from galen_model.arm.kinematics import tip_pose
from galen_model.arm.stiffness import tip_compliance
from galen_model.errors import GalenError
from galen_model.load.nominal_tools import TOOLS
from galen_model.rotation import matrix_to_rotvec, quaternion_to_matrix, rotvec_to_matrix
from galen_sim_driver.errors import ConfigError
from galen_sim_driver.node.parameters import DriverParameters
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import (
    HandPush,
    HysteresisConfig,
    PlantConfig,
    SensorConfig,
    TrackerConfig,
)
from galen_sim_driver.plant.joint_hysteresis import (
    DahlFriction,
    JointHysteresis,
    load_of,
    residual_fraction,
    shape,
)
from galen_sim_driver.plant.trajectory import Trajectory, TrajectoryPoint
from scipy.optimize import brentq

RETRACTOR = TOOLS["retractor"].tip_m
TURNED = (0.03, -0.05, 0.45, 0.8, -0.6)
POSES = [
    HOME.tolist(),
    [0.06, -0.05, 0.43, 0.7, -0.4],
    [-0.07, 0.04, 0.37, -0.9, 0.5],
    [0.03, 0.07, 0.40, 0.3, 0.8],
]
STILL = TrackerConfig(noise=False, rate_hz=100.0)


# --- the law ------------------------------------------------------------------------------------


def by_small_steps(ratio, loads, step=1e-4):
    """phi after each load (over F_c): Dahl's equation by the midpoint rule, in steps of y."""
    y = phi = 0.0
    out = []
    for load in loads:
        sign = np.sign(load - (y / ratio + phi))
        while sign * (load - (y / ratio + phi)) > 0.0:
            middle = phi + 0.5 * step * sign * (1.0 - sign * phi)
            phi += step * sign * (1.0 - sign * middle)
            y += step * sign
        out.append(phi)
    return np.array(out)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 2.0])
def test_the_friction_solves_dahls_equation(ratio):
    loads = np.array([1.5, 0.2, 0.9, -4.0, -4.0, 0.0, 0.3, -0.3])
    joint = DahlFriction(ratio, np.array([1.0]))
    phi = []
    for load in loads:
        joint.load(np.array([load]))
        phi.append(joint.friction[0])
    # One step too many at a turn is up to 2e-4 of phi.
    assert np.abs(phi - by_small_steps(ratio, loads)).max() < 5e-4
    assert 0.1 < np.ptp(phi) < 2.0


def test_a_load_in_one_step_or_in_thousands_is_the_same():
    one, many = (DahlFriction(0.2, np.array([2.0, 0.5])) for _ in range(2))
    for turn in ([3.0, -1.0], [-2.0, 0.1], [0.0, 0.0]):
        start = many._load
        one.load(np.array(turn))
        for part in np.linspace(0.0, 1.0, 3001)[1:]:
            many.load(start + part * (turn - start))
        assert np.abs(one.friction - many.friction).max() < 1e-10
    assert np.abs(one.friction).min() > 0.01


def test_a_load_that_stays_changes_nothing_and_a_huge_one_only_slides():
    joint = DahlFriction(0.2, np.array([2.0]))
    joint.load(np.array([1.0]))
    kept = joint.friction[0]
    for _ in range(100):
        joint.load(np.array([1.0]))
    assert joint.friction[0] == kept > 0.0
    joint.load(np.array([1e6]))
    assert joint.friction[0] == pytest.approx(2.0, rel=1e-12)
    joint.load(np.array([-1e6]))
    assert joint.friction[0] == pytest.approx(-2.0, rel=1e-12)


def test_a_loop_keeps_the_energy_that_the_law_takes():
    # In a steady loop between -Y and Y friction runs between -tanh(Y) and tanh(Y) F_c, and keeps
    # the integral of F over x: 4 (F_c^2 / sigma) (Y - tanh(Y)). Here F_c and k are 1.
    ratio, amplitude, a_turn = 0.5, 2.0, 2000
    joint = DahlFriction(ratio, np.array([1.0]))
    loads = amplitude * np.sin(2.0 * np.pi * np.arange(8 * a_turn + 1) / a_turn)
    friction = []
    for load in loads:
        joint.load(np.array([load]))
        friction.append(joint.friction[0])
    displacement = loads - np.array(friction)
    work = np.cumsum(0.5 * (loads[1:] + loads[:-1]) * np.diff(displacement))
    way = brentq(lambda y: y / ratio + np.tanh(y) - amplitude, 0.0, 10.0)
    expected = 4.0 / ratio * (way - np.tanh(way))
    assert work[-1] - work[-1 - a_turn] == pytest.approx(expected, rel=1e-4)
    assert work.min() >= 0.0


@pytest.mark.parametrize("wanted", [1e-4, 0.01, 0.0742, 0.2, 0.5])
def test_the_largest_residual_fraction_is_what_was_asked_for(wanted):
    ratio, way = shape(wanted)
    reference = load_of(ratio, way)

    def left(times):
        joint = DahlFriction(ratio, np.array([1.0]))
        joint.load(np.array([times * reference]))
        pushed = times * reference - joint.friction[0]
        joint.load(np.array([0.0]))
        return -joint.friction[0] / pushed

    assert left(1.0) == pytest.approx(wanted, rel=1e-6)
    others = [left(times) for times in np.geomspace(0.05, 20.0, 60)]
    assert max(others) <= wanted * (1.0 + 1e-9)
    # As the module says of how it depends on the load, and the formula agrees with the walk.
    for times in (0.5, 0.8, 1.25, 2.0):
        y = brentq(lambda y, t=times: load_of(ratio, y) - t * reference, 1e-9, 100.0 * way)
        assert left(times) == pytest.approx(residual_fraction(ratio, y), rel=1e-6)
    if wanted == 0.0742:
        lower = [left(times) / wanted for times in (0.8, 1.25, 0.5, 2.0)]
        assert lower == pytest.approx([0.98, 0.978, 0.839, 0.80], abs=1e-3)


# --- in the joints ------------------------------------------------------------------------------


# Which columns are of one kind, and what they are called by the configuration and by the arm.
KINDS = {
    "carriage_load_n": (slice(0, 3), "carriage_stiffness_n_m"),
    "roll_load_nm": (slice(3, 4), "roll_stiffness_nm_rad"),
    "tilt_load_nm": (slice(4, 5), "tilt_stiffness_nm_rad"),
    "rod_load_n": (slice(5, 11), "rod_stiffness_n_m"),
}


def columns_of(joints):
    return JointHysteresis(HysteresisConfig(0.1), GALEN)._columns_for(joints, RETRACTOR.tolist())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("joints", [HOME.tolist(), TURNED])
def test_the_joints_are_those_of_the_nominal_compliance(kind, joints):
    # By the six-rod formula with and without that kind's give; the columns don't come from it.
    which, stiffness = KINDS[kind]
    rigid = replace(GALEN, **{stiffness: 1e15})
    expected = tip_compliance(joints, RETRACTOR) - tip_compliance(joints, RETRACTOR, rigid)
    column = columns_of(joints)[:, which]
    found = column @ column.T / getattr(GALEN, stiffness)
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


def test_small_loads_find_all_joints_stiffer():
    # Dahl's friction of a small load is a spring of sigma beside k.
    ratio, _ = shape(0.3)
    compliance = tip_compliance(TURNED, RETRACTOR)
    found = np.zeros((6, 6))
    for axis, wrench in enumerate(1e-6 * np.eye(6)):
        hysteresis = JointHysteresis(HysteresisConfig(0.3), GALEN)
        hysteresis.load(TURNED, RETRACTOR.tolist(), wrench.tolist())
        found[:, axis] = np.array(hysteresis.displacement(TURNED, RETRACTOR.tolist())) / 1e-6
    expected = compliance / (1.0 + ratio) - compliance
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("times", "part"), [(0.25, 0.551), (1.0, 1.0), (1.15, 0.992), (2.0, 0.80)])
def test_every_joint_keeps_its_fraction_after_a_push(kind, times, part):
    which, stiffness = KINDS[kind]
    wrench = np.array([3.0, -4.0, 2.0, 0.3, 0.2, -0.1])
    columns = columns_of(TURNED)[:, which]
    loads = columns.T @ wrench
    stiffness = getattr(GALEN, stiffness)
    tip_m = RETRACTOR.tolist()
    # The others slide from the start, and their friction is nothing.
    config = replace(HysteresisConfig(0.0742), **dict.fromkeys(KINDS, 1e-9))
    for joint, load in enumerate(loads):
        own = replace(config, **{kind: abs(load) / times})
        hysteresis = JointHysteresis(own, GALEN)
        hysteresis.load(TURNED, tip_m, wrench.tolist())
        taken = np.linalg.lstsq(columns, hysteresis.displacement(TURNED, tip_m), rcond=None)[0]
        hysteresis.load(TURNED, tip_m, None)
        kept = np.linalg.lstsq(columns, hysteresis.displacement(TURNED, tip_m), rcond=None)[0]
        fraction = kept[joint] / (load / stiffness + taken[joint])
        assert fraction == pytest.approx(0.0742 * part, rel=0.01), joint


def test_the_tip_keeps_about_the_fraction_after_ten_newtons():
    # As the README tells of the poses of bags/pushes; the largest deflection is along y.
    for axis, low in ((0, 0.82), (1, 0.96), (2, 0.81)):
        for joints in POSES:
            hysteresis = JointHysteresis(HysteresisConfig(0.0742), GALEN)
            wrench = 10.0 * np.eye(6)[axis]
            hysteresis.load(joints, RETRACTOR.tolist(), wrench.tolist())
            pushed = tip_compliance(joints, RETRACTOR) @ wrench
            pushed = (pushed + hysteresis.displacement(joints, RETRACTOR.tolist()))[:3]
            hysteresis.load(joints, RETRACTOR.tolist(), None)
            left = np.array(hysteresis.displacement(joints, RETRACTOR.tolist()))[:3]
            assert low < left @ pushed / (pushed @ pushed) / 0.0742 < 1.0


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (HysteresisConfig(-0.1), "-0.1"),
        (HysteresisConfig(1e-5), "1e-05.*0.0001 and 0.5"),
        (HysteresisConfig(0.6), "0.6"),
        (HysteresisConfig(float("nan")), "nan"),
        (HysteresisConfig(0.1, carriage_load_n=0.0), "carriage.*0.0"),
        (HysteresisConfig(0.1, rod_load_n=float("nan")), "rod.*nan"),
        (HysteresisConfig(0.1, roll_load_nm=-1.0), "roll.*-1.0"),
        (HysteresisConfig(0.1, tilt_load_nm=float("inf")), "tilt.*inf"),
    ],
)
def test_bad_values_are_named(config, words):
    with pytest.raises(ConfigError, match=words):
        replace(PlantConfig(), hysteresis=config).validate()


# --- in the plant -------------------------------------------------------------------------------


def pushed_plant(fraction, rate_hz=500.0, joints=TURNED, pushes=None, noise=False):
    if pushes is None:
        pushes = [
            HandPush(0.1, 0.5, (10.0, 0.0, 0.0), ramp_s=0.2),
            HandPush(0.8, 0.5, (0.0, -6.0, 4.0), (0.0, 0.2, 0.0), ramp_s=0.2),
        ]
    config = replace(
        PlantConfig(),
        rate_hz=rate_hz,
        start_joints=joints,
        hand=pushes,
        sensor=SensorConfig(noise=noise),
        tracker=replace(STILL, noise=noise),
        hysteresis=HysteresisConfig(fraction),
    )
    plant = Plant(config, np.random.default_rng(3))
    plant.attach_tool("retractor")
    plant.start_hand()
    return plant


def tip_deflections(plant, seconds, joints=TURNED):
    """Displacement (n, 6) of the tip in base_link at the tracker's looks, and their times, s."""
    base = PlantConfig().tracker.base_in_tracker
    turn = rotvec_to_matrix(base.rotvec_rad)
    rotation, tip = tip_pose(joints, RETRACTOR)
    times, found = [], []
    start_ns = plant.now_ns
    for _ in range(round(seconds * 1e9 / plant._period_ns)):
        sample = plant.step()
        if sample.tracker is None:
            continue
        tool = sample.tracker.tool
        position = turn.T @ (np.array(tool.position_m) - base.translation_m)
        turned = turn.T @ quaternion_to_matrix(tool.quaternion) @ rotation.T
        found.append([*(position - tip), *matrix_to_rotvec(turned)])
        times.append((sample.stamp_ns - start_ns) * 1e-9)
    return np.array(times), np.array(found)


def test_without_it_or_before_the_first_touch_the_plant_is_the_nominal_one():
    nominal = pushed_plant(0.0, noise=True)
    assert nominal._hysteresis is None
    # Before the first touch a plant with hysteresis draws and shows the same.
    on = pushed_plant(0.1, noise=True)
    for _ in range(49):
        assert nominal.step() == on.step()
    samples = [(nominal.step(), on.step()) for _ in range(300)]
    assert all(a.wrench == b.wrench for a, b in samples)
    assert any(a.tracker != b.tracker for a, b in samples)


def test_a_deflection_is_left_after_the_push_and_the_plant_shows_what_the_law_says():
    times, found = tip_deflections(pushed_plant(0.1), 1.6)
    compliance = tip_compliance(TURNED, RETRACTOR)
    law = JointHysteresis(HysteresisConfig(0.1), GALEN)
    tip_m = RETRACTOR.tolist()
    first = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    second = np.array([0.0, -6.0, 4.0, 0.0, 0.2, 0.0])
    assert np.abs(found[times < 0.1]).max() < 1e-12
    for wrench, at_s in ((first, 0.35), (None, 0.7), (second, 1.05), (None, 1.5)):
        law.load(TURNED, tip_m, None if wrench is None else wrench.tolist())
        expected = np.array(law.displacement(TURNED, tip_m))
        if wrench is not None:
            expected = expected + compliance @ wrench
        seen = found[np.argmin(np.abs(times - at_s))]
        assert np.abs(seen - expected).max() < 1e-9
        assert np.abs(seen[:3]).max() > 1e-5


def test_the_result_does_not_depend_on_the_step_rate():
    at_rest = {}
    for rate_hz in (100.0, 500.0, 1000.0):
        times, found = tip_deflections(pushed_plant(0.0742, rate_hz), 1.5)
        at_rest[rate_hz] = found[np.isclose(times % 0.05, 0.0, atol=1e-6)]
    assert np.abs(at_rest[100.0][-1][:3]).max() > 5e-6
    for rate_hz in (500.0, 1000.0):
        assert np.abs(at_rest[rate_hz] - at_rest[100.0]).max() < 1e-11


def test_what_is_left_stays_in_the_joints_while_the_arm_moves():
    pushes = [HandPush(0.1, 0.5, (0.0, 10.0, 0.0), ramp_s=0.2)]
    home, turned = tuple(HOME.tolist()), (0.0, 0.0, 0.408, 0.0, 0.7)
    plant = pushed_plant(0.1, joints=home, pushes=pushes)
    _, found = tip_deflections(plant, 1.0, home)
    plant.command(Trajectory(("tilt",), [TrajectoryPoint(1.0, [0.7], [0.0], [0.0])]))
    for _ in range(1000):
        plant.step()
    _, after = tip_deflections(plant, 0.1, turned)
    # The platform stands as it did, and the roll axis with it: the turn is the same, but the tip
    # moves with it to where the same rigid displacement takes its new place.
    left, right = found[-1], after[-1]
    assert np.abs(left[3:]).max() > 1e-5
    assert right[3:] == pytest.approx(left[3:], rel=1e-6)
    way = tip_pose(turned, RETRACTOR)[1] - tip_pose(home, RETRACTOR)[1]
    assert right[:3] == pytest.approx(left[:3] + np.cross(left[3:], way), rel=1e-4, abs=1e-10)
    assert np.abs(right[:3] - left[:3]).max() > 1e-6


def test_the_nodes_parameters_reach_the_plant():
    assert DriverParameters().plant_config().hysteresis == HysteresisConfig()
    assert not HysteresisConfig().on
    asked = replace(
        DriverParameters(),
        deflection_hysteresis_fraction=0.05,
        deflection_hysteresis_load=(10.0, 50.0, 2.0, 3.0),
    )
    asked.validate()
    assert asked.plant_config().hysteresis == HysteresisConfig(0.05, 10.0, 50.0, 2.0, 3.0)
    with pytest.raises(GalenError, match=r"deflection_hysteresis_load.*2 numbers.*4"):
        replace(asked, deflection_hysteresis_load=(1.0, 2.0)).validate()
