# SPDX-License-Identifier: Apache-2.0
"""The simulated driver with an arm that is not the Galen, against Pinocchio."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
import sim_bench
from galen_common.parameters import param_fields
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, TOOLS, gravity_wrench
from galen_model.rotation import rotvec_to_matrix
from galen_ros.messages import LATCHED
from galen_ros.node.testing import Harness
from galen_sim_driver.effects.effect import ConfigError, Instants, Loading
from galen_sim_driver.effects.hysteresis import DeflectionHysteresis
from galen_sim_driver.effects.joints import compliance
from galen_sim_driver.effects.registry import contract_parameters, effect_from, identities
from galen_sim_driver.parameters import (
    DriverParameters,
    driver_parameters,
    effect_parameters,
    effects_of,
)
from galen_sim_driver.plant.config import (
    BASE_IN_TRACKER,
    HandPush,
    PlantError,
    acceleration_limits,
    velocity_limits,
)
from galen_sim_driver.plant.geometry import tip_jacobian
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from sim_bench import EXACT, run, typical
from std_msgs.msg import String
from test_sim_node import Cell

URDF = Path(__file__).resolve().parents[2] / "galen_bringup" / "urdf" / "six_axis.urdf"
TEXT = URDF.read_text()
GRAVITY = (3.0, -2.0, -9.1)
SIX = read_arm(TEXT, sensor_frame="tool0", gravity_m_s2=GRAVITY)
# A rail under it: seven joints of two kinds, so redundant.
RAIL = TEXT.replace(
    '<link name="base_link">',
    '<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/>'
    '<child link="base_link"/><axis xyz="1 0 0"/>'
    '<limit lower="-0.5" upper="0.5" effort="1" velocity="0.1"/></joint><link name="base_link">',
    1,
)
ON_RAIL = read_arm(RAIL, sensor_frame="tool0")
ELBOW_UP = (0.2, -1.1, 1.6, 0.5, 1.2, -0.4)
RETRACTOR = TOOLS["retractor"]


def make_plant(arm=SIX, **changes):
    return sim_bench.make_plant(
        "retractor", arm=arm, **{"start_joints": ELBOW_UP} | EXACT | changes
    )


def pinocchio_pose(text, joints, frame="tool0"):
    """R_base_frame and the frame's origin."""
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.asarray(joints, dtype=float))
    at = data.oMf[model.getFrameId(frame)]
    return at.rotation, at.translation


def weight(rotation, *loads):
    gravity = rotation.T @ np.array(GRAVITY)
    force = sum(load.mass_kg * gravity for load in loads)
    torque = sum(np.cross(load.com_m, load.mass_kg * gravity) for load in loads)
    return np.concatenate([force, torque])


# --- the plant ------------------------------------------------------------------------------------


def test_the_reading_at_rest_is_the_contracts_model_by_pinocchio():
    for seed in range(5):
        joints = np.random.default_rng(seed).uniform(SIX.lower, SIX.upper)
        sample = make_plant(start_joints=tuple(joints)).step()
        rotation, _ = pinocchio_pose(TEXT, joints)
        zeroed, _ = pinocchio_pose(TEXT, np.zeros(6))
        expected = weight(rotation, RETRACTOR.load, ADAPTER) - weight(zeroed, ADAPTER)
        assert sample.wrench == pytest.approx(expected, abs=1e-12)
        assert sample.positions == pytest.approx(joints, abs=0.5 * 5e-5 + 1e-12)


def test_the_tracker_sees_the_tip_where_pinocchio_has_it():
    (tool_m, _), _ = make_plant(tracker_rate_hz=500.0).step().tracker
    rotation, origin = pinocchio_pose(TEXT, ELBOW_UP)
    tip = origin + rotation @ RETRACTOR.tip_m
    there = rotvec_to_matrix(BASE_IN_TRACKER.rotvec_rad) @ tip + BASE_IN_TRACKER.translation_m
    assert tool_m == pytest.approx(there, abs=1e-12)


