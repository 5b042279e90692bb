# SPDX-License-Identifier: Apache-2.0
"""Play operators by their properties, and joint hysteresis on friction of another law."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from deflection_synthetic import NOISE, TIP_M, Arm, dahl, recording, without_noise
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.least_squares import blocks, finished, held_out_cost, sums
from galen_deflection.models.spring_fit import LEADS, OF_PLATFORM, fit_stiffness
from galen_deflection.models.spring_fit import fit_hysteresis as fit
from galen_deflection.models.spring_model import (
    PLATFORM,
    Operator,
    SpringBasis,
    SpringModel,
    SpringRun,
)
from galen_deflection.scoring.score import score
from galen_model.arm.galen import GALEN
from galen_model.play import PlayOperators, SmoothOperators
from galen_model.registration import move_twist, move_wrench
from scipy.integrate import solve_ivp

THRESHOLDS = np.array([0.0, 0.1, 0.35, 0.8])
RUBBING = Arm(friction=(0.3, 0.3, 4.0))


def play(load, thresholds=THRESHOLDS):
    """Outputs (n, 4) of one load (n,)."""
    columns = np.tile(np.asarray(load, dtype=float)[:, None], (1, len(thresholds)))
    return PlayOperators(thresholds).run(columns).output


def ramps(*corners, steps=50):
    """A load (n,) that goes straight from each corner to the next."""
    parts = [np.linspace(a, b, steps + 1)[1:] for a, b in pairwise(corners)]
    return np.concatenate([[corners[0]], *parts])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def rubbed():
    return recording(RUBBING, rate_hz=20.0)


@pytest.fixture(scope="module")
def model(rubbed):
    return fit(rubbed)


# --- the operators ------------------------------------------------------------------------------


def test_a_play_follows_by_as_little_as_it_must():
    load = [0.0, 0.5, 1.0, 0.9, 0.5, 0.0, -1.0, -0.7]
    expected = [0.0, 0.1, 0.6, 0.6, 0.6, 0.4, -0.6, -0.6]
    np.testing.assert_allclose(play(load, np.array([0.4]))[:, 0], expected, atol=1e-15)


def test_a_larger_load_wipes_out_smaller_ones():
    quiet = play(ramps(0.0, 2.0, -1.0, 0.3))
    busy = play(ramps(0.0, 1.2, -0.4, 0.9, 0.1, 2.0, -1.0, 0.5, -0.2, 0.5, -1.0, 0.3))
    np.testing.assert_allclose(busy[-51:], quiet[-51:], atol=1e-14)
    other = play(ramps(0.0, 2.0, -0.5, 0.3))
    assert np.abs(other[-1] - quiet[-1]).max() > 0.1  # memory there is, of what was not wiped out


def test_weights_that_are_not_negative_dissipate():
    """Work over a closed loop: positive, and for one play 4 r (L - r)."""
    load = ramps(0.0, 1.0, -1.0, 1.0, steps=400)
    loop = slice(400, None)
    for column, threshold in enumerate(THRESHOLDS):
        output = play(load)[loop, column]
        middle = 0.5 * (load[loop][1:] + load[loop][:-1])
        work = float(middle @ np.diff(output))
        assert work == pytest.approx(4.0 * threshold * (1.0 - threshold), abs=0.01)


def test_plays_of_a_load_invert_maxwell_slip():
    """A spring beside slipping ones, driven by displacement: the load it needs gives it back."""
    spring, stiffness, slip_at = 1000.0, np.array([800.0, 500.0]), np.array([1e-3, 3e-3])
    moved = 1e-3 * ramps(0.0, 2.0, -1.0, 0.5, -0.7, 5.0, -6.0, 1.0, steps=500)
    slipping = (
        np.tile(moved[:, None], (1, 2))
        - PlayOperators(slip_at).run(np.tile(moved[:, None], (1, 2))).output
    )
    load = spring * moved + slipping @ stiffness
    # on the virgin curve slopes are k + all, k + those not yet slipping, k; r are loads there
    slopes = spring + np.array([stiffness.sum(), stiffness[1], 0.0])
    thresholds = np.array([slopes[0] * slip_at[0], 0.0])
    thresholds[1] = thresholds[0] + slopes[1] * (slip_at[1] - slip_at[0])
    weights = np.diff(1.0 / slopes)
    found = load / slopes[0] + play(load, thresholds) @ weights
    np.testing.assert_allclose(found, moved, atol=1e-12)


def test_the_spread_bounds_every_past_and_is_gone_once_the_load_has_swept_it():
    rng = np.random.default_rng(3)
    load = np.concatenate([0.1 * rng.normal(size=100), ramps(0.0, 0.7, -0.5, 1.65, 0.0)])
    thresholds = THRESHOLDS[1:]
    tiled = np.tile(load[:, None], (1, 3))
    ours = PlayOperators(thresholds).run(tiled)
    assert np.all(np.diff(ours.spread, axis=0) <= 0.0)
    unloaded = PlayOperators(thresholds).run(np.zeros((1, 3)))
    np.testing.assert_allclose(unloaded.spread[0], 2 * thresholds)
    for _ in range(20):
        past = PlayOperators(thresholds)
        past.run(rng.normal(size=(30, 1)) * np.ones(3))
        other = past.run(tiled).output
        assert np.all(np.abs(other - ours.output) <= ours.spread + 1e-12)
    swept = np.maximum.accumulate(load) - np.minimum.accumulate(load)
    for column, threshold in enumerate(thresholds):
        # zero as soon as the load has swept twice the threshold, and not before
        np.testing.assert_array_equal(
            ours.spread[:, column] < 1e-12, swept >= 2.0 * threshold - 1e-12
        )


# --- the model ----------------------------------------------------------------------------------


def test_friction_of_another_law_is_predicted_at_an_unseen_position():
    """Down to the noise, and what is left at zero load within a tenth of the true deflection."""
    unseen = 3
    whole = recording(RUBBING, seed=unseen, rate_hz=30.0)
    clean = without_noise(whole, RUBBING).deflection
    there = whole.position == unseen
    model = fit(whole.rows(~there))
    assert model.notes == ()
    mean = model.predict(whole.rows(there)).mean
    assert rms((whole.deflection[there] - mean) / NOISE) < 1.05
    assert rms((clean[there] - mean) / NOISE) < 0.12
    springs = fit_stiffness(whole.rows(~there)).predict(whole.rows(there)).mean
    assert rms((whole.deflection[there] - springs) / NOISE) > 1.2  # without the memory
    at_rest = np.all(whole.wrench[there] == 0.0, axis=1)
    left = clean[there][at_rest]
    assert np.abs(left[:, :3]).max() > 40e-6  # there is something to predict
    assert rms((mean[at_rest] - left) / NOISE) < 0.1 * rms(left / NOISE)


def test_an_arm_of_plays_gives_its_weights_back():
    """Fitted with the operators it was made of, within their covariance."""
    basis = SpringBasis(
        TIP_M,
        (
            Operator("roll", "play", (0.5,)),
            Operator("tilt", "play", (0.4,)),
            Operator("carriage", "play", (3.0,) * 3),
        ),
        arm=GALEN,
    )
    true = np.array([5e-4, 6e-4, 3e-6, 5e-7, 1e-4, 2e-4, 1e-6])
    pushed = recording(rate_hz=10.0)
    made = _of(basis, true, pushed).predict(pushed).mean
    errors = []
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(size=made.shape) * NOISE
        samples = replace(pushed, deflection=made + noise)
        model = finished("x", basis, samples, sums(basis, samples, FitSettings()))
        off = model.values - true
        errors.append(off @ np.linalg.solve(model.covariance, off))
    assert 14.0 < sum(errors) < 80.0  # chi-squared with 42 degrees of freedom: 42 +- 9


def test_no_hysteresis_is_found_where_there_is_none():
    found = [fit(recording(seed=seed, rate_hz=10.0)).basis.operators for seed in (0, 1, 2)]
    assert sum(len(operators) > 0 for operators in found) <= 1


def test_the_held_out_cost_is_that_of_samples_which_the_fit_has_not_seen(rubbed):
    """Position by position, against a fit of the springs alone to the other three."""
    basis = SpringBasis(TIP_M, arm=GALEN)
    costs = held_out_cost(sums(basis, rubbed, FitSettings()), basis)
    for position in range(4):
        there = rubbed.position == position
        mean = fit_stiffness(rubbed.rows(~there)).predict(rubbed.rows(there)).mean
        cost = np.sum(((rubbed.deflection[there] - mean) / NOISE) ** 2)
        assert costs[position] == pytest.approx(cost, rel=1e-6)


@pytest.mark.filterwarnings("error")
def test_one_stretch_of_load_tells_no_hysteresis():
    short = recording(RUBBING, rate_hz=25.0).rows(slice(70, 160))
    assert len(blocks(short)) == 1  # there is nothing to hold out
    basis = fit(short).basis
    assert basis.operators == ()


@pytest.mark.parametrize(
    ("place", "shape", "notes"),
    [
        (PLATFORM, "play", (OF_PLATFORM,)),
        ("roll", "stop", (LEADS,)),
        (PLATFORM, "stop", (OF_PLATFORM, LEADS)),
    ],
)
def test_what_no_joint_does_is_fitted_and_said(place, shape, notes):
    """Hysteresis of the platform as a whole, and a deflection that leads its load."""
    samples = recording(seed=5, rate_hz=15.0)
    anywhere = SpringBasis(TIP_M, (Operator(PLATFORM, "play", (0.0,) * 6),), arm=GALEN)
    motion = SpringRun(anywhere).loads(samples.joints, samples.wrench)[3][
        :, SpringBasis(TIP_M, arm=GALEN).columns[PLATFORM]
    ]
    largest = np.abs(motion).max(axis=0)
    thresholds = tuple((0.2 * largest).tolist()) if place == PLATFORM else (0.3,)
    weight = 0.4 if place == PLATFORM else 3e-4
    basis = SpringBasis(TIP_M, (Operator(place, shape, thresholds),), arm=GALEN)
    true = np.append(np.array([5e-4, 6e-4, 3e-6, 5e-7]), weight)
    clean = _of(basis, true, samples).predict(samples).mean
    noise = np.random.default_rng(0).normal(size=clean.shape) * NOISE
    model = fit(replace(samples, deflection=clean + noise))
    assert model.notes == notes
    assert rms((model.predict(samples).mean - clean) / NOISE) < 0.25


@pytest.mark.parametrize("loaded_with", [0.0, 0.3, 1.0, -2.0])
def test_a_start_under_load_bounds_every_past(loaded_with):
    """How a load that is there at the start came to be is not known."""
    thresholds = THRESHOLDS[1:]
    load = np.tile(ramps(loaded_with, 0.5 * loaded_with, loaded_with + 0.2)[:, None], (1, 3))
    ours = PlayOperators(thresholds).run(load)
    ends = []
    for extreme in (-10.0, 10.0):
        past = PlayOperators(thresholds)
        past.run(np.full((1, 3), extreme))
        ends.append(past.run(load).output)
    np.testing.assert_allclose(ends[1] - ends[0], ours.spread, atol=1e-14)
    between = np.linspace(ends[0], ends[1], 20001)
    rms = np.sqrt(np.mean((between - ours.output) ** 2, axis=0))
    np.testing.assert_allclose(ours.unknown, rms, rtol=1e-3, atol=1e-12)


def _of(basis, values, samples):
    """A model with given values."""
    known = fit_stiffness(samples)
    size = len(values)
    return SpringModel(
        "x", basis, values, np.zeros((size, size)), np.zeros((6, 6)), NOISE,
        known.fitted_range, known.fitted_on,
    )  # fmt: skip


def test_the_platforms_motion_is_that_of_its_centre():
    """Against the nominal model: a tip at the platform's centre would move so."""
    samples = recording(seed=5, rate_hz=5.0).rows(slice(0, None, 40))
    basis = SpringBasis(TIP_M, (Operator(PLATFORM, "play", (0.0,) * 6),), arm=GALEN)
    _, _, jacobian, loads = SpringRun(basis).loads(samples.joints, samples.wrench)
    columns = list(SpringBasis(TIP_M, arm=GALEN).columns[PLATFORM])
    for row in range(len(samples)):
        joints = samples.joints[row]
        _, tip = GALEN.tip_pose(joints, TIP_M)
        rotation, origin = GALEN.sensor_pose(joints)
        wrench = move_wrench(samples.wrench[row], rotation, origin - joints[:3])
        twist = np.linalg.solve(GALEN.delta.platform_stiffness(joints[:3]), wrench)
        np.testing.assert_allclose(loads[row, columns], twist, rtol=1e-9, atol=1e-15)
        moved = jacobian[row][:, columns] @ twist
        np.testing.assert_allclose(moved, move_twist(twist, joints[:3], tip), rtol=1e-9, atol=1e-15)


