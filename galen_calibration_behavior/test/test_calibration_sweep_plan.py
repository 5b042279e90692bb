"""Poses of a sweep: grid, listed and chosen ones, their order and times, boxes, the command."""

import dataclasses
import json

import numpy as np
import pytest
from calibration_fake_arm import FakeArm
from galen_calibration_behavior.calibrate_from_bag import main
from galen_calibration_behavior.commands import CalibrationCode
from galen_calibration_behavior.parameters import CalibrationParameters
from galen_model.arm.clearance import ArmClearance, ObstacleError, boxes_from_numbers
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError, NotExcitedError
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import ADAPTER, gravity_wrench
from galen_model.poses.plan import (
    SweepGrid,
    drift_share,
    make_router,
    order_poses,
    quintic_duration_s,
)
from galen_ros.parameters import ParameterError
from test_calibration_procedure import World

GRID = CalibrationParameters()
CHOSEN = dataclasses.replace(GRID, poses="chosen")
TIP = np.array([0.15, 0.0, 0.05])
SIDE = (0.5, 0.07, 0.2, 0.9, 0.5, 0.44)


@pytest.fixture(scope="module")
def plan():
    return CHOSEN.plan(TIP)


def drifted_mass(poses, times):
    """Error of mass, kg, where the reading drifts by 0.1 N over the sweep, without noise."""
    at = times.at_s(poses)
    drift = (at / at[-1])[:, None] * np.array([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3])
    gravity = GALEN.gravity_in_sensor(poses)
    moments, _ = plain_least_squares(gravity, gravity_wrench(gravity, ADAPTER) + drift)
    return abs(moments[0] - ADAPTER.mass_kg)


def test_the_order_is_short_and_a_drift_does_not_look_like_load(plan):
    times, shuffled = CHOSEN.times(), np.random.default_rng(1).permutation(plan.poses)
    ordered = order_poses(shuffled, times)
    assert {tuple(pose) for pose in ordered} == {tuple(pose) for pose in plan.poses}
    assert times.sweep_s(ordered) < 0.8 * times.sweep_s(shuffled)
    grid = GRID.grid_poses(7, 8)
    assert times.sweep_s(ordered) < 0.75 * GRID.times().sweep_s(grid)
    # R^2 against a regression by another way
    at = times.at_s(ordered)
    columns = np.column_stack([GALEN.gravity_in_sensor(ordered), np.ones(len(at))])
    left = np.linalg.lstsq(columns, at, rcond=None)[1][0] / np.sum((at - at.mean()) ** 2)
    assert drift_share(ordered, at) == pytest.approx(1.0 - left, abs=1e-4)
    assert drift_share(ordered, at) < 0.03
    assert drift_share(grid, GRID.times().at_s(grid)) > 0.9
    by_roll = ordered[np.argsort(ordered[:, 0])]
    assert drifted_mass(ordered, times) < 0.2 * drifted_mass(by_roll, times)


@pytest.mark.slow
def test_chosen_poses_stay_in_range_and_away_from_boxes(plan):
    assert len(plan.poses) == 18
    assert plan.router is None
    boxed = dataclasses.replace(CHOSEN, obstacles=SIDE).plan(TIP)
    arm = ArmClearance(boxes_from_numbers(SIDE), CHOSEN.obstacle_clearance_m, TIP)
    for roll, tilt in boxed.poses:
        assert -1.5 <= roll <= 1.5
        assert -1.0 <= tilt <= 0.9
        assert arm.nearest([0.0, 0.0, 0.408, roll, tilt])[0] >= 0.03
    assert min(arm.nearest([0, 0, 0.408, *pose])[0] for pose in plan.poses) < 0.01


def test_what_is_in_the_way_is_named():
    with pytest.raises(
        ObstacleError, match=r"pose 0 of the grid \(roll -1.500, tilt -1.000 rad\).* box 1"
    ):
        dataclasses.replace(GRID, obstacles=SIDE).plan(TIP)
    walls = (*SIDE, 0.5, -0.5, 0.3, 0.9, -0.075, 0.6, 0.6, -0.4, 0.0, 1.2, 0.4, 0.31)
    with pytest.raises(ObstacleError, match=r"of 187 candidates \d+ .* by box \d"):
        dataclasses.replace(CHOSEN, obstacles=walls, chosen_poses=40).plan(TIP)
    for name, value in (("poses", "some"), ("obstacles", (1.0, 2.0))):
        with pytest.raises((ParameterError, ObstacleError), match=name):
            dataclasses.replace(GRID, **{name: value}).validate()


