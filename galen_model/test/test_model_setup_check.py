# SPDX-License-Identifier: Apache-2.0
"""Set-up errors are named, and a sound set-up is left alone, on simulated sweeps."""

import numpy as np
import pytest
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import matrix_to_quaternion, quaternion_to_matrix, rot_z
from galen_model.setup_check.check import check_setup
from galen_model.setup_check.readings import StillReadings, at_angles
from galen_model.setup_check.stamps import check_stamps
from model_files import SIX_AXIS as SIX_AXES
from model_files import SIX_AXIS_URDF

NOISE = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])
BIAS = np.array([1.0, -2.0, 3.0, 0.05, -0.02, 0.01])
LOAD = Load(0.85, np.array([0.012, -0.007, 0.065]))


def sweep(arm, seed=0, count=24, load=LOAD, gravity=None):
    """Angles and readings of still poses of an arm with a load, under `gravity` in its base."""
    rng = np.random.default_rng(seed)
    lower, upper = arm.lower[list(arm.turning)], arm.upper[list(arm.turning)]
    angles = rng.uniform(np.maximum(lower, -2.5), np.minimum(upper, 2.5), (count, len(lower)))
    down = arm.direction_in_sensor(angles, arm.gravity_m_s2 if gravity is None else gravity)
    wrench = gravity_wrench(down, load) + BIAS + NOISE * rng.normal(size=(count, 6))
    return angles, wrench


def check_at(arm, angles, wrench):
    return check_setup(at_angles(wrench, angles, arm))


IN_NMM = np.repeat([1.0, 1e3], 3)
SECOND_REVERSED = np.where(np.arange(6) == 1, -1.0, 1.0)
FLANGE = np.kron(np.eye(2), rot_z(np.radians(45.0)))


@pytest.mark.parametrize(
    ("mistake", "what", "remedy"),
    [
        (lambda q, w: (q, -w), "the reading is reversed", "negate the wrench"),
        (
            lambda q, w: (q, w * [-1, 1, 1, -1, 1, 1]),
            "fx and tx have the wrong",
            "negate fx and tx",
        ),
        (lambda q, w: (q, w * [1, 1, -1, 1, 1, 1]), "fz has the wrong sign", "negate fz"),
        (lambda q, w: (q, w * IN_NMM), "torques are in N.mm", "divide torques by 1000"),
        (lambda q, w: (np.degrees(q), w), "joint angles are in degrees", "rad"),
        (lambda q, w: (q * SECOND_REVERSED, w), "turns the other way", "reverse its sign"),
        (
            lambda q, w: (q[:, [0, 1, 2, 4, 3, 5]], w),
            "wrist_1 and wrist_2 are exch",
            "order of names",
        ),
        (lambda q, w: (q, w[:, [1, 2, 0, 4, 5, 3]]), "turned by 120.0 deg", ":= (fz, fx, fy)"),
        (lambda q, w: (q, w @ FLANGE), "turned by 45.0 deg about -z", "description"),
        (
            lambda q, w: (q * SECOND_REVERSED, w * IN_NMM),
            "torques are in N.mm, and joint",
            "divide torques by 1000",
        ),
    ],
)
def test_a_mistake_is_named_with_its_remedy(mistake, what, remedy):
    found = check_at(SIX_AXES, *mistake(*sweep(SIX_AXES)))
    assert found is not None
    named = [one for one in found.explanations if what in one.what]
    assert named, found.sentence
    assert remedy in named[0].remedy
    assert named[0].fit.mass_kg == pytest.approx(0.85, abs=0.01)
    np.testing.assert_allclose(np.abs(named[0].fit.com_m), np.abs(LOAD.com_m), atol=0.07)


@pytest.mark.parametrize(
    ("gravity", "words", "option"),
    [
        ((0.0, 0.0, 1.0), "hangs from the ceiling", "--gravity 0 0 9.80665"),
        ((1.0, 0.0, 0.0), "mounted on a wall", "--gravity 9.80665 0 0"),
        ((np.sin(0.35), 0.0, -np.cos(0.35)), "inclined by 20", "about +y"),
    ],
)
@pytest.mark.parametrize("arm", [GALEN, SIX_AXES], ids=["galen", "six_axis"])
def test_a_mount_is_named(arm, gravity, words, option):
    down = STANDARD_GRAVITY_M_S2 * np.array(gravity)
    found = check_at(arm, *sweep(arm, gravity=down))
    assert words in found.explanations[0].what
    assert option in found.sentence
    expected = ["ceiling", "reversed"] if gravity[2] == 1.0 else [words]
    assert [word for word in expected if word not in found.sentence] == []


def test_the_ceiling_and_a_reversed_reading_are_told_apart_by_a_push():
    angles, wrench = sweep(SIX_AXES)
    found = check_at(SIX_AXES, angles, -wrench)
    assert len(found.explanations) == 2
    assert "what separates them" in found.sentence and "push the tool" in found.sentence


