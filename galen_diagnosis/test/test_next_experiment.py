# SPDX-License-Identifier: Apache-2.0
"""The experiment that separates what is left, against second methods and known twins."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import yaml
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_deflection.collection.plan import CollectionParameters
from galen_diagnosis.experiment.next_experiment import Proposal, proposals, propose, write_sweep
from galen_diagnosis.experiment.separation import (
    Alternative,
    choose_units,
    linearise,
    separate,
    typical_sizes,
)
from galen_diagnosis.experiment.trial import (
    free_columns,
    load_columns,
    motion_trial,
    push_trial,
    signature,
    still_trial,
)
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.load.model import ADAPTER, TOOLS, LoadEstimate
from galen_model.poses.design import angle_grid
from galen_sim_driver.effects.registry import EFFECTS
from scipy.integrate import quad
from scipy.optimize import least_squares
from scipy.stats import norm

GRID = angle_grid((-1.5, -1.0), (1.5, 0.9), 8, 7)


def tool_file(com_std_m=2e-4):
    load, covariance = TOOLS["pointer"].load, np.diag([1e-4, *[com_std_m] * 3]) ** 2
    return CalibrationFile(
        "pointer",
        LoadEstimate(load.mass_kg, load.com_m, covariance),
        LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, covariance),
        TOOLS["pointer"].tip_m,
        np.zeros(6),
        56,
        "2026-01-01T00:00:00Z",
        arm=GALEN,
        zeroing=zeroed_at(arm=GALEN),
    )


TOOL = tool_file()


def effect(name, **parameters):
    return EFFECTS[name](**parameters)


def sweep(tool=TOOL, **options):
    return still_trial(GRID, 2.3 * np.arange(1, 57), 1.0, tool, **options)


def refitted(trials, truth, effects, tool):
    """Effects fitted on the simulator itself to what the truth shows, and what is left then."""
    shown = np.concatenate([signature(trial, truth) for trial in trials])
    typical = typical_sizes(effects)
    free, _ = np.linalg.qr(free_columns(trials))
    known = load_columns(trials, tool)
    other = Alternative(effects, 1.0, np.zeros((len(typical),) * 2))

    def left(unknown):
        found = other.with_vector(unknown[: len(typical)] * typical)
        rest = shown - np.concatenate([signature(trial, found) for trial in trials])
        rest = rest - known @ unknown[len(typical) :]
        return np.concatenate([rest - free @ (free.T @ rest), unknown[len(typical) :]])

    start = np.concatenate([other.vector() / typical, np.zeros(known.shape[1])])
    fit = least_squares(left, start, x_scale="jac")
    return other.with_vector(fit.x[: len(typical)] * typical), np.sqrt(2.0 * fit.cost)


def fitted_covariance(trials, effects, tool):
    """Covariance (k, k) that a fit to these trials would have, with priors of typical sizes."""
    typical = typical_sizes(effects)
    _, slope = linearise(trials, Alternative(effects, 1.0, np.eye(len(typical))))
    free, _ = np.linalg.qr(free_columns(trials))
    columns = np.hstack([slope, load_columns(trials, tool)])
    columns -= free @ (free.T @ columns)
    prior = np.ones(columns.shape[1])
    prior[: len(typical)] = typical**-2.0
    inverse = np.linalg.inv(columns.T @ columns + np.diag(prior))
    return inverse[: len(typical), : len(typical)]


def smallest(trials, left, tool=TOOL):
    """Smallest distance of all pairs, in the less favourable of both directions."""
    distance, _ = separate(trials, left, tool)
    return distance[~np.eye(len(distance), dtype=bool)].min()


def alternatives(truth, others, tool=TOOL):
    """The truth, and others as a recording of the wrench alone would have them fitted."""
    trials = [sweep(tool), motion_trial(1.0, 10.0, tool)]
    left = [truth, *(refitted(trials, truth, other, tool)[0] for other in others)]
    return [Alternative(e, 1 / len(left), fitted_covariance(trials, e, tool)) for e in left]


def judged(left, tool=TOOL):
    """Smallest distance and expected probability by kind of experiment."""
    return {
        one.kind: (smallest(one.trials, left, tool), separate(one.trials, left, tool)[1])
        for one in proposals(left, tool)
    }


@pytest.fixture(scope="module")
def roll_twins():
    return alternatives(
        (effect("joint_zero_offset", joint="roll", offset_rad=0.012),),
        [(effect("base_inclination"),)],
    )


@pytest.fixture(scope="module")
def roll_experiment(roll_twins):
    return propose(roll_twins, TOOL)


@pytest.mark.slow
def test_the_distance_is_what_a_fit_on_the_simulator_leaves():
    # A gain of fx against a heavier tool, a turned sensor against a tilt's zero: the parameters
    # are known to nearly nothing before, as in the fit.
    for truth, other in (
        ((effect("axis_gain", gain=(0.04, 0.0, 0.0, 0.0, 0.0, 0.0)),), "tool_mass_error"),
        ((effect("loose_tool", shift_m=0.004),), "tool_com_error"),
        ((effect("joint_zero_offset", joint="tilt", offset_rad=0.03),), "sensor_mount_rotation"),
    ):
        trials = [sweep(), push_trial(GALEN.home[None], (5.0,), TOOL)]
        found, left = refitted(trials, truth, (effect(other),), TOOL)
        loose = np.diag(1e3 * typical_sizes(found)) ** 2
        known = np.zeros((len(typical_sizes(truth)),) * 2)
        both = [Alternative(truth, 0.5, known), Alternative(found, 0.5, loose)]
        distance = separate(trials, both, TOOL)[0][0, 1]
        assert left > 3.0
        assert distance == pytest.approx(left, rel=0.03), other


def test_the_expected_probability_is_that_of_two_gaussians():
    """Against quadrature: with x the log odds, normal with mean D^2/2 and deviation D."""
    trials = [sweep()]
    exact = tool_file(0.0)
    for shift_m in (4e-5, 1.2e-4):
        loose = (effect("loose_tool", shift_m=shift_m),)
        both = [
            Alternative(loose, 0.5, np.zeros((1, 1))),
            Alternative((), 0.5, np.zeros((0, 0))),
        ]
        distance = smallest(trials, both, exact)
        assert 0.5 < distance < 6.0
        expected, _ = quad(
            lambda x, d=distance: norm.pdf(x, d * d / 2, d) / (1.0 + np.exp(-x)), -40.0, 60.0
        )
        assert separate(trials, both, exact)[1] == pytest.approx(expected, abs=0.02)


def test_a_turn_about_rolls_axis_needs_the_platform_to_move(roll_twins, roll_experiment):
    """With the platform at home it is base_link's place in `tracker`, which is not known."""
    at_home = smallest([sweep(tracker=True)], roll_twins)
    moved = np.array([[0.07, -0.06, 0.45, 0.9, -0.6], [-0.07, 0.06, 0.36, -0.9, 0.6]])
    elsewhere = smallest([push_trial(moved, (3.0,), TOOL)], roll_twins)
    assert smallest([sweep()], roll_twins) < 0.5
    assert at_home < 3.3 < 30.0 < elsewhere
    assert roll_experiment.proposal.kind == "pushes"
    assert set(roll_experiment.separates) == {"joint_zero_offset:roll", "base_inclination"}
    assert roll_experiment.before == pytest.approx(0.5)
    assert roll_experiment.expected_probability > 0.99