@pytest.mark.slow
def test_the_procedure_goes_around_boxes():
    box = (0.5, 0.05, 0.2, 0.9, 0.5, 0.44)
    parameters = dataclasses.replace(GRID, obstacles=box, obstacle_clearance_m=0.02)
    router = make_router(parameters.range, parameters.surroundings, TIP)
    arm = ArmClearance(boxes_from_numbers(box), 0.02, TIP)
    poses = np.array([[0.0, -0.6], [1.5, -0.6], [0.0, -0.81], [-0.5, 0.3]])
    assert "box 1" in arm.path_fault([0, 0, 0.408, *poses[0]], [0, 0, 0.408, *poses[1]])
    world = World(poses=poses, router=router, one_sweep=True)
    nearest = np.inf
    step = world.arm.step

    def watched():
        nonlocal nearest
        if world.arm.moving and round(world.arm.stamp_ns / 1e7) % 3 == 0:
            nearest = min(nearest, arm.nearest(world.arm.joints)[0])
        return step()

    world.arm.step = watched
    world.run(until=lambda w: w.estimate is not None)
    assert 0.02 <= nearest < 0.05
    lost = World(poses=poses, router=router, arm=FakeArm(start=[0.0, 0.1, 0.408, 0.9, 0.0])).run()
    assert lost.end.error_code == CalibrationCode.BAD_INPUT
    assert "no way to roll 0.000, tilt 0.000" in lost.end.error_msg
    assert "box 1" in lost.end.error_msg


def test_the_command_proposes_and_rejects(capsys):
    assert main(["--propose-poses", "--json", "-p", "chosen_poses:=12"]) == 0
    found = json.loads(capsys.readouterr().out)
    chosen, grid = found["promises"]["chosen"], found["promises"]["grid"]
    assert len(found["poses"]) == chosen["poses"] == 12 and grid["poses"] == 56
    assert chosen["sweep_s"] < 0.7 * grid["sweep_s"]
    assert chosen["force_std_n"] < 1.3 * grid["force_std_n"]
    assert main(["--propose-poses"]) == 0
    assert "error of compensation" in capsys.readouterr().out
    box = ["--propose-poses", "-p", "obstacles:=[0.5, -0.1, 0.4, 0.9, 0.1, 0.6]"]
    assert main([*box, "--tip", "0.1", "0", "0"]) == 1
    assert "home can't be taken" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(box)
    assert ended.value.code == 2


# --- grid

LOWER, UPPER = (-1.57, -1.04), (1.57, 0.96)


def grid(tstart=-1.0, tend=0.9, tilts=7, rstart=-1.5, rend=1.5, rolls=8):
    return SweepGrid(tstart, tend, tilts, rstart, rend, rolls).poses(LOWER, UPPER)


def test_the_report_s_grid_has_56_different_poses_ends_included():
    found = grid()
    assert found.shape == (56, 2)
    assert len({tuple(row) for row in found.round(12)}) == 56
    assert np.allclose(np.unique(found[:, 0].round(12)), np.linspace(-1.5, 1.5, 8))
    assert np.allclose(np.unique(found[:, 1].round(12)), np.linspace(-1.0, 0.9, 7))


@pytest.mark.parametrize(("tilts", "rolls"), [(7, 8), (3, 12), (12, 3), (1, 5), (5, 1), (1, 1)])
def test_each_move_is_one_step_of_one_joint(tilts, rolls):
    found = grid(tilts=tilts, rolls=rolls)
    moves = np.abs(np.diff(found, axis=0))
    assert len(found) == tilts * rolls
    assert np.all(np.sum(moves > 1e-12, axis=1) == 1)
    assert np.all(moves[:, 0] <= 3.0 / max(rolls - 1, 1) + 1e-12)
    assert np.all(moves[:, 1] <= 1.9 / max(tilts - 1, 1) + 1e-12)


