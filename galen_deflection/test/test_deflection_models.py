"""Independent axes, coupled axes and joint stiffness: what they recover, and where they fail."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import NOISE, POSITIONS, TIP_M, Arm, in_sensor, recording, without_noise
from galen_deflection.errors import FitError, NegativeComplianceError
from galen_deflection.models.fitted_range import FittedRange
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.joint_stiffness import StiffnessBasis
from galen_deflection.models.least_squares import BLOCK_S, blocks, folds
from galen_deflection.models.registry import KINDS
from galen_deflection.springs.springs import Springs, TipWrench, kinds
from galen_model.arm.galen import GALEN, HOME, LIMITS
from galen_model.arm.kinematics import tip_pose
from galen_model.arm.stiffness import deflection, tip_compliance
from galen_model.errors import KinematicsError
from galen_model.rotation import matrix_to_rotvec

ALL = [kind for kind, what in KINDS.items() if not what.is_network]
WORN = Arm(k_roll=1700.0, k_tilt=1800.0, k_carriage=2.4e5, k_rod=1.6e6)


def fit(kind, samples):
    return KINDS[kind].fit(samples, None)


def places(count, seed=0):
    rng = np.random.default_rng(seed)
    spread = np.array([0.1, 0.1, 0.08, 1.4, 0.9])
    return HOME + rng.uniform(-1.0, 1.0, (count, 5)) * spread


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def coarse():
    return recording(WORN, seed=1, rate_hz=10.0)


@pytest.fixture(scope="module")
def pushed():
    return recording(WORN, seed=1)


# --- springs ------------------------------------------------------------------------------------


def test_springs_give_the_nominal_deflection_to_rounding():
    joints = places(40)
    wrench = np.random.default_rng(1).normal(size=(40, 6)) * [10, 10, 10, 1, 1, 1]
    design = StiffnessBasis(TIP_M).run().rows(joints, wrench).design
    ours = design @ [kind.compliance for kind in kinds()]
    theirs = [deflection(q, w, TIP_M) for q, w in zip(joints, wrench, strict=True)]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-15)


def test_a_deflection_is_linear_in_the_compliances():
    """Against finite differences of the nominal model, over each compliance."""
    joints, wrench = places(5, seed=2), np.random.default_rng(3).normal(size=(5, 6))
    design = StiffnessBasis(TIP_M).run().rows(joints, wrench).design
    fields = ("roll", "tilt", "carriage", "rod")
    for k, (name, kind) in enumerate(zip(fields, kinds(), strict=True)):
        # twice as compliant: a difference as large as the compliance itself
        softer = GALEN.with_stiffness({name: 0.5 / kind.compliance})
        for row in range(5):
            step = deflection(joints[row], wrench[row], TIP_M, softer)
            step -= deflection(joints[row], wrench[row], TIP_M)
            np.testing.assert_allclose(
                step, design[row, :, k] * kind.compliance, rtol=1e-9, atol=1e-15
            )


def test_joints_that_give_move_the_tip_as_the_kinematics_say():
    """J against finite differences of the forward kinematics, and the delta's own Jacobian."""
    step = 1e-6
    for joints in places(6, seed=4):
        jacobian = Springs(TIP_M).jacobian(joints[None])[0]
        for column, joint in ((0, 3), (1, 4)):
            ends = []
            for sign in (-1.0, 1.0):
                moved = joints.copy()
                moved[joint] += sign * step
                ends.append(tip_pose(moved, TIP_M))
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
    with pytest.raises(KinematicsError, match="rod 3 does not reach"):
        Springs(TIP_M).jacobian(np.array([HOME, [0.4, 0.0, 0.4, 0.0, 0.0]]))


def test_one_joint_vector_after_another_is_as_all_at_once():
    """Also where joints come again after others: what is kept from call to call must not show."""
    joints = places(6)[[0, 0, 1, 2, 2, 0, 3, 3]]
    springs = Springs(TIP_M)
    single = np.concatenate([springs.jacobian(q[None]) for q in joints])
    np.testing.assert_allclose(Springs(TIP_M).jacobian(joints), single, rtol=0, atol=1e-13)


