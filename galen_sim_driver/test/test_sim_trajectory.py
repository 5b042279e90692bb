# SPDX-License-Identifier: Apache-2.0
"""Trajectories: what is rejected, and the polynomials between points."""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_sim_driver.plant.config import PlantError
from galen_sim_driver.plant.motion import Reference, Trajectory, TrajectoryPoint, check_trajectory

NOW_NS = 5_000_000_000
NAN = float("nan")
POINT = TrajectoryPoint(1.0, [0.1, -0.2])


def check(names, *points, start_ns=0):
    check_trajectory(Trajectory(names, points, start_ns), GALEN, NOW_NS)


def test_good_trajectories_pass():
    check(["tilt", "roll"], POINT)
    check(
        list(GALEN.joint_names),
        TrajectoryPoint(0.0, GALEN.home),
        TrajectoryPoint(0.1, GALEN.home, [0.0] * 5),
    )
    check(["roll", "tilt"], POINT, start_ns=NOW_NS - 900_000_000)
    check(["roll", "tilt"], TrajectoryPoint(1.0, [1.57, -1.04], [0, 0], [0, 0]))


@pytest.mark.parametrize(
    ("names", "points", "words"),
    [
        (["roll", "wrist"], [POINT], ["wrist", "delta_x"]),
        (["roll", "roll"], [POINT], ["roll", "twice"]),
        ([], [TrajectoryPoint(1.0, [])], ["joint names"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [0.0, 0.97])], ["tilt", "0.97", "0.96"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [-1.58, 0.0])], ["roll", "-1.58", "-1.57"]),
        (["delta_z"], [TrajectoryPoint(1.0, [0.0])], ["delta_z", "0.198"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [0.1])], ["1 positions for 2 joints"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [])], ["0 positions for 2 joints"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [0, 0], [0])], ["1 velocities for 2"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [0, 0], [0, 0], [0])], ["1 accelerations"]),
        (["roll"], [TrajectoryPoint(1.0, [0], [], [0])], ["accelerations without velocities"]),
        (["roll", "tilt"], [TrajectoryPoint(1.0, [0.1, NAN])], ["tilt", "nan"]),
        (["roll"], [TrajectoryPoint(1.0, [0.1], [float("inf")])], ["velocities of roll", "inf"]),
        (["roll", "tilt"], [POINT, POINT], ["point 1", "not after"]),
        (["roll", "tilt"], [TrajectoryPoint(-0.5, [0, 0])], ["-0.5"]),
        (["roll", "tilt"], [TrajectoryPoint(NAN, [0, 0])], ["nan"]),
    ],
)
def test_bad_trajectories_are_rejected_with_joint_and_value(names, points, words):
    with pytest.raises(PlantError) as error:
        check(names, *points)
    for word in words:
        assert word in str(error.value)


def test_a_trajectory_of_the_past_is_rejected():
    with pytest.raises(PlantError, match=r"1\.000 s in the past"):
        check(["roll", "tilt"], POINT, start_ns=NOW_NS - 2_000_000_000)


START = TrajectoryPoint(
    0.0, GALEN.home + [0, 0, 0, 0.2, -0.1], [0, 0, 0, 0.3, -0.2], [0, 0, 0, 0.5, 1.0]
)


def sampled(names, points, start_ns=0):
    """Reference from START now: (times (n,), positions (n, 5)) on a fine grid to past its end."""
    reference = Reference(Trajectory(names, points, start_ns), GALEN, NOW_NS, START, GALEN.home)
    time_ns = np.arange(NOW_NS, reference.end_ns + 200_000_000, 1_000_000)
    return (time_ns - NOW_NS) * 1e-9, np.array([reference.sample(int(ns)) for ns in time_ns])


