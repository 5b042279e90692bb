# SPDX-License-Identifier: Apache-2.0
"""The simulator along recorded joints: nominal, each effect by an independent formula, together."""

import json
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
import sim_bench
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, TOOLS, Load, gravity_wrench, nominal_reading
from galen_sim_driver.effects.joints import (
    BaseInclination,
    JointAxisMisalignment,
    JointCompliance,
    JointEccentricity,
    JointGain,
    JointZeroOffset,
)
from galen_sim_driver.effects.load import LooseTool, ToolComError, ToolMassError
from galen_sim_driver.effects.registry import contract_parameters, effect_from, identities
from galen_sim_driver.effects.sensor import (
    AxisGain,
    BiasStep,
    Crosstalk,
    SensorDrift,
    SensorMountRotation,
    SensorNonlinearity,
    SensorSaturation,
    WrenchDelay,
)
from galen_sim_driver.replay import Replay, rates
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from sim_bench import typical

from galen_validation.pinocchio_arm import PinocchioArm

TOOL = TOOLS["retractor"]
IDENTITIES = identities(GALEN)
BIAS = (0.1, -0.05)
START_S = 30.0
JOINT_S = np.arange(0.0, 4.0, 0.004)
WRENCH_S = np.arange(0.3, 3.7, 0.01) + 0.0007
PUSH = np.array([3.0, -2.0, 5.0, 0.05, -0.02, 0.01])


def joints_at(at_s):
    """A motion of all joints in closed form, (n, 5)."""
    amplitude = np.array([0.05, 0.06, 0.04, 1.1, 0.7])
    turns = np.array([1.1, 0.9, 1.3, 0.8, 1.0])
    return GALEN.home + amplitude * np.sin(np.outer(at_s, turns) + np.arange(5))


def scene(bag="motion", **changes):
    ours = {
        "joints": joints_at(JOINT_S),
        "start_s": START_S,
        "touched": np.zeros(len(WRENCH_S), dtype=bool),
        "tracker_s": np.arange(0.5, 3.5, 1 / 60),
        "zero_pose_rad": BIAS,
    }
    return sim_bench.scene(WRENCH_S, joint_s=JOINT_S, bag=bag, **ours | changes)


def held(joints):
    """A scene that stands still under one push."""
    joints = np.tile(joints, (len(JOINT_S), 1))
    still = scene("push", joints=joints, touched=np.ones(len(WRENCH_S), dtype=bool))
    return replace(still, reading=Replay(still).reading() + PUSH)


STILL = np.array([0.03, -0.02, 0.45, 0.4, -0.5])
WHEN = scene().instants(WRENCH_S)
JOINTS = np.stack([np.interp(WRENCH_S, JOINT_S, q) for q in joints_at(JOINT_S).T], axis=1)
NOMINAL = nominal_reading(JOINTS[:, 3:], TOOL.load, ADAPTER, BIAS, arm=GALEN)


def sensor_by_pinocchio(joints, roll_axis=(0.0, 0.0, 0.0), tilt_axis=(0.0, 0.0, 0.0)):
    """R_base_sensor and its origin at joints (5,), axes turned in their parent links (rotvec)."""
    model = PinocchioArm().model.copy()
    of_roll, of_tilt = (
        pinocchio.SE3(Rotation.from_rotvec(turn).as_matrix(), np.zeros(3))
        for turn in (roll_axis, tilt_axis)
    )
    roll, tilt = model.getJointId("roll"), model.getJointId("tilt")
    frame = model.getFrameId(GALEN.sensor_frame)
    model.jointPlacements[roll] = model.jointPlacements[roll] * of_roll
    model.jointPlacements[tilt] = of_roll.inverse() * model.jointPlacements[tilt] * of_tilt
    model.frames[frame].placement = of_tilt.inverse() * model.frames[frame].placement
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.asarray(joints))
    return data.oMf[frame].rotation.copy(), data.oMf[frame].translation.copy()


