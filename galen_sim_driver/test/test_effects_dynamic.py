# SPDX-License-Identifier: Apache-2.0
"""Effects of cable, motion, stiffness, hysteresis, play and tracker against other formulas."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import sim_bench
from galen_model.arm.galen import GALEN
from galen_model.load.model import ADAPTER, TOOLS
from galen_model.rotation import matrix_to_rotvec, rotvec_to_matrix
from galen_sim_driver.effects.effect import ConfigError, Instants, Loading, Posture
from galen_sim_driver.effects.hysteresis import (
    DeflectionCreep,
    DeflectionHysteresis,
    turning_points,
)
from galen_sim_driver.effects.joints import Backlash, JointCompliance
from galen_sim_driver.effects.load import CableDrag
from galen_sim_driver.effects.sensor import BaseShift, SensorHysteresis, TrackerDelay, TrackerScale
from galen_sim_driver.replay import Replay

POINTER = TOOLS["pointer"]
TURNED = np.array([0.03, -0.05, 0.45, 0.8, -0.6])


def scene(at_s, joints, applied=0.0):
    """A bag that reads what the nominal arm would, with `applied` (n, 6) in ft_sensor pushed."""
    given = sim_bench.scene(at_s, np.broadcast_to(joints, (len(at_s), 5)), tool="pointer")
    return replace(given, reading=Replay(given).reading() + applied)


def instants(count, bag="push"):
    at_s = 0.01 * np.arange(count)
    return Instants(bag, at_s, at_s)


def pushes(turns, samples=60):
    """Loads (n,) that go straight from turn to turn."""
    legs = [np.linspace(a, b, samples, endpoint=False) for a, b in pairwise(turns)]
    return np.concatenate([*legs, [turns[-1]]])


def loading(joints, load, direction=(0.0, 1.0, 0.0, 0.0, 0.0, 0.0)):
    """`load` (n,) times a wrench at the tip in base_link."""
    wrench = np.outer(load, direction)
    compliance = GALEN.tip_compliance(joints, POINTER.tip_m)
    return Loading(
        np.broadcast_to(joints, (len(load), 5)), wrench, wrench @ compliance.T, POINTER.tip_m, GALEN
    )


def sample(given, k):
    """The loading of one instant."""
    rows = {name: getattr(given, name)[[k]] for name in ("joints", "wrench", "elastic")}
    return replace(given, **rows)


# --- cable --------------------------------------------------------------------------------------


def posture(joints):
    """The pointer at rest at joints (n, 5)."""
    pose = GALEN.sensor_pose(joints)
    return Posture(joints, *pose, None, None, POINTER.load, ADAPTER, POINTER.tip_m, GALEN)


def test_a_cable_pulls_along_its_line_without_a_moment_about_its_anchor():
    drag = CableDrag(0.3, bending_nm=0.02)
    rng = np.random.default_rng(1)
    joints = GALEN.home + rng.uniform(-1.0, 1.0, (30, 5)) * [0.14, 0.14, 0.2, 1.5, 0.9]
    rotation, origin = GALEN.sensor_pose(joints)

    def pull(effect):
        return effect.wrench(instants(30), posture(joints))

    # In base_link, about the anchor.
    force = np.einsum("nij,nj->ni", rotation, pull(drag)[:, :3])
    torque = np.einsum("nij,nj->ni", rotation, pull(drag)[:, 3:])
    assert np.abs(torque - np.cross(np.array(drag.anchor_m) - origin, force)).max() < 1e-12
    straight = np.einsum("nij,nj->ni", rotation, pull(replace(drag, bending_nm=0.0))[:, :3])
    line = np.array(drag.anchor_m) - origin - rotation @ np.array(drag.attachment_m)
    length = np.linalg.norm(line, axis=1)
    tension = np.linalg.norm(straight, axis=1)
    assert np.abs(straight - tension[:, None] * line / length[:, None]).max() < 1e-12
    # A spring of 0.3 N times 3 a metre where it is taut, to the rounded corner's 0.2 %.
    reference = np.linalg.norm(np.subtract(drag.anchor_m, drag.reference_m))
    taut = 0.3 * (1.0 + 3.0 * (length - reference))
    assert np.ptp(taut) > 0.2
    assert np.abs(tension - taut)[taut > 0.35].max() < 0.01 * 0.3
    assert (tension[taut < 0.0] < 0.06).all()
    assert (np.diff(tension[np.argsort(length)]) > 0.0).all()
    # Bending: none at home, and a force of B |n x l| / d across the line.
    home_rotation, home_origin = GALEN.sensor_pose(GALEN.home)
    at_home = home_rotation.T @ (np.array(drag.anchor_m) - home_origin) - drag.attachment_m
    here = np.einsum("nji,nj->ni", rotation, line) / length[:, None]
    turned = np.linalg.norm(np.cross(at_home / np.linalg.norm(at_home), here), axis=1)
    across = np.linalg.norm(force - straight, axis=1)
    assert across == pytest.approx(0.02 * turned / length, rel=1e-9)
    # Twice the cable pulls twice, and a cable without tension and bending not at all.
    assert pull(replace(drag, tension_n=0.6, bending_nm=0.04)) == pytest.approx(2.0 * pull(drag))
    assert np.abs(pull(replace(drag, tension_n=0.0, bending_nm=0.0))).max() == 0.0
    # Smooth where it goes slack: the change over a small step is the mean of both slopes there.
    slack = replace(drag, stretch_per_m=40.0)
    vector = slack.vector()
    for number in range(1, len(vector)):
        step = np.zeros(len(vector))
        step[number] = 1e-5
        forward = pull(slack.with_vector(vector + step)) - pull(slack)
        backward = pull(slack) - pull(slack.with_vector(vector - step))
        assert np.abs(forward - backward).max() < 0.01 * np.abs(forward).max() + 1e-9


def test_the_tension_is_the_mean_one_where_the_reference_is_centred():
    rng = np.random.default_rng(3)
    joints = GALEN.home + rng.uniform(-1.0, 1.0, (400, 5)) * [0.05, 0.05, 0.05, 1.2, 0.8]
    rotation, origin = GALEN.sensor_pose(joints)
    drag = CableDrag(0.2).centred(rotation, origin)
    tension = drag.tension(rotation, origin)
    assert np.ptp(tension) > 0.05
    assert tension.mean() == pytest.approx(0.2, rel=0.04)
    force = drag.wrench(instants(400), posture(joints))[:, :3]
    assert tension == pytest.approx(np.linalg.norm(force, axis=1), rel=1e-9)


# --- stiffness ----------------------------------------------------------------------------------


def test_other_stiffnesses_bend_as_the_stiffness_model_says_and_linearly_in_softness():
    rng = np.random.default_rng(5)
    wrench = rng.uniform(-1.0, 1.0, (8, 6)) * [8.0, 8.0, 8.0, 0.3, 0.3, 0.3]
    softer = JointCompliance(k_roll=1200.0, k_carriage=2e5, k_rod=3e6)
    pushed = scene(0.1 * np.arange(8), TURNED, wrench)

    def bent(effects):
        rotation, position = Replay(pushed, effects).tip(wrench)
        base_rotation, base = GALEN.tip_pose(TURNED, POINTER.tip_m)
        return np.hstack([position - base, matrix_to_rotvec(rotation @ base_rotation.T)])

    arm = GALEN.with_stiffness({"roll": 1200.0, "carriage": 2e5, "rod": 3e6})
    # Replay rounds the pose to 0.2 mm for its compliance.
    expected = np.array([arm.deflection(TURNED, row, POINTER.tip_m) for row in wrench])
    assert np.abs(bent([softer]) - expected).max() < 1e-3 * np.abs(expected).max()
    nominal = bent([])
    assert np.abs(nominal - expected).max() > 0.05 * np.abs(expected).max()
    # Half the softness is half the change, far from small changes.
    vector = np.array([1.5, 0.8, 0.7, 0.9])
    whole = bent([JointCompliance().with_vector(vector)]) - nominal
    half = bent([JointCompliance().with_vector(0.5 * vector)]) - nominal
    assert np.abs(2.0 * half - whole).max() < 1e-6 * np.abs(whole).max()
    assert JointCompliance().with_vector(np.array([1.0, 0.0, 0.0, 0.0])) == JointCompliance(1000.0)


# --- hysteresis ---------------------------------------------------------------------------------


def test_turning_points_are_where_a_load_turned_and_not_where_noise_did():
    path = pushes([0.0, 3.0, -2.0, 2.5, 0.0], samples=200)
    exact = turning_points(path, 0.05)
    assert exact.tolist() == [0, 200, 400, 600]
    noisy = turning_points(path + np.random.default_rng(2).normal(0.0, 0.05, len(path)), 0.6)
    assert len(noisy) == 4
    assert np.abs(noisy - exact).max() < 12


@pytest.mark.parametrize("form", ["tip", "joints"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_fraction_is_left_after_the_largest_push_on_its_side(form, side):
    effect = DeflectionHysteresis(0.08, side, form)
    given = loading(TURNED, pushes([0.0, 10.0, 0.0]))
    found = effect.fresh().deflect(instants(len(given.wrench)), given)
    peak, left = given.elastic[60], found[-1]
    # In "joints" each joint has its fraction, over its deflection with the friction (which with
    # side -1 is added); none here is a joint that shares with others.
    peak = peak + (side if form == "joints" else 1.0) * found[60]
    largest = np.argmax(np.abs(peak[:3]))
    assert left[largest] / peak[largest] == pytest.approx(
        side * 0.08, rel=1e-6 if form == "tip" else 0.01
    )


def test_the_tips_state_solves_its_equation():
    knee, fraction = 0.3, 0.1
    load = pushes([0.0, 8.0, -10.0, 5.0, -2.0, 0.0], samples=4000)
    given = loading(GALEN.home, load)
    effect = DeflectionHysteresis(fraction, 1.0, "tip", knee)
    found = effect.fresh().deflect(instants(len(load)), given)[:, 1]
    e = given.elastic[:, 1]
    peak = np.abs(e).max()
    z = np.zeros(len(e))
    for k, step in enumerate(np.diff(e) / peak):
        middle = z[k] + 0.5 * (step - abs(step) * z[k]) / knee
        z[k + 1] = z[k] + (step - abs(step) * middle) / knee
    a = 1.0 - np.exp(-1.0 / knee)
    c = fraction / (a**2 + fraction * a)
    assert np.abs(found + c * peak * z).max() < 1e-5 * peak


@pytest.mark.parametrize("form", ["tip", "joints"])
def test_one_sample_at_a_time_is_a_whole_bag_where_the_largest_loads_are_the_drivers(form):
    load = np.concatenate([pushes([0.0, 9.0, -6.0, 0.0], samples=40), np.zeros(5)])
    given = loading(TURNED, load, (0.2, 1.0, -0.4, 0.0, 0.0, 0.0))
    effect = DeflectionHysteresis(0.06, 1.0, form).fresh()
    one = [effect.deflect(instants(1), sample(given, k))[0] for k in range(len(load))]
    # The first sample is no load, so the driver's own largest loads are taken for the bag as well.
    whole = DeflectionHysteresis(0.06, 1.0, form).fresh()
    whole.deflect(instants(1), sample(given, 0))
    found = whole.deflect(instants(len(load)), given)
    assert np.abs(found - one).max() < 1e-9 * np.abs(found).max() + 1e-15
    assert np.abs(found[-1]).max() > 1e-6


def test_noise_doesnt_wear_the_tips_state_off():
    rng = np.random.default_rng(7)
    load = np.concatenate([pushes([0.0, 10.0, 0.0]), np.zeros(2000)])
    effect = DeflectionHysteresis(0.08)
    clean = effect.fresh().deflect(instants(len(load)), loading(GALEN.home, load))[-1, 1]
    noisy_load = loading(GALEN.home, load + rng.normal(0.0, 0.02, len(load)))
    noisy = effect.fresh().deflect(instants(len(load)), noisy_load)[-100:, 1].mean()
    assert noisy == pytest.approx(clean, rel=0.03)


def test_a_held_deflection_creeps_on_exponentially_and_back():
    at_s = np.cumsum(np.random.default_rng(2).uniform(0.005, 0.05, 800))
    at_s = np.concatenate([[0.0, 1e-9], at_s + 1e-9])
    load = np.where((at_s > 0.0) & (at_s < 8.0), 10.0, 0.0)
    given = loading(GALEN.home, load)
    effect, when = DeflectionCreep(0.2, 2.5), Instants("push", at_s, at_s)
    found = effect.fresh().deflect(when, given)
    held, last = load > 0.0, int(np.flatnonzero(load)[-1])
    expected = 0.2 * given.elastic * (1.0 - np.exp(-at_s / 2.5))[:, None]
    assert found[held] == pytest.approx(expected[held], abs=1e-9)
    # Straight to no load in one step, from which on it comes back as it went.
    back = found[last + 1] * np.exp(-(at_s[last + 1 :, None] - at_s[last + 1]) / 2.5)
    assert found[last + 1 :] == pytest.approx(back, abs=1e-12)
    assert np.abs(found[last] - found[last + 1]).max() < 0.02 * np.abs(found[last]).max()
    live = effect.fresh()
    again = [
        live.deflect(Instants("push", at_s[[k]], at_s[[k]]), sample(given, k))[0]
        for k in range(len(at_s))
    ]
    assert np.array(again) == pytest.approx(found, abs=1e-15)


# --- hysteresis of the sensor -------------------------------------------------------------------


def along_fz(load):
    return np.outer(load, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sensor_keeps_a_fraction_of_the_largest_load_on_either_side(side):
    load = pushes([0.0, 10.0, 0.0, -10.0, 0.0, 10.0])
    effect, when = SensorHysteresis(0.05, side, knee=0.4), instants(len(load))
    read = effect.read(when, along_fz(load))
    # The state's differential equation in small steps.
    fine = np.interp(np.arange(0.0, len(load) - 1.0, 1e-3), np.arange(len(load)), load)
    state, states = 0.0, [0.0]
    for step in np.diff(fine) / 4.0:
        state += step - 0.5 * (abs(step) * state + step * abs(state))
        states.append(state)
    states = np.append(states[::1000], state)
    size = -side * 0.5 / states[120]
    assert load - read[:, 2] == pytest.approx(size * states, abs=2e-4)
    assert read[[120, 240], 2] == pytest.approx([side * 0.5, -side * 0.5], abs=1e-2)
    assert np.abs(read[:, [0, 1, 3, 4, 5]]).max() == 0.0
    assert effect.unread(when, read) == pytest.approx(along_fz(load), abs=1e-3)
    # One at a time is the same: the largest load is what a driver takes it for.
    live = effect.fresh()
    again = [live.read(instants(1), row[None])[0] for row in along_fz(load)]
    assert np.array(again) == pytest.approx(read, abs=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sharp_lag_is_a_load_less_its_play(side):
    load = pushes([0.0, 10.0, 0.0, -10.0, 4.0, 10.0])
    effect, when = SensorHysteresis(0.05, side, knee=0.4, sharp=True), instants(len(load))
    read = effect.read(when, along_fz(load))
    # A play operator holds what comes within its width, 4 N.
    held, state = np.empty_like(load), 0.0
    for k, value in enumerate(load):
        state = min(max(state, value - 4.0), value + 4.0)
        held[k] = state
    assert load - read[:, 2] == pytest.approx(side * 0.05 * 10.0 / 4.0 * (load - held), abs=1e-12)
    assert read[[120, 240], 2] == pytest.approx([side * 0.5, 4.0 - side * 0.5])
    assert effect.unread(when, read) == pytest.approx(along_fz(load), abs=1e-3)


def test_what_loads_have_left_in_a_sensor_outlasts_a_pause_or_does_not():
    load = np.concatenate([pushes([0.0, 10.0, 0.0]), np.zeros(5)])
    at_s = 0.01 * np.arange(len(load)) + 5.0 * (np.arange(len(load)) > 120)
    when = Instants("push", at_s, at_s)
    for restarts, left in ((True, 0.0), (False, 0.5)):
        read = SensorHysteresis(0.05, restarts=restarts).read(when, along_fz(load))
        assert read[120, 2] == pytest.approx(0.5)
        assert read[121:, 2] == pytest.approx(left, abs=1e-12)


def test_a_push_leaves_something_in_the_readings_after_it():
    load = along_fz(pushes([0.0, 10.0, 0.0, 0.0]))
    effect = SensorHysteresis(0.05)
    given = scene(0.01 * np.arange(len(load)), GALEN.home, load)
    still = Replay(given).reading()
    given = replace(given, reading=still + effect.read(instants(len(load)), load),
                    touched=np.arange(len(load)) <= 120)  # fmt: skip
    pushed = Replay(given, [effect])
    assert pushed.applied_wrench() == pytest.approx(load, abs=1e-3)
    after = ~given.touched
    assert (pushed.reading() - still)[after, 2] == pytest.approx(0.5, abs=1e-3)


def test_a_sensor_whose_reading_would_stand_still_is_refused():
    with pytest.raises(
        ConfigError, match=r"fraction is 0.2, but with side 1 and knee 0.1 it stays below 0.1"
    ):
        SensorHysteresis(0.2, knee=0.1).validate()
    with pytest.raises(ConfigError, match=r"knee is 0.6, but at most 0.5 where it is sharp"):
        SensorHysteresis(0.02, knee=0.6, sharp=True).validate()


# --- play ---------------------------------------------------------------------------------------


def test_a_joint_with_play_lags_by_half_its_gap_after_each_reversal():
    gap = 0.004
    joints = np.tile(GALEN.home, (4001, 1))
    joints[:, 4] = pushes([0.0, 0.3, -0.2, 0.1, 0.0], samples=1000)
    effect = Backlash("tilt", gap)
    true = effect.fresh().true_joints(instants(4001), joints)
    lag = joints[:, 4] - true[:, 4]
    assert np.abs(true[:, :4] - joints[:, :4]).max() == 0.0
    # In the middle at first; then half a gap behind, in the direction of the motion.
    assert lag[0] == 0.0
    for leg, sign in enumerate((1.0, -1.0, 1.0, -1.0)):
        assert lag[1000 * leg + 100 : 1000 * leg + 1000] == pytest.approx(0.5 * gap * sign)
    # Or where it starts, which ends with the first motion.
    below = replace(effect, start=-1.0).fresh().true_joints(instants(4001), joints)[:, 4]
    assert joints[:900, 4] - below[:900] == pytest.approx(0.5 * gap)
    assert below[100:] == pytest.approx(true[100:, 4], abs=1e-15)
    # It stays while the joint goes through the gap.
    step = 0.3 / 1000.0
    assert np.ptp(true[1000 : 1000 + int(gap / (0.5 / 1000.0)), 4]) < step
    # One at a time is the same.
    one = effect.fresh()
    again = [one.true_joints(instants(1), row[None])[0, 4] for row in joints]
    assert again == pytest.approx(true[:, 4], abs=1e-15)


def crossed(effect, given):
    """What the pushes move the tip by through the joint's gap, from a fresh start."""
    return effect.fresh().deflect(instants(len(given.wrench)), given)


