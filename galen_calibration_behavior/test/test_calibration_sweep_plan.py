# SPDX-License-Identifier: Apache-2.0
"""Poses of a sweep: grid, listed and chosen ones, their order and times, boxes, the command."""

import dataclasses
import json
import re

import numpy as np
import pytest
from calibration_fake_arm import FakeArm
from galen_calibration_behavior.calibrate_from_bag import main
from galen_calibration_behavior.common.commands import CalibrationCode
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_common.parameters import ParameterError
from galen_model.arm.clearance import ArmClearance, ObstacleError, boxes_from_numbers
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError, NotExcitedError
from galen_model.estimation.curves import BiasShape, Shape
from galen_model.estimation.problem import Problem
from galen_model.load.choice import choose_calibration
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.model import ADAPTER, TOOLS, gravity_regressor, gravity_wrench
from galen_model.load.pose_order import drift_price, drift_warning
from galen_model.load.readings import StillPoses
from galen_model.poses.design import reading_noise
from galen_model.poses.plan import make_router, order_poses, quintic_duration_s, sweep_grid
from test_calibration_procedure import World

GRID = CalibrationParameters()
CHOSEN = dataclasses.replace(GRID, poses="chosen")
TIP = np.array([0.15, 0.0, 0.05])
RETRACTOR = TOOLS["retractor"].load
LINE, WALK = (BiasShape(Shape.LINEAR),) * 6, (BiasShape(Shape.WALK, 3.0),) * 6
SIDE = (0.5, 0.07, 0.2, 0.9, 0.5, 0.44)


@pytest.fixture(scope="module")
def plan():
    return CHOSEN.plan(TIP)


def grid_at(count):
    """Gravity and times of a grid's poses in the order of a plan and as a serpentine."""
    times, serpentine = GRID.times(), GRID.grid_poses(count - 1, count)
    orders = order_poses(serpentine, times, arm=GALEN), serpentine
    return [(GALEN.gravity_in_sensor(poses), times.at_s(poses)) for poses in orders]


def test_the_grid_is_visited_in_an_order_in_which_a_drift_costs_little():
    times, serpentine = GRID.times(), GRID.grid_poses(7, 8)
    poses = GRID.plan(TIP).poses
    assert {tuple(pose) for pose in poses} == {tuple(pose) for pose in serpentine}
    assert times.sweep_s(poses) < 1.1 * times.sweep_s(serpentine)
    gravity, at = GALEN.gravity_in_sensor(poses), times.at_s(poses)
    assert drift_price(gravity, at, LINE) < 1.02
    (_, _), before = grid_at(8)
    assert drift_price(*before, LINE) > 2.0
    for walk in (WALK, (BiasShape(Shape.WALK, 13.0),) * 6):
        assert drift_price(gravity, at, walk) < 0.5 * drift_price(*before, walk)


def test_a_drift_s_price_is_that_of_the_fit(plan):
    """As least squares with the walk's covariance written out, and as a fit's own growth."""
    times = CHOSEN.times()
    gravity, at = GALEN.gravity_in_sensor(plan.poses), times.at_s(plan.poses)
    assert drift_price(gravity, at, (BiasShape(),) * 6) == pytest.approx(1.0)
    since = at - at[0]
    variance = np.eye(18) + 9.0 * np.minimum.outer(since, since) / since[-1]
    rows, growth = np.swapaxes(gravity_regressor(gravity), 0, 1), []
    for weight in (np.linalg.inv(variance), np.eye(18)):
        whole = np.sum(weight)
        free = weight - np.outer(weight.sum(axis=0), weight.sum(axis=0)) / whole
        information = np.einsum("kip,ij,kjq->pq", rows, free, rows)
        growth.append(np.sqrt(np.diag(np.linalg.inv(information))))
    # the fit's prior for the first reading is flat, and so is a constant's
    assert drift_price(gravity, at, WALK) == pytest.approx(np.max(growth[0] / growth[1]), rel=0.02)
    readings = gravity_wrench(gravity, ADAPTER) + 1e-3 * np.random.default_rng(0).normal(
        size=(18, 6)
    )
    sweeps = Problem(gravity_regressor(gravity), readings, at, np.zeros(18, dtype=int))
    fitted = sweeps.under(WALK).fit(np.ones(18, dtype=bool))
    assert drift_price(gravity, at, WALK) == pytest.approx(fitted.growth.max(), rel=0.2)


