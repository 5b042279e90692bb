# SPDX-License-Identifier: Apache-2.0
"""The plant: its reading, noise, encoders, commands and determinism."""

import numpy as np
import pytest
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR
from galen_model.load.model import ADAPTER, TOOLS, Load, ToolGeometry, nominal_reading
from galen_model.registration import move_wrench
from galen_sim_driver.effects.effect import ConfigError
from galen_sim_driver.plant.config import HandPush, PlantError, acceleration_limits
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from sim_bench import EXACT, TURNED, make_plant, run, to_rest

SIGMA = np.sqrt(SENSOR.noise_std**2 + SENSOR.quantum**2 / 12)


def go_to(plant, joints, steps=1500):
    plant.command(to_rest(joints, 2.0))
    return run(plant, steps)


# --- the reading ------------------------------------------------------------------------------


@pytest.mark.parametrize("tool", ["", "pointer", "retractor"])
def test_the_reading_is_the_nominal_model_exactly(tool):
    rng = np.random.default_rng(7)
    load = TOOLS[tool].load if tool else Load(0.0)
    for roll, tilt in rng.uniform([-1.57, -1.04], [1.57, 0.96], (20, 2)):
        plant = make_plant(tool, **EXACT, start_joints=(0.0, 0.0, 0.4, roll, tilt))
        expected = nominal_reading(np.stack([roll, tilt], axis=-1), load, ADAPTER, arm=GALEN)
        assert np.abs(plant.step().wrench - expected).max() < 1e-12


def test_the_reading_holds_the_hands_push_in_both_frames():
    force, torque = (3.0, -2.0, 1.5), (0.02, -0.01, 0.03)
    for frame in ("base", "tip"):
        push = HandPush(0.0, 1.0, force, torque, frame, ramp_s=0.1)
        plant = make_plant("retractor", **EXACT, start_joints=TURNED, hand=[push])
        untouched = np.array(plant.step().wrench)
        plant.start_hand()
        wrench = np.array(run(plant, 250)[-1].wrench)
        rotation, _ = GALEN.sensor_pose(TURNED)
        at_tip = np.array([*force, *torque])
        if frame == "base":
            at_tip = move_wrench(at_tip, rotation.T, np.zeros(3))
        expected = move_wrench(at_tip, np.eye(3), TOOLS["retractor"].tip_m)
        assert np.abs(wrench - untouched - expected).max() < 1e-12
        # And it lets go again.
        after = np.array(run(plant, 300)[-1].wrench)
        assert np.abs(after - untouched).max() < 1e-12
        assert not plant.hand_active


def test_a_single_push_rises_holds_and_falls_in_its_own_times():
    plant = make_plant("pointer", **EXACT)
    weight = plant.step().wrench[0]
    plant.push(HandPush(0.0, 1.0, (0.0, 0.0, 6.0), ramp_s=0.2, fall_s=0.4))
    # At home base_link's z is the sensor's -x.
    force = weight - np.array([sample.wrench[0] for sample in run(plant, 600)])
    assert force[49] == pytest.approx(3.0, abs=0.1)  # half way up at 0.1 s
    assert force[100:299] == pytest.approx(6.0)
    assert force[399] == pytest.approx(3.0, abs=0.1)  # half way down at 0.8 s
    assert force[501:] == pytest.approx(0.0, abs=1e-12)
    assert not plant.hand_active
    # The script is what it was.
    plant.start_hand()
    assert plant.hand_active


def test_a_single_push_waits_for_no_other_and_must_make_sense():
    plant = make_plant()
    for push, words in (
        (HandPush(0.0, 1.0, (float("nan"), 0.0, 0.0)), "nan"),
        (HandPush(0.0, float("inf"), (1.0, 0.0, 0.0)), "inf"),
        (HandPush(0.0, 1.0, (1.0, 0.0, 0.0), ramp_s=0.2, fall_s=0.9), "rise and fall"),
        (HandPush(0.0, 1.0, (1.0, 0.0, 0.0), fall_s=-0.1), "rise and fall"),
    ):
        with pytest.raises(ConfigError, match=words):
            plant.push(push)
        assert not plant.hand_active
    plant.push(HandPush(0.0, 0.1, (1.0, 0.0, 0.0), ramp_s=0.05))
    with pytest.raises(PlantError):
        plant.push(HandPush(0.0, 0.1, (1.0, 0.0, 0.0), ramp_s=0.05))


