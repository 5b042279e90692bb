# SPDX-License-Identifier: Apache-2.0
"""Rotations in plain floats; the tracker: geometry, deflection and noise."""

import math

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.load.model import TOOLS
from galen_model.registration import move_wrench
from galen_model.rotation import matrix_to_rotvec, quaternion_to_matrix, rotvec_to_matrix
from galen_sim_driver.plant.config import BASE_IN_TRACKER, BASE_MARKER, HandPush, Pose
from galen_sim_driver.plant.geometry import from_rotvec, multiply, rotate_by, to_quaternion
from sim_bench import TURNED, make_plant, run

QUIET = {"noise": False, "start_joints": TURNED}
RNG = np.random.default_rng(11)


def look(plant):
    """The next tracker sample."""
    return next(sample.tracker for sample in iter(plant.step, None) if sample.tracker is not None)


def transform(translation, rotation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def of_pose(pose):
    return transform(pose.translation_m, rotvec_to_matrix(pose.rotvec_rad))


def of_marker(marker):
    position, turn = marker
    return transform(position, quaternion_to_matrix(turn))


def test_markers_are_where_the_configuration_puts_them():
    tool_marker = Pose((0.01, -0.02, 0.03), (0.3, -0.2, 0.5))
    tool_seen, base_seen = look(make_plant("pointer", **QUIET, tool_marker=tool_marker))
    rotation, tip = GALEN.tip_pose(TURNED, TOOLS["pointer"].tip_m)
    base = of_pose(BASE_IN_TRACKER)
    assert np.allclose(of_marker(base_seen), base @ of_pose(BASE_MARKER), atol=1e-12)
    expected = base @ transform(tip, rotation) @ of_pose(tool_marker)
    assert np.allclose(of_marker(tool_seen), expected, atol=1e-12)


@pytest.mark.parametrize("frame", ["base", "tip"])
@pytest.mark.parametrize(
    ("force", "torque"),
    [((20.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((3.0, -8.0, 5.0), (0.2, -0.1, 0.3))],
)
def test_a_push_deflects_the_tip_as_the_stiffness_says(force, torque, frame):
    push = HandPush(0.0, 1.0, force, torque, frame, ramp_s=0.1)
    plant = make_plant("pointer", **QUIET, hand=[push])
    base = of_pose(BASE_IN_TRACKER)
    still = np.linalg.inv(base) @ of_marker(look(plant)[0])
    plant.start_hand()
    run(plant, 200)
    pushed = np.linalg.inv(base) @ of_marker(look(plant)[0])

    tip_m = TOOLS["pointer"].tip_m
    rotation, _ = GALEN.tip_pose(TURNED, tip_m)
    at_tip = np.array([*force, *torque])
    if frame == "base":
        at_tip = move_wrench(at_tip, rotation.T, np.zeros(3))
    at_sensor = move_wrench(at_tip, np.eye(3), tip_m)
    expected = GALEN.deflection(TURNED, at_sensor, tip_m)
    assert np.allclose(pushed[:3, 3] - still[:3, 3], expected[:3], atol=1e-12)
    turn = matrix_to_rotvec(pushed[:3, :3] @ still[:3, :3].T)
    assert np.allclose(turn, expected[3:], atol=1e-9)
    # It gives way to the push, by a size that a tracker sees.
    force_base = rotation @ at_tip[:3]
    assert expected[:3] @ force_base > 0.0
    assert np.linalg.norm(expected[:3]) > 1e-4


def test_noise_has_the_configured_size_in_each_axis():
    plant = make_plant("pointer", 3, start_joints=TURNED, tracker_rate_hz=500.0)
    quiet = look(make_plant("pointer", **QUIET))
    samples = [sample.tracker for sample in run(plant, 2000)]
    for marker in range(2):  # the tool's, the base's
        truth = of_marker(quiet[marker])
        seen = [of_marker(sample[marker]) for sample in samples]
        moved = np.array([pose[:3, 3] - truth[:3, 3] for pose in seen])
        turned = matrix_to_rotvec(np.array([pose[:3, :3] for pose in seen]) @ truth[:3, :3].T)
        bound = 5 / np.sqrt(2 * len(samples))
        assert np.all(np.abs(moved.std(axis=0) / 0.03e-3 - 1) < bound)
        assert np.all(np.abs(turned.std(axis=0) / 0.1e-3 - 1) < bound)
        assert np.all(np.abs(moved.mean(axis=0)) < 5 * 0.03e-3 / np.sqrt(len(samples)))


# --- rotations --------------------------------------------------------------------------------


def test_quaternions():
    for scale in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        a, b = RNG.normal(size=3) * scale, RNG.normal(size=3)
        first, second = rotvec_to_matrix(a), rotvec_to_matrix(b)
        product = multiply(from_rotvec(a), from_rotvec(b))
        assert np.allclose(quaternion_to_matrix(product), first @ second, atol=1e-12)
        vector = RNG.normal(size=3)
        assert np.allclose(rotate_by(from_rotvec(b), vector), second @ vector, atol=1e-12)
        found = np.array(to_quaternion(tuple(second.ravel().tolist())))
        assert np.allclose(quaternion_to_matrix(found), second, atol=1e-12)
        assert math.hypot(*product) == pytest.approx(1.0, abs=1e-12)