def test_positions_only_are_joined_by_lines():
    time_s, q = sampled(
        ["tilt", "roll"], [TrajectoryPoint(0.5, [0.3, 0.4]), TrajectoryPoint(1.0, [0.0, 1.0])]
    )
    # "tilt" comes first in this trajectory: joints are taken by name.
    expected_tilt = np.interp(time_s, [0.0, 0.5, 1.0], [-0.1, 0.3, 0.0])
    expected_roll = np.interp(time_s, [0.0, 0.5, 1.0], [0.2, 0.4, 1.0])
    assert np.allclose(q[:, 4], expected_tilt, atol=1e-12)
    assert np.allclose(q[:, 3], expected_roll, atol=1e-12)
    assert np.all(q[:, :3] == GALEN.home[:3])


def derivatives(time_s, values):
    step = time_s[1] - time_s[0]
    velocity = np.gradient(values, step, edge_order=2)
    return velocity, np.gradient(velocity, step, edge_order=2)


def test_velocities_make_it_cubic():
    time_s, q = sampled(["roll"], [TrajectoryPoint(0.8, [1.0], [0.6])])
    part = time_s <= 0.8
    velocity, _ = derivatives(time_s[part], q[part, 3])
    assert q[0, 3] == pytest.approx(0.2) and q[part][-1, 3] == pytest.approx(1.0)
    assert velocity[0] == pytest.approx(0.3, abs=1e-4)
    assert velocity[-1] == pytest.approx(0.6, abs=1e-4)
    # The fourth differences of a cubic vanish; those of a quintic don't.
    assert np.abs(np.diff(q[part, 3], 4)).max() < 1e-12


def test_accelerations_make_it_quintic():
    time_s, q = sampled(
        ["roll", "tilt"], [TrajectoryPoint(0.8, [1.0, 0.5], [0.6, 0.0], [-0.7, 0.0])]
    )
    part = time_s <= 0.8
    for joint, start, end in ((3, (0.3, 0.5), (0.6, -0.7)), (4, (-0.2, 1.0), (0.0, 0.0))):
        velocity, acceleration = derivatives(time_s[part], q[part, joint])
        assert (velocity[0], velocity[-1]) == pytest.approx((start[0], end[0]), abs=1e-3)
        # One-sided second differences of 1 ms are good to a few hundredths here.
        assert (acceleration[2], acceleration[-3]) == pytest.approx((start[1], end[1]), abs=0.3)
        # Its sixth differences vanish, over steps of 50 ms; one of seventh order would show 1e-8.
        assert np.abs(np.diff(q[part, joint][::50], 6)).max() < 1e-12
    assert q[-1, 3] == 1.0 and q[-1, 4] == 0.5


def test_a_start_in_the_future_shifts_the_points():
    time_s, q = sampled(["roll"], [TrajectoryPoint(0.5, [0.4])], NOW_NS + 500_000_000)
    assert np.allclose(q[:, 3], np.interp(time_s, [0.0, 1.0], [0.2, 0.4]), atol=1e-12)


def test_a_start_in_the_past_joins_in_the_middle():
    points = [TrajectoryPoint(0.5, [0.4]), TrajectoryPoint(1.5, [0.6])]
    time_s, q = sampled(["roll"], points, NOW_NS - 1_000_000_000)
    assert np.allclose(q[:, 3], np.interp(time_s, [-0.5, 0.5], [0.4, 0.6]), atol=1e-12)


@pytest.mark.parametrize("kind", ["velocities", "accelerations"])
def test_rates_that_would_overflow_are_rejected(kind):
    """The sum of 1e308 and 1e308 in a polynomial is infinite, and then the arm's place NaN."""
    rates = {"velocities": [0.0], "accelerations": [0.0], kind: [1e308]}
    with pytest.raises(PlantError, match=f"{kind} of roll hold 1e\\+308"):
        check(["roll"], TrajectoryPoint(1.0, [0.2], **rates))
    # the largest that are taken keep the reference finite, however short the piece
    rates = {"velocities": [1e6], "accelerations": [1e6]}
    for time_s in (1e-9, 1.0, 2.0**31):
        points = [TrajectoryPoint(time_s, [0.2], **rates)]
        check(["roll"], *points)
        reference = Reference(Trajectory(["roll"], points), GALEN, NOW_NS, START, GALEN.home)
        for part in (0.0, 0.3, 0.9):
            assert np.all(np.isfinite(reference.sample(NOW_NS + round(part * time_s * 1e9))))