def tabled(rotation, wrench):
    gravity = np.einsum("nji,j->ni", rotation, GALEN.gravity_m_s2)
    return StillReadings(wrench, gravity, GALEN, rotation)


def test_orientations_of_tables_are_checked():
    angles, wrench = sweep(SIX_AXES)
    rotation = SIX_AXES.rotation(angles)
    assert check_setup(tabled(rotation, wrench)) is None
    inverse = check_setup(tabled(np.swapaxes(rotation, 1, 2), wrench))
    assert "(inverse)" in inverse.explanations[0].what
    order = matrix_to_quaternion(rotation)[:, [3, 0, 1, 2]]
    swapped = check_setup(tabled(quaternion_to_matrix(order), wrench))
    assert "order w, x, y, z" in swapped.explanations[0].what
    in_base = np.hstack(
        [np.einsum("nij,nj->ni", rotation, part) for part in np.split(wrench, 2, axis=1)]
    )
    written = check_setup(tabled(rotation, in_base))
    assert "--wrench-frame base" in written.explanations[0].remedy
    up = StillReadings(wrench, -SIX_AXES.gravity_in_sensor(angles), SIX_AXES)
    assert "accelerometer" in check_setup(up).sentence


def test_another_frame_of_the_description_is_named():
    turned = SIX_AXIS_URDF.replace(
        "</robot>",
        '<link name="plate"/><joint name="plate_joint" type="fixed"><parent link="ft_sensor"/>'
        '<child link="plate"/><origin rpy="0 0 0.7"/></joint></robot>',
    )
    plate = read_arm(turned, sensor_frame="plate")
    angles, wrench = sweep(plate)
    found = check_at(read_arm(turned), angles, wrench)
    assert any("--sensor-frame plate" in one.remedy for one in found.explanations)


def test_a_sound_set_up_is_left_alone():
    """Gains of 1 %, joint zeros of 4 mrad, drift, touched poses; few poses, narrow sweeps."""
    named = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        arm, count = (GALEN, SIX_AXES)[seed % 2], int(rng.choice([4, 5, 8, 24, 56]))
        load = Load(rng.uniform(0.1, 2.0), rng.normal(size=3) * 0.06)
        low, high = arm.lower[list(arm.turning)], arm.upper[list(arm.turning)]
        width = rng.choice([0.6, 1.2, 2.5])
        middle = rng.uniform(np.maximum(low, -2.0), np.minimum(high, 2.0))
        angles = np.clip(middle + rng.uniform(-width, width, (count, len(low))), low, high)
        down = arm.gravity_in_sensor(angles + 0.004 * rng.normal(size=len(low)))
        wrench = gravity_wrench(down, load) * (1.0 + 0.01 * rng.normal(size=6)) + BIAS
        wrench += NOISE * rng.normal(size=wrench.shape)
        wrench += np.linspace(0.0, 1.0, count)[:, None] * 5.0 * NOISE * rng.normal(size=6)
        if count > 12:
            touched = rng.integers(0, count, count // 12)
            wrench[touched] += 100.0 * NOISE * rng.normal(size=(len(touched), 6))
        found = check_at(arm, angles, wrench)
        named += [] if found is None else [(seed, found.sentence)]
    assert named == []


@pytest.mark.parametrize("late_s", [-0.1, 0.0, 2.0])
def test_stamps_that_are_apart_are_named(late_s):
    rng = np.random.default_rng(1)
    time_s = np.arange(0.0, 60.0, 0.01)
    turns = rng.uniform(0.2, 0.6, 6), rng.uniform(0.0, 6.0, 6)
    joints = np.sin(turns[0] * time_s[:, None] + turns[1])
    wrench = gravity_wrench(SIX_AXES.gravity_in_sensor(joints), LOAD) + BIAS
    wrench += NOISE * rng.normal(size=wrench.shape)
    found = check_stamps(time_s, joints, time_s + late_s, wrench, SIX_AXES)
    if late_s == 0.0:
        assert found is None
        return
    late = "wrench" if late_s > 0.0 else "joints"
    assert f"stamps of the {late} are" in found.sentence
    told = float(found.sentence.split("stamps of the ")[1].split(" are ")[1].split(" s ")[0])
    assert told == pytest.approx(abs(late_s), abs=0.01)


def test_axes_without_signal_are_named_and_too_few_poses_tell_nothing():
    angles, wrench = sweep(SIX_AXES)
    assert check_at(SIX_AXES, angles[:2], -wrench[:2]) is None
    wrench[:, :2] = 0.0
    found = check_at(SIX_AXES, angles, wrench)
    assert "fx, fy hardly change" in found.sentence