@pytest.mark.slow
def test_each_kind_of_experiment_is_worth_most_for_what_it_is_for():
    bias_drift = effect("sensor_drift", rate_per_hour=(0.3, 0.3, 0.3, 0.006, 0.006, 0.006))
    left = alternatives((bias_drift,), [(effect("loose_tool"),)])
    found = propose(left, TOOL).proposal
    assert found.program == "calibration"
    numbers = tuple(GALEN.angles(found.poses).ravel().tolist())
    parameters = CalibrationParameters(poses="listed", listed_poses_rad=numbers)
    assert len(parameters.plan(np.asarray(TOOL.tip_m)).poses) == len(found.poses)
    told = judged([one.in_another_session() for one in left])
    unsure = 1.0 - told["reversed order"][1]
    assert 1.0 - told["still poses"][1] > 5.0 * unsure
    assert 1.0 - told["tracker at rest"][1] > 5.0 * unsure

    gain = alternatives((effect("axis_gain", gain=(0.03,) * 6),), [(effect("tool_mass_error"),)])
    told = judged(gain)
    assert told["second mass"][0] > 2.0 * told["still poses"][0]

    late = effect("wrench_delay", delay_s=0.01)
    inertia = effect("inertial_load", mass_kg=0.16)
    known = np.diag([1e-6])
    both = [Alternative((late,), 0.5, known), Alternative((inertia,), 0.5, known)]
    told = judged(both)
    assert told["two speeds"][0] > 30.0
    assert told["still poses"][0] == pytest.approx(0.0, abs=1e-9)
    assert propose(both, TOOL).proposal.kind == "two speeds"