def test_one_pose_is_calculated_as_many_are():
    """The two ways to the same numbers, in all of the arm's room."""
    rng = np.random.default_rng(8)
    joints = np.array([0.0, 0.0, 0.408, 0.0, 0.0]) + rng.uniform(-1, 1, (200, 5)) * [
        *(0.1, 0.1, 0.1, np.pi, np.pi / 2)
    ]
    wrench = rng.normal(size=(200, 6))
    one, many = Springs(TIP_M), Springs(TIP_M).geometry(joints)
    to_tip = TipWrench(TIP_M)
    at_tip = to_tip(joints, wrench)
    for k in range(200):
        single = one.geometry(joints[k : k + 1])
        np.testing.assert_allclose(single.jacobian[0], many.jacobian[k], rtol=0, atol=1e-13)
        np.testing.assert_allclose(single.lever[0], many.lever[k], rtol=0, atol=1e-15)
        alone = to_tip(joints[k : k + 1], wrench[k : k + 1])
        np.testing.assert_allclose(alone[0], at_tip[k], rtol=0, atol=1e-14)


def test_the_wrench_at_the_tip_does_the_same_work():
    """Power of a rigid motion: the same by the sensor's wrench and by the tip's."""
    joints = places(3, seed=6)
    wrench = np.random.default_rng(7).normal(size=(3, 6))
    at_tip = TipWrench(TIP_M)(joints, wrench)
    turn = np.array([0.3, -0.2, 0.5])
    for k in range(3):
        rotation, _ = tip_pose(joints[k], TIP_M)
        at_sensor = np.cross(turn, -rotation @ TIP_M)  # the tip stands still
        power = rotation @ wrench[k, :3] @ at_sensor + rotation @ wrench[k, 3:] @ turn
        assert at_tip[k, 3:] @ turn == pytest.approx(power, rel=1e-12)


# --- parameters ---------------------------------------------------------------------------------


def test_compliances_come_back_within_their_covariance():
    """Squared normalised errors over seeds: 4 a fit if the covariance is right."""
    errors = []
    for seed in range(15):
        model = fit("joint_stiffness", recording(WORN, seed, rate_hz=10.0))
        off = model.values - WORN.compliances
        errors.append(off @ np.linalg.solve(model.covariance, off))
    # chi-squared with 60 degrees of freedom: 60 +- 11; the covariance may be up to 1.3 too large
    assert 30.0 < sum(errors) < 95.0


def test_the_covariance_is_cramer_and_raos():
    """The bound from the nominal model itself, by its differences over each compliance."""
    samples = recording(WORN, seed=2, rate_hz=4.0)
    information = np.zeros((4, 4))
    names = ("roll", "tilt", "carriage", "rod")
    stiff = GALEN.with_stiffness(dict.fromkeys(names, 1e15))
    unit = [stiff.with_stiffness({name: 1.0}) for name in names]
    at_tip = TipWrench(TIP_M)(samples.joints, samples.wrench)
    for place in POSITIONS:
        rows = np.all(samples.joints == place, axis=1)
        slopes = np.stack([at_tip[rows] @ tip_compliance(place, TIP_M, arm).T for arm in unit], 2)
        slopes /= NOISE[:, None]
        information += np.einsum("nip,niq->pq", slopes, slopes)
    bound = np.linalg.inv(information)
    ratio = np.diag(fit("joint_stiffness", samples).covariance) / np.diag(bound)
    assert np.all(ratio > 1.0 - 1e-6)
    assert np.all(ratio < 1.8)  # what the blocks' few sums make of pure noise


