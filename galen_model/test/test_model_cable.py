# SPDX-License-Identifier: Apache-2.0
"""A cable's pull learned from a sweep: form, likelihood, what it says, when it is rejected."""

import json
from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.calibrated.cable_learning import (
    CableSweep,
    _Likelihood,
    fit_cable,
    learn_cable,
    pose_blocks,
    spacing_rad,
)
from galen_model.errors import CalibrationFileError, IdentificationError, NotExcitedError
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.cable import (
    FORMS,
    form_matrices,
    smooth_kernel,
)
from galen_model.load.model import Load, gravity_wrench
from galen_model.registration import move_wrench
from model_files import SIX_AXIS, calibration, read_content

AT = np.array([0.09, 0.01, 0.05])
ANCHOR = np.array([0.4, 0.3, 0.85])
NOISE = SENSOR.noise_std
WHEN = "2026-01-02T03:04:05+00:00"


def grid(rolls=6, tilts=5):
    roll, tilt = np.meshgrid(
        np.linspace(-1.2, 1.2, rolls), np.linspace(-0.9, 0.8, tilts), indexing="ij"
    )
    joints = np.tile(GALEN.home, (rolls * tilts, 1))
    joints[:, 3], joints[:, 4] = roll.ravel(), tilt.ravel()
    return joints


def between(count=40, seed=3):
    rng = np.random.default_rng(seed)
    joints = np.tile(GALEN.home, (count, 1))
    joints[:, 3] = rng.uniform(-1.2, 1.2, count)
    joints[:, 4] = rng.uniform(-0.9, 0.8, count)
    return joints


def six_axis(count, seed=0):
    """Poses of the six-axis arm in which only the wrist moves; the last joint hardly."""
    joints = np.tile([0.3, -1.2, 1.4, -0.4, 0.9, 0.2], (count, 1))
    joints[:, 3:] += np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)) * [0.8, 0.8, 0.1]
    return joints


def pull(joints, couple=0.0, arm=GALEN):
    """A pull towards an anchor that grows with the distance, and a couple; along ft_sensor."""
    rotation, origin = arm.sensor_pose(joints)
    line = ANCHOR - origin - rotation @ AT
    length = np.linalg.norm(line, axis=1, keepdims=True)
    unit = np.einsum("nji,nj->ni", rotation, line / length)
    force = unit * (0.25 + 1.5 * (length - 0.5))
    return np.concatenate([force, np.cross(AT, force) + couple * np.cross([0, 0, 1], unit)], axis=1)


def sweep_of(wrench, joints, seed=0, scatter=0.0, arm=GALEN):
    rng = np.random.default_rng(seed)
    std = np.tile(NOISE / np.sqrt(250.0), (len(joints), 1))
    noise = rng.normal(size=wrench.shape) * np.hypot(std, scatter * NOISE)
    return CableSweep(joints, wrench + noise, std, NOISE, arm)


@pytest.fixture(scope="module")
def learned():
    joints = grid()
    return learn_cable(sweep_of(pull(joints), joints), WHEN, forms=["point", "free"])


# --- form and likelihood ------------------------------------------------------------------------


def test_a_force_at_a_point_reads_as_a_wrench_moved_from_there():
    joints = between(5)
    rotation, _ = GALEN.sensor_pose(joints)
    rng = np.random.default_rng(1)
    force, couple = rng.normal(size=(2, 3))
    matrices = form_matrices("point_and_couple", joints, AT, arm=GALEN)
    for pose in range(5):
        at_point = move_wrench(np.concatenate([force, couple]), rotation[pose].T, np.zeros(3))
        expected = move_wrench(at_point, np.eye(3), AT)
        found = matrices[0, pose] @ force + matrices[1, pose] @ couple
        assert np.abs(found - expected).max() < 1e-14


@pytest.mark.parametrize(
    ("form", "arm"), [*((form, GALEN) for form in FORMS), ("point_and_couple", SIX_AXIS)]
)
def test_the_likelihoods_gradient_is_that_of_finite_differences(form, arm):
    joints = grid(4, 4) if arm is GALEN else six_axis(16)
    joints[8:, :3] += 0.05
    likelihood = _Likelihood(sweep_of(pull(joints, 0.01, arm), joints, arm=arm), form)
    rng = np.random.default_rng(5)
    lengths = np.linspace(0.9, 1.1, len(arm.turning))
    at = np.concatenate([np.log([*lengths, 0.3, 0.1, 0.01, 0.3]), AT + 0.01])
    at += 0.05 * rng.normal(size=len(at))
    _, gradient = likelihood(at)
    step = 1e-5
    steps = step * np.eye(len(at))
    expected = np.array([likelihood(at + e)[0] - likelihood(at - e)[0] for e in steps]) / (2 * step)
    assert np.abs(gradient - expected).max() < 1e-4 * np.abs(expected).max()