def reading_of(joints, gravity=GRAVITY_M_S2, tool=lambda gravity: TOOL.load,
               true=lambda q: q, **axes):  # fmt: skip
    """The reading (6,) at reported joints (5,), zeroed at BIAS; `true` makes the true joints."""

    def seen(q):
        return sensor_by_pinocchio(true(np.asarray(q)), **axes)[0].T @ gravity

    now, zero = seen(joints), seen([*GALEN.home[:3], *BIAS])
    weight = gravity_wrench(now, tool(now)) + gravity_wrench(now, ADAPTER)
    return weight - gravity_wrench(zero, ADAPTER)


def inclined(joints):
    # Capitals: about axes that move along, so Rx(a) Ry(b).
    base = Rotation.from_euler("XY", [0.03, -0.02]).as_matrix()
    return reading_of(joints, base.T @ GRAVITY_M_S2)


def sagging(gravity):
    down = gravity / np.linalg.norm(gravity)
    return Load(TOOL.load.mass_kg, TOOL.load.com_m + 0.004 * np.array([down[0], down[1], 0.0]))


def other_tool(_gravity):
    return Load(TOOL.load.mass_kg + 0.01, TOOL.load.com_m + [0.002, -0.001, 0.003])


def angles(roll=0.0, tilt=0.0, gain=1.0, roll_gain=1.0):
    return {"true": lambda q: np.array([*q[:3], roll_gain * q[3] + roll, gain * q[4] + tilt])}


@pytest.mark.parametrize(
    ("effects", "arm"),
    [
        ((), {}),
        ((JointZeroOffset("roll", 0.02),), angles(roll=0.02)),
        ((JointZeroOffset("tilt", -0.03),), angles(tilt=-0.03)),
        ((JointGain("tilt", 0.05),), angles(gain=1.05)),
        ((JointGain("roll", 0.05),), angles(roll_gain=1.05)),
        # However they are given: the encoder's gain first, then its zero.
        ((JointZeroOffset("tilt", 0.02), JointGain("tilt", 0.05)), angles(tilt=0.02, gain=1.05)),
        (
            (JointEccentricity("roll", 0.02, 3.0, 0.7),),
            {"true": lambda q: q + [0.0, 0.0, 0.0, 0.02 * np.sin(3.0 * q[3] + 0.7), 0.0]},
        ),
        ((JointAxisMisalignment("tilt", "z", 0.06),), {"tilt_axis": (0.0, 0.0, 0.06)}),
        ((JointAxisMisalignment("tilt", "x", 0.06),), {"tilt_axis": (0.06, 0.0, 0.0)}),
        ((JointAxisMisalignment("roll", "y", 0.06),), {"roll_axis": (0.0, 0.06, 0.0)}),
        ((LooseTool(0.004),), {"tool": sagging}),
        ((ToolMassError(0.01), ToolComError((0.002, -0.001, 0.003))), {"tool": other_tool}),
        ((BaseInclination(0.03, -0.02),), inclined),
    ],
)
def test_what_changes_the_load_reads_as_pinocchios_arm_with_it(effects, arm):
    found = Replay(scene(), effects).reading()[::20]
    wanted = np.array([arm(q) if callable(arm) else reading_of(q, **arm) for q in JOINTS[::20]])
    assert np.abs(found - wanted).max() < 1e-12
    gone = np.abs(found - NOMINAL[::20]).max()
    assert gone > 0.002 if effects else gone < 1e-12


def saturated(wrench):
    wrench[:, 2] = np.minimum(np.maximum(wrench[:, 2], -0.9), 0.9)
    return wrench


def bent(wrench):
    wrench[:, 2] += 0.03 * wrench[:, 2] ** 2
    return wrench


def bent_with_its_load(wrench):
    load = wrench[:, 1] - 0.7
    wrench[:, 1] += 0.03 * (load**2 - 0.7**2)
    return wrench


def oddly_bent_with_its_load(wrench):
    load = wrench[:, 2] + 0.4
    wrench[:, 2] += 0.05 * (load * np.abs(load) - 0.4**2)
    return wrench


def oddly_bent(wrench):
    wrench[:, 0] -= 0.02 * wrench[:, 0] * np.abs(wrench[:, 0])
    return wrench


