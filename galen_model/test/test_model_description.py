# SPDX-License-Identifier: Apache-2.0
"""Arms read from robot descriptions, against Pinocchio on random chains."""

import numpy as np
import pinocchio
import pytest
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN, galen_urdf
from galen_model.errors import GalenError


def joint(name, kind, parent, child, rng, axis):
    xyz, rpy = rng.uniform(-0.5, 0.5, 3), rng.uniform(-3.0, 3.0, 3)
    numbers = " ".join(map(str, xyz)), " ".join(map(str, rpy)), " ".join(map(str, axis))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{numbers[0]}" rpy="{numbers[1]}"/><axis xyz="{numbers[2]}"/>'
        '<limit lower="-2" upper="2.5" effort="1" velocity="1"/></joint>'
    )


def random_robot(seed):
    """A stand, a chain of eight joints with a sensor amid, a gripper beyond it, and a branch."""
    rng = np.random.default_rng(seed)
    kinds = ["revolute", "fixed", "prismatic", "continuous", "revolute", "fixed", "revolute"]
    kinds = ["fixed", *rng.permutation(kinds), "fixed", "prismatic"]
    links = ["stand", *(f"link_{k}" for k in range(len(kinds) - 2)), "sensor", "finger", "branch"]
    axes = [rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)] for _ in kinds]
    axes = [axis / np.linalg.norm(axis) for axis in axes]
    joints = [
        joint(f"joint_{k}", kind, links[k], links[k + 1], rng, axes[k])
        for k, kind in enumerate(kinds)
    ]
    joints.append(joint("aside", "revolute", "link_0", "branch", rng, axes[0]))
    body = "".join(f'<link name="{name}"/>' for name in links)
    return f'<robot name="random">{body}{"".join(joints)}</robot>'


def reference(text, arm, q, tip_m):
    """Pose, Jacobian of a tip and gravity at joints q, of Pinocchio's whole robot."""
    model = pinocchio.buildModelFromXML(text)
    data, full, columns = model.createData(), pinocchio.neutral(model), []
    for name, value in zip(arm.joint_names, q, strict=True):
        one = model.joints[model.getJointId(name)]
        full[one.idx_q : one.idx_q + one.nq] = (
            value if one.nq == 1 else (np.cos(value), np.sin(value))
        )
        columns.append(one.idx_v)
    pinocchio.computeJointJacobians(model, data, full)
    pinocchio.updateFramePlacements(model, data)
    base = data.oMf[model.getFrameId(arm.base_frame)]
    sensor = data.oMf[model.getFrameId(arm.sensor_frame)]
    world = pinocchio.getFrameJacobian(
        model, data, model.getFrameId(arm.sensor_frame), pinocchio.LOCAL_WORLD_ALIGNED
    ).reshape(6, -1)[:, columns]
    at_tip = world.copy()
    at_tip[:3] += np.cross(world[3:].T, sensor.rotation @ tip_m).T
    turned = np.kron(np.eye(2), base.rotation.T)
    relative = base.inverse() * sensor
    return relative.rotation, relative.translation, turned @ at_tip


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("base", ["", "link_2"])
def test_any_chain_is_pinocchios(seed, base):
    text, tip_m = random_robot(seed), np.array([0.1, -0.2, 0.05])
    arm = read_arm(text, base_frame=base, sensor_frame="sensor", gravity_m_s2=(1.0, -2.0, 9.0))
    assert arm.base_frame == (base or "stand") and arm.name == "random"
    movable = [name for name in pinocchio.buildModelFromXML(text).names if name.startswith("joint")]
    after = "joint_2" if base else "joint_0"
    assert list(arm.joint_names) == [name for name in sorted(movable) if after < name < "joint_9"]
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, (6, len(arm.joints)))
    rotations, origins = arm.sensor_pose(q)
    jacobians, gravity = arm.tip_jacobian(q, tip_m), arm.gravity_in_sensor(arm.angles(q))
    for k, one in enumerate(q):
        rotation, origin, jacobian = reference(text, arm, one, tip_m)
        np.testing.assert_allclose(rotations[k], rotation, atol=1e-12)
        np.testing.assert_allclose(origins[k], origin, atol=1e-12)
        np.testing.assert_allclose(jacobians[k], jacobian, atol=1e-12)
        np.testing.assert_allclose(gravity[k], rotation.T @ [1.0, -2.0, 9.0], atol=1e-12)
        np.testing.assert_allclose(arm.sensor_pose(one)[0], rotation, atol=1e-12)