def test_the_pull_is_the_conditional_mean_and_covariance_of_the_process():
    # The same by another way: the readings as sums of drawn latent functions, conditioned in the
    # space of these (information form) instead of in that of the readings.
    joints, at = grid(4, 4), between(3)
    sweep = sweep_of(pull(joints), joints, scatter=0.2)
    drag = replace(fit_cable(sweep, "point", WHEN)[0], inflation=1.0)
    every = np.concatenate([joints, at])
    kernel = smooth_kernel(every, every, drag.posterior.lengths)
    prior = drag.amplitude[0] ** 2 * kernel + 1.0 + 1e-9 * np.eye(len(every))
    latent = np.kron(prior, np.eye(3))
    matrices = form_matrices("point", every, drag.attachment_m, arm=GALEN)[0]
    observe = np.zeros((6 * len(joints), 3 * len(every)))
    for pose in range(len(joints)):
        observe[6 * pose : 6 * pose + 6, 3 * pose : 3 * pose + 3] = matrices[pose]
    information = np.linalg.inv(latent) + observe.T @ (observe / drag.std.ravel()[:, None] ** 2)
    covariance = np.linalg.inv(information)
    mean = covariance @ observe.T @ (drag.wrench.ravel() / drag.std.ravel() ** 2)
    for pose in range(3):
        rows = slice(3 * (len(joints) + pose), 3 * (len(joints) + pose) + 3)
        turned = matrices[len(joints) + pose]
        found = drag.posterior.means(at[pose : pose + 1])[0]
        assert np.abs(found - turned @ mean[rows]).max() < 1e-5
        expected = turned @ covariance[rows, rows] @ turned.T
        got = drag.posterior.process_covariance(at[pose])
        assert np.abs(got - expected).max() < 0.01 * np.abs(expected).max()


# --- what is learned ----------------------------------------------------------------------------


def test_unseen_poses_are_predicted_and_the_attachment_found(learned):
    drag, at = learned.drag, between()
    assert drag.form == "point"
    error = drag.posterior.readings(at) - pull(at)
    assert np.abs(error[:, :3]).max() < 0.004 < 0.1 < np.abs(pull(at)[:, :3]).max()
    assert np.abs(error[:, 3:]).max() < 3e-4
    std = np.sqrt([np.diag(drag.posterior.covariance(q)) for q in at])
    assert np.mean(np.abs(error) < 1.96 * std) > 0.85
    point = fit_cable(sweep_of(pull(grid()), grid()), "point", WHEN)[0]
    assert np.abs(point.attachment_m - AT).max() < 0.001


def test_held_out_blocks_say_what_it_is_worth(learned):
    assert learned.drag.form == min(learned.forms, key=lambda form: learned.forms[form].chi)
    assert learned.held_out.chi < 0.1 * learned.least_squares.chi < learned.file.chi
    assert 0.85 < learned.held_out.coverage <= 1.0
    assert learned.drag.held_out_rmse == pytest.approx(learned.held_out.rmse)
    # No pose is in the block of one that it is predicted from.
    assert np.bincount(learned.block).min() >= 1
    assert len(np.unique(learned.block)) == len(np.unique(pose_blocks(grid()[:, 3:]))) >= 6


@pytest.mark.slow
def test_a_pull_that_is_no_force_at_a_point_chooses_a_form_that_can_tell_it():
    joints = grid()
    sweep = sweep_of(pull(joints, couple=0.03), joints)
    found = learn_cable(sweep, WHEN, forms=["point", "point_and_couple"])
    assert found.drag.form != "point"
    assert found.held_out.chi < 0.6 * found.forms["point"].chi
    at = between()
    error = found.drag.posterior.readings(at) - pull(at, couple=0.03)
    assert np.abs(error[:, :3]).max() < 0.005


def test_outside_the_poses_seen_it_fades_to_nothing_without_a_kink(learned):
    posterior, start = learned.drag.posterior, grid()[7]
    assert posterior.weights(between()).min() == 1.0
    for direction, far in (([1.0, 0.5, 0.3, 0, 0], 0.3), ([0, 0, 0, 0, 1.0], 3.0)):
        way = np.linspace(0.0, far, 3001)[:, None] * np.array(direction)
        path = posterior.readings(start + way)
        assert np.abs(path[-1]).max() == 0.0 < np.abs(path[0]).max()
        # Steps of the slope are as small as a smooth path's: no corner anywhere.
        slope = np.diff(path, axis=0)
        assert np.abs(np.diff(slope, axis=0)).max() < 0.02 * np.abs(slope).max()
        # What is not taken any more is in the covariance.
        std = np.sqrt(np.diag(posterior.covariance(start + way[-1])))
        assert (std > 0.9 * np.abs(posterior.means(start + way[-1:])[0])).all()