def test_noise_has_the_configured_size_quantum_included():
    plant = make_plant(seed=5)
    count = 6000
    readings = np.array([sample.wrench for sample in run(plant, count)])
    # Five standard deviations of a standard deviation and of a mean of this many samples.
    assert np.all(np.abs(readings.std(axis=0) / SIGMA - 1) < 5 / np.sqrt(2 * count))
    expected = nominal_reading((0.0, 0.0), Load(0.0), ADAPTER, arm=GALEN)
    assert np.all(np.abs(readings.mean(axis=0) - expected) < 5 * SIGMA / np.sqrt(count))
    # White: neighbouring samples have nothing to do with each other.
    centred = readings - readings.mean(axis=0)
    correlation = (centred[1:] * centred[:-1]).mean(axis=0) / readings.var(axis=0)
    assert np.all(np.abs(correlation) < 5 / np.sqrt(count))


def test_the_sensor_clips_at_its_range_before_the_zero():
    heavy = ToolGeometry(Load(20.0, np.array([0.2, 0.0, 0.0])), np.zeros(3))
    plant = make_plant("heavy", **EXACT, tools={"heavy": heavy})
    # At home gravity is along the sensor's x: 20.1 kg pull with 197 N, beyond 125 N.
    zero = ADAPTER.mass_kg * 9.80665
    assert plant.step().wrench[0] == pytest.approx(125.0 - zero, abs=1e-12)


# --- zeroing ------------------------------------------------------------------------------


def test_zeroing_subtracts_the_mean_of_the_window():
    plant = make_plant("pointer", 2, start_joints=TURNED)
    assert np.abs(run(plant, 10)[-1].wrench[0]) > 0.1
    zeroing = plant.start_zeroing(0.5)
    during = np.array([sample.wrench for sample in run(plant, 250)])
    assert zeroing.done and zeroing.error is None
    after = np.array([sample.wrench for sample in run(plant, 1000)])
    # What the mean of the window was is subtracted from then on.
    deviation = np.abs(after.mean(axis=0))
    assert np.all(deviation < 5 * SIGMA * np.sqrt(1 / 250 + 1 / 1000))
    expected = nominal_reading((0.8, -0.6), TOOLS["pointer"].load, ADAPTER, arm=GALEN)
    assert np.all(np.abs(during.mean(axis=0) - expected) < 5 * SIGMA / np.sqrt(250))
    assert plant.zero_angles == [0.8, -0.6]


def test_zeroing_without_noise_is_the_contracts_bias():
    plant = make_plant(**EXACT, start_joints=TURNED)
    plant.step()
    plant.start_zeroing(0.1)
    run(plant, 50)
    plant.attach_tool("retractor")
    samples = go_to(plant, (0.0, 0.0, 0.408, -0.5, 0.4))
    expected = nominal_reading(
        (-0.5, 0.4), TOOLS["retractor"].load, ADAPTER, (0.8, -0.6), arm=GALEN
    )
    assert np.abs(samples[-1].wrench - expected).max() < 1e-12


def test_zeroing_is_rejected_or_spoilt_by_motion():
    plant = make_plant()
    plant.command(Trajectory(["roll"], [TrajectoryPoint(1.0, [0.5])]))
    with pytest.raises(PlantError, match="moving"):
        plant.start_zeroing(0.5)
    plant = make_plant()
    zero_angles = plant.zero_angles
    zeroing = plant.start_zeroing(0.5)
    with pytest.raises(PlantError, match="already"):
        plant.start_zeroing(0.5)
    go_to(plant, TURNED, steps=400)
    assert zeroing.done and "moved" in str(zeroing.error)
    assert plant.zero_angles == zero_angles
    plant = make_plant()
    zeroing = plant.start_zeroing(0.5)
    plant.step()
    plant.attach_tool("pointer")
    assert "tool" in str(zeroing.error)
    plant.step()
    plant.start_zeroing(0.5)
    plant = make_plant()
    plant.set_admittance(True)
    with pytest.raises(PlantError, match="admittance"):
        plant.start_zeroing(0.5)


# --- motion ------------------------------------------------------------------------------


def test_a_stop_brakes_at_the_limit_and_stays():
    plant = make_plant()
    go_to(plant, (0.1, 0.0, 0.408, 1.5, 0.0), steps=500)
    before = plant.step()
    assert before.true_velocities[3] > 1.0
    plant.command(Trajectory([], []))
    samples = run(plant, 500)
    velocities = np.array([s.true_velocities for s in [before, *samples]])
    steps = np.diff(velocities, axis=0)
    assert np.all(np.abs(steps) <= np.array(acceleration_limits(GALEN)) * 0.002 * (1 + 1e-6))
    assert np.all(steps <= 1e-12)
    assert not plant.moving
    # v^2 / 2 a, to a period's way.
    way = samples[-1].true_joints[3] - before.true_joints[3]
    speed = before.true_velocities[3]
    assert way == pytest.approx(speed**2 / 12.0, abs=speed * 0.002)