@pytest.mark.parametrize("joint", GALEN.joint_names)
def test_a_push_takes_a_joint_to_the_side_it_pushes_to_and_leaves_it_there(joint):
    gap = 0.002
    index = GALEN.joint_names.index(joint)
    column = GALEN.tip_jacobian(TURNED, POINTER.tip_m)[:, index]
    # Along the joint's own motion of the tip; then back, then to rest.
    direction = np.concatenate([column[:3], np.zeros(3)]) / np.linalg.norm(column[:3])
    load = pushes([0.0, 0.0, 5.0, 0.0, -5.0, 0.0])
    given = loading(TURNED, load, direction)
    moved = crossed(Backlash(joint, gap), given)
    for at, side in ((30, 0.0), (120, 1.0), (180, 1.0), (240, -1.0), (300, -1.0)):
        assert moved[at] == pytest.approx(side * 0.5 * gap * column, abs=1e-12)
    # What noise makes of no load takes it nowhere.
    noisy = load + 0.1 * np.random.default_rng(1).uniform(-1.0, 1.0, len(load))
    shaken = crossed(Backlash(joint, gap), loading(TURNED, noisy, direction))
    assert shaken[[30, 180, 300]] == pytest.approx(moved[[30, 180, 300]], abs=1e-12)
    below = crossed(Backlash(joint, gap, -1.0), given)
    assert below[120] == pytest.approx(gap * column, abs=1e-12)
    # After a motion upwards it rests below: the same push now takes it through the whole gap.
    before = TURNED.copy()
    before[index] -= 0.05
    joints = np.concatenate([np.tile(before, (5, 1)), given.joints[5:]])
    moved_before = replace(given, joints=joints)
    moved = crossed(Backlash(joint, gap), moved_before)
    assert moved[120] == pytest.approx(gap * column, abs=1e-12)
    assert moved[240] == pytest.approx(np.zeros(6), abs=1e-12)
    # A centred one rests in the middle, wherever it came from.
    moved = crossed(Backlash(joint, gap, crossing="centred"), moved_before)
    assert moved[[120, 240]] == pytest.approx(np.outer([0.5, -0.5], gap * column), abs=1e-12)
    # A soft one comes back, and gives way by no more than the gap.
    moved = crossed(Backlash(joint, gap, crossing="soft"), given)
    assert moved[180] == pytest.approx(np.zeros(6), abs=1e-12)
    assert np.abs(moved[[120, 240]]) == pytest.approx(np.abs(moved[[240, 120]]), abs=1e-12)
    assert np.all(np.abs(moved) <= 0.5 * gap * np.abs(column) + 1e-12)
    assert np.abs(moved[120]).max() > 0.4 * gap * np.abs(column).max()
    for wrong in ({"joint": "elbow"}, {"joint": joint, "crossing": "elbow"}):
        with pytest.raises(ConfigError, match="elbow"):
            Backlash(**wrong).validate()