def test_the_serpentine_takes_the_order_with_less_travel():
    for found in (grid(), grid(tilts=3, rolls=12), grid(tilts=12, rolls=3)):
        rolls, tilts = np.unique(found[:, 0]), np.unique(found[:, 1])
        travel = np.abs(np.diff(found, axis=0)).sum()
        roll_inside = np.ptp(tilts) + len(tilts) * np.ptp(rolls)
        tilt_inside = np.ptp(rolls) + len(rolls) * np.ptp(tilts)
        assert travel == pytest.approx(min(roll_inside, tilt_inside))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tstart": -1.2}, ["tilt", "tstart", "-1.2", "-1.04"]),
        ({"tend": 1.0}, ["tilt", "tend", "0.96"]),
        ({"rstart": -2.0}, ["roll", "rstart", "-2"]),
        ({"rend": float("nan")}, ["roll", "rend", "nan"]),
        ({"tilts": 0}, ["itersT", "0", "tilt"]),
        ({"rolls": -3}, ["itersR", "-3", "roll"]),
        ({"rstart": 0.5, "rend": 0.5}, ["roll", "0.5", "same"]),
    ],
)
def test_an_impossible_grid_names_joint_and_value(change, words):
    with pytest.raises(GalenError) as error:
        grid(**change)
    assert all(word in str(error.value) for word in words), str(error.value)


# --- listed poses

POSES = [[-1.2, 0.5], [0.0, -0.9], [1.1, 0.4], [0.6, -0.3], [-0.7, 0.1], [0.3, 0.8], [0.0, -0.9]]


def listed(poses, **more):
    numbers = tuple(float(value) for value in np.ravel(poses))
    return CalibrationParameters(poses="listed", listed_poses_rad=numbers, **more)


def test_listed_poses_are_visited_as_they_are_in_their_order():
    parameters = listed(POSES)
    parameters.validate()
    assert parameters.plan(TIP).poses.tolist() == POSES
    # each averaged as a grid's pose is, not for as long as a chosen one
    assert parameters.of_sweep().average_s == parameters.average_s
    assert parameters.times().stay_s == CalibrationParameters().times().stay_s


def test_what_can_not_be_visited_is_rejected_by_its_number():
    for numbers in ((), (0.1, 0.2, 0.3), tuple([0.1, 0.2] * 1001)):
        with pytest.raises(ParameterError, match=f"listed_poses_rad' has {len(numbers)} numbers"):
            CalibrationParameters(poses="listed", listed_poses_rad=numbers).validate()
    with pytest.raises(GalenError, match=r"pose 2 of listed_poses_rad .roll 0.000, tilt 1.200 rad"):
        listed([[0.0, 0.0], [0.1, 0.0], [0.0, 1.2]]).validate()
    with pytest.raises(NotExcitedError):
        listed([[0.1 * k, 0.0] for k in range(8)]).plan(TIP)
    box = (0.5, 0.07, 0.2, 0.9, 0.5, 0.44)
    with pytest.raises(ObstacleError, match=r"pose \d of listed_poses_rad .* leave it out"):
        listed(POSES, obstacles=box).plan(TIP)


# --- times

TIME = np.linspace(0.0, 1.0, 20001)


def peaks(distance, duration):
    """Peak velocity and acceleration of the quintic, by differences."""
    path = distance * (10 * TIME**3 - 15 * TIME**4 + 6 * TIME**5)
    velocity = np.gradient(path, TIME * duration)
    return np.max(np.abs(velocity)), np.max(np.abs(np.gradient(velocity, TIME * duration)))


@pytest.mark.parametrize("distance", [0.001, 0.3, -2.0])
def test_one_limit_is_met_and_none_is_broken(distance):
    duration = quintic_duration_s([distance], [0.8], [3.0])
    velocity, acceleration = peaks(distance, duration)
    assert velocity <= 0.8 * 1.001
    assert acceleration <= 3.0 * 1.001
    assert velocity >= 0.8 * 0.999 or acceleration >= 3.0 * 0.995 or duration == 0.05
