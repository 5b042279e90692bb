# SPDX-License-Identifier: Apache-2.0
"""Limits hold at every step, references are followed, targets are reached exactly."""

import numpy as np
from galen_common.goal.parameters import MotionParameters
from galen_model.arm.galen import GALEN
from galen_sim_driver.plant import config
from galen_sim_driver.plant.motion import (
    LimitedMotion,
    Reference,
    Trajectory,
    TrajectoryPoint,
    stopping_distance,
)

PERIOD_S = 0.002
VELOCITY = np.array(config.velocity_limits(GALEN))
ACCELERATION = np.array(config.acceleration_limits(GALEN))


def follow(targets, motion=None):
    """Step through targets (n, 5); return positions and velocities (n + 1, 5), start included."""
    motion = motion or LimitedMotion(GALEN, GALEN.home, PERIOD_S)
    positions, velocities = [motion.positions.copy()], [motion.velocities.copy()]
    for target in targets:
        motion.step(target)
        positions.append(motion.positions.copy())
        velocities.append(motion.velocities.copy())
    return np.array(positions), np.array(velocities)


def assert_limits(positions, velocities):
    assert np.all(np.abs(velocities) <= VELOCITY * (1 + 1e-6))
    assert np.all(np.abs(np.diff(velocities, axis=0)) <= ACCELERATION * PERIOD_S * (1 + 1e-6))
    assert np.allclose(np.diff(positions, axis=0), velocities[1:] * PERIOD_S, atol=1e-12)
    assert np.all(positions >= GALEN.lower) and np.all(positions <= GALEN.upper)


def test_a_jump_is_reached_exactly_in_the_least_time_without_overshoot():
    target = GALEN.home + [0.05, -0.10, 0.08, 1.2, -0.7]
    positions, velocities = follow([target] * 1500)
    assert_limits(positions, velocities)
    assert positions[-1].tolist() == target.tolist()
    assert not velocities[-1].any()
    sign = np.sign(target - GALEN.home)
    assert np.all(np.diff(positions, axis=0) * sign >= 0.0)
    assert np.all((target - positions) * sign >= 0.0)
    # Bang-bang: distance / v + v / a, or 2 sqrt(distance / a) where v_max is not reached; in
    # sampled time a velocity holds for its whole period, which gains one of them.
    distance = np.abs(target - GALEN.home)
    full = distance > VELOCITY**2 / ACCELERATION
    least_s = np.where(
        full, distance / VELOCITY + VELOCITY / ACCELERATION, 2 * np.sqrt(distance / ACCELERATION)
    )
    arrived_s = np.argmax(positions == target, axis=0) * PERIOD_S
    assert np.all(arrived_s >= least_s - 1.001 * PERIOD_S)
    assert np.all(arrived_s <= least_s + 3 * PERIOD_S)


def test_a_reference_within_the_limits_is_followed_without_lag():
    s = np.arange(1, 1001)[:, None] / 1000
    quintic = 10 * s**3 - 15 * s**4 + 6 * s**5
    # Peak velocity 1.875 d / T and peak acceleration 5.774 d / T^2 stay below the limits.
    targets = GALEN.home + quintic * np.array([0.1, -0.1, 0.1, 1.4, -0.9])
    positions, velocities = follow(targets)
    assert np.abs(positions[1:] - targets).max() == 0.0
    assert_limits(positions, velocities)


def test_any_reference_keeps_the_limits():
    rng = np.random.default_rng(3)
    # Random jumps far beyond the limits, every few steps.
    targets = np.repeat(
        GALEN.home + rng.normal(0.0, [0.2, 0.2, 0.2, 2.0, 2.0], (300, 5)), 17, axis=0
    )
    positions, velocities = follow(targets)
    assert_limits(positions, velocities)
    assert positions.max(axis=0)[3] > 1.0  # it did go somewhere


def test_stopping_distance_agrees_with_braking():
    motion = LimitedMotion(GALEN, GALEN.home, PERIOD_S)
    follow([GALEN.home + 0.1] * 100, motion)
    stop = np.array(motion.stopping_positions([0.0] * 5))
    before = np.array(motion.velocities)
    positions, velocities = follow([stop] * 400, motion)
    assert_limits(positions, velocities)
    assert positions[-1].tolist() == stop.tolist()
    # It brakes at the limit from the first step, and never turns back.
    assert np.allclose(velocities[1], before - ACCELERATION * PERIOD_S, atol=1e-12)
    assert np.all(velocities >= 0.0)
    assert np.all(np.abs(stop - positions[0] - before**2 / 2 / ACCELERATION) < before * PERIOD_S)
    assert stopping_distance(-0.1, 0.002, 0.002) == -stopping_distance(0.1, 0.002, 0.002) < 0.0


def test_a_point_where_it_comes_to_rest_stops_the_arm_without_a_jump_or_a_way_back():
    motion = LimitedMotion(GALEN, GALEN.home, PERIOD_S)
    speed = np.array([0.05, -0.05, 0.02, 0.8, -0.6])
    follow([GALEN.home + speed * PERIOD_S * k for k in range(1, 300)], motion)
    rest, duration_s = MotionParameters().braking(
        np.array(motion.positions), np.array(motion.velocities)
    )
    point = TrajectoryPoint(duration_s, rest.tolist(), [0.0] * 5, [0.0] * 5)
    now = TrajectoryPoint(0.0, motion.positions, motion.velocities, motion.accelerations)
    trajectory = Trajectory(GALEN.joint_names, [point])
    reference = Reference(trajectory, GALEN, 0, now, motion.positions)
    steps = range(1, int(duration_s / PERIOD_S) + 100)
    targets = [reference.sample(int(k * PERIOD_S * 1e9)) for k in steps]
    positions, velocities = follow(targets, motion)
    assert_limits(positions, velocities)
    assert np.all(np.sign(speed) * velocities >= -1e-9)
    np.testing.assert_allclose(positions[-1], rest, atol=1e-9)
    np.testing.assert_allclose(velocities[-1], 0.0, atol=1e-9)
