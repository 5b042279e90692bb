# SPDX-License-Identifier: Apache-2.0
"""Each correction on a six-axis arm, on the floor and on a wall, against Pinocchio's bodies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_common.stream.samples import PairedWrench
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections.cable import CablePull
from galen_gravcomp.evaluate.bag import EvaluationSettings, evaluate_bag
from galen_gravcomp.evaluate.bag_report import to_json
from galen_gravcomp.evaluate.plots import plot_evaluation
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.description import read_arm
from galen_model.arm.galen import SENSOR
from galen_model.load.cable import LearnedPull
from galen_model.load.mounting import Mounting
from galen_model.load.verdict import Cause
from motion_tape import MS, START_NS, measured, readings, swing, tool_file

URDF = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
FLOOR = read_arm(URDF)
WALL = read_arm(URDF, gravity_m_s2=(0.0, 9.80665, 0.0))
PUSH = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])


def compensator(tool, **settings):
    made = Compensator(GravcompParameters(**settings), arm=tool.arm)
    made.set_tool(tool)
    return made


def outcomes(made, joints, wrenches, stamps=None):
    """What comes out; stamps (n,) ns, or 2 ms apart."""
    results = []
    stamps = START_NS + 2 * MS * np.arange(len(joints)) if stamps is None else stamps
    for stamp, q, wrench in zip(stamps.tolist(), joints.tolist(), wrenches, strict=True):
        results += made.push_joints(stamp, tuple(q))
        results += made.push_wrench(stamp, wrench)
    return [result.wrench for result in results if isinstance(result, PairedWrench)]


def at_rest(arm, poses=40, samples=1, step_ns=2 * MS):
    """Poses in which nothing moves, as `swing` gives them; and stamps, 0.9 s from pose to pose."""
    q = np.random.default_rng(4).uniform(-2.5, 2.5, (poses, len(arm.joints)))
    q = np.repeat(q, samples, axis=0)
    pauses = np.repeat(np.arange(poses), samples) * 900 * MS
    return (q, 0.0 * q, 0.0 * q), START_NS + pauses + np.arange(len(q)) * step_ns


def noisy(wrench):
    return wrench + SENSOR.noise_std * np.random.default_rng(1).standard_normal(wrench.shape)


@pytest.mark.parametrize("arm", [FLOOR, WALL])
def test_the_weight_is_subtracted_whole(arm):
    motion, stamps = at_rest(arm)
    made = compensator(tool_file(arm=arm))
    out = outcomes(made, motion[0], readings(motion, arm) + PUSH, stamps)
    np.testing.assert_allclose(out, np.tile(PUSH, (40, 1)), atol=1e-9)


@pytest.mark.parametrize("arm", [FLOOR, WALL])
def test_a_mounting_is_undone(arm):
    """The true joints and gravity are others than reported; the sensor is turned, with gains."""
    vector = np.random.default_rng(2).uniform(-0.05, 0.05, 18)
    mounting = Mounting.from_vector(vector, joints=arm.turning_names)
    # home, where the sensor was zeroed, is as far off as any pose
    zero = mounting.joint_zero_rad
    inclined = replace(
        arm,
        gravity_m_s2=mounting.inclination @ arm.gravity_m_s2,
        joints=tuple(
            replace(joint, home=joint.home + off)
            for joint, off in zip(arm.joints, zero, strict=True)
        ),
    )
    (reported, *still), stamps = at_rest(arm)
    true = readings((reported + zero, *still), inclined)
    seen = (true + PUSH) @ mounting.reading_from_wrench.T
    out = outcomes(compensator(tool_file(arm=arm, mounting=mounting)), reported, seen, stamps)
    np.testing.assert_allclose(out, np.tile(PUSH, (40, 1)), atol=1e-9)


@pytest.mark.parametrize("arm", [FLOOR, WALL])
def test_inertial_forces_are_subtracted_to_the_polynomials_bias(arm):
    times = np.arange(0.0, 2.0, 0.002)
    tool, motion = tool_file(arm=arm), swing(times, arm=arm)
    wrench, moving = readings(motion, arm), {"motion": "joints", "calibration_monitor": False}
    out = outcomes(compensator(tool, **moving), motion[0], wrench)
    assert len(out) > 0.97 * len(times)
    assert np.max(np.abs(out) / SENSOR.noise_std) < 0.3
    static = outcomes(compensator(tool, calibration_monitor=False), motion[0], wrench)
    assert np.min(np.abs(static).max(axis=0) / SENSOR.noise_std) > 10.0
    # with the encoders' steps, differentiated twice, at the end of a long arm
    joints, wrench = measured(motion, np.random.default_rng(2), arm)
    out = outcomes(compensator(tool, **moving), joints, wrench)
    assert np.max(np.sqrt(np.mean(np.square(out), axis=0)) / SENSOR.noise_std) < 1.7


def test_an_endless_joint_s_inertial_forces_are_known_through_half_a_turn():
    endless = replace(FLOOR.joints[5], lower=-np.inf, upper=np.inf)
    arm = replace(FLOOR, joints=(*FLOOR.joints[:5], endless))
    motion = swing(np.arange(0.0, 1.0, 0.002), arm=arm)
    joints, wrench = motion[0], readings(motion, arm)
    wrapped = joints.copy()
    wrapped[joints[:, 5] > joints[:, 5].mean(), 5] -= 2.0 * np.pi
    tool, moving = tool_file(arm=arm), {"motion": "joints", "calibration_monitor": False}
    expected = outcomes(compensator(tool, **moving), joints, wrench)
    found = outcomes(compensator(tool, **moving), wrapped, wrench)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_cable_pulls_alike_one_by_one_and_in_arrays():
    rng = np.random.default_rng(3)
    joints = np.tile([0.3, -1.2, 1.4, -0.4, 0.9, 0.2], (30, 1))
    joints[:, 3:] += rng.uniform(-0.7, 0.7, (30, 3))
    pull = LearnedPull(
        "point_and_couple", joints, 0.2 * rng.normal(size=(30, 6)), np.full((30, 6), 0.01),
        np.linspace(0.8, 1.2, 6), 0.15, np.array([0.2, 0.02]), 0.4, "", np.array([0.1, 0, 0.05]),
        arm=FLOOR,
    )  # fmt: skip
    at = joints + 0.02 * rng.normal(size=joints.shape)
    fast = CablePull(pull, FLOOR)
    expected = pull.posterior.readings(at)
    np.testing.assert_allclose([fast.reading(tuple(q)) for q in at], expected, atol=1e-10)
    made = compensator(tool_file(arm=FLOOR, cable=pull))
    weight = readings((at, 0.0 * at, 0.0 * at), FLOOR)
    out = outcomes(made, at, weight + expected + PUSH, START_NS + 1000 * MS * np.arange(30))
    np.testing.assert_allclose(out, np.tile(PUSH, (30, 1)), atol=1e-9)


def test_bias_drift_monitor_and_tare_leave_a_healthy_arm_alone():
    rest, stamps = at_rest(WALL, 12, 500)
    joints, wrench = rest[0], noisy(readings(rest, WALL))
    made, answers = compensator(tool_file(arm=WALL), bias_drift=True), []
    assert len(outcomes(made, joints[:4000], wrench[:4000], stamps[:4000])) == 4000
    made.start_tare(lambda message, offset: answers.append((message, offset)))
    outcomes(made, joints[4000:], wrench[4000:], stamps[4000:])
    assert answers[0][1] is not None, answers
    assert np.all(np.abs(answers[0][1]) < 0.5 * SENSOR.noise_std)
    assert np.all(np.abs(made.bias_drift_offset) < SENSOR.noise_std)


def test_a_recording_is_evaluated_and_drawn(tmp_path):
    tool, lighter_kg = tool_file(arm=WALL), 0.02
    rest, stamps = at_rest(WALL, 16, 150, 10 * MS)
    wrench = noisy(readings(rest, WALL))
    states, forces = joint_state_bytes(WALL.joint_names), wrench_bytes("ft_sensor")
    with BagWriter(tmp_path / "bag") as bag:
        topics = (
            bag.add_topic("joint_states", "sensor_msgs/msg/JointState"),
            bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped"),
        )
        for stamp, q, reading in zip(stamps.tolist(), rest[0], wrench, strict=True):
            bag.write(topics[0], stamp, states.fill(stamp, q.tolist(), [0.0] * 6))
            bag.write(topics[1], stamp, forces.fill(stamp, reading.tolist()))
    file = replace(tool, load=replace(tool.load, mass_kg=tool.load.mass_kg - lighter_kg))
    result = evaluate_bag(tmp_path / "bag", file, EvaluationSettings())
    assert result.verdict.cause is Cause.LOAD
    assert result.compensated == len(stamps) and len(result.phases) == 16
    assert list(to_json(result)["worst_poses"][0]["angles_rad"]) == list(WALL.turning_names)
    assert plot_evaluation(result, tmp_path, "wall").stat().st_size > 10_000
    # the mass alone is another: the first moment is the file's centre times the difference
    assert result.parts.values["load"][0] == pytest.approx(lighter_kg, abs=0.002)