def test_what_happened_once_or_can_not_be_separated_gets_no_experiment():
    step = effect("bias_step", time_s=20.0, step=(0.1,) * 6, bag="sweep")
    jumped = Alternative((step,), 0.5, np.eye(6) * 1e-4)
    nothing = Alternative((), 0.5, np.zeros((0, 0)))
    assert propose([jumped, nothing], TOOL) is None
    assert propose([nothing], TOOL) is None


@pytest.mark.slow
def test_chosen_poses_are_the_best_of_all_sets():
    poses = angle_grid((-1.4, -0.9), (1.4, 0.9), 3, 3)
    trial = still_trial(poses, 2.0 * np.arange(1, 10), 1.0, TOOL)
    both = [
        Alternative((effect("loose_tool", shift_m=0.003),), 0.5, np.diag([1e-6])),
        Alternative(
            (effect("tool_com_error", delta_m=(0.001, 0.0, 0.001)),), 0.5, np.eye(3) * 1e-6
        ),
    ]

    def of(some):
        return smallest([still_trial(poses[some], 2.0 * np.arange(1, 4), 1.0, TOOL)], both)

    every = {some: of(list(some)) for some in combinations(range(9), 3)}
    chosen = tuple(choose_units(trial, both, TOOL, 3))
    assert every[chosen] > 0.999 * max(every.values())
    assert min(every.values()) < 0.8 * every[chosen]


def read_parameters(path, node):
    return yaml.safe_load(path.read_text())[f"/**/{node}"]["ros__parameters"]


def test_the_file_is_what_the_nodes_take(tmp_path, roll_experiment):
    sweep_proposal = Proposal("still poses", "sweep", GALEN.with_angles(GRID), ())
    found = replace(roll_experiment, proposal=sweep_proposal)
    write_sweep(found, tmp_path / "sweep.yaml", arm=GALEN)
    numbers = read_parameters(tmp_path / "sweep.yaml", "calibration")
    numbers["listed_poses_rad"] = tuple(numbers["listed_poses_rad"])
    parameters = CalibrationParameters(**numbers)
    parameters.validate()
    plan = parameters.plan(np.asarray(TOOL.tip_m), one_sweep=True)
    assert np.abs(plan.poses - GRID).max() < 1e-5
    assert tuple(parameters.home) == tuple(GALEN.home)
    assert found.to_json()["poses"] == 56

    write_sweep(roll_experiment, tmp_path / "pushes.yaml", arm=GALEN)
    numbers = read_parameters(tmp_path / "pushes.yaml", "collection")
    CollectionParameters(**{name: tuple(value) for name, value in numbers.items()}).validate()


def test_what_no_node_runs_is_not_written(tmp_path, roll_experiment):
    by_hand = replace(roll_experiment.proposal, kind="two speeds", program="none")
    found = replace(roll_experiment, proposal=by_hand)
    with pytest.raises(GalenError, match="do it by hand: with the tracker on"):
        write_sweep(found, tmp_path / "none.yaml", arm=GALEN)
    assert not list(tmp_path.iterdir())