def mixed(wrench):
    wrench[:, 3] += 0.02 * wrench[:, 1]
    return wrench


RATE = (0.5, -1.0, 2.0, 0.01, 0.02, -0.03)
KNOTS = np.array([30.0, 31.0, 33.0])
LEVELS = np.array([np.zeros(6), np.arange(6.0), np.full(6, 2.0)])
TURN = (0.03, -0.05, 0.02)
STEP = (0.1, 0.0, -0.3, 0.0, 0.01, 0.0)
COLUMN = WRENCH_S[:, None]


def turned(wrench):
    back = Rotation.from_rotvec(TURN).inv()
    return np.hstack([back.apply(part) for part in np.hsplit(wrench, 2)])


def through_knots(wrench):
    second = LEVELS[1] + (COLUMN - 1.0) / 2.0 * (LEVELS[2] - LEVELS[1])
    late = np.where(COLUMN < 3.0, second, LEVELS[2])
    return wrench + np.where(COLUMN < 1.0, COLUMN * LEVELS[1], late)


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (AxisGain((0.01, 0.02, -0.03, 0.04, 0.05, -0.06)),
         lambda w: w * [1.01, 1.02, 0.97, 1.04, 1.05, 0.94]),
        (Crosstalk("fy", "tx", 0.02), mixed),
        (SensorNonlinearity("fz", 0.03), bent),
        (SensorNonlinearity("fx", -0.02, True), oddly_bent),
        (SensorNonlinearity("fy", 0.03, tare=-0.7), bent_with_its_load),
        (SensorNonlinearity("fz", 0.05, True, tare=0.4), oddly_bent_with_its_load),
        (SensorMountRotation(TURN), turned),
        (SensorDrift(RATE), lambda w: w + (COLUMN + START_S) / 3600.0 * RATE),
        (SensorDrift.through(KNOTS, LEVELS), through_knots),
        (BiasStep(2.0, STEP, "motion"), lambda w: w + (COLUMN >= 2.0) * STEP),
        (BiasStep(32.0, STEP), lambda w: w + (COLUMN >= 2.0) * STEP),
        (BiasStep(2.0, STEP, "sweep"), lambda w: w + STEP),
        (BiasStep(2.0, STEP, "push"), lambda w: w),
        (SensorSaturation(0.9, "fz"), saturated),
    ],
)  # fmt: skip
def test_the_sensors_errors_and_back(effect, expected):
    assert np.abs(NOMINAL[:, 2]).max() > 1.0  # so that the axis clips at all
    found = Replay(scene(), [effect]).reading()
    assert np.abs(found - expected(NOMINAL.copy())).max() < 1e-12
    if effect.name != "sensor_saturation":
        assert np.abs(effect.unread(WHEN, found) - NOMINAL).max() < 1e-12


def test_the_sensors_errors_come_one_after_the_other_and_a_push_is_found_behind_them():
    chain = [
        SensorSaturation(0.9, "fz"),
        BiasStep(1.0, STEP, "push"),
        SensorDrift(RATE),
        Crosstalk("fy", "tx", 0.02),
        AxisGain((0.1,) * 6),
        SensorMountRotation(TURN),
    ]
    pushed = scene("push", touched=WRENCH_S > 1.5)
    wrench = mixed(1.1 * turned(NOMINAL + np.outer(pushed.touched, PUSH)))
    wrench += (COLUMN + START_S) / 3600.0 * RATE + (COLUMN >= 1.0) * STEP
    found = Replay(pushed, chain).reading()
    assert np.abs(found - saturated(wrench.copy()))[~pushed.touched].max() < 1e-12
    applied = Replay(replace(pushed, reading=wrench), chain[1:]).applied_wrench()
    assert np.abs(applied - np.outer(pushed.touched, PUSH)).max() < 1e-12


def test_a_late_wrench_is_that_of_the_joints_before():
    found = Replay(scene(), [WrenchDelay(0.02)]).reading()
    sooner = joints_at(WRENCH_S - 0.02)
    expected = nominal_reading(sooner[:, 3:], TOOL.load, ADAPTER, BIAS, arm=GALEN)
    assert np.abs(found - expected).max() < 3e-5  # straight lines between samples of 4 ms
    assert np.abs(NOMINAL - expected).max() > 0.01


