# SPDX-License-Identifier: Apache-2.0
"""Identification: known parameters recovered at the noise's limit, bad input rejected by name."""

import re

import numpy as np
import pytest
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.load.choice import choose_calibration
from galen_model.load.identification import (
    check_planned_poses,
    identify_one_sweep,
    identify_two_sweeps,
    zeroing_fault,
)
from galen_model.load.model import (
    ADAPTER,
    TOOLS,
    Load,
    gravity_wrench,
    nominal_reading,
)
from galen_model.load.readings import StillPoses
from model_files import SIGMA, SIX_AXIS_URDF, sweep_grid

NO_TOOL = Load(0.0)


def sweeps(tool, rng, noise=SIGMA, drift=0.0, poses=None, arm=GALEN):
    angles = sweep_grid() if poses is None else poses
    zeroing = noise * rng.standard_normal(6)
    bare = nominal_reading(angles, NO_TOOL, ADAPTER, arm=arm) + zeroing
    with_tool = nominal_reading(angles, tool, ADAPTER, arm=arm) + zeroing + drift
    hours = np.arange(float(len(angles)))
    bare += noise * rng.standard_normal(bare.shape)
    with_tool += noise * rng.standard_normal(bare.shape)
    return (
        StillPoses(angles, bare, None, hours, arm=arm),
        StillPoses(angles, with_tool, None, 100.0 + hours, arm=arm),
    )


def truth(tool):
    return np.concatenate([[tool.mass_kg], tool.com_m, [ADAPTER.mass_kg], ADAPTER.com_m])


def estimate(found):
    return np.concatenate(
        [[found.load.mass_kg], found.load.com_m, [found.adapter.mass_kg], found.adapter.com_m]
    )


def stated_std(found):
    return np.sqrt(
        np.concatenate([np.diag(found.load.covariance), np.diag(found.adapter.covariance)])
    )


@pytest.mark.parametrize("name", ["pointer", "retractor"])
def test_noise_free_sweeps_give_the_loads_to_rounding(name):
    tool = TOOLS[name].load
    found = identify_two_sweeps(*sweeps(tool, np.random.default_rng(0), noise=np.zeros(6)))
    np.testing.assert_allclose(estimate(found), truth(tool), atol=1e-9)
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-9)
    assert not found.outliers


@pytest.mark.parametrize(
    ("identify", "down"),
    [
        (identify_two_sweeps, (0.0, 0.0, -9.80665)),
        (identify_two_sweeps, (0.0, 6.0, 7.75)),
        (choose_calibration, (0.0, 6.0, 7.75)),
    ],
)
def test_the_loads_on_a_six_axis_arm_are_found_on_the_floor_and_on_a_wall(identify, down):
    arm, tool = read_arm(SIX_AXIS_URDF, gravity_m_s2=down), TOOLS["retractor"].load
    poses = np.random.default_rng(3).uniform(-2.0, 2.0, (40, 6))
    found = identify(*sweeps(tool, np.random.default_rng(1), poses=poses, arm=arm))
    error = estimate(found) - truth(tool)
    assert np.all(np.abs(error) < 4.0 * stated_std(found))
    assert np.all(stated_std(found) < 1e-3)
    # two joints that hardly move, and the others not at all
    few = poses * [0.02, 0.02, 0, 0, 0, 0]
    spans = r"span 0\.080 rad of shoulder_pan, 0\.068 .* and 0\.000 rad of wrist_3"
    with pytest.raises(NotExcitedError, match=spans):
        identify(*sweeps(tool, np.random.default_rng(1), poses=few, arm=arm))


@pytest.mark.slow
def test_coverage_and_efficiency_over_200_calibrations():
    """95 % intervals hold the truth in 95 %; the scatter is the Cramer-Rao bound's.

    Healthy poses are hardly ever rejected: one in a hundred calibrations by design.
    """
    tool, rng, count = TOOLS["pointer"].load, np.random.default_rng(7), 200
    errors, stds, rejected, bound = [], [], 0, cramer_rao(sweep_grid(), tool)
    for _ in range(count):
        found = identify_two_sweeps(*sweeps(tool, rng))
        errors.append(estimate(found) - truth(tool))
        stds.append(stated_std(found))
        rejected += len(found.outliers)
    assert rejected <= 8
    inside = np.abs(errors) < 1.96 * np.array(stds)
    # binomial: 1600 outcomes, correlated within a calibration; each parameter alone has 1.5 %
    assert 0.93 < inside.mean() < 0.97
    assert inside.mean(axis=0).min() > 0.95 - 4 * 0.0154
    scatter = np.std(errors, axis=0)
    np.testing.assert_allclose(scatter / bound, 1.0, atol=4 / np.sqrt(2 * count))
    np.testing.assert_allclose(np.mean(errors, axis=0) / bound, 0.0, atol=4 / np.sqrt(count))