def test_poses_at_several_places_of_the_platform_are_covered():
    joints = np.concatenate([grid(5, 4) + [dx, 0.0, 0.0, 0.0, 0.0] for dx in (0.0, 0.06)])
    drag = fit_cable(sweep_of(pull(joints), joints), "point", WHEN)[0]
    assert spacing_rad(joints[:, 3:]) == pytest.approx(0.6, abs=0.05)
    at = between() + [0.03, 0.0, 0.0, 0.0, 0.0]
    error = drag.posterior.readings(at) - pull(at)
    assert np.abs(error[:, :3]).max() < 0.02


def test_on_another_arm_it_is_learned_where_the_sweep_has_been(tmp_path):
    joints, at = six_axis(50), six_axis(30, seed=1)
    found = learn_cable(
        sweep_of(pull(joints, arm=SIX_AXIS), joints, arm=SIX_AXIS), WHEN, forms=["point"]
    )
    assert len(found.drag.length_rad) == 6 and found.held_out.chi < 0.2 * found.least_squares.chi
    inside = found.drag.posterior.weights(at) == 1.0
    assert inside.mean() > 0.7
    error = found.drag.posterior.readings(at[inside]) - pull(at[inside], arm=SIX_AXIS)
    assert np.abs(error[:, :3]).max() < 0.02 < 0.2 < np.abs(pull(at, arm=SIX_AXIS)[:, :3]).max()
    # the arm elsewhere, the wrist as it was: another pull
    assert found.drag.posterior.weights(at + [0, 0, 1.5, 0, 0, 0]).max() == 0.0
    write_calibration(tmp_path / "a.json", calibration(cable=found.drag, arm=SIX_AXIS))
    again = read_calibration(tmp_path / "a.json", SIX_AXIS).cable
    assert np.array_equal(again.posterior.readings(at), found.drag.posterior.readings(at))
    still = six_axis(30) * [1, 1, 1, 1, 0, 0] + [0, 0, 0, 0, 0.9, 0.2]
    with pytest.raises(NotExcitedError, match=r"0 rad of \w+; of two joints at least 0\.3"):
        learn_cable(sweep_of(pull(still, arm=SIX_AXIS), still, arm=SIX_AXIS), WHEN)


# --- rejections -----------------------------------------------------------------------------------


def test_where_there_is_no_cable_none_is_learned():
    joints = grid()
    with pytest.raises(IdentificationError, match="no pull beyond the noise"):
        learn_cable(sweep_of(np.zeros((len(joints), 6)), joints), WHEN)
    load = gravity_wrench(GALEN.gravity_in_sensor(joints[:, 3:]), Load(0.004, AT))
    with pytest.raises(IdentificationError, match="another load explains it"):
        learn_cable(sweep_of(load, joints), WHEN, forms=["point"])
    with pytest.raises(IdentificationError, match="does not tell of the others"):
        learn_cable(sweep_of(np.zeros((len(joints), 6)), joints, scatter=1.0), WHEN, ["free"])


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (grid(5, 3), "15 still poses; at least 16"),
        (grid(11, 11), "121 still poses; at most 120"),
        (grid()[:, [0, 1, 2, 3, 0]], "0 rad of tilt"),
        (grid(4, 4), r"0\.57 rad apart|0\.8 rad apart"),
    ],
)
def test_a_sweep_that_is_too_sparse_is_rejected(joints, words):
    with pytest.raises(NotExcitedError, match=words):
        learn_cable(sweep_of(pull(joints), joints), WHEN)


# --- the file -----------------------------------------------------------------------------------


def test_a_tools_file_keeps_it_and_reads_it_back(learned, tmp_path):
    path, at = tmp_path / "pen.json", between(6)
    write_calibration(path, calibration(cable=learned.drag))
    assert path.stat().st_size < 60_000
    drag = read_calibration(path, arm=GALEN).cable
    assert np.array_equal(drag.posterior.readings(at), learned.drag.posterior.readings(at))
    assert drag.inflation == learned.drag.inflation
    write_calibration(path, replace(read_calibration(path, arm=GALEN), cable=None))
    assert "cable" not in json.loads(path.read_text())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"form": "rope"}, "cable.form.*rope"),
        ({"poses": []}, "cable.poses are 0"),
        ({"poses": "none"}, "cable.poses is not a list"),
        ({"length_rad": [1.0]}, "cable.length_rad"),
        ({"length_rad": [0.0, 1.0]}, "cable.length_rad is not between"),
        ({"amplitude": [float("nan"), 1.0]}, "cable.amplitude"),
        ({"inflation": 0.5}, "cable.inflation"),
        ({"learned_at": ""}, "cable.learned_at"),
        ({"attachment_m": [9.0, 0.0, 0.0]}, "cable.attachment_m"),
    ],
)
def test_a_file_that_was_tampered_with_is_rejected(learned, tmp_path, change, words):
    content = calibration(cable=learned.drag).to_json()
    content["cable"] |= change
    with pytest.raises(CalibrationFileError, match=words):
        read_content(tmp_path, content)