def test_a_trajectory_is_followed_within_the_limits():
    plant = make_plant(ON_RAIL, start_joints=())
    names, goal = ON_RAIL.joint_names[::-1], [0.3, -0.5, 0.9, -0.4, 0.2, -0.8, 0.15]
    plant.command(Trajectory(names, [TrajectoryPoint(4.0, goal, [0.0] * 7, [0.0] * 7)]))
    samples = run(plant, 2100)
    assert samples[0].true_joints == pytest.approx(ON_RAIL.home, abs=1e-4)
    assert samples[-1].true_joints == goal[::-1]
    velocities = np.array([sample.true_velocities for sample in samples])
    assert (np.abs(velocities).max(axis=0) <= velocity_limits(ON_RAIL)).all()
    changes = np.abs(np.diff(velocities, axis=0)).max(axis=0) / 0.002
    assert (changes <= np.array(acceleration_limits(ON_RAIL)) * (1 + 1e-6)).all()
    with pytest.raises(PlantError, match="unknown joint 'roll'; the arm has rail, shoulder_pan"):
        plant.command(Trajectory(["roll"], [TrajectoryPoint(1.0, [0.0])]))


def test_a_description_may_ask_for_slower_joints_but_not_for_faster_ones():
    assert velocity_limits(ON_RAIL) == (0.1, *[1.5] * 6)
    assert velocity_limits(GALEN) == (0.2, 0.2, 0.2, 1.5, 1.5)


@pytest.mark.parametrize("arm", [GALEN, SIX, ON_RAIL], ids=["galen", "six", "redundant"])
def test_the_jacobian_in_plain_floats_is_the_arms(arm):
    rng = np.random.default_rng(2)
    for joints in rng.uniform(arm.lower, arm.upper, (20, len(arm.joints))):
        rotation, columns = tip_jacobian(arm, joints.tolist(), RETRACTOR.tip_m.tolist())
        expected = arm.tip_jacobian(joints, RETRACTOR.tip_m)
        assert np.abs(np.transpose(columns) - expected).max() < 1e-13
        assert np.abs(np.reshape(rotation, (3, 3)) - arm.sensor_pose(joints)[0]).max() < 1e-13


def follow_push(arm, joints, force):
    """Push for 0.8 s at the tip in admittance mode; return the tip's way and the samples."""
    plant = make_plant(arm, start_joints=tuple(joints), hand=[HandPush(0.0, 3.0, force)])

    def weight_at(joints):
        gravity = arm.gravity_in_sensor(arm.angles(joints))
        return sum(gravity_wrench(gravity, load) for load in (RETRACTOR.load, ADAPTER))

    plant.set_admittance(True)
    zero = plant.step().wrench - weight_at(joints)
    plant.start_hand()
    samples = []
    for _ in range(400):
        samples.append(sample := plant.step())
        compensated = sample.wrench - zero - weight_at(sample.true_joints)
        plant.admittance.feed(sample.stamp_ns, compensated)
    ends = [arm.tip_pose(q, RETRACTOR.tip_m)[1] for q in (joints, samples[-1].true_joints)]
    return ends[1] - ends[0], samples


