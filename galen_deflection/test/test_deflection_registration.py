# SPDX-License-Identifier: Apache-2.0
"""The tracker's registration: truth recovered, what can't be told rejected, what's wrong told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_deflection.measurement.measured_deflection import measure_deflection
from galen_deflection.measurement.push_recording import read_pushes
from galen_deflection.measurement.registration import RegistrationError, RestPose, register
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.registration import IDENTITY, Transform
from galen_model.rotation import rotvec_to_matrix
from push_bag import BASE_MARKER, NOISE, POSITIONS, TOOL, Scene, repeated, write
from scipy.stats import chi2

SHARED = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "disclosed"
OFFSET = Transform(rotvec_to_matrix([0.02, -0.03, 0.5]), np.array([0.12, -0.34, 0.21]))
SAMPLES = 100


def rests(
    positions=POSITIONS, offset=IDENTITY, seed=None, zeros=0.0, tip_m=TOOL.tip_m, samples=SAMPLES
):
    """Rests of an arm whose true joints are the reported ones and `zeros`; no noise by default."""
    rng = np.random.default_rng(seed)
    reported = np.asarray(positions, dtype=float)
    quantum = 0.0 if seed is None else ENCODER_QUANTUM
    true = reported + rng.uniform(-0.5, 0.5, reported.shape) * quantum
    tip = Transform(*GALEN.tip_pose(true + zeros, tip_m))
    count = len(reported)
    marker = repeated(BASE_MARKER.inverse(), count) @ tip @ repeated(offset, count)
    if seed is not None:
        marker = marker.displaced(rng.standard_normal((len(tip), 6)) * NOISE / np.sqrt(samples))
    covariance = np.diag(NOISE**2) / samples
    return [
        RestPose(number, joints, marker[number], NOISE, covariance)
        for number, joints in enumerate(reported)
    ]


def off(found, true):
    return found.displacement_from(true)


# --- truth recovered ----------------------------------------------------------------------------


def test_one_position_tells_the_base_marker():
    found = register(rests()[:1], TOOL.tip_m, arm=GALEN)
    assert off(found.base_marker, BASE_MARKER) == pytest.approx(np.zeros(6), abs=1e-12)
    assert "nothing checks" in found.problems[0]
    assert np.isnan(found.checks[0].distance)


def test_one_position_is_the_reports_equations_13_and_14():
    """g_fB = g_Tf^-1 g_Tt g_Bt^-1, and the tool in the base g_fB^-1 g_Tf^-1 g_Tt."""
    rest = rests(seed=1)[1]
    tracker_base = Transform(rotvec_to_matrix([0.1, 2.9, 0.3]), np.array([0.15, -0.35, 1.8]))
    tracker_tool = tracker_base @ rest.marker
    base_tool = Transform(*GALEN.tip_pose(rest.joints, TOOL.tip_m))
    report = tracker_base.inverse() @ tracker_tool @ base_tool.inverse()
    found = register([rest], TOOL.tip_m, arm=GALEN)
    assert off(found.base_marker.inverse(), report) == pytest.approx(np.zeros(6), abs=1e-12)
    moved = Transform(rotvec_to_matrix([0.01, 0.02, 0.0]), np.array([0.0, 1e-3, 0.0])) @ rest.marker
    seen = report.inverse() @ tracker_base.inverse() @ (tracker_base @ moved)
    assert off(found.tip(moved), seen) == pytest.approx(np.zeros(6), abs=1e-12)


@pytest.mark.parametrize("estimated", [False, True])
def test_the_covariance_is_that_of_the_errors(estimated):
    """Normalised errors over 120 seeds, noise of tracker and encoders: chi-squared as they say."""
    offset = OFFSET if estimated else IDENTITY
    count = 12 if estimated else 6
    squares, alarms = [], 0
    for seed in range(120):
        found = register(rests(offset=offset, seed=seed), TOOL.tip_m, estimated, arm=GALEN)
        error = np.concatenate(
            [off(found.base_marker, BASE_MARKER), off(found.tool_marker, offset)]
        )[:count]
        squares.append(error @ np.linalg.solve(found.covariance[:count, :count], error))
        alarms += sum(check.distance > check.limit for check in found.checks)
    total, freedom = np.sum(squares), len(squares) * count
    assert chi2.ppf(1e-4, freedom) < total < chi2.ppf(1.0 - 1e-4, freedom)
    assert alarms <= 2  # one in a thousand registrations


def test_from_a_recording_with_the_markers_own_offset(tmp_path):
    scene = Scene(tool_marker=OFFSET)
    recording = read_pushes(write(tmp_path / "bag", scene.topics()), TOOL, arm=GALEN)
    found = measure_deflection(recording, marker_offset=True)
    (registered,) = found.registrations
    error = off(registered.tool_marker, OFFSET)
    sigmas = error @ np.linalg.solve(registered.covariance[6:, 6:], error)
    assert sigmas < chi2.ppf(1.0 - 1e-4, 6)
    times = (recording.stamp_ns - int(scene.topics()["/joint_states"].stamp_ns[0])) * 1e-9
    left = found.samples.deflection - scene.deflection_at(times)
    # The marker is 42 cm from the tip: its rotation noise is position noise of the tip.
    lever = np.linalg.norm(OFFSET.translation)
    assert np.all(np.abs(left.mean(axis=0)) < 0.3 * found.samples.noise)
    at_tip = np.sqrt(3 * NOISE[0] ** 2 + 2 * (NOISE[3] * lever) ** 2)
    assert np.linalg.norm(found.samples.noise[:3]) == pytest.approx(at_tip, rel=0.1)


# --- what can't be told -------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_positions_tell_no_offset(count):
    with pytest.raises(RegistrationError, match=f"from {count} position"):
        register(rests()[:count], TOOL.tip_m, estimate_offset=True, arm=GALEN)


@pytest.mark.parametrize("joint", [3, 4])
def test_turns_about_one_axis_tell_no_offset(joint):
    positions = np.tile(POSITIONS[0], (4, 1))
    positions[:, joint] = [-0.5, 0.0, 0.4, 0.8]
    positions[:, :3] += 0.02 * np.arange(4)[:, None]
    with pytest.raises(RegistrationError, match="turns about one axis only"):
        register(rests(positions, seed=1), TOOL.tip_m, estimate_offset=True, arm=GALEN)
    # The base's marker is told all the same.
    register(rests(positions, seed=1), TOOL.tip_m, arm=GALEN)


def test_small_turns_tell_no_offset():
    positions = POSITIONS.copy()
    positions[:, 3:] *= 0.01
    with pytest.raises(RegistrationError, match=r"known to .* only, worse than one sample"):
        register(rests(positions, seed=1), TOOL.tip_m, estimate_offset=True, arm=GALEN)


def test_no_rest_no_registration():
    with pytest.raises(RegistrationError, match="stands untouched"):
        register([], TOOL.tip_m, arm=GALEN)


# --- does it hold -------------------------------------------------------------------------------


def test_a_check_is_the_fit_to_the_other_positions():
    poses = rests(seed=5)
    found = register(poses, TOOL.tip_m, arm=GALEN)
    for number, check in enumerate(found.checks):
        others = register([p for p in poses if p is not poses[number]], TOOL.tip_m, arm=GALEN)
        tip = Transform(*GALEN.tip_pose(poses[number].joints, TOOL.tip_m))
        residual = off(others.tip(poses[number].marker), tip)
        assert check.residual == pytest.approx(residual, abs=1e-8)
        assert check.holds


def test_a_position_that_does_not_agree_is_named_with_its_size():
    """A marker knocked by 0.3 mm and 1 mrad before the third position, say."""
    poses = rests(seed=6)
    knocked = poses[2].marker.displaced(np.array([0.0, 0.3e-3, 0.0, 1e-3, 0.0, 0.0]))
    poses[2] = replace(poses[2], marker=knocked)
    with pytest.raises(RegistrationError) as caught:
        register(poses, TOOL.tip_m, arm=GALEN)
    text = str(caught.value)
    assert "position 2 is off" in text
    assert "and 1.0" in text
    assert "sigma" in text


def test_what_is_no_noise_but_small_is_told_and_let_pass():
    poses = rests(seed=6)
    knocked = poses[2].marker.displaced(np.array([0.0, 0.06e-3, 0.0, 0.0, 0.0, 0.0]))
    poses[2] = replace(poses[2], marker=knocked)
    found = register(poses, TOOL.tip_m, arm=GALEN)
    assert any(
        "position 2" in text and "accepted, but more than noise" in text for text in found.problems
    )


def test_poses_without_noise_are_not_measured():
    poses = [RestPose(0, POSITIONS[0], BASE_MARKER, np.zeros(6), np.zeros((6, 6)))]
    with pytest.raises(RegistrationError, match="aren't measured"):
        register(poses, TOOL.tip_m, arm=GALEN)


def test_a_zero_of_the_tilt_is_noticed_and_is_exactly_an_offset():
    zeros = np.array([0.0, 0.0, 0.0, 0.0, 0.01])
    poses = rests(zeros=zeros)
    with pytest.raises(RegistrationError, match="does not hold") as caught:
        register(poses, TOOL.tip_m, arm=GALEN)
    assert "10.00" in str(caught.value)  # the hint: the marker's offset that would explain it
    found = register(poses, TOOL.tip_m, estimate_offset=True, arm=GALEN)
    assert np.linalg.norm(found.tool_marker.displacement_from(IDENTITY)[3:]) == pytest.approx(0.01)
    assert max(check.distance for check in found.checks) < 1e-3
    assert off(found.base_marker, BASE_MARKER) == pytest.approx(np.zeros(6), abs=1e-9)


def test_a_zero_of_the_roll_is_noticed_by_the_platforms_way_only():
    zeros = np.array([0.0, 0.0, 0.0, 0.01, 0.0])
    with pytest.raises(RegistrationError, match="does not hold"):
        register(rests(zeros=zeros), TOOL.tip_m, arm=GALEN)
    # With the platform in one place, the base marker takes the turn up, whatever the angles.
    still = POSITIONS.copy()
    still[:, :3] = POSITIONS[0, :3]
    found = register(rests(still, zeros=zeros), TOOL.tip_m, arm=GALEN)
    assert max(check.distance for check in found.checks) < 1e-3
    assert np.linalg.norm(off(found.base_marker, BASE_MARKER)[3:]) == pytest.approx(0.01)


def test_a_wrong_registration_names_the_recording(tmp_path):
    scene = Scene(positions=POSITIONS[:2], joint_zeros=np.array([0.0, 0.0, 0.0, 0.0, 0.01]))
    path = write(tmp_path / "wrong_tilt", scene.topics())
    with pytest.raises(RegistrationError, match="wrong_tilt: the registration does not hold"):
        measure_deflection(read_pushes(path, TOOL, arm=GALEN))


def test_an_arm_that_others_wrote_with_another_zero_of_its_tilt():
    folder = SHARED / "recording_601"
    if not folder.is_dir():
        pytest.skip("the shared recordings are not here")
    tool = read_calibration(folder / "tool.json", arm=GALEN)
    recording = read_pushes(folder / "push", tool, arm=GALEN)
    with pytest.raises(RegistrationError, match="does not hold"):
        measure_deflection(recording)
    found = measure_deflection(recording, marker_offset=True).registrations[0]
    (effect,) = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["effects"]
    assert effect["effect"] == "tilt_zero_offset"
    std = np.sqrt(found.covariance[10, 10])
    # ft_sensor's y axis is the tilt's.
    turn = found.tool_marker.displacement_from(IDENTITY)[4]
    assert abs(turn - effect["parameters"]["offset_rad"]) < 4.0 * std
    assert std < 2e-5
