# SPDX-License-Identifier: Apache-2.0
"""Sensor and mounting: recovered at the noise's limit, told apart or rejected by the pair."""

import json
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.json_fields import FieldError
from galen_model.load.identification import (
    KnownLoad,
    check_planned_poses,
    identify_one_sweep,
    identify_single_load,
    identify_two_sweeps,
)
from galen_model.load.model import ADAPTER, TOOLS, Load, LoadEstimate
from galen_model.load.mounting import Mounting, entities, groups_of
from galen_model.load.mounting_worth import MOUNTED, ROBUST, Calibrated, worth
from galen_model.load.reading_model import JointPoses, MountedSweep, ReadingModel
from galen_model.load.readings import StillPoses, with_offsets
from model_files import SIGMA, calibration, sweep_grid
from model_files import SIX_AXIS as SIX
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from galen_validation.pinocchio_arm import PinocchioArm

DEG = np.pi / 180.0
RETRACTOR, NOTHING = TOOLS["retractor"].load, Load(0.0)
ARM = PinocchioArm()
LEVEL = Mounting.of(GALEN)
WALL = replace(SIX, gravity_m_s2=np.array([0.0, 9.80665, 0.0]))
SIX_MODEL = pinocchio.buildModelFromXML(SIX.urdf)
GRAVITY = np.array([0.0, 0.0, -9.80665])


def mounting(seed=3, size=1.0, only=None, arm=GALEN):
    """Rotation 1 deg, gains 1 %, inclination and zeros 0.5 deg, times `size`; `only` some."""
    rng, zeros = np.random.default_rng(seed), len(arm.turning)
    vector = np.repeat([DEG, 0.01, 0.5 * DEG, 0.5 * DEG], [3, 6, 3, zeros])
    vector *= rng.uniform(-1, 1, len(vector))
    if only is not None:
        basis = np.array([e.direction for e in entities(only, arm)])
        vector = np.linalg.pinv(basis) @ basis @ vector
    return Mounting.from_vector(size * vector, joints=arm.turning_names)


def base_from_sensor(angles):
    """R_base_sensor of the Galen or of the six-axis arm, by Pinocchio, at angles (k,)."""
    if len(angles) == 2:
        return ARM.pose([0.0, 0.0, 0.408, *angles])[0]
    data = SIX_MODEL.createData()
    pinocchio.framesForwardKinematics(SIX_MODEL, data, angles)
    return data.oMf[SIX_MODEL.getFrameId("ft_sensor")].rotation


def true_wrench(mounted, angles, load, gravity=GRAVITY):
    """Weight in ft_sensor, by Pinocchio's frames and torque about the sensor's origin in base."""
    down = Rotation.from_euler("XYZ", mounted.base_inclination_rad).inv().apply(np.array(gravity))
    wrenches = []
    for pose in np.atleast_2d(angles) + mounted.joint_zero_rad:
        rotation = Rotation.from_matrix(base_from_sensor(pose))
        force = load.mass_kg * down
        torque = np.cross(rotation.apply(load.com_m), force)
        wrenches.append(np.concatenate([rotation.inv().apply(f) for f in (force, torque)]))
    return np.array(wrenches)


def sensed(mounted, wrench):
    """What the turned sensing element reads of wrenches (n, 6) in ft_sensor, by rotations."""
    turn = Rotation.from_rotvec(mounted.sensor_rotvec_rad).inv()
    axes = np.concatenate([turn.apply(wrench[:, :3]), turn.apply(wrench[:, 3:])], axis=1)
    return axes * (1.0 + mounted.axis_gain)


def reading(mounted, angles, tool, gravity=GRAVITY):
    """As the sensor reads, zeroed at home with the adapter on: one reading less another."""
    both = sum(true_wrench(mounted, angles, load, gravity) for load in (tool, ADAPTER))
    home = true_wrench(mounted, np.zeros(np.shape(angles)[-1]), ADAPTER, gravity)
    return sensed(mounted, both) - sensed(mounted, home)