def test_joints_hold_over_what_was_not_recorded():
    kept = (JOINT_S < 1.0) | (JOINT_S > 3.0)
    joint_s, joints = JOINT_S[kept], joints_at(JOINT_S)[kept]
    ends = joint_s[np.searchsorted(joint_s, 2.0) - 1 :][:2]
    at_s = np.array([0.5, 1.2, 2.8, 3.5])
    late = replace(scene(), joint_s=joint_s, joints=joints, wrench_s=at_s + 0.1)
    found = Replay(late, [WrenchDelay(0.1)]).reading()
    then = joints_at(np.array([at_s[0], *ends, at_s[3]]))
    expected = nominal_reading(then[:, 3:], TOOL.load, ADAPTER, BIAS, arm=GALEN)
    assert np.abs(found - expected).max() < 3e-5


def test_the_tip_stands_where_the_arm_and_the_push_put_it():
    bent = GALEN.deflection(STILL, PUSH, TOOL.tip_m)
    assert np.linalg.norm(bent[:3]) > 1e-4
    nobody = np.zeros((len(WRENCH_S), 6))
    turned = JointAxisMisalignment("tilt", "z", 0.05), JointAxisMisalignment("roll", "y", 0.02)
    for effects, axes, offset_rad in (
        ((), {}, 0.0),
        (
            (*turned, JointZeroOffset("roll", 0.01)),
            {"roll_axis": (0.0, 0.02, 0.0), "tilt_axis": (0.0, 0.0, 0.05)},
            0.01,
        ),
    ):
        replay = Replay(held(STILL), effects)
        true = STILL + [0.0, 0.0, 0.0, offset_rad, 0.0]
        rotation, origin = sensor_by_pinocchio(true, **axes)
        bare_rotations, bare = replay.tip(nobody)
        assert np.abs(bare_rotations - rotation).max() < 1e-12
        assert np.abs(bare - origin - rotation @ TOOL.tip_m).max() < 1e-12
    rotations, positions = Replay(held(STILL)).tip()
    _, bare = Replay(held(STILL)).tip(nobody)
    rotation, _ = sensor_by_pinocchio(STILL)
    bend = Rotation.from_matrix(rotations @ rotation.T).as_rotvec()
    # Poses are rounded to 0.2 mm and mrad for the compliance.
    assert np.abs(positions - bare - bent[:3]).max() < 1e-3 * np.linalg.norm(bent[:3])
    assert np.abs(bend - bent[3:]).max() < 1e-3 * np.linalg.norm(bent[3:])


def test_the_motion_that_effects_feel_is_that_of_the_joints():
    at_s = JOINT_S[:500]
    velocity, acceleration = rates(at_s, joints_at(at_s))
    inner, step = slice(20, -20), 1e-4
    before, now, after = (joints_at(at_s + s) for s in (-step, 0.0, step))
    slope, bend = (after - before) / (2.0 * step), (after - 2.0 * now + before) / step**2
    # What cubic polynomials over 80 ms leave of sines of 1.3 rad/s.
    assert np.abs(velocity - slope)[inner].max() < 1e-5
    assert np.abs(acceleration - bend)[inner].max() < 2e-3
    assert np.abs(bend[inner]).max() > 0.5
    # Across a gap nothing is known; on either side of it all is.
    there = (at_s < 0.6) | (at_s > 1.4)
    found, _ = rates(at_s[there], joints_at(at_s)[there])
    assert np.abs(found - slope[there])[inner].max() < 1e-3
    # Noise, and both ends: as SciPy's filter takes them.
    joints = joints_at(at_s) + np.random.default_rng(3).normal(0.0, 1e-3, (len(at_s), 1))
    step = float(np.median(np.diff(at_s)))
    window = 2 * round(0.04 / step) + 1
    for order, own in enumerate(rates(at_s, joints), 1):
        expected = savgol_filter(joints, window, 3, deriv=order, delta=step, axis=0)
        assert np.abs(own - expected).max() < 1e-6 * np.abs(expected).max()