# --- tracker ------------------------------------------------------------------------------------


def test_a_late_tracker_sees_what_was_and_a_long_one_sees_it_farther():
    at_s = 0.01 * np.arange(300)
    joints = np.tile(GALEN.home, (300, 1))
    joints[:, 0] = 0.05 * at_s
    moving = replace(scene(at_s, GALEN.home), joints=joints)
    nominal = Replay(moving).tip(np.zeros((300, 6)))[1]
    late = Replay(moving, [TrackerDelay(0.04)]).tip(np.zeros((300, 6)))[1]
    assert nominal[50:] - late[50:] == pytest.approx(np.tile([0.002, 0.0, 0.0], (250, 1)), abs=1e-9)
    there = rotvec_to_matrix([0.1, 2.9, 0.3]), np.array([0.15, -0.35, 1.8])
    rotation, _ = GALEN.tip_pose(joints, POINTER.tip_m)
    plain = Replay(moving).seen_by_tracker(rotation, nominal, *there)
    longer = Replay(moving, [TrackerScale(0.01)]).seen_by_tracker(rotation, nominal, *there)
    assert longer[1] == pytest.approx(1.01 * plain[1])
    assert (longer[0] == plain[0]).all()


def test_the_bases_marker_moves_once_and_only_in_the_pushes():
    effect = BaseShift((0.001, -0.002, 0.0), (0.0, 0.003, 0.0), 0.5)
    moved = effect.base_marker(instants(100))
    assert (moved[:50] == 0.0).all()
    assert (moved[50:] == [0.001, -0.002, 0.0, 0.0, 0.003, 0.0]).all()
    assert effect.base_marker(instants(100, "sweep")) is None
    still = scene(0.01 * np.arange(100), GALEN.home)
    assert (Replay(still, [effect]).base_marker() == moved).all()


def test_a_fraction_that_a_law_cant_leave_is_rejected():
    DeflectionHysteresis(residual_fraction=0.4, side=1.0, knee=2.0).validate()
    DeflectionHysteresis(residual_fraction=0.38, side=-1.0, knee=2.0).validate()
    with pytest.raises(ConfigError, match=r"stays below 0\.393"):
        DeflectionHysteresis(residual_fraction=0.4, side=-1.0, knee=2.0).validate()