def sweeps(mounted, rng=None, noise=SIGMA, poses=None, tool=RETRACTOR, arm=GALEN):
    angles = sweep_grid() if poses is None else poses
    made = []
    for load in (NOTHING, tool):
        wrench = reading(mounted, angles, load, arm.gravity_m_s2)
        if rng is not None:
            wrench = wrench + noise * rng.standard_normal(wrench.shape)
        made.append(StillPoses(angles, wrench, arm=arm))
    return made


def tool_file(mounted):
    load = LoadEstimate(RETRACTOR.mass_kg, np.asarray(RETRACTOR.com_m), np.zeros((4, 4)))
    return calibration("retractor", load=load, mounting=mounted)


def test_the_reading_is_that_of_finite_rotations_in_pinocchio():
    """At 20 degrees and more, where a slip in order or sign can't hide."""
    mounted = mounting(size=30.0)
    angles = sweep_grid(3, 4)
    expected = reading(mounted, angles, RETRACTOR)
    file = tool_file(mounted)
    np.testing.assert_allclose(file.predict(angles), expected, atol=1e-12)
    single = np.array([file.predict(pose) for pose in angles])
    np.testing.assert_allclose(single, expected, atol=1e-12)


def test_a_push_comes_out_right_through_gains_rotation_and_zeroing():
    mounted, push = mounting(size=30.0), np.array([5.0, -3.0, 2.0, 0.1, 0.2, -0.3])
    angles = sweep_grid(3, 4)
    weight = reading(mounted, angles, RETRACTOR)
    both = true_wrench(mounted, angles, RETRACTOR) + true_wrench(mounted, angles, ADAPTER)
    raw = sensed(mounted, both + push) - (sensed(mounted, both) - weight)
    left = (raw - tool_file(mounted).predict(angles)) @ mounted.wrench_from_reading.T
    np.testing.assert_allclose(left, np.tile(push, (len(angles), 1)), atol=1e-12)


def two_sweeps_model(groups, arm=GALEN):
    angles = sweep_grid(4, 5) if arm is GALEN else six_poses(20)
    poses, adapter = JointPoses(angles, arm), slice(4, 8)
    return ReadingModel(
        [MountedSweep(poses, None, adapter), MountedSweep(poses, slice(0, 4), adapter)],
        JointPoses(angles[:1] + 0.1, arm),
        entities(groups, arm),
        8,
    )


ALL = ["sensor_rotation", "axis_gain", "base_inclination", "joint_zero"]


@pytest.mark.parametrize(("size", "arm"), [(0.0, GALEN), (20.0, GALEN), (20.0, SIX), (20.0, WALL)])
def test_the_jacobian_is_that_of_finite_differences(size, arm):
    model = two_sweeps_model(ALL, arm)
    rng = np.random.default_rng(0)
    mounted = size * 0.02 * rng.normal(size=model.basis.shape[1])
    values = np.concatenate([RETRACTOR.moments, ADAPTER.moments, mounted])
    _, jacobian = model.evaluate(values)
    for column in range(len(values)):
        step = np.zeros(len(values))
        step[column] = 1e-6
        slope = (model.evaluate(values + step)[0] - model.evaluate(values - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, column], slope, atol=2e-8)


def test_a_sensor_that_is_turned_by_a_right_angle_is_no_small_rotation():
    made = sweeps(mounting(size=90.0, only=["sensor_rotation"]), poses=sweep_grid(4, 5))
    with pytest.raises(IdentificationError, match="the fit does not settle"):
        identify_two_sweeps(*made, groups=["sensor_rotation", "gain_ratio"])


def test_four_twins_and_no_others():
    """The null space of all parameters at once, over a sweep without and one with the tool."""
    model = two_sweeps_model(ALL)
    values = np.concatenate([RETRACTOR.moments, ADAPTER.moments, np.zeros(13)])
    rows = with_offsets(model.evaluate(values)[1], np.repeat([0, 1], 20)).reshape(-1, 33)
    rows = rows / np.linalg.norm(rows, axis=0)
    singular = np.linalg.svd(rows, compute_uv=False)
    assert np.sum(singular < 1e-9 * singular[0]) == 4
    assert singular[-5] > 1e-3 * singular[0]


