# SPDX-License-Identifier: Apache-2.0
"""Springs as a model: what they recover, what is not identifiable, how sure they are."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import NOISE, POSITIONS, TIP_M, Arm, in_sensor, recording
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.models.file import KINDS
from galen_deflection.models.interface import FitSettings, FittedRange
from galen_deflection.models.spring_model import SpringBasis, SpringRun
from galen_deflection.models.springs import Springs, kinds
from galen_model.arm.galen import GALEN
from galen_model.errors import KinematicsError
from galen_model.rotation import matrix_to_rotvec

SPRINGS = ["joint_stiffness", "joint_hysteresis"]
LINEAR = [*SPRINGS, "independent", "coupled"]
WORN = Arm(k_roll=1700.0, k_tilt=1800.0, k_carriage=2.4e5, k_rod=1.6e6)


def fit(kind, samples, settings=None):
    return KINDS[kind].fit(samples, settings)


def places(count, seed=0):
    rng = np.random.default_rng(seed)
    spread = np.array([0.1, 0.1, 0.08, 1.4, 0.9])
    return GALEN.home + rng.uniform(-1.0, 1.0, (count, 5)) * spread


@pytest.fixture(scope="module")
def coarse():
    return recording(WORN, seed=1, rate_hz=10.0)


# --- springs ------------------------------------------------------------------------------------


def test_springs_give_the_nominal_deflection_and_are_linear_in_compliances():
    """Against the arm's own deflection, and its differences over each stiffness."""
    joints = places(40)
    wrench = np.random.default_rng(1).normal(size=(40, 6)) * [10, 10, 10, 1, 1, 1]
    design = SpringRun(SpringBasis(TIP_M, arm=GALEN)).rows(joints, wrench)[1]
    nominal = [kind.compliance for kind in kinds(arm=GALEN)]
    theirs = [GALEN.deflection(q, w, TIP_M) for q, w in zip(joints, wrench, strict=True)]
    np.testing.assert_allclose(design @ nominal, theirs, rtol=0, atol=1e-15)
    for k, kind in enumerate(kinds(arm=GALEN)):
        softer = GALEN.with_stiffness({kind.name: 0.5 / kind.compliance})
        for row in range(5):
            step = softer.deflection(joints[row], wrench[row], TIP_M) - theirs[row]
            expected = design[row, :, k] * kind.compliance
            np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-15)


def test_joints_that_deflect_move_the_tip_as_the_kinematics_do():
    """J against finite differences of the forward kinematics, and the delta's own Jacobian."""
    step = 1e-6
    for joints in places(6, seed=4):
        jacobian = Springs(TIP_M, arm=GALEN).geometry(joints[None]).jacobian[0]
        for column, joint in enumerate(GALEN.turning):
            ends = [
                GALEN.tip_pose(joints + sign * step * np.eye(5)[joint], TIP_M) for sign in (-1, 1)
            ]
            (before, from_m), (after, to_m) = ends
            turned = matrix_to_rotvec(after @ before.T) / (2 * step)
            np.testing.assert_allclose(
                jacobian[:, column], [*((to_m - from_m) / (2 * step)), *turned], atol=1e-8
            )
        # a carriage moves the platform without turning it
        moves = np.linalg.inv(GALEN.delta.jacobian(joints[:3]))
        np.testing.assert_allclose(jacobian[:3, 2:5], moves, atol=1e-12)
        np.testing.assert_allclose(jacobian[3:, 2:5], 0.0, atol=1e-12)


def test_rods_that_do_not_reach_are_named():
    for joints in ([GALEN.home, [0.4, 0.0, 0.4, 0.0, 0.0]], [[0.4, 0.0, 0.4, 0.0, 0.0]]):
        with pytest.raises(KinematicsError, match="rod 3 does not reach"):
            Springs(TIP_M, arm=GALEN).geometry(np.array(joints))


# --- parameters ---------------------------------------------------------------------------------


def test_compliances_come_back_within_their_covariance():
    """Squared normalised errors over seeds: 4 a fit if the covariance is right."""
    errors = []
    for seed in range(8):
        model = fit("joint_stiffness", recording(WORN, seed, rate_hz=10.0))
        off = model.values - WORN.compliances
        errors.append(off @ np.linalg.solve(model.covariance, off))
    # chi-squared with 32 degrees of freedom: 32 +- 8; the covariance may be up to 1.3 too large
    assert 12.0 < sum(errors) < 58.0


# --- what is not identifiable -------------------------------------------------------------------


def test_compliances_that_are_not_identifiable_are_named_and_stay_near_nominal():
    """Moments about the base's y at home: tilt and platform turn, roll carries nothing."""
    samples = recording(Arm(k_tilt=1000.0), positions=POSITIONS[:1], axes=[4])
    model = fit("joint_stiffness", samples)
    assert "1/k_roll" in model.unresolved
    assert "1/k_tilt" not in model.unresolved
    by_name = {p.name: k for k, p in enumerate(model.basis.parameters)}
    assert model.values[by_name["1/k_roll"]] == pytest.approx(1.0 / 2000.0, rel=0.2)
    assert model.std[by_name["1/k_roll"]] > 0.4 / 2000.0
    tilt = by_name["1/k_tilt"]
    assert abs(model.values[tilt] - 1e-3) < 4.0 * model.std[tilt]
    assert fit("joint_stiffness", recording()).unresolved == ()