def test_a_stiff_spring_gives_the_compliance_of_the_others():
    """C = J K^-1 J^T over the elastic joints alone."""
    arm = read_arm(random_robot(3), sensor_frame="sensor")
    names = arm.joint_names[1], arm.joint_names[3]
    elastic = arm.with_stiffness(dict(zip(names, (200.0, 500.0), strict=True)))
    q, tip_m = np.full(len(arm.joints), 0.3), np.array([0.1, 0.0, 0.2])
    columns = arm.tip_jacobian(q, tip_m)[:, [1, 3]]
    expected = columns @ np.diag([1 / 200.0, 1 / 500.0]) @ columns.T
    np.testing.assert_allclose(elastic.tip_compliance(q, tip_m), expected, atol=1e-15)


def test_the_galens_description_is_the_galen():
    arm, rng = read_arm(galen_urdf(GALEN)), np.random.default_rng(1)
    assert (arm.joint_names, arm.units) == (GALEN.joint_names, GALEN.units)
    assert [joint.link for joint in arm.joints] == [joint.link for joint in GALEN.joints]
    np.testing.assert_array_equal(arm.lower, GALEN.lower)
    for q in rng.uniform(GALEN.lower, GALEN.upper, (20, 5)):
        np.testing.assert_array_equal(arm.sensor_pose(q)[1], GALEN.sensor_pose(q)[1])
        np.testing.assert_allclose(
            arm.gravity_in_sensor(q[3:]), GALEN.gravity_in_sensor(q[3:]), atol=1e-14
        )


@pytest.mark.parametrize(
    ("text", "frames", "message"),
    [
        ("no robot", {}, "not a URDF"),
        ("<robot name='a'></robot>", {}, "not a URDF|no root link"),
        (" " * 10_000_001, {}, "10000001 characters; at most 10000000"),
        (None, {"sensor_frame": "tool0"}, "no frame 'tool0'; its frames are stand, link_0"),
        (None, {"base_frame": "nowhere"}, "no frame 'nowhere'"),
        (None, {"base_frame": "branch"}, "not carried by 'branch'"),
        (None, {"base_frame": "sensor"}, "no movable joint lies between 'sensor' and 'sensor'"),
    ],
)
def test_names_what_a_description_lacks(text, frames, message):
    with pytest.raises(GalenError, match=message):
        read_arm(random_robot(0) if text is None else text, **{"sensor_frame": "sensor", **frames})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"continuous"', '"floating"', "degrees of freedom; revolute, continuous and"),
        ('"continuous"', '"planar"', "degrees of freedom; revolute, continuous and"),
        ("<limit", '<mimic joint="joint_1" multiplier="2"/><limit', "follows joint_1"),
    ],
)
def test_rejects_joints_that_it_can_not_move(old, new, message):
    with pytest.raises(GalenError, match=message):
        read_arm(random_robot(0).replace(old, new), sensor_frame="sensor")


LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def one_joint(kind="revolute", axis="0 0 1", limit=LIMIT):
    return (
        '<robot name="one"><link name="base"/><link name="ft_sensor"/>'
        f'<joint name="only" type="{kind}"><parent link="base"/><child link="ft_sensor"/>'
        f'<origin xyz="0 0 1" rpy="0.3 0 0"/><axis xyz="{axis}"/>{limit}</joint></robot>'
    )


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_reads_an_arm_of_one_joint(kind):
    arm = read_arm(one_joint(kind, "0 3 4"), sensor_frame="ft_sensor")
    np.testing.assert_allclose(arm.joints[0].axis, [0.0, 0.6, 0.8], atol=1e-15)
    assert arm.endless.tolist() == [kind == "continuous"]
    rotation, _, _ = reference(one_joint(kind, "0 3 4"), arm, [0.7], np.zeros(3))
    np.testing.assert_allclose(arm.sensor_pose([0.7])[0], rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "prismatic"}, "no revolute joint lies between 'base' and 'ft_sensor'"),
        ({"axis": "0 0 0"}, "joint 'only' has the axis \"0 0 0\""),
        ({"limit": ""}, "joint 'only' is revolute and has no <limit> with effort and velocity"),
        ({"limit": LIMIT.replace("velocity", "speed")}, "no <limit> with velocity: add it"),
        ({"limit": '<limit effort="1" velocity="1"/>'}, "'only' .* without lower and upper"),
        ({"limit": LIMIT.replace("-1", "2")}, "'only' has the limits 2 to 1: lower is above upper"),
    ],
)
def test_names_the_joint_that_an_arm_can_not_use(change, message):
    with pytest.raises(GalenError, match=message):
        read_arm(one_joint(**change))


def test_rejects_more_links_than_the_parser_can_follow():
    links = "".join(f'<link name="l{k}"/>' for k in range(5000))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k in range(4999)
    )
    with pytest.raises(GalenError, match="has 5000 links; at most 1000 are read"):
        read_arm(f"<robot name='long'>{links}{joints}</robot>", sensor_frame="l4999")


def test_a_fault_of_the_parser_is_an_error_of_the_description(monkeypatch):
    def broken(text):
        raise RuntimeError("out of order")

    monkeypatch.setattr(pinocchio, "buildModelFromXML", broken)
    with pytest.raises(GalenError, match="can't be read: out of order"):
        read_arm(one_joint())


def test_an_endless_joint_is_nearest_by_whole_turns():
    arm = read_arm(one_joint("continuous"))
    near = arm.nearest([[3.1], [-3.1], [9.5]], [[-3.1], [3.1], [3.2]])
    np.testing.assert_allclose(near[:, 0] + [2 * np.pi, -2 * np.pi, 2 * np.pi], [3.1, -3.1, 9.5])
    assert arm.nearest([7.0], [np.nan]) == [7.0]
    wrapped = np.array([[3.1], [np.nan], [-3.1], [-3.0], [3.1]])
    true = [3.1, np.nan, 2 * np.pi - 3.1, 2 * np.pi - 3.0, 3.1]
    np.testing.assert_allclose(arm.unwrapped(wrapped)[:, 0], true)
    assert read_arm(one_joint()).nearest([7.0], [0.0]) == [7.0]


def test_limits_of_velocity_are_kept_where_the_description_has_them():
    text = random_robot(0)
    arm = read_arm(text, sensor_frame="sensor")
    turning = [joint for joint in arm.joints if np.isfinite(joint.upper)]
    assert {joint.max_velocity for joint in turning} == {1.0}
    unknown = read_arm(text.replace('velocity="1"', 'velocity="0"'), sensor_frame="sensor")
    assert {joint.max_velocity for joint in unknown.joints} == {np.inf}


def test_the_galen_goes_no_faster_than_its_description_allows():
    text = GALEN.urdf.replace('velocity="1.5"', 'velocity="0.4"')
    arm = read_arm(text)
    assert arm.delta is GALEN.delta
    assert [joint.max_velocity for joint in arm.joints] == [0.2, 0.2, 0.2, 0.4, 0.4]


def test_a_xacro_is_told_how_to_expand():
    text = (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:property name="a" value="1"/><link name="base_link"/></robot>'
    )
    with pytest.raises(GalenError, match="it is a xacro: run `xacro FILE"):
        read_arm(text)