def test_a_chosen_order_is_short_and_tells_a_drift_from_load(plan):
    times, shuffled = CHOSEN.times(), np.random.default_rng(1).permutation(plan.poses)
    ordered = order_poses(shuffled, times, arm=GALEN)
    assert {tuple(pose) for pose in ordered} == {tuple(pose) for pose in plan.poses}
    assert times.sweep_s(ordered) < 0.75 * times.sweep_s(shuffled)
    assert times.sweep_s(ordered) < 0.75 * GRID.times().sweep_s(GRID.grid_poses(7, 8))
    for poses in (ordered, plan.poses):
        assert drift_price(GALEN.gravity_in_sensor(poses), times.at_s(poses), LINE) < 1.02


def cost_of_drift(poses, identify, runs):
    """Errors of two sweeps under 0.1 N/h, over those of the same noise without drift."""
    times, rng = GRID.times(), np.random.default_rng(4)
    at, gravity = times.at_s(poses), GALEN.gravity_in_sensor(poses)
    time = np.concatenate([at, at + times.sweep_s(poses) + 10.0]).reshape(2, -1)
    zero = GALEN.gravity_in_sensor(GRID.home_angles)
    bare = gravity_wrench(gravity, ADAPTER) - gravity_wrench(zero, ADAPTER)
    still = np.stack([bare, bare + gravity_wrench(gravity, RETRACTOR)])
    squares = np.zeros((2, 8))
    for _ in range(runs):
        noise = rng.normal(size=still.shape) * reading_noise() / np.sqrt(250.0)
        drift = time[..., None] / 3600.0 * np.repeat([0.1, 2e-3], 3) * rng.choice([-1, 1], 6)
        for case, extra in enumerate((0.0, drift)):
            readings = still + noise + extra
            sweeps = [StillPoses(poses, readings[k], None, time[k], arm=GALEN) for k in range(2)]
            found = identify(*sweeps, GRID.home_angles)
            both = ((found.load, RETRACTOR), (found.adapter, ADAPTER))
            error = [(load.mass_kg - true.mass_kg, *load.com_m - true.com_m) for load, true in both]
            squares[case] += np.ravel(error) ** 2
    return np.sqrt(np.mean(squares[1] / squares[0]))


def test_a_steady_drift_of_a_tenth_of_a_newton_an_hour_costs_less_than_a_fifth():
    """With a constant bias, as where nothing notices it; a serpentine's loads are far off."""
    assert cost_of_drift(GRID.plan(TIP).poses, identify_two_sweeps, 6) < 1.2
    assert cost_of_drift(GRID.grid_poses(7, 8), identify_two_sweeps, 6) > 2.0


@pytest.mark.slow
def test_nor_where_the_model_is_chosen():
    assert cost_of_drift(GRID.plan(TIP).poses, choose_calibration, 10) < 1.2


def test_a_sweep_in_a_bad_order_is_told_by_how_much_a_better_one_lowers_the_cost():
    good, bad = grid_at(5)
    for shapes in (LINE, WALK):
        assert drift_warning(*good, shapes) == ""
        text = drift_warning(*bad, shapes)
        factor = float(re.search(r"(\d+\.\d) times", text).group(1))
        # the better order's moves are guessed from the bad one's
        true = drift_price(*bad, shapes) / drift_price(*good, shapes)
        assert 0.4 * true < factor < 1.3 * true
    assert drift_warning(bad[0], bad[1], (BiasShape(),) * 6) == ""


def test_poses_on_a_line_and_too_many_are_ordered_as_well():
    times = GRID.times()
    for tilts, rolls in ((1, 2), (1, 9), (20, 20)):
        poses = GRID.grid_poses(tilts, rolls)
        assert sorted(map(tuple, order_poses(poses, times, arm=GALEN))) == sorted(map(tuple, poses))
    many = GRID.grid_poses(20, 21)
    assert np.array_equal(order_poses(many, times, arm=GALEN), many)


@pytest.mark.slow
def test_chosen_poses_stay_in_range_and_away_from_boxes(plan):
    assert len(plan.poses) == 18
    assert plan.router is None
    boxed = dataclasses.replace(CHOSEN, obstacles=SIDE).plan(TIP)
    arm = ArmClearance(boxes_from_numbers(SIDE), CHOSEN.obstacle_clearance_m, TIP, arm=GALEN)
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
    arm = ArmClearance(boxes_from_numbers(box), 0.02, TIP, arm=GALEN)
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
    return sweep_grid((tstart, tend, tilts), (rstart, rend, rolls), LOWER, UPPER)


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