@pytest.mark.parametrize("kind", LINEAR)
def test_samples_that_cannot_be_fitted_to_are_rejected(kind, coarse):
    for samples, settings, words in (
        (replace(coarse, wrench=np.zeros_like(coarse.wrench)), None, "nothing loads the arm"),
        (coarse.rows(slice(0, 0)), None, "no samples"),
        (coarse, FitSettings(use=np.zeros(len(coarse), dtype=bool)), "no samples"),
        (replace(coarse, wrench=np.where(np.arange(6) == 2, np.nan, coarse.wrench)), None,
         "aren't finite"),
        (replace(coarse, wrench=8e151 * np.ones_like(coarse.wrench)), None,
         r"hold 8e\+151, which is no measurement"),
        # A tracker that is simulated without noise.
        (replace(coarse, noise=NOISE * [1, 1, 1, 1, 1, 0]), None,
         r"0\.0001, 0 \(m, rad\): not above zero"),
    ):  # fmt: skip
        with pytest.raises(DeflectionError, match=words):
            fit(kind, samples, settings)


@pytest.mark.parametrize("kind", SPRINGS)
def test_a_spring_that_pushes_back_is_rejected_by_name(kind):
    with pytest.raises(DeflectionError, match=r"1/k_tilt comes out as -0\.0006.*rad/\(N"):
        fit(kind, recording(Arm(k_tilt=-1500.0), rate_hz=10.0))


def test_rigid_carriages_are_not_rejected():
    """Their compliance is zero within its error, and never below."""
    for seed in range(4):
        samples = recording(Arm(k_carriage=1e12), seed, rate_hz=10.0)
        model = fit("joint_stiffness", samples)
        assert 0.0 <= model.values[2] < 5.0 * model.std[2]


# --- uncertainty --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SPRINGS)
def test_errors_at_an_unseen_position_are_as_large_as_predicted(kind):
    """Normalised squared error over all samples, 1 an axis if the covariance is right."""
    ratio = []
    whole = recording(WORN, seed=6, rate_hz=10.0)
    for unseen in (0, 3):
        there = whole.rows(whole.position == unseen)
        predicted = fit(kind, whole.rows(whole.position != unseen)).predict(there)
        off = there.deflection - predicted.mean
        covariance = predicted.covariance + np.diag(NOISE**2)
        solved = np.linalg.solve(covariance, off[..., None])[..., 0]
        ratio.append(np.einsum("ni,ni->n", off, solved))
    assert 0.6 < np.mean(np.concatenate(ratio)) / 6 < 1.3


def test_residuals_of_a_wrong_model_are_its_discrepancy_and_enlarge_the_covariance():
    """Friction that springs don't have: correlated residuals don't count by their samples."""
    rubbing = Arm(friction=(0.3, 0.3, 4.0))
    few, many = (
        fit("joint_stiffness", recording(rubbing, seed=1, rate_hz=rate)) for rate in (12.5, 50.0)
    )
    np.testing.assert_allclose(many.std, few.std, rtol=0.2)  # not half, for four times as many
    assert np.all(np.sqrt(np.diag(few.discrepancy)) > 0.3 * NOISE)
    right = fit("joint_stiffness", recording(WORN, seed=1))
    assert np.all(np.sqrt(np.diag(right.discrepancy)) < 0.15 * NOISE)


# --- the interface ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LINEAR)
def test_a_stream_predicts_what_a_recording_does_segment_by_segment(kind):
    samples = recording(Arm(friction=(0.3, 0.3, 4.0)), rate_hz=10.0)
    rng = np.random.default_rng(0)
    joints = samples.joints + 1e-5 * rng.integers(-2, 3, samples.joints.shape)  # encoder steps
    samples = replace(samples, joints=joints)
    model = fit(kind, samples)
    predicted = model.predict(samples)
    stream = model.stream()
    for segment in list(samples.segments())[:2]:
        stream.reset()
        alone = model.predict(samples.rows(segment))
        np.testing.assert_allclose(alone.mean, predicted.mean[segment], rtol=0, atol=1e-14)
        for k in range(segment.start, segment.stop):
            one = stream.step(int(samples.stamp_ns[k]), samples.joints[k], samples.wrench[k])
            np.testing.assert_allclose(one.mean, predicted.mean[k], rtol=0, atol=1e-14)
            np.testing.assert_allclose(one.covariance, predicted.covariance[k], rtol=0, atol=1e-18)
            assert one.extrapolated == predicted.extrapolated[k]


def test_beyond_load_or_position_it_is_extrapolated(coarse):
    model = fit("joint_stiffness", coarse)
    assert not model.predict(coarse).extrapolated.any()
    one = coarse.rows(slice(0, 1))
    for axis, limit in ((0, 10.0), (4, 0.8)):
        for factor, beyond in ((1.1, False), (1.4, True), (-1.1, False), (-1.4, True)):
            load = factor * limit * np.eye(6)[[axis]]
            at_limit = replace(one, wrench=in_sensor(one.joints, load))
            assert model.predict(at_limit).extrapolated[0] == beyond
    far = one.joints + [[0.0, 0.0, 0.0, 0.0, 1.2]]
    assert model.predict(replace(one, joints=far)).extrapolated[0]
    between = replace(coarse, joints=np.tile(POSITIONS.mean(axis=0), (len(coarse), 1)))
    assert not model.predict(between).extrapolated.any()


def test_a_range_of_positions_keeps_one_for_all_that_are_near_it():
    rng = np.random.default_rng(0)
    joints = np.repeat(POSITIONS, 50, axis=0) + rng.uniform(-1, 1, (200, 5)) * 1e-3
    whole = FittedRange.of(joints, np.zeros((200, 6)), True, GALEN)
    assert len(whole.positions) == 4
    outside = whole.left_by(joints + [[0.0, 0.028, 0.0, 0.0, 0.0]], np.zeros((200, 6)))
    assert not outside.any()
    assert whole.left_by(joints + [[0.0, 0.033, 0.0, 0.0, 0.0]], np.zeros((200, 6))).all()
