# SPDX-License-Identifier: Apache-2.0
"""Chosen poses: the criterion is the identification's own, and nothing beats them by much."""

import itertools

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.load.model import gravity_regressor
from galen_model.load.readings import LoadReadings, StillPoses, with_offsets
from galen_model.poses.design import (
    PoseDesign,
    PoseDesignError,
    compensation_std,
    reading_noise,
    workspace,
)

RANGE = (-1.5, -1.0), (1.5, 0.9)
SIGMA = reading_noise()
BIAS = (0.3, -0.2)


def random_poses(rng, count):
    return rng.uniform(*RANGE, (count, 2))


def both_loads(design):
    """From all parameters to the sum of both loads and what the tool's sweep adds to it."""
    at_zero = gravity_regressor(GALEN.gravity_in_sensor(BIAS))
    matrix = np.zeros((10, design))
    matrix[:4, :4] = matrix[:4, 4:8] = np.eye(4)
    matrix[4:, 4:8] = -at_zero
    matrix[4:, design - 6 :] = np.eye(6)
    return matrix


def workspace_error(covariance):
    """Mean variance of G x + c over the workspace and axes, in readings; written out again."""
    poses = workspace(25, arm=GALEN)
    total = 0.0
    for gravity in GALEN.gravity_in_sensor(poses):
        row = np.hstack([gravity_regressor(gravity), np.eye(6)])
        total += np.mean(np.diag(row @ covariance @ row.T) / SIGMA**2)
    return total / len(poses)


def test_the_criterion_is_what_two_sweeps_leave():
    poses = random_poses(np.random.default_rng(1), 9)
    sweep = StillPoses(poses, np.zeros((9, 6)), arm=GALEN)
    readings = LoadReadings.of_two_sweeps(sweep, sweep, BIAS)
    design = with_offsets(readings.of_loads.design, readings.segment) / SIGMA[:, None]
    covariance = np.linalg.inv(np.einsum("nkp,nkq->pq", design, design))
    matrix = both_loads(20)
    both = matrix @ covariance @ matrix.T
    value = PoseDesign(poses, arm=GALEN).value(poses)
    np.testing.assert_allclose(value, workspace_error(both), rtol=1e-6)
    # with the same poses in both sweeps the tool alone is known with twice the sum's variance
    np.testing.assert_allclose(covariance[:4, :4], 2.0 * both[:4, :4], rtol=1e-5, atol=1e-15)


def test_the_criterion_is_what_one_sweep_leaves():
    poses = random_poses(np.random.default_rng(2), 7)
    sweep = StillPoses(poses, np.zeros((7, 6)), arm=GALEN)
    problem = LoadReadings.of_one_sweep(sweep, BIAS).of_loads
    scaled = with_offsets(problem.design) / SIGMA[:, None]
    known = problem.known.beside(6).whitened
    information = np.einsum("nkp,nkq->pq", scaled, scaled) + known.T @ known
    information[8:, 8:] += np.diag(1.0 / SIGMA**2)
    matrix = both_loads(14)
    both = matrix @ np.linalg.inv(information) @ matrix.T
    value = PoseDesign(poses, one_sweep_zero=BIAS, arm=GALEN).value(poses)
    np.testing.assert_allclose(value, workspace_error(both), rtol=1e-5)
    assert value < PoseDesign(poses, arm=GALEN).value(poses)  # the zeroing tells something


@pytest.mark.parametrize("bias", [None, BIAS])
def test_exchange_finds_the_best_of_all_subsets(bias):
    rng = np.random.default_rng(4)
    for count in (4, 5):
        candidates = random_poses(rng, 8)
        design = PoseDesign(candidates, one_sweep_zero=bias, arm=GALEN)
        best = min(
            design.value(candidates[list(subset)])
            for subset in itertools.combinations(range(8), count)
        )
        found = design.choose(count)
        assert len(set(found)) == count
        value = design.value(candidates[found])
        # an exchange may end at a local optimum
        assert best <= value < 1.01 * best


def test_poses_that_do_not_tell_all_are_rejected():
    line = np.column_stack([np.zeros(8), np.linspace(-1.0, 0.9, 8)])
    assert np.all(np.isinf(compensation_std(line[:2], SIGMA, arm=GALEN)))
    with pytest.raises(PoseDesignError, match="6 poses out of 8 don't tell all"):
        PoseDesign(np.tile(line[:1], (8, 1)), arm=GALEN).choose(6)
    with pytest.raises(PoseDesignError, match="9 poses are wanted, but there are only 8"):
        PoseDesign(line, arm=GALEN).choose(9)