def test_unseen_positions_are_at_the_noise_for_springs_and_not_for_axes():
    """The report's finding, and its answer: train at three positions, check at the fourth."""
    error, score = dict.fromkeys(ALL, 0.0), dict.fromkeys(ALL, 0.0)
    whole = recording(WORN, seed=3, rate_hz=20.0)
    clean = without_noise(whole, WORN)
    for unseen in range(4):
        there = whole.position == unseen
        for kind in ("independent", "coupled", "joint_stiffness"):
            model = fit(kind, whole.rows(~there))
            mean = model.predict(whole.rows(there)).mean
            error[kind] += rms((mean - clean.deflection[there]) / NOISE) / 4
            score[kind] += rms((mean - whole.deflection[there]) / NOISE) / 4
    assert score["joint_stiffness"] < 1.03
    assert error["joint_stiffness"] < 0.05
    assert score["independent"] > 1.7
    assert score["coupled"] > 1.4
    assert error["independent"] > error["coupled"] > 20.0 * error["joint_stiffness"]


def test_coupled_axes_are_enough_at_one_position():
    """There, and only there, the arm is a 6 x 6 matrix: the nominal one."""
    samples = recording(Arm(), seed=4, positions=POSITIONS[1:2])
    model = fit("coupled", samples)
    off = (model.values - tip_compliance(POSITIONS[1], TIP_M).ravel()) / model.std
    assert rms(off) < 1.4
    assert np.abs(off).max() < 4.5
    residual = samples.deflection - model.predict(samples).mean
    assert rms(residual / NOISE) < 1.03