def test_a_new_trajectory_takes_over_smoothly_and_unnamed_joints_stop():
    plant = make_plant()
    samples = go_to(plant, (0.1, 0.0, 0.408, 1.2, -0.5), steps=500)
    velocity_before = samples[-1].true_velocities
    plant.command(Trajectory(["tilt"], [TrajectoryPoint(1.0, [0.3], [0.0], [0.0])]))
    later = run(plant, 1000)
    tilt_velocities = [velocity_before[4]] + [s.true_velocities[4] for s in later]
    assert np.abs(np.diff(tilt_velocities)).max() < 6.0 * 0.002 * (1 + 1e-6)
    assert later[0].true_velocities[4] == pytest.approx(velocity_before[4], abs=6.0 * 0.002)
    assert later[-1].true_joints[4] == 0.3
    assert later[-1].true_velocities == [0.0] * 5
    assert samples[-1].true_joints[3] < later[-1].true_joints[3] < 1.2


def test_a_bad_trajectory_changes_nothing():
    plant, other = make_plant(seed=1), make_plant(seed=1)
    go_to(plant, TURNED, steps=100), go_to(other, TURNED, steps=100)
    with pytest.raises(PlantError, match="tilt at 2"):
        plant.command(Trajectory(["tilt"], [TrajectoryPoint(1.0, [2.0])]))
    assert run(plant, 200) == run(other, 200)


# --- what is reported ------------------------------------------------------------------------


def test_stamps_and_encoders():
    plant = make_plant()
    samples = go_to(plant, TURNED, steps=1200)
    stamps = np.array([sample.stamp_ns for sample in samples])
    assert np.all(np.diff(stamps) == 2_000_000)
    true = np.array([sample.true_joints for sample in samples])
    reported = np.array([sample.positions for sample in samples])
    assert np.all(np.abs(reported - true) <= ENCODER_QUANTUM / 2 * (1 + 1e-6))
    assert np.abs(reported - true).max() > 0.0
    counts = reported / ENCODER_QUANTUM
    assert np.abs(counts - np.round(counts)).max() < 1e-6
    velocities = np.array([sample.velocities for sample in samples])
    # A difference over 10 periods: the mean velocity over these, to one quantum over the window.
    mean_velocity = (true[10:] - true[:-10]) / 0.02
    assert np.all(np.abs(velocities[10:] - mean_velocity) <= ENCODER_QUANTUM / 0.02 * (1 + 1e-6))
    assert velocities[-1].tolist() == [0.0] * 5


def test_the_seed_decides_everything():
    def samples(seed):
        plant = make_plant("pointer", seed)
        plant.start_hand()
        return go_to(plant, TURNED, steps=300)

    first, again, other = samples(4), samples(4), samples(5)
    assert first == again
    assert first[0].wrench != other[0].wrench


def test_the_trackers_rate_does_not_change_the_sensors_noise():
    slow, fast = (run(make_plant(tracker_rate_hz=rate_hz), 500) for rate_hz in (60.0, 300.0))
    assert [s.wrench for s in slow] == [s.wrench for s in fast]
    assert sum(s.tracker is not None for s in slow) == 60
    assert sum(s.tracker is not None for s in fast) == 300


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate_hz": 0.0}, "rate is 0.0"),
        ({"start_joints": (0.0, 0.0, 0.4, 0.0, 1.2)}, "tilt starts at 1.2"),
        ({"tracker_rate_hz": 600.0}, "tracker rate is 600.0"),
        ({"adapter": Load(-0.1)}, "adapter is -0.1"),
        ({"hand": [HandPush(0.0, 0.1, ramp_s=0.2)]}, "rise and fall"),
        ({"hand": [HandPush(0.0, 1.0, frame="world")]}, "world"),
    ],
)
def test_bad_configurations_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        make_plant(**changes)


# --- admittance ------------------------------------------------------------------------------


def pushed_tip_path(push, start=TURNED, seconds=1.0):
    """Tip positions (n, 3) and the plant, while the hand pushes a weightless tool."""
    light = ToolGeometry(Load(0.0), TOOLS["pointer"].tip_m)
    changes = {"start_joints": start, "tools": {"light": light}, "hand": [push]}
    plant = make_plant("light", **EXACT, adapter=Load(0.0), **changes)
    plant.set_admittance(True)
    plant.start_hand()
    path = []
    for _ in range(round(seconds * 500)):
        sample = plant.step()
        plant.admittance.feed(sample.stamp_ns, sample.wrench)
        path.append(GALEN.tip_pose(sample.true_joints, light.tip_m)[1])
    return np.array(path), plant


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_push_moves_the_tip_the_same_way(axis, sign):
    force = [0.0, 0.0, 0.0]
    force[axis] = 5.0 * sign
    path, _ = pushed_tip_path(HandPush(0.0, 2.0, tuple(force)))
    velocity = (path[-1] - path[-51]) / (50 * 0.002)
    # gain 0.01 m/s/N, but for the damping's small part.
    assert velocity[axis] == pytest.approx(0.05 * sign, rel=0.01)
    assert np.abs(np.delete(velocity, axis)).max() < 0.001


