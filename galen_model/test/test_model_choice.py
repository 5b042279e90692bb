# SPDX-License-Identifier: Apache-2.0
"""The choice among models of a load, beside the plain fit, on every kind of set."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.load.choice import PLAIN, STRUCTURED, choose_calibration, choose_load
from galen_model.load.identification import identify_single_load, plain_least_squares
from galen_model.load.model import (
    ADAPTER,
    TOOLS,
    Load,
    gravity_regressor,
    gravity_wrench,
    nominal_reading,
)
from galen_model.load.readings import StillPoses
from model_files import SIGMA, SIX_AXIS
from scipy.spatial.transform import Rotation

RETRACTOR = TOOLS["retractor"].load
KINDS = ("drift", "walk", "step", "outliers", "gains", "rotation")


@dataclass(frozen=True)
class Simulated:
    """Readings (n, 6) at gravity (n, 3) and times (n,), s, and how they were made.

    response (6, 6) and bias (n, 6): reading = response @ weight + bias, but for noise (6,) and
    outliers.
    """

    gravity: np.ndarray
    wrench: np.ndarray
    time_s: np.ndarray
    load: Load
    response: np.ndarray
    bias: np.ndarray
    noise: np.ndarray

    def expected_rmse(self, predicted, rows):
        """RMSE (6,) that readings at `rows` of the poses will have about `predicted`."""
        truth = gravity_wrench(self.gravity[rows], self.load) @ self.response.T + self.bias[rows]
        return np.sqrt(np.mean((truth - predicted) ** 2, axis=0) + self.noise**2)


def simulate(rng, arm, kinds):
    count, period = int(rng.integers(24, 57)), rng.uniform(3.0, 12.0)
    low, high = np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0)
    angles = rng.uniform(low, high, (count, len(low)))[:, arm.turning]
    if rng.random() < 0.5:  # as a grid is swept: the orientation goes with the time
        angles = angles[np.argsort(angles[:, -1])]
    gravity, time_s = arm.gravity_in_sensor(angles), period * np.arange(count)
    load = Load(rng.uniform(0.05, 1.5), rng.uniform(-0.08, 0.08, 3))
    noise = SIGMA * np.exp(rng.uniform(0.0, np.log(10.0)))
    bias = np.broadcast_to(rng.uniform(-5.0, 5.0, 6), (count, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]
    scale = np.repeat([1.0, 0.02], 3) * rng.choice([-1.0, 1.0], 6) * (rng.random(6) < 0.6)
    hourly = scale * np.exp(rng.uniform(np.log(0.05), np.log(0.5)))  # N/h and N.m/h
    if "drift" in kinds:
        bias = bias + hourly * time_s[:, None] / 3600.0
    if "walk" in kinds:
        steps = rng.standard_normal((count, 6)) * hourly * time_s[-1] / 3600.0 / np.sqrt(count)
        bias = bias + np.cumsum(steps, axis=0)
    if "step" in kinds:
        size = scale * np.exp(rng.uniform(np.log(5.0), np.log(50.0))) * noise[0]
        bias = bias + size * (np.arange(count) >= rng.integers(3, count - 3))[:, None]
    response = np.eye(6)
    if "gains" in kinds:
        response = np.diag(1.0 + rng.uniform(-0.03, 0.03, 6))
    if "rotation" in kinds:
        turn = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.0), 3)).as_matrix()
        response = response @ np.kron(np.eye(2), turn)
    wrench = gravity_wrench(gravity, load) @ response.T + bias
    wrench = wrench + noise * rng.standard_normal((count, 6))
    if "outliers" in kinds:
        hit = rng.random(count) < rng.uniform(0.05, 0.2)
        size = np.exp(rng.uniform(np.log(10.0), np.log(300.0), (count, 1))) * noise
        wrench = wrench + hit[:, None] * size * rng.standard_normal((count, 6))
    return Simulated(gravity, wrench, time_s, load, response, bias, noise)


def compare(rng, arm, kinds):
    """Hold a sixth of the poses out; RMSE (6,) expected there over the plain fit's."""
    made = simulate(rng, arm, kinds)
    count = len(made.time_s)
    first = int(rng.integers(0, count - count // 6 + 1))
    held = (np.arange(count) >= first) & (np.arange(count) < first + count // 6)
    gravity, wrench = made.gravity[~held], made.wrench[~held]
    moments, offset = plain_least_squares(gravity, wrench)
    chosen = choose_load(gravity, wrench, made.time_s[~held], arm=GALEN)
    expected = chosen.predict(made.gravity[held], made.time_s[held])
    plain = gravity_regressor(made.gravity[held]) @ moments + offset
    return made.expected_rmse(expected, held) / made.expected_rmse(plain, held)


def combination(rng, number):
    """Every kind alone and none in turn, and between them combinations."""
    if number % 4 < 2:
        return ((), *((kind,) for kind in KINDS))[number // 4 % (len(KINDS) + 1)]
    return tuple(kind for kind in KINDS if rng.random() < 0.4)


def ratios(numbers):
    """Expected RMSE (sets, 6) over the plain fit's, on both arms by turns."""
    found = []
    for number in numbers:
        rng = np.random.default_rng(1000 + number)
        kinds = combination(rng, number)
        found.append(compare(rng, (GALEN, SIX_AXIS)[number % 2], kinds))
    return np.array(found)


@pytest.mark.parametrize(
    "sets",
    [
        pytest.param(28, marks=[pytest.mark.slow, pytest.mark.timeout(600)]),
        pytest.param(300, marks=[pytest.mark.soak, pytest.mark.timeout(1800)]),
    ],
)
def test_the_choice_over_many_sets(sets):
    """28 are every kind alone, and none, on both arms, and as many combinations."""
    found = ratios(range(sets))
    assert np.mean(found > 1.05) < 0.03
    assert np.exp(np.mean(np.log(found))) < 0.4


@pytest.mark.parametrize(
    ("seed", "poses", "reason"),
    [(0, slice(None), "held-out blocks"), (9, slice(0, 24, 3), "too few")],
    ids=["healthy", "few poses"],
)
def test_a_healthy_sensor_and_few_poses_get_the_plain_fit(seed, poses, reason):
    made = simulate(np.random.default_rng(seed), GALEN, ())
    gravity, wrench = made.gravity[poses], made.wrench[poses]
    chosen = choose_load(gravity, wrench, made.time_s[poses], arm=GALEN)
    moments, offset = plain_least_squares(gravity, wrench)
    assert chosen.names == (PLAIN, PLAIN) and reason in chosen.reason
    np.testing.assert_allclose(chosen.single.load.load.moments, moments, rtol=1e-9)
    np.testing.assert_allclose(chosen.single.offset, offset, rtol=1e-9)
    assert abs(moments[0] - made.load.mass_kg) < 4.0 * chosen.single.load.mass_std_kg
    if reason != "too few":
        robust = identify_single_load(gravity, wrench, arm=GALEN).load
        np.testing.assert_allclose(chosen.single.load.com_std_m, robust.com_std_m, rtol=0.3)


def test_a_strong_drift_is_explained_and_not_rejected():
    """100 poses whose force drifts far: no pose is rejected, and the mass is right."""
    rng = np.random.default_rng(7)
    made = simulate(rng, SIX_AXIS, ())
    time_s = np.arange(100.0) * 5.0
    angles = rng.uniform(-3.0, 3.0, (100, 6))
    gravity = SIX_AXIS.gravity_in_sensor(angles)
    drift = np.outer(time_s / time_s[-1], [0.0, 0.0, 100.0, 0.0, 0.0, 0.0]) * SIGMA[2]
    wrench = gravity_wrench(gravity, made.load) + drift + SIGMA * rng.standard_normal((100, 6))
    chosen = choose_load(gravity, wrench, time_s, arm=GALEN)
    assert chosen.names[0] == STRUCTURED
    assert chosen.single.used.mean() > 0.95
    assert "drifting bias" in chosen.words
    error = abs(chosen.single.load.mass_kg - made.load.mass_kg)
    assert error < 4.0 * chosen.single.load.mass_std_kg
    assert chosen.single.offset[2] == pytest.approx(drift[-1, 2], abs=0.1 * drift[-1, 2])


def test_a_drift_with_temperature_is_told_from_one_with_time():
    """A cooler that goes on and off: the temperature explains what no curve in time does."""
    rng = np.random.default_rng(11)
    made = simulate(rng, GALEN, ())
    count = len(made.time_s)
    celsius = 30.0 + 2.0 * rng.standard_normal(count)
    by_celsius = np.outer(celsius - 30.0, [10.0, -8.0, 5.0, 10.0, 6.0, -7.0]) * made.noise
    wrench = made.wrench + by_celsius
    chosen = choose_load(made.gravity, wrench, made.time_s, temperature_c=celsius, arm=GALEN)
    assert "temperature" in chosen.words
    error = np.abs(chosen.single.load.load.moments - made.load.moments)
    assert error[0] < 4.0 * chosen.single.load.mass_std_kg
    expected = chosen.predict(made.gravity, made.time_s, celsius)
    assert np.all(np.std(wrench - expected, axis=0) < 1.3 * made.noise)
    assert "temperature" not in choose_load(made.gravity, wrench, made.time_s, arm=GALEN).words


def test_gains_and_a_rotation_are_found_beside_a_step():
    """Ratios of gains and the rotation as they are; a common gain stays in the mass."""
    rng = np.random.default_rng(12)
    made = simulate(rng, SIX_AXIS, ("step", "gains", "rotation"))
    chosen = choose_load(made.gravity, made.wrench, made.time_s, arm=SIX_AXIS)
    assert chosen.names == (STRUCTURED, STRUCTURED)
    assert "step" in chosen.words
    assert chosen.mounting is not None
    force = np.diag(made.response)[:3] * np.ones(3)  # a turn of a degree changes them by 2e-4
    ratio = 1.0 + chosen.mounting.axis_gain[:3]
    np.testing.assert_allclose(ratio / ratio.mean(), force / force.mean(), atol=2e-3)
    assert chosen.single.load.mass_kg == pytest.approx(made.load.mass_kg * force.mean(), rel=2e-3)
    expected = chosen.predict(made.gravity, made.time_s)
    rms = np.sqrt(np.mean((made.wrench - expected) ** 2, axis=0))
    assert np.all(rms < 2.0 * made.noise)


def nominal(angles, load):
    return nominal_reading(angles, load, ADAPTER, arm=GALEN)


def calibration(seed, *, reads=nominal, bias=lambda time_s: 0.0, disturb=lambda w: w, **options):
    """Choose on two sweeps of 40 poses: what the sensor reads of a load, its bias (n, 6) by time,
    and how the readings with the tool are disturbed.
    """
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-1.5, -1.0], [1.5, 0.9], (40, 2))
    sweeps = []
    for load, start_s in ((Load(0.0), 0.0), (RETRACTOR, 100.0)):
        time_s = start_s + 2.0 * np.arange(40)
        wrench = reads(angles, load) + bias(time_s) + SIGMA * rng.standard_normal((40, 6))
        sweeps.append(StillPoses(angles, wrench, None, time_s, arm=GALEN))
    sweeps[1] = replace(sweeps[1], wrench=disturb(sweeps[1].wrench))
    return choose_calibration(*sweeps, **options)


def test_a_calibration_finds_a_turned_sensor_and_stores_it():
    turn = Rotation.from_rotvec([0.02, -0.01, 0.015]).as_matrix()
    compared = []
    found = calibration(
        13,
        reads=lambda angles, load: nominal(angles, load) @ np.kron(np.eye(2), turn),
        progress=compared.append,
    )
    assert found.model == "rotation of the sensor"
    assert any("walk" in text for text in compared)
    assert found.mounting is not None
    np.testing.assert_allclose(found.mounting.sensor_rotvec_rad, [0.02, -0.01, 0.015], atol=1e-3)
    total = found.load.mass_kg + found.adapter.mass_kg
    assert total == pytest.approx(RETRACTOR.mass_kg + ADAPTER.mass_kg, abs=1e-3)
    assert found.used_tool.all() and found.used_bare.all()
    assert np.all(found.rmse < 1.5 * SIGMA)
    assert np.all(found.sigma < 1.5 * SIGMA)


def test_zeros_of_the_joints_are_not_taken_for_a_turned_sensor():
    """Both explain weights; the zeros leave pushes as they are, and what is said names both."""
    zero = GALEN.home_angles + 0.01
    found = calibration(
        15,
        reads=lambda angles, load: nominal_reading(angles + 0.01, load, ADAPTER, zero, arm=GALEN),
    )
    assert "zeros of the joints" in found.model
    assert "rotation" in found.reason
    assert found.mounting is not None
    assert not found.mounting.sensor_rotvec_rad.any()


def test_a_step_after_the_first_poses_and_on_some_axes_is_found():
    step = np.array([40.0, 0.0, 0.0, 0.0, 40.0, 0.0]) * SIGMA
    found = calibration(3, bias=lambda time_s: np.outer(time_s > 105.0, step))
    assert "step" in found.model and "nan" not in found.reason
    assert found.bias_drift is not None
    curves = found.bias_drift.tool
    np.testing.assert_allclose(curves[-1] - curves[0], step, atol=6.0 * SIGMA.max())
    assert found.load.mass_std_kg < 2e-4


def test_touched_poses_that_follow_each_other_are_rejected():
    hit = [4, 5, 6, 20, 21, 30]
    push = 100.0 * SIGMA * np.random.default_rng(4).standard_normal((6, 6))

    def touched(wrench):
        return wrench + np.eye(40)[:, hit] @ push

    found = calibration(3, disturb=touched)
    assert np.flatnonzero(~found.used_tool).tolist() == hit
    assert found.load.mass_std_kg < 2e-4


def test_a_drift_of_one_axis_leaves_the_others_constant():
    drift = np.array([0.0, 60.0, 0.0, 0.0, 0.0, 0.0]) * SIGMA / 180.0
    found = calibration(5, bias=lambda time_s: np.outer(time_s, drift))
    assert found.model.startswith("drifting bias: forces") and "torques constant" in found.model
    assert np.all(np.ptp(found.bias_drift.tool, axis=0)[[0, 2, 3, 4, 5]] == 0.0)


def test_channels_that_are_predicted_exactly_are_compared_too():
    made = simulate(np.random.default_rng(6), SIX_AXIS, ())
    forces = made.wrench * [1, 1, 1, 0, 0, 0]
    for wrench in (forces, np.round(10.0 * forces)):
        assert "held-out blocks" in choose_load(made.gravity, wrench, made.time_s, arm=GALEN).reason
    # torques in steps of 0.05 N.m, most of which are zero
    coarse = calibration(6, disturb=lambda wrench: np.round(20.0 * wrench) / 20).load
    assert abs(coarse.mass_kg - RETRACTOR.mass_kg) < 3.5 * coarse.mass_std_kg
    off = np.abs(coarse.com_m - RETRACTOR.com_m)
    np.testing.assert_array_less(off, 3.5 * coarse.com_std_m)


def test_gross_outliers_are_rejected():
    made, hit = simulate(np.random.default_rng(8), GALEN, ()), [3, 9, 16]
    wrench = made.wrench.copy()
    wrench[hit] += [2.0, -3.0, 2.0, 0.05, 0.05, -0.05]
    chosen = choose_load(made.gravity, wrench, made.time_s, arm=GALEN)
    assert np.flatnonzero(~chosen.single.used).tolist() == hit
    assert PLAIN not in chosen.names


def test_a_comparison_can_be_ended():
    def ended(_):
        raise InterruptedError

    with pytest.raises(InterruptedError):
        calibration(14, progress=ended)