def cramer_rao(angles, tool):
    """The bound from the model's own derivatives by (m, p), taken numerically, offsets free."""
    start = truth(tool)

    def stacked(x, o_bare, o_tool):
        adapter, load = Load(x[4], x[5:8]), Load(x[0], x[1:4])
        bare = nominal_reading(angles, NO_TOOL, adapter, arm=GALEN) + o_bare
        return np.concatenate([bare, nominal_reading(angles, load, adapter, arm=GALEN) + o_tool])

    columns = []
    for index in range(20):
        step = np.zeros(20)
        step[index] = 1e-6
        ahead = stacked(start + step[:8], step[8:14], step[14:])
        behind = stacked(start - step[:8], -step[8:14], -step[14:])
        columns.append(((ahead - behind) / 2e-6 / SIGMA).ravel())
    jacobian = np.column_stack(columns)
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))[:8])


def test_drift_between_the_sweeps_reaches_neither_mass_nor_centre():
    tool, rng = TOOLS["retractor"].load, np.random.default_rng(3)
    drift = np.array([0.2, -0.1, 0.5, 0.01, -0.02, 0.005])
    found = identify_two_sweeps(*sweeps(tool, rng, drift=drift))
    assert np.all(np.abs(estimate(found) - truth(tool)) < 5 * stated_std(found))
    assert np.all(np.abs(found.offset_change - drift) < 5 * found.offset_change_std)
    assert any(
        re.match(r"the sensor's fz moved by \+0\.(49|50)", warning) for warning in found.warnings
    )