def test_independent_axes_are_those_of_the_base_at_the_tip():
    """An arm that is made of six springs there: the model finds them at any position."""
    stiff = np.array([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
    samples = recording(seed=5)
    at_tip = TipWrench(TIP_M)(samples.joints, samples.wrench)
    noise = samples.noise * np.random.default_rng(0).normal(size=at_tip.shape)
    model = fit("independent", replace(samples, deflection=at_tip * stiff + noise))
    assert np.all(np.abs(model.values - stiff) < 4.0 * model.std)
    assert np.all(model.std < 0.12 * stiff)


# --- what samples don't tell --------------------------------------------------------------------


def test_compliances_that_pushes_do_not_tell_are_named_and_stay_near_nominal():
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


def test_an_axis_that_was_never_pushed_is_named_and_predicted_as_unknown():
    samples = recording(positions=POSITIONS[:1], axes=[0, 1, 2])
    model = fit("independent", samples)
    assert model.unresolved == ("rx/tx", "ry/ty", "rz/tz")
    torque = replace(
        samples, wrench=in_sensor(samples.joints, np.tile(0.5 * np.eye(6)[3], (len(samples), 1)))
    )
    predicted = model.predict(torque)
    assert predicted.extrapolated.all()
    nominal = tip_compliance(HOME, TIP_M)[3, 3] * 0.5
    assert np.sqrt(predicted.covariance[0, 3, 3]) > 0.9 * nominal


@pytest.mark.parametrize("kind", ALL)
def test_samples_without_load_are_rejected(kind):
    samples = recording(rate_hz=10.0)
    with pytest.raises(FitError, match=f"{kind}: nothing loads the arm"):
        fit(kind, replace(samples, wrench=np.zeros_like(samples.wrench)))
    with pytest.raises(FitError, match="no samples"):
        fit(kind, samples.rows(slice(0, 0)))
    with pytest.raises(FitError, match="aren't finite"):
        fit(kind, replace(samples, wrench=np.where(np.arange(6) == 2, np.nan, samples.wrench)))


@pytest.mark.parametrize("kind", ALL)
def test_what_is_no_measurement_is_rejected(kind):
    samples = recording(rate_hz=10.0)
    with pytest.raises(FitError, match=r"hold 8e\+151, which is no measurement"):
        fit(kind, replace(samples, wrench=8e151 * np.ones_like(samples.wrench)))
    # A tracker that is simulated without noise.
    with pytest.raises(FitError, match=r"0\.0001, 0 \(m, rad\): not above zero"):
        fit(kind, replace(samples, noise=NOISE * [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]))


@pytest.mark.parametrize("kind", ["joint_stiffness", "joint_hysteresis"])
def test_a_spring_that_pushes_back_is_rejected_by_name(kind):
    with pytest.raises(NegativeComplianceError, match=r"1/k_tilt comes out as -0\.0006.*rad/\(N"):
        fit(kind, recording(Arm(k_tilt=-1500.0), rate_hz=10.0))


def test_rigid_carriages_are_not_rejected():
    """Their compliance is zero within its error, and never below."""
    for seed in range(8):
        samples = recording(Arm(k_carriage=1e12), seed, rate_hz=10.0)
        model = fit("joint_stiffness", samples)
        assert 0.0 <= model.values[2] < 5.0 * model.std[2]


# --- uncertainty --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL)
def test_errors_at_an_unseen_position_are_as_large_as_predicted(kind):
    """Normalised squared error over all samples, 1 an axis if the covariance is right."""
    ratio = []
    whole = recording(WORN, seed=6, rate_hz=10.0)
    for unseen in range(4):
        there = whole.rows(whole.position == unseen)
        predicted = fit(kind, whole.rows(whole.position != unseen)).predict(there)
        off = there.deflection - predicted.mean
        covariance = predicted.covariance + np.diag(NOISE**2)
        ratio.append(
            np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
        )
    mean = np.mean(np.concatenate(ratio)) / 6
    assert 0.6 < mean < 1.3


def test_the_discrepancy_is_what_a_model_leaves_beyond_the_noise(pushed):
    assert np.all(np.sqrt(np.diag(fit("joint_stiffness", pushed).discrepancy)) < 0.15 * NOISE)
    assert np.all(np.sqrt(np.diag(fit("independent", pushed).discrepancy)) > 0.8 * NOISE)


def test_residuals_that_hang_together_enlarge_the_covariance(pushed):
    """A model that is wrong at every push is not sure of its parameters by counting samples."""
    faster = recording(WORN, seed=1, rate_hz=200.0)
    few, many = fit("independent", pushed), fit("independent", faster)
    np.testing.assert_allclose(many.std, few.std, rtol=0.15)  # not half, for four times as many


def test_blocks_and_folds_never_mix_places(pushed):
    twice = recording(WORN, sets=2, rate_hz=20.0)
    for samples in (pushed, twice):
        parts = blocks(samples)
        assert [part.start for part in parts[1:]] == [part.stop for part in parts[:-1]]
        assert parts[0].start == 0 and parts[-1].stop == len(samples)
        labels = folds(samples, parts)
        assert len(np.unique(labels)) == len(np.unique(samples.segment))
        for part, label in zip(parts, labels, strict=True):
            assert np.ptp(samples.segment[part]) == 0
            assert np.ptp(samples.stamp_ns[part]) * 1e-9 <= BLOCK_S
            assert np.all(labels[[p.start == part.start for p in parts]] == label)
    alone = recording(WORN, positions=POSITIONS[:1])
    assert len(np.unique(folds(alone, blocks(alone)))) == 4


# --- the interface ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL)
def test_a_stream_predicts_what_a_recording_does(kind):
    samples = recording(Arm(friction=(0.3, 0.3, 4.0)), rate_hz=10.0)
    rng = np.random.default_rng(0)
    joints = samples.joints + 1e-5 * rng.integers(-2, 3, samples.joints.shape)  # encoder steps
    samples = replace(samples, joints=joints)
    model = fit(kind, samples)
    predicted = model.predict(samples)
    stream = model.stream()
    segment = samples.segment[0]
    for k in range(len(samples)):
        if samples.segment[k] != segment:
            segment = samples.segment[k]
            stream.reset()
        one = stream.step(int(samples.stamp_ns[k]), samples.joints[k], samples.wrench[k])
        np.testing.assert_allclose(one.mean, predicted.mean[k], rtol=0, atol=1e-14)
        np.testing.assert_allclose(one.covariance, predicted.covariance[k], rtol=0, atol=1e-18)
        assert one.extrapolated == predicted.extrapolated[k]


@pytest.mark.parametrize("kind", ALL)
def test_segments_are_predicted_each_on_its_own(kind):
    samples = recording(Arm(friction=(0.3, 0.3, 4.0)), rate_hz=10.0)
    model = fit(kind, samples)
    whole = model.predict(samples)
    for segment in np.unique(samples.segment):
        rows = samples.segment == segment
        alone = model.predict(samples.rows(rows))
        np.testing.assert_allclose(alone.mean, whole.mean[rows], rtol=0, atol=1e-14)
    assert np.all(model.predict(samples.rows(slice(0, 0))).mean == 0.0)


@pytest.mark.parametrize("kind", ALL)
def test_beyond_load_or_position_it_says_so(kind, coarse):
    model = fit(kind, coarse)
    assert not model.predict(coarse).extrapolated.any()
    one = coarse.rows(slice(0, 1))
    for axis, limit in ((0, 10.0), (4, 0.8)):
        for sign in (1.0, -1.0):
            for factor, beyond in ((1.1, False), (1.4, True)):
                load = sign * factor * limit * np.eye(6)[[axis]]
                at_limit = replace(one, wrench=in_sensor(one.joints, load))
                assert model.predict(at_limit).extrapolated[0] == beyond
    far = one.joints + [[0.0, 0.0, 0.0, 0.0, 1.2]]
    assert model.predict(replace(one, joints=far)).extrapolated[0]


def test_only_models_that_know_the_arm_interpolate_between_positions(coarse):
    between = replace(coarse, joints=np.tile(POSITIONS.mean(axis=0), (len(coarse), 1)))
    for kind in ALL:
        extrapolated = fit(kind, coarse).predict(between).extrapolated.any()
        assert extrapolated == (kind in ("independent", "coupled"))


def test_a_range_keeps_one_position_for_all_that_are_near_it():
    rng = np.random.default_rng(0)
    joints = np.repeat(POSITIONS, 50, axis=0) + rng.uniform(-1, 1, (200, 5)) * 1e-3
    whole = FittedRange.of(joints, np.zeros((200, 6)), only_nearby=True)
    assert len(whole.positions) == 4
    outside = whole.left_by(joints + [[0.0, 0.028, 0.0, 0.0, 0.0]], np.zeros((200, 6)))
    assert not outside.any()
    assert whole.left_by(joints + [[0.0, 0.033, 0.0, 0.0, 0.0]], np.zeros((200, 6))).all()


def test_positions_in_the_tests_are_within_the_arms_limits():
    assert np.all((LIMITS.lower <= POSITIONS) & (LIMITS.upper >= POSITIONS))


@pytest.mark.parametrize("kind", ALL)
def test_a_fit_looks_at_no_deflection_that_it_may_not_use(kind, coarse):
    """Others' deflections may be anything; what was used gives the same as alone."""
    use = coarse.position < 2
    hidden = coarse.deflection.copy()
    hidden[~use] = np.nan
    settings = FitSettings(use=use)
    masked = KINDS[kind].fit(replace(coarse, deflection=hidden), settings)
    alone = KINDS[kind].fit(coarse.rows(use), None)
    np.testing.assert_allclose(masked.values, alone.values, rtol=1e-9)
    np.testing.assert_allclose(masked.covariance, alone.covariance, rtol=1e-6, atol=1e-18)
    assert masked.fitted_on == alone.fitted_on
    np.testing.assert_array_equal(masked.fitted_range.joints_high, alone.fitted_range.joints_high)


def test_nothing_to_use_is_rejected(pushed):
    with pytest.raises(FitError, match="no samples"):
        KINDS["coupled"].fit(pushed, FitSettings(use=np.zeros(len(pushed), dtype=bool)))