# --- the registry -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", IDENTITIES)
def test_an_effects_numbers_survive_a_file(name):
    default = IDENTITIES[name]
    effect = typical(default)
    assert default.changes_nothing
    assert not effect.changes_nothing
    others = {field: getattr(effect, field) for field in effect.beyond_contract}
    written = json.loads(json.dumps(contract_parameters(effect) | others))
    again = effect_from(effect.name, written, arm=GALEN)
    assert again == effect
    assert np.array_equal(again.vector(), effect.vector())


@pytest.mark.parametrize("name", IDENTITIES)
def test_by_default_an_effect_changes_nothing(name):
    nominal, found = Replay(held(STILL)), Replay(held(STILL), [IDENTITIES[name]])
    assert np.array_equal(found.reading(), nominal.reading())
    for a, b in zip(found.tip(), nominal.tip(), strict=True):
        assert np.array_equal(a, b)
    assert not found.base_marker().any()


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("friction", {}, "no effect 'friction'"),
        ("joint_gain", {"gian": 0.1}, "joint_gain: no parameter 'gian'; known: joint, gain"),
        ("joint_gain", {"gain": float("nan")}, "joint_gain.*'gain' is nan"),
        ("joint_gain", {"gain": [0.1]}, "joint_gain.*'gain'"),
        ("joint_gain", {"gain": 7.0}, "joint_gain.*-0.5 to 0.5"),
        ("joint_gain", {"joint": "knee"}, "joint_gain: joint is 'knee', not one of roll, tilt"),
        ("joint_axis_misalignment", {"about": "w"}, "about is 'w', not one of x, y, z"),
        ("joint_compliance", {"stiffness": {"knee": 1.0}}, "no parameter 'stiffness.knee'"),
        ("joint_compliance", {"stiffness": 1.0}, "no parameter 'stiffness'"),
        ("axis_gain", {"gain": [0.1] * 5}, "axis_gain: gain has 5 numbers.*6"),
        ("axis_gain", {"gain": [0.1] * 5 + [float("inf")]}, "axis_gain.*gain"),
        ("crosstalk", {"from": "fw", "to": "tx"}, "crosstalk: from is 'fw'"),
        ("crosstalk", {"from": "fx", "to": "fx"}, "crosstalk: from and to are both fx"),
        ("sensor_saturation", {"axis": "z"}, "sensor_saturation: axis is 'z'"),
        ("bias_step", {"bag": "../push"}, "bias_step: bag is '../push'"),
        ("sensor_drift", {"knots_s": [1.0, 1.0]}, "sensor_drift: knots_s"),
        ("sensor_drift", {"knots_s": [1.0, 2.0], "levels": [0.0] * 6}, "sensor_drift: levels"),
    ],
)
def test_bad_numbers_are_named(name, parameters, words):
    with pytest.raises(GalenError, match=words):
        effect_from(name, parameters, arm=GALEN)


@pytest.mark.parametrize(
    ("name", "parameters", "effect"),
    [
        ("roll_zero_offset", {"offset_rad": 0.01}, JointZeroOffset("roll", 0.01)),
        ("tilt_zero_offset", {"offset_rad": 0.01}, JointZeroOffset("tilt", 0.01)),
        ("tilt_gain", {"gain": 0.02}, JointGain("tilt", 0.02)),
        ("tilt_axis_misalignment", {"about_z_rad": 0.03}, JointAxisMisalignment("tilt", "z", 0.03)),
        ("base_inclination", {"about_z_rad": 0.02}, BaseInclination(about_z_rad=0.02)),
        (
            "joint_compliance",
            {"k_tilt": 900.0, "k_rod": 1e6},
            JointCompliance(k_tilt=900.0, k_rod=1e6),
        ),
    ],
)
def test_reads_the_names_from_before_effects_had_joints(name, parameters, effect):
    assert effect_from(name, parameters, arm=GALEN) == effect