def six_poses(count=40):
    return np.random.default_rng(8).uniform(-2.0, 2.0, (count, 6))


@pytest.mark.parametrize(
    ("arm", "names"),
    [
        (GALEN, "sensor_rotation gain_ratio base_inclination"),
        (GALEN, "sensor_rotation_x sensor_rotation_z joint_zero gain_ratio base_inclination_y"),
        (SIX, "joint_zero sensor_rotation_x sensor_rotation_y gain_ratio base_inclination"),
        (SIX, "sensor_rotation base_inclination wrist_1_zero wrist_2_zero"),
    ],
)
def test_next_to_no_noise_gives_the_mounting_and_the_loads(arm, names):
    groups = names.split()
    mounted, rng = mounting(only=groups, arm=arm), np.random.default_rng(2)
    poses = sweep_grid(4, 5) if arm is GALEN else six_poses()
    made = sweeps(mounted, rng, noise=1e-6 * SIGMA, poses=poses, arm=arm)
    found = identify_two_sweeps(*made, groups=groups)
    np.testing.assert_allclose(found.mounting.vector, mounted.vector, atol=1e-8)
    assert found.load.mass_kg == pytest.approx(RETRACTOR.mass_kg, abs=1e-8)
    np.testing.assert_allclose(found.load.com_m, RETRACTOR.com_m, atol=1e-8)
    assert not found.outliers
    assert found.mounting.joints == arm.turning_names
    again = Mounting.from_json(found.mounting.to_json(), "mounting", arm)
    np.testing.assert_array_equal(again.vector, found.mounting.vector)
    other = SIX if arm is GALEN else GALEN
    with pytest.raises(FieldError, match=other.turning_names[0]):
        Mounting.from_json(found.mounting.to_json(), "mounting", other)


def test_joints_without_an_effect_keep_their_zero_and_parallel_ones_share_one():
    names = [one.name for one in groups_of(SIX)["joint_zero"]]
    shared = "the common zero of the joints shoulder_lift, elbow, wrist_1"
    assert names == [shared, "the wrist_2 joint's zero", "the wrist_3 joint's zero"]
    made = sweeps(mounting(only=["joint_zero"], arm=SIX), poses=six_poses(), arm=SIX)
    for asked, named in (
        (["shoulder_pan_zero"], "the shoulder_pan joint's zero"),
        (["elbow_zero", "wrist_1_zero"], "the elbow joint's zero and the wrist_1 joint's zero"),
        (
            ["joint_zero", "sensor_rotation"],
            "wrist_3 joint's zero and the sensor's rotation",
        ),
    ):
        with pytest.raises(NotExcitedError, match=named):
            identify_two_sweeps(*made, groups=asked)
    # on a wall the first joint turns gravity
    assert groups_of(WALL)["joint_zero"][0].name == "the shoulder_pan joint's zero"
    only = replace(SIX, joints=SIX.joints[:1])
    with pytest.raises(IdentificationError, match="no joint's zero of the arm 'six_axis'"):
        entities(["joint_zero"], only)