@pytest.mark.parametrize(
    ("arm", "joints"), [(SIX, ELBOW_UP), (ON_RAIL, (0.1, *ELBOW_UP))], ids=["six", "redundant"]
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_in_admittance_mode_the_tip_goes_along_the_push(arm, joints, axis):
    force = np.zeros(3)
    force[axis] = 5.0
    way, _ = follow_push(arm, joints, tuple(force))
    # 5 N for 0.8 s but for the ramps: 0.05 m/s.
    assert 0.025 < way[axis] < 0.04
    assert np.abs(np.delete(way, axis)).max() < 0.1 * way[axis]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_singular_pose_moves_slowly_instead_of_running_away(axis):
    force = np.zeros(3)
    force[axis] = 20.0
    assert np.linalg.svd(SIX.tip_jacobian(SIX.home, RETRACTOR.tip_m))[1][-1] < 1e-6
    way, samples = follow_push(SIX, SIX.home, tuple(force))
    speeds = np.abs([sample.true_velocities for sample in samples])
    assert speeds.max() <= 1.5 * (1 + 1e-9)
    assert np.linalg.norm(way) < 20.0 * 0.01 * 0.8
    assert way[axis] > 0.0


# --- effects --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", identities(SIX))
def test_every_effect_of_the_arm_is_a_set_of_the_drivers_parameters(name):
    if name == "joint_compliance":
        effect = effect_from(name, {"stiffness": {"elbow": 5000.0}}, SIX)
    elif name == "backlash":
        effect = effect_from(name, {"gap_rad": 0.004, "joint": "wrist_2"}, SIX)
    else:
        effect = typical(identities(SIX)[name])
    told = driver_parameters([effect])
    kind = effect_parameters(SIX)
    assert told.keys() <= param_fields(kind).keys()
    lists = {key: tuple(value) for key, value in told.items() if isinstance(value, list)}
    assert effects_of(kind(**told | lists)) == (effect,)


def test_an_axis_is_turned_in_the_parent_link_by_pinocchio():
    angle = 0.03
    # wrist_1 sits turned in its parent link and turns about y.
    effect = effect_from(
        "joint_axis_misalignment", {"joint": "wrist_1", "about": "z", "angle_rad": angle}, SIX
    )
    model = pinocchio.buildModelFromXML(TEXT)
    index = model.getJointId("wrist_1")
    turn = pinocchio.exp3(np.array([0.0, 0.0, angle]))
    joints = np.array(ELBOW_UP)
    placement = model.jointPlacements[index]
    own = placement.rotation.T @ turn @ placement.rotation
    rotation_q = pinocchio.exp3(np.array([0.0, joints[3], 0.0]))
    data = model.createData()
    still = joints.copy()
    still[3] = 0.0
    pinocchio.framesForwardKinematics(model, data, still)
    before = data.oMi[index]
    moved = before.rotation @ own @ rotation_q @ own.T @ before.rotation.T
    at_zero = data.oMf[model.getFrameId("tool0")].rotation
    found, _ = effect.misaligned(SIX).sensor_pose(joints)
    assert np.abs(found - moved @ at_zero).max() < 1e-12


def test_a_push_live_on_a_soft_arm_leaves_no_more_than_the_fraction_asked_for():
    soft = SIX.with_stiffness(dict.fromkeys(SIX.joint_names, 8000.0))
    compliance = soft.tip_compliance(ELBOW_UP, RETRACTOR.tip_m)
    effect = DeflectionHysteresis(0.1).fresh()

    def deflected(load):
        wrench = np.outer(load, np.eye(6)[1])
        joints, at_s = np.tile(ELBOW_UP, (len(load), 1)), 0.01 * np.arange(len(load))
        given = Loading(joints, wrench, wrench @ compliance.T, RETRACTOR.tip_m, soft)
        return effect.deflect(Instants("push", at_s, at_s), given)[:, 1]

    deflected(np.zeros(1))
    left = deflected(10.0 * np.sin(np.linspace(0.0, np.pi, 100)))[-1]
    assert 0.01 < left / (10.0 * compliance[1, 1]) <= 0.1


def test_stiffnesses_are_counted_from_the_rigid_arm():
    effect = effect_from("joint_compliance", {"stiffness": {"elbow": 5000.0}}, SIX)
    assert contract_parameters(effect) == {"stiffness": {"elbow": 5000.0}}
    softness = effect.vector()
    assert softness.tolist() == [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]
    assert effect.with_vector(softness) == effect
    column = SIX.tip_jacobian(ELBOW_UP, RETRACTOR.tip_m)[:, 2]
    found = effect.arm(SIX).tip_compliance(ELBOW_UP, RETRACTOR.tip_m)
    assert found == pytest.approx(np.outer(column, column) / 5000.0)
    nothing = identities(SIX)["joint_compliance"]
    assert nothing.changes_nothing and not SIX.tip_compliance(ELBOW_UP, RETRACTOR.tip_m).any()


def test_joints_of_other_arms_and_names_that_clash_are_named():
    with pytest.raises(ConfigError, match="joint is 'tilt', not one of shoulder_pan, shoulder_l"):
        effect_from("joint_zero_offset", {"joint": "tilt", "offset_rad": 0.01}, SIX)
    with pytest.raises(ConfigError, match=r"no parameter 'stiffness\.roll'; known: stiff"):
        effect_from("joint_compliance", {"stiffness": {"roll": 1000.0}}, SIX)
    clash = read_arm(TEXT.replace('"elbow"', '"wrist-1"'), sensor_frame="tool0")
    with pytest.raises(ConfigError, match="two joints of six_axis make the parameter 'k_wrist_1'"):
        compliance(clash)


def test_a_joints_name_may_be_any():
    odd = read_arm(TEXT.replace('"elbow"', '"arm/2.joint-x"'), sensor_frame="tool0")
    given = {"stiffness": {"arm/2.joint-x": 4e3}}
    told = driver_parameters([effect_from("joint_compliance", given, odd)])
    assert told["joint_compliance_stiffness_arm_2_joint_x"] == 4e3
    assert "joint_gain_arm_2_joint_x" in param_fields(effect_parameters(odd))


# --- the node -------------------------------------------------------------------------------------


def test_the_node_is_the_arm_of_its_file():
    with Harness() as harness:
        cell = Cell(
            harness,
            urdf_file=str(URDF),
            sensor_frame="tool0",
            gravity_m_s2=list(GRAVITY),
            start_joints=list(ELBOW_UP),
            initial_tool="retractor",
            joint_zero_offset_wrist_2_rad=0.01,
        )
        texts = []
        cell.probe.create_subscription(String, "robot_description", texts.append, LATCHED)
        cell.wait(lambda: texts and cell.tool_poses and cell.value("effects"), "the arm")
        assert texts[0].data == TEXT
        assert tuple(cell.joints[-1].name) == SIX.joint_names
        assert cell.wrenches[-1].header.frame_id == "tool0"
        assert cell.value("effects") == "joint_zero_offset:wrist_2"
        rotation, _ = pinocchio_pose(TEXT, np.array(ELBOW_UP) + [0, 0, 0, 0, 0.01, 0])
        zeroed, _ = pinocchio_pose(TEXT, [0, 0, 0, 0, 0.01, 0])
        expected = weight(rotation, RETRACTOR.load, ADAPTER) - weight(zeroed, ADAPTER)
        mean = cell.fresh_wrenches(200).mean(axis=0)
        assert mean == pytest.approx(expected, abs=0.015)
        cell.send(["wrist_3", "elbow"], [0.0, 1.5], 0.5)
        cell.wait(lambda: cell.positions()[5] == 0.0, "the motion")
        assert cell.positions() == pytest.approx(
            [*ELBOW_UP[:2], 1.5, *ELBOW_UP[3:5], 0.0], abs=5e-5
        )


def test_an_arm_that_cant_be_read_ends_the_start_with_the_reason(tmp_path):
    with Harness() as harness, pytest.raises(GalenError, match=r"no frame 'ft_7'; its frames are"):
        Cell(harness, urdf_file=str(URDF), sensor_frame="ft_7")
    with pytest.raises(GalenError, match="start_joints has 5 numbers, but must have 6"):
        replace(DriverParameters(), start_joints=(0.0,) * 5).plant_config(SIX).validate()