def test_a_torque_about_the_roll_axis_rolls_and_leaves_the_tip():
    push = HandPush(0.0, 2.0, torque_nm=(0.4, 0.0, 0.0))
    path, plant = pushed_tip_path(push, start=(0.0, 0.0, 0.408, 0.0, 0.0))
    assert plant.step().true_velocities[3] == pytest.approx(0.2, rel=0.02)
    assert np.abs(path[-1] - path[0]).max() < 0.001


def test_without_or_with_a_stale_wrench_nothing_moves():
    plant = make_plant("retractor", **EXACT)
    plant.set_admittance(True)
    assert run(plant, 100)[-1].true_joints == GALEN.home.tolist()
    # One wrench: it counts for 50 ms, then the arm stops.
    at_tip = [5.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    plant.admittance.feed(plant.now_ns, move_wrench(at_tip, np.eye(3), TOOLS["retractor"].tip_m))
    samples = run(plant, 500)
    assert any(samples[20].true_velocities)
    assert samples[-1].true_velocities == [0.0] * 5
    # The offset gained speed for 50 ms at half the joint's 1 m/s^2, towards 0.05 m/s, and lost it
    # as fast: 2 * a t^2 / 2. At home the sensor's x points down.
    way = samples[-1].true_joints[2] - GALEN.home[2]
    assert way == pytest.approx(-0.5 * 0.05**2, rel=0.05)
    # What isn't finite, or comes from the future, moves nothing.
    still = samples[-1].true_joints
    for stamp_ns, value in ((plant.now_ns, float("nan")), (plant.now_ns + 10**9, 5.0)):
        plant.admittance.feed(stamp_ns, [value] * 6)
        assert run(plant, 50)[-1].true_joints == still


def test_admittance_keeps_the_joints_limits():
    path, plant = pushed_tip_path(HandPush(0.0, 30.0, (120.0, 0.0, 0.0)), seconds=2.0)
    sample = plant.step()
    assert sample.true_joints[0] == pytest.approx(0.14, abs=1e-12)
    velocities = np.diff(path, axis=0) / 0.002
    assert np.abs(velocities).max() < 0.5


def test_trajectories_turn_the_arm_in_admittance_mode_and_its_end_stops_it():
    push = HandPush(0.0, 1.0, (5.0, 0.0, 0.0))
    start = (0.0, 0.0, 0.408, 0.0, 0.0)
    _, plant = pushed_tip_path(push, start=start, seconds=1.5)
    drifted = plant.step().true_joints
    assert drifted[0] > 0.03
    plant.command(Trajectory(["roll"], [TrajectoryPoint(1.0, [0.7], [0.0], [0.0])]))
    turned = run(plant, 600)[-1].true_joints
    assert turned[3] == pytest.approx(0.7 + drifted[3], abs=1e-9)
    assert turned[0] == pytest.approx(drifted[0], abs=1e-9)
    plant.set_admittance(False)
    assert run(plant, 100)[-1].true_joints == pytest.approx(turned)
    # From then on targets are absolute again.
    assert go_to(plant, start)[-1].true_joints == list(start)


def noisy_turn(seed, admittance):
    """Roll and tilt (n, 2) on a fast turn, with or without following the sensor's noise."""
    plant = make_plant("retractor", seed, start_joints=(0.0, 0.0, 0.408, 0.8, -0.6))
    plant.set_admittance(admittance)
    plant.command(to_rest([0.0, 0.0, 0.408, 0.0, 0.6], 2.0))
    way = []
    for _ in range(1000):
        sample = plant.step()
        way.append(sample.true_joints[3:])
        expected = nominal_reading(way[-1], TOOLS["retractor"].load, ADAPTER, arm=GALEN)
        plant.admittance.feed(sample.stamp_ns, list(np.array(sample.wrench) - expected))
    return np.array(way)


def test_noise_in_admittance_mode_does_not_make_a_joint_lose_its_moving_reference():
    """Its steps, on top of a fast reference, once were more than the joints could follow."""
    assert np.abs(noisy_turn(0, True) - noisy_turn(0, False)).max() < 0.005