def test_gravity_along_any_axis_of_the_base_is_inclined_with_it():
    mounted, angles = mounting(size=20.0, arm=SIX), six_poses(3)
    turn = Rotation.from_euler("XYZ", mounted.base_inclination_rad).inv()
    expected = [
        base_from_sensor(one + mounted.joint_zero_rad).T @ turn.apply(WALL.gravity_m_s2)
        for one in angles
    ]
    np.testing.assert_allclose(mounted.gravity_in_sensor(angles, WALL), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("direction", "axes"),
    [((0.0, -1.0, 0.0), "xz"), ((1.0, 1.0, 1.0), "xy")],
)
def test_an_inclination_shows_wherever_gravity_points(direction, axes):
    """Two angles of 2 to 4 degrees, against the bound of Cramer and Rao."""
    gravity = 9.80665 * np.array(direction) / np.linalg.norm(direction)
    arm, poses, rng = replace(SIX, gravity_m_s2=gravity), six_poses(12), np.random.default_rng(4)
    at = ["xyz".index(axis) for axis in axes]
    angles = np.zeros(3)
    angles[at] = 0.07, -0.04
    mounted = replace(Mounting.of(arm), base_inclination_rad=angles)
    made = sweeps(mounted, rng, poses=poses, arm=arm)
    found = identify_two_sweeps(*made, groups=["base_inclination"])
    error = found.mounting.base_inclination_rad - angles
    assert error["xyz".index(*set("xyz") - set(axes))] == 0.0

    def expected(values):
        tool, adapter = (Load(one[0], one[1:4] / one[0]) for one in (values[:4], values[4:8]))
        inclined = angles.copy()
        inclined[at] = values[20:]
        turned = replace(mounted, base_inclination_rad=inclined)
        both = [true_wrench(turned, poses, load, gravity) for load in (tool, adapter)]
        home = true_wrench(turned, np.zeros(6), adapter, gravity)
        rows = [both[1] - home + values[8:14], both[0] + both[1] - home + values[14:20]]
        return (np.concatenate(rows) / SIGMA).ravel()

    truth = np.concatenate([RETRACTOR.moments, ADAPTER.moments, np.zeros(12), angles[at]])
    steps = 1e-6 * np.eye(22)
    jacobian = np.array([(expected(truth + s) - expected(truth - s)) / 2e-6 for s in steps])
    bound = np.linalg.inv(jacobian @ jacobian.T)[20:, 20:]
    assert error[at] @ np.linalg.solve(bound, error[at]) < chi2.ppf(0.999, 2)
    std = found.mounting.std[[9 + k for k in at]]
    np.testing.assert_allclose(std, np.sqrt(np.diag(bound)), rtol=0.3)
    assert "base_inclination_z" in groups_of(arm)
    back = Mounting.from_json(found.mounting.to_json(), "mounting", arm)
    np.testing.assert_array_equal(back.vector, found.mounting.vector)
    np.testing.assert_array_equal(back.covariance, found.mounting.covariance)


def test_along_z_a_file_has_two_angles_and_a_turn_about_gravity_does_not_show():
    whole = replace(LEVEL, base_inclination_rad=np.array([0.02, -0.03, 0.0])).to_json()
    assert whole["base_inclination_rad"] == {"about_x": 0.02, "about_y": -0.03}
    assert np.shape(whole["covariance"]) == (13, 13)
    back = Mounting.from_json(whole, "mounting", GALEN)
    assert back.base_inclination_rad.tolist() == [0.02, -0.03, 0.0]
    made = sweeps(LEVEL, np.random.default_rng(1), poses=sweep_grid(4, 5))
    with pytest.raises(NotExcitedError, match="the base's inclination about z"):
        identify_two_sweeps(*made, groups=["base_inclination_z"])


def test_a_weighed_load_with_a_known_centre_tells_every_gain():
    mounted = mounting(only=["axis_gain"])
    known = KnownLoad(RETRACTOR.mass_kg, 1e-4, RETRACTOR.com_m, 1e-4)
    made = sweeps(mounted, np.random.default_rng(2), noise=1e-3 * SIGMA)
    found = identify_two_sweeps(*made, groups=["axis_gain"], known=known)
    np.testing.assert_allclose(found.mounting.axis_gain, mounted.axis_gain, atol=1e-4)
    # no better than the scale tells the mass, nor the drawing the centre, of the whole load
    relative = 1e-4 / RETRACTOR.mass_kg
    common = found.mounting.covariance[3:6, 3:6].mean() ** 0.5
    assert common == pytest.approx(relative, rel=0.05)


TWINS = [
    (["roll_zero", "base_inclination"], ("base's inclination about x", "roll joint's zero")),
    (["joint_zero", "sensor_rotation"], ("tilt joint's zero", "sensor's rotation about y")),
    (["force_gain"], ("common force gain", "masses")),
    (["torque_gain"], ("common torque gain", "centres")),
]


def named_pairs(message):
    """What is named before each remedy in parentheses."""
    parts = message.removeprefix("not identifiable from these poses: ").split("); ")
    return {frozenset(part.partition(" (")[0].split(" and ")) for part in parts}


