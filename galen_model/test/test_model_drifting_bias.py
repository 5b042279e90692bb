# SPDX-License-Identifier: Apache-2.0
"""A bias that drifts: chosen by held-out blocks, with covariances that hold what it costs."""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import IdentificationError
from galen_model.estimation.curves import BiasBasis, BiasShape, Shape
from galen_model.estimation.problem import Problem
from galen_model.load.choice import choose_calibration
from galen_model.load.identification import identify_single_load, load_estimate
from galen_model.load.model import (
    ADAPTER,
    TOOLS,
    gravity_regressor,
    gravity_wrench,
    nominal_reading,
)
from galen_model.load.readings import StillPoses
from model_files import SIGMA

TOOL = TOOLS["retractor"].load
PERIOD_S = 2.0
WALK = (BiasShape(Shape.WALK, 10.0),) * 6


def grid():
    """A sweep's 56 poses in a meandering order."""
    roll, tilt = np.meshgrid(np.linspace(-1.5, 1.5, 8), np.linspace(-1.0, 0.9, 7))
    roll[1::2] = roll[1::2, ::-1].copy()
    return np.column_stack([roll.ravel(), tilt.ravel()])


ANGLES = grid()
GRAVITY = GALEN.gravity_in_sensor(ANGLES)
TIME_S = PERIOD_S * np.arange(56)


def bias_drift(rng, over_sigma):
    """Random walks (56, 6) that get `over_sigma` of the noise far in a sweep."""
    return np.cumsum(rng.standard_normal((56, 6)), axis=0) * SIGMA * over_sigma / np.sqrt(56)


def reading(rng, over_sigma):
    return (
        gravity_wrench(GRAVITY, TOOL)
        + bias_drift(rng, over_sigma)
        + SIGMA * rng.standard_normal((56, 6))
    )


def sweeps(readings):
    return Problem(gravity_regressor(GRAVITY), readings, TIME_S, np.zeros(56, dtype=int))


def test_the_elimination_is_generalised_least_squares():
    """The same x and covariance as with the readings' whole covariance matrix, written out."""
    rng = np.random.default_rng(0)
    data = sweeps(reading(rng, 10.0))
    found = data.under(WALK).fit(np.ones(56, dtype=bool))
    time = TIME_S / TIME_S[-1]
    prior = np.eye(56) + 100.0 * np.minimum.outer(time, time)  # b(0) is free: one more column
    information, right = np.zeros((4, 4)), np.zeros(4)
    for channel in range(6):
        columns = np.column_stack([data.design[:, channel], np.ones(56)])
        weight = np.linalg.inv(prior) / found.sigma[channel] ** 2
        joint = columns.T @ weight @ columns
        reduced = joint[:4, :4] - np.outer(joint[:4, 4], joint[4, :4]) / joint[4, 4]
        side = columns.T @ weight @ data.readings[:, channel]
        information += reduced
        right += side[:4] - joint[:4, 4] * side[4] / joint[4, 4]
    expected = np.linalg.solve(information, right)
    np.testing.assert_allclose(found.values[:4], expected, rtol=1e-6)
    ratio = np.diag(found.covariance)[:4] / np.diag(np.linalg.inv(information))
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)  # all widened by the same
    assert 1.0 < ratio[0] < 1.1
    # the end of the curve, and the curve there, are one
    np.testing.assert_allclose(found.values[4:], found.bias[-1], atol=1e-12)
    np.testing.assert_allclose(found.bias_at(TIME_S, data.segment), found.bias, atol=1e-12)


def test_a_smooth_curves_line_costs_nothing():
    time = np.array([0.0, 1.0, 3.0, 7.0, 10.0])
    smooth = BiasBasis(BiasShape(Shape.SMOOTH, 5.0), time, np.zeros(5, dtype=int))
    np.testing.assert_allclose(smooth.penalty() @ (2.0 - 3.0 * time), 0.0, atol=1e-12)


@pytest.mark.slow
def test_mass_under_bias_drift_is_better_and_its_interval_true():
    """20 sweeps: the four moments scatter as the covariance says, which is the Cramer-Rao bound
    given the shape, and the mass by less than 0.8 of what it does with a constant bias.
    """
    rng = np.random.default_rng(1)
    shapes = (BiasShape(Shape.WALK, 30.0),) * 6
    constant, walk, squares = [], [], []
    for _ in range(20):
        readings = reading(rng, 30.0)
        constant.append(
            identify_single_load(GRAVITY, readings, arm=GALEN).load.mass_kg - TOOL.mass_kg
        )
        fit = sweeps(readings).under(shapes).fit(np.ones(56, dtype=bool))
        error = fit.values[:4] - TOOL.moments
        walk.append(error[0])
        squares.append(error @ np.linalg.solve(fit.covariance[:4, :4], error))
    assert np.sqrt(np.mean(np.square(walk))) < 0.8 * np.sqrt(np.mean(np.square(constant)))
    # sum of 80 squared normals; 99.8 % of them lie here. In 300 sweeps it is 1.05 a piece.
    assert 48.0 < np.sum(squares) < 125.0


def test_one_sweep_with_a_known_adapter():
    rng = np.random.default_rng(4)
    weight = nominal_reading(ANGLES, TOOL, ADAPTER, arm=GALEN)
    tool = weight + bias_drift(rng, 50.0) + SIGMA * rng.standard_normal((56, 6))
    found = choose_calibration(None, StillPoses(ANGLES, tool, None, TIME_S, arm=GALEN))
    assert found.bias_drift is not None and found.zeroed
    assert found.unresolved and "drifted" in found.warnings[0]
    total = found.load.mass_kg + found.adapter.mass_kg
    assert total == pytest.approx(TOOL.mass_kg + ADAPTER.mass_kg, abs=2e-3)
    untimed = choose_calibration(None, StillPoses(ANGLES, tool, arm=GALEN))
    assert untimed.bias_drift is None and "no times" in untimed.reason


def test_poses_in_an_order_that_goes_with_time_are_told_or_rejected():
    """Tilt alone, slowly from one end to the other: a straight drift is a load."""
    tilt = np.linspace(-0.15, 0.15, 40)
    gravity = GALEN.gravity_in_sensor(np.column_stack([np.zeros(40), tilt]))
    time = np.arange(40.0)
    rng = np.random.default_rng(5)
    readings = gravity_wrench(gravity, TOOL) + 0.05 * rng.standard_normal((40, 6))
    slow = Problem(gravity_regressor(gravity), readings, time, np.zeros(40, dtype=int))
    found = slow.under(WALK).fit(np.ones(40, dtype=bool))
    assert found.growth[0] > 3.0
    with pytest.raises(IdentificationError, match="not distinguishable from none"):
        load_estimate(found.values, found.covariance, "the load")
    # a grid's order goes with the tilt; that costs more than any order by chance
    data = sweeps(reading(rng, 0.0))
    order = rng.permutation(56)
    shuffled = Problem(data.design[order], data.readings[order], TIME_S, data.segment)
    everything = np.ones(56, dtype=bool)
    in_order = data.under(WALK).fit(everything).growth[0]
    assert in_order > 1.3 * shuffled.under(WALK).fit(everything).growth[0]