# --- smooth operators ---------------------------------------------------------------------------

R = np.array([0.1, 0.4, 1.5])


def smooth(load, thresholds=R):
    columns = np.tile(np.asarray(load, dtype=float)[:, None], (1, len(thresholds)))
    return SmoothOperators(thresholds).run(columns)


def test_against_the_differential_equation():
    """Bouc and Wen's equation in time, with n = 1 and beta = gamma = 1/2, by a general solver."""
    corners = np.array([0.0, 0.8, -0.3, 0.5, 0.45, -1.0, 0.0])

    def rate(t, z):
        k = min(int(t), len(corners) - 2)
        dx = corners[k + 1] - corners[k]
        return (dx - 0.5 * abs(dx) * z - 0.5 * dx * np.abs(z)) / R

    solved = solve_ivp(
        rate, (0.0, 6.0), np.zeros(3), t_eval=np.arange(7.0), rtol=1e-10, atol=1e-12, max_step=0.01
    )
    expected = corners[:, None] - R * solved.y.T
    np.testing.assert_allclose(smooth(corners).output, expected, atol=1e-6)


def test_what_soft_friction_leaves_at_no_load_is_predicted():
    """Soft friction in every spring, rods included, which never quite slides; on pushes not seen.

    The friction acts on each spring's own motion and follows another law: it bends at once on the
    way back, too.
    """
    samples = recording(seed=6, rate_hz=20.0, sets=2)
    rubbed = _rubbed(samples)
    there = rubbed.set_number == 1
    model = fit(rubbed.rows(~there))
    assert {operator.shape for operator in model.basis.operators} == {"smooth_play"}
    rests = score(rubbed.rows(there), model.predict(rubbed.rows(there))).rests
    gain, noise = rests.gain(slice(0, 3))
    assert abs(gain - 1.0) < 0.1 + 2.0 * noise
    assert "rod" in {operator.place for operator in model.basis.operators}


def _rubbed(samples):
    """Dahl's friction beside each spring: a fifth of its stiffness, half of its largest load."""
    basis = SpringBasis(TIP_M, arm=GALEN)
    clean = np.zeros_like(samples.deflection)
    for segment in np.unique(samples.segment):
        rows = samples.segment == segment
        _, _, jacobian, loads = SpringRun(basis).loads(samples.joints[rows], samples.wrench[rows])
        for compliance, (place, friction) in zip(Arm().compliances, _FRICTION.items(), strict=True):
            for column in basis.columns[place]:
                moved = dahl(loads[:, column], 1.0 / compliance, friction, share=0.2)
                clean[rows] += jacobian[:, :, column] * moved[:, None]
    noise = np.random.default_rng(7).normal(size=clean.shape) * NOISE
    return replace(samples, deflection=clean + noise)


_FRICTION = {"roll": 0.3, "tilt": 0.3, "carriage": 3.0, "rod": 12.0}