@pytest.mark.parametrize(("groups", "pair"), TWINS)
def test_twins_are_rejected_by_name(groups, pair):
    rng = np.random.default_rng(5)
    with pytest.raises(NotExcitedError) as rejected:
        identify_two_sweeps(*sweeps(mounting(only=groups), rng), groups=groups)
    with pytest.raises(NotExcitedError) as planned:
        check_planned_poses(sweep_grid(), groups, arm=GALEN)
    for message in (str(rejected.value), str(planned.value)):
        assert named_pairs(message) == {frozenset(f"the {name}" for name in pair)}


def test_a_tool_on_the_axis_does_not_tell_the_torque_about_it():
    on_axis = Load(0.2, np.array([0.0, 0.0, 0.05]))
    made = sweeps(LEVEL, np.random.default_rng(1), tool=on_axis)
    with pytest.raises(NotExcitedError, match=r"gain of tz .* centres"):
        identify_two_sweeps(*made, groups=["torque_gain_ratio"])


def test_a_healthy_arm_gives_zeros_and_does_not_pay():
    bare, tool = sweeps(LEVEL, np.random.default_rng(11), poses=sweep_grid(4, 6))
    measured = Calibrated(bare, tool, ["sensor_rotation", "gain_ratio", "base_inclination"])
    found = measured.identify()
    basis = np.array([e.direction for e in entities(measured.groups, arm=GALEN)]).T
    reduced = np.linalg.pinv(basis)
    error, covariance = reduced @ found.mounting.vector, reduced @ found.mounting.covariance
    distance = error @ np.linalg.solve(covariance @ reduced.T, error)
    assert distance < chi2.ppf(0.999, len(error))
    verdict = worth(measured, found)
    assert not verdict.pays
    assert "do not pay" in verdict.sentence


@pytest.mark.slow
def test_a_turned_sensor_pays_down_to_the_noise():
    mounted = mounting(only=["sensor_rotation"])
    bare, tool = sweeps(mounted, np.random.default_rng(12), poses=sweep_grid(4, 6))
    measured = Calibrated(bare, tool, ["sensor_rotation"])
    verdict = worth(measured, measured.identify())
    assert verdict.pays
    assert np.all(verdict.rmse[MOUNTED] < 1.4 * SIGMA)
    unmounted = verdict.rmse[ROBUST]
    assert not np.all(np.isfinite(unmounted)) or np.any(unmounted > 3.0 * SIGMA)


def test_one_sweep_tells_the_mounting_too():
    mounted = mounting(only=["joint_zero"])
    _, tool = sweeps(mounted, np.random.default_rng(14))
    found = identify_one_sweep(tool, groups=["joint_zero"])
    error = found.mounting.joint_zero_rad - mounted.joint_zero_rad
    assert np.all(np.abs(error) < 4.0 * found.mounting.std[12:])
    assert found.mounting.std[12:].max() < 0.1 * DEG
    assert found.unresolved
    with pytest.raises(NotExcitedError, match="common force gain and the masses"):
        identify_one_sweep(tool, groups=["force_gain"])


def test_orientations_tell_rotation_and_inclination():
    mounted = replace(mounting(seed=4), joint_zero_rad=np.zeros(2), axis_gain=np.zeros(6))
    rng = np.random.default_rng(15)
    turns = Rotation.random(30, random_state=rng)
    level = turns.inv().apply(GRAVITY)
    true = mounted.turned_gravity(level, turns.as_matrix())
    np.testing.assert_allclose(
        true, turns.inv().apply(mounted.gravity_direction(GALEN) * 9.80665), atol=1e-12
    )
    force = RETRACTOR.mass_kg * true
    weight = np.concatenate([force, np.cross(RETRACTOR.com_m, force)], axis=1)
    wrench = sensed(mounted, weight) + 0.3 + SIGMA * rng.standard_normal((30, 6))
    groups = ["sensor_rotation", "base_inclination"]
    found = identify_single_load(level, wrench, groups, turns.as_matrix(), arm=GALEN)
    told = found.mounting.std > 0.0
    assert told.sum() == 5
    error = (found.mounting.vector - mounted.vector)[told] / found.mounting.std[told]
    assert np.all(np.abs(error) < 4.0)
    left = wrench - found.predict(level, turns.as_matrix())
    assert np.all(np.sqrt(np.mean(left**2, axis=0)) < 1.4 * SIGMA)
    with pytest.raises(NotExcitedError, match=r"not identifiable .* the base's inclination"):
        identify_single_load(level, wrench, ["base_inclination"], arm=GALEN)
    with pytest.raises(NotExcitedError, match=r"not identifiable .* the roll joint's zero"):
        identify_single_load(level, wrench, ["roll_zero"], turns.as_matrix(), arm=GALEN)