def test_touched_poses_are_rejected_and_do_no_harm():
    tool, rng = TOOLS["pointer"].load, np.random.default_rng(5)
    bare, with_tool = sweeps(tool, rng)
    touched = [3, 17, 30, 44, 51]
    with_tool.wrench[touched] += rng.uniform(0.1, 3.0, (5, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    bare.wrench[9, 2] += 0.4
    found = identify_two_sweeps(bare, with_tool)
    assert set(np.flatnonzero(~found.used_tool)) >= set(touched)
    assert np.count_nonzero(~found.used_tool) <= len(touched) + 2
    assert 9 in np.flatnonzero(~found.used_bare)
    assert any(o[:2] == ("tool", 17) and o[2] > 5 for o in found.outliers)
    assert np.all(np.abs(estimate(found) - truth(tool)) < 5 * stated_std(found))


def test_too_many_outliers_are_an_error():
    tool, rng = TOOLS["pointer"].load, np.random.default_rng(6)
    bare, with_tool = sweeps(tool, rng)
    with_tool.wrench[:45] += rng.uniform(-3, 3, (45, 6))
    with pytest.raises(IdentificationError, match=r"poses fit no common load|agree on"):
        identify_two_sweeps(bare, with_tool)


def test_poses_that_do_not_turn_are_rejected_by_name():
    tool, rng = TOOLS["pointer"].load, np.random.default_rng(8)
    same = np.tile([0.2, 0.1], (56, 1))
    with pytest.raises(NotExcitedError, match=r"the tool's mass.*0.000 rad of roll"):
        identify_two_sweeps(*sweeps(tool, rng, poses=same))
    with pytest.raises(NotExcitedError, match="times less information than well-spread"):
        identify_two_sweeps(*sweeps(tool, rng, poses=sweep_grid(roll=0.05, tilt=(-0.05, 0.05))))
    still_good = identify_two_sweeps(
        *sweeps(tool, rng, poses=sweep_grid(roll=0.3, tilt=(-0.3, 0.3)))
    )
    assert np.all(np.abs(estimate(still_good) - truth(tool)) < 5 * stated_std(still_good))


def test_mass_that_is_not_positive_is_rejected():
    rng = np.random.default_rng(9)
    tool = TOOLS["pointer"].load
    bare, with_tool = sweeps(tool, rng)
    with pytest.raises(IdentificationError, match="a mass is positive"):
        identify_two_sweeps(
            with_tool, bare
        )  # the sweeps swapped: the tool's mass comes out negative
    nothing, still_nothing = sweeps(NO_TOOL, rng)
    with pytest.raises(IdentificationError, match="the tool"):
        identify_two_sweeps(nothing, still_nothing)
    flipped = [StillPoses(s.angles, -s.wrench, arm=GALEN) for s in (bare, with_tool)]
    with pytest.raises(IdentificationError, match="direction of the push"):
        identify_two_sweeps(*flipped)


def test_one_sweep_compensates_fully_and_says_what_it_can_not_know():
    tool, rng = TOOLS["retractor"].load, np.random.default_rng(10)
    _, with_tool = sweeps(tool, rng)
    found = identify_one_sweep(with_tool)
    # predictions at poses of its own, not at the sweep's
    angles = rng.uniform([-1.5, -1.0], [1.5, 0.9], (200, 2))
    expected = nominal_reading(angles, tool, ADAPTER, arm=GALEN)
    predicted = (
        nominal_reading(angles, found.load.load, found.adapter.load, arm=GALEN) + found.offset
    )
    assert np.all(np.sqrt(np.mean((predicted - expected) ** 2, axis=0)) < 2.5 * SIGMA)
    total = tool.moments[1] + ADAPTER.moments[1]  # gravity at home is along the sensor's x
    both = found.load.load.moments[1] + found.adapter.load.moments[1]
    assert both == pytest.approx(total, abs=1e-4)
    assert "only their sum" in found.unresolved[0]
    # what isn't known is stated as wide, what is known as narrow
    assert found.load.com_std_m[0] > 0.02
    assert found.load.com_std_m[1] < 1e-3


BIAS = np.array([0.4, -3.1, -4.0, -0.07, -0.02, -0.05])


@pytest.mark.parametrize("bias", [BIAS, -BIAS, 0.03 * BIAS], ids=["large", "negative", "small"])
def test_one_sweep_of_a_sensor_that_was_not_zeroed_is_one_load_and_its_offset(bias):
    tool, rng = TOOLS["retractor"].load, np.random.default_rng(15)
    both = Load(0.3, (tool.moments + ADAPTER.moments)[1:] / 0.3)
    readings = gravity_wrench(GALEN.gravity_in_sensor(sweep_grid()), both) + bias
    sweep = StillPoses(
        sweep_grid(), readings + SIGMA * rng.standard_normal(readings.shape), arm=GALEN
    )
    found = choose_calibration(None, sweep)
    assert not found.zeroed and found.adapter.mass_kg == 0.0
    assert abs(found.load.mass_kg - 0.3) < 4.0 * found.load.mass_std_kg
    assert np.all(np.abs(found.load.com_m - both.com_m) < 4.5 * found.load.com_std_m)
    assert np.all(np.abs(found.offset - bias) < 4.5 * found.offset_std)
    assert any("not zeroed with the adapter alone" in text for text in found.warnings)


def test_one_sweep_of_a_zeroed_sensor_is_told_from_others():
    """The test's level is 0.1 %: of 20 sets of a zeroed sensor at most 1 (else once in 5,000)."""
    tool, rng = TOOLS["pointer"].load, np.random.default_rng(16)
    home = GALEN.gravity_in_sensor(None)
    zeroed = [zeroing_fault(sweeps(tool, rng)[1], home) for _ in range(20)]
    assert np.count_nonzero(zeroed) <= 1
    for _ in range(3):
        _, sweep = sweeps(tool, rng, drift=rng.normal(size=6) * [1, 1, 1, 0.05, 0.05, 0.05])
        assert zeroing_fault(sweep, home)
    heavy = np.array([9.80665 * 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])  # as an adapter of -300 g more
    assert "adapter would weigh" in zeroing_fault(sweeps(tool, rng, drift=heavy)[1], home)
    _, few = sweeps(tool, rng, poses=sweep_grid(3, 4))
    assert not choose_calibration(None, few, zeroed=False).zeroed


@pytest.mark.slow
def test_one_sweep_coverage():
    tool, rng = TOOLS["pointer"].load, np.random.default_rng(13)
    inside = []
    for _ in range(100):
        _, with_tool = sweeps(tool, rng)
        found = identify_one_sweep(with_tool)
        inside.append(np.abs(estimate(found) - truth(tool)) < 1.96 * stated_std(found))
    rate = np.delete(np.mean(inside, axis=0), [1, 5])  # the two that it says it doesn't know
    assert 0.90 < rate.mean() < 0.99


def test_noise_free_readings_with_quanta_are_identified():
    """The driver without noise: tz of the bare sweep is 0 at every pose, fitted to nothing."""
    tool = TOOLS["pointer"].load
    quantum = np.array([5e-3, 5e-3, 5e-3, 1e-4, 1e-4, 1e-4])
    bare, with_tool = sweeps(tool, np.random.default_rng(0), noise=np.zeros(6))
    for sweep in (bare, with_tool):
        sweep.wrench[:] = np.round(sweep.wrench / quantum) * quantum
    found = identify_two_sweeps(bare, with_tool)
    assert len(found.outliers) <= 5
    # no noise smooths the quanta: an error of half a quantum, 0.25 g, may be common to all poses
    np.testing.assert_allclose(estimate(found), truth(tool), atol=0.25e-3)


@pytest.mark.parametrize(("axis", "channel", "value"), [("fy", 1, 0.3), ("tz", 5, 0.0)])
def test_a_channel_that_never_changes_is_named(axis, channel, value):
    for sticks in ((0, 1), (1,)):
        both = sweeps(TOOLS["pointer"].load, np.random.default_rng(15))
        for sweep in sticks:
            both[sweep].wrench[:, channel] = value
        with pytest.raises(IdentificationError, match=f"{axis} .* same at all 56 poses"):
            identify_two_sweeps(*both)
    with pytest.raises(IdentificationError, match=f"{axis} .* same at all 56 poses"):
        identify_one_sweep(both[1])


@pytest.mark.slow
def test_a_bias_drift_within_a_sweep_is_told():
    """Three sigma over a sweep already make the adapter's interval miss; it must not be silent."""
    tool, sigmas = TOOLS["pointer"].load, np.array([0, 0, 3, 0, 0, 0]) * SIGMA
    bias_drift = np.linspace(0.0, 1.0, 56)[:, None] * sigmas
    told = {"with": 0, "without": 0, "one": 0, "none": 0}
    for seed in range(40):
        bare, with_tool = sweeps(tool, np.random.default_rng(seed))
        told["none"] += len(identify_two_sweeps(bare, with_tool).warnings)
        with_tool.wrench[:] += bias_drift
        pattern = r"fz drifted by \+0\.00\d+ N .* sweep with the tool"
        warned = identify_two_sweeps(bare, with_tool).warnings
        told["with"] += any(re.search(pattern, text) for text in warned)
        warned = identify_one_sweep(with_tool).warnings
        told["one"] += any(re.search(pattern, text) for text in warned)
        bare.wrench[:] -= bias_drift
        warned = identify_two_sweeps(bare, with_tool).warnings
        told["without"] += any("sweep without the tool" in text for text in warned)
    assert told["none"] == 0
    assert min(told["with"], told["without"], told["one"]) >= 30, told


def test_planned_poses_are_judged_before_the_arm_moves():
    check_planned_poses(sweep_grid(), arm=GALEN)
    check_planned_poses(sweep_grid(2, 3), one_sweep=True, arm=GALEN)
    for one_sweep in (False, True):
        with pytest.raises(NotExcitedError, match="each sweep: 1 still poses; at least 4"):
            check_planned_poses(sweep_grid(1, 1), one_sweep=one_sweep, arm=GALEN)
        with pytest.raises(NotExcitedError, match=r"the tool's centre along \w"):
            check_planned_poses(np.tile([0.3, 0.1], (8, 1)), one_sweep=one_sweep, arm=GALEN)


def test_sweep_shapes_are_checked():
    with pytest.raises(IdentificationError, match="shape"):
        StillPoses(sweep_grid(), np.zeros((55, 6)), arm=GALEN)
    with pytest.raises(IdentificationError, match=r"wrench .* non-finite"):
        StillPoses(sweep_grid(), np.full((56, 6), np.nan), arm=GALEN)