@pytest.mark.slow
def test_the_intervals_hold():
    """30 calibrations against chi-square."""
    groups = ["sensor_rotation", "base_inclination", "gain_ratio"]
    basis = np.array([e.direction for e in entities(groups, arm=GALEN)]).T
    mounted, poses, count = mounting(only=groups), sweep_grid(4, 5), 30
    rng = np.random.default_rng(16)
    clean = sweeps(mounted, poses=poses)
    reduce = np.linalg.pinv(basis)
    truth = reduce @ mounted.vector
    distances, inside = [], []
    for _ in range(count):
        bare, tool = (
            StillPoses(poses, one.wrench + SIGMA * rng.standard_normal(one.wrench.shape), arm=GALEN)
            for one in clean
        )
        found = identify_two_sweeps(bare, tool, groups=groups).mounting
        error, covariance = reduce @ found.vector - truth, reduce @ found.covariance @ reduce.T
        distances.append(error @ np.linalg.solve(covariance, error))
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(covariance)))
    # 30 x 9 outcomes; the chi-square of each has 9 degrees of freedom
    assert 0.90 < np.mean(inside) < 0.985
    assert abs(np.mean(distances) - 9.0) < 4.0 * np.sqrt(2 * 9 / count)


def test_a_file_holds_the_mounting_and_rejects_a_broken_one(tmp_path):
    covariance = np.diag(np.arange(14) * 1e-8)
    mounted = replace(mounting(), estimated=("sensor_rotation",), covariance=covariance)
    path = tmp_path / "retractor.json"
    write_calibration(path, tool_file(mounted))
    back = read_calibration(path, arm=GALEN)
    assert back.mounting is not None
    np.testing.assert_array_equal(back.mounting.vector, mounted.vector)
    np.testing.assert_array_equal(back.mounting.covariance, covariance)
    assert back.mounting.estimated == ("sensor_rotation",)
    np.testing.assert_array_equal(
        back.predict((0.3, -0.2)), tool_file(mounted).predict((0.3, -0.2))
    )
    write_calibration(path, tool_file(None))
    assert "mounting" not in json.loads(path.read_text())
    good = mounted.to_json()
    for change, named in (
        ({"axis_gain": [0.0] * 5 + [0.7]}, "axis_gain"),
        ({"sensor_rotvec_rad": [4.0, 0.0, 0.0]}, "sensor_rotvec_rad"),
        ({"base_inclination_rad": {"about_x": 0.0}}, "about_y"),
        ({"joint_zero_rad": {"roll": 2.0, "tilt": 0.0}}, "joint_zero_rad"),
        ({"estimated": ["everything"]}, "everything"),
        ({"covariance": (-covariance).tolist()}, "covariance"),
    ):
        with pytest.raises(FieldError, match=named):
            Mounting.from_json(good | change, "mounting", arm=GALEN)


def test_what_can_not_be_asked_for_is_said():
    with pytest.raises(IdentificationError, match="'gains' can't be estimated"):
        entities(["gains"], arm=GALEN)
    with pytest.raises(IdentificationError, match="known mass"):
        KnownLoad(0.0, 1e-3)
    with pytest.raises(IdentificationError, match="known centre"):
        KnownLoad(0.1, 1e-3, np.zeros(3))
