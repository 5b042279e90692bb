import numpy as np
import pytest
from galen_model.arm.galen import GALEN, LIMITS
from galen_model.arm.kinematics import joint_axes, sensor_pose, tip_jacobian, tip_pose
from galen_model.arm.stiffness import deflection, platform_stiffness
from galen_model.arm.urdf import galen_urdf
from galen_model.rotation import matrix_to_rotvec
from galen_model.wrench import move_twist, move_wrench
from galen_panel.page.live.arm_view import (
    bent_frames,
    delta_parts,
    force_in_base,
    frames,
    read_urdf,
    share,
)

TIP = np.array([0.18, 0.01, 0.05])
MODEL = read_urdf(galen_urdf(TIP))


def poses(count, seed=5):
    rng = np.random.default_rng(seed)
    joints = LIMITS.lower + rng.random((count, 5)) * (LIMITS.upper - LIMITS.lower)
    joints[:, 2] = rng.uniform(0.3, 0.48, count)
    return joints


@pytest.mark.parametrize("joints", poses(20))
def test_frames_are_where_the_kinematics_have_them(joints):
    placed = frames(MODEL, joints)
    roll_point, _, tilt_point, _ = joint_axes(joints)
    for link, rotation, origin in (
        ("delta_platform", np.eye(3), joints[:3]),
        ("roll_link", None, roll_point),
        ("tilt_link", None, tilt_point),
        ("ft_sensor", *sensor_pose(joints)),
        ("tool_tip", *tip_pose(joints, TIP)),
    ):
        np.testing.assert_allclose(placed[link].origin_m, origin, atol=1e-12)
        if rotation is not None:
            np.testing.assert_allclose(placed[link].rotation, rotation, atol=1e-12)


def test_every_shape_of_the_urdf_is_read():
    shapes = {shape.link: shape for shape in MODEL.shapes}
    assert set(shapes) == {
        "base_link", "delta_platform", "roll_link", "tilt_link", "ft_sensor", "tool_tip",
    }  # fmt: skip
    roll = shapes["roll_link"]
    assert (roll.kind, roll.sizes_m) == ("cylinder", (0.02, 0.6085))
    # Its axis is z and it lies along the link's x.
    np.testing.assert_allclose(roll.pose.rotation @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(roll.pose.origin_m, [0.30425, 0, 0], atol=1e-12)
    assert (shapes["tool_tip"].kind, shapes["tool_tip"].sizes_m) == ("sphere", (0.004,))


def to_the_tip(joints, bend):
    """What a bend does to the tip, to first order."""
    _, tip = tip_pose(joints, TIP)
    twist = move_twist(bend.platform, joints[:3], tip)
    return twist + tip_jacobian(joints, TIP)[:, 3:] @ [bend.roll_rad, bend.tilt_rad]


@pytest.mark.parametrize("joints", poses(10, seed=6))
def test_the_shares_add_up_to_the_deflection(joints):
    rng = np.random.default_rng(7)
    # Any twist, not only one that the nominal model would predict.
    twist = rng.normal(size=6) * [3e-4, 3e-4, 3e-4, 1e-3, 1e-3, 1e-3]
    bend = share(joints, twist, TIP)
    np.testing.assert_allclose(to_the_tip(joints, bend), twist, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("joints", poses(10, seed=8))
def test_of_a_nominal_deflection_each_spring_has_its_own_part(joints):
    wrench = np.array([8.0, -5.0, 3.0, 0.2, -0.1, 0.3])
    bend = share(joints, deflection(joints, wrench, TIP), TIP)
    rotation, origin = sensor_pose(joints)
    force, torque = rotation @ wrench[:3], rotation @ wrench[3:]
    roll_point, roll_axis, tilt_point, tilt_axis = joint_axes(joints)
    for angle, point, axis, stiffness in (
        (bend.roll_rad, roll_point, roll_axis, GALEN.roll_stiffness_nm_rad),
        (bend.tilt_rad, tilt_point, tilt_axis, GALEN.tilt_stiffness_nm_rad),
    ):
        moment = axis @ (torque + np.cross(origin - point, force))
        assert angle == pytest.approx(moment / stiffness, rel=1e-6)
    at_centre = move_wrench(wrench, rotation, origin - joints[:3])
    platform = np.linalg.solve(platform_stiffness(joints[:3]), at_centre)
    np.testing.assert_allclose(bend.platform, platform, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("joints", poses(10, seed=9))
def test_the_bent_tip_is_displaced_by_the_deflection(joints):
    twist = np.array([2e-4, -3e-4, 1e-4, 4e-4, -2e-4, 5e-4])
    bend = share(joints, twist, TIP)
    straight, bent = frames(MODEL, joints), bent_frames(MODEL, joints, bend)
    moved = bent["tool_tip"].origin_m - straight["tool_tip"].origin_m
    # To first order: the rest is of the size of an angle's square times a metre.
    np.testing.assert_allclose(moved, twist[:3], atol=3e-6)
    turned = bent["tool_tip"].rotation @ straight["tool_tip"].rotation.T
    np.testing.assert_allclose(matrix_to_rotvec(turned), twist[3:], atol=3e-6)
    assert set(bent) == {"delta_platform", "roll_link", "tilt_link", "ft_sensor", "tool_tip"}


def test_without_a_deflection_nothing_bends():
    joints = poses(1)[0]
    bent = bent_frames(MODEL, joints, share(joints, np.zeros(6), TIP).times(500.0))
    for link, pose in bent.items():
        np.testing.assert_allclose(pose.origin_m, frames(MODEL, joints)[link].origin_m, atol=1e-12)


def test_exaggeration_multiplies_the_platforms_way():
    joints = poses(1)[0]
    bend = share(joints, np.array([3e-4, 0, 0, 0, 0, 0]), TIP)
    moved = [
        bent_frames(MODEL, joints, bend.times(factor))["delta_platform"].origin_m - joints[:3]
        for factor in (1.0, 50.0)
    ]
    np.testing.assert_allclose(moved[1], 50.0 * moved[0], atol=1e-12)
    assert np.linalg.norm(moved[0]) > 1e-6


@pytest.mark.parametrize("joints", poses(10, seed=10))
def test_rods_keep_their_length_and_stand_on_the_carriages(joints):
    parts = delta_parts(joints[:3])
    lengths = np.linalg.norm(parts.end_m - parts.start_m, axis=1)
    np.testing.assert_allclose(lengths, GALEN.rod_length_m, atol=1e-12)
    radii = np.linalg.norm(parts.carriages_m[:, :2], axis=1)
    np.testing.assert_allclose(radii, GALEN.rail_radius_m, atol=1e-12)
    home = delta_parts(np.array([0.0, 0.0, 0.408])).carriages_m[:, 2]
    travel = GALEN.delta.carriages(joints[:3], check_travel=False)
    np.testing.assert_allclose(parts.carriages_m[:, 2] - home, travel, atol=1e-12)


def test_rods_that_cannot_reach_are_left_out():
    assert delta_parts(np.array([0.5, 0.0, 0.4])) is None


def test_a_force_along_the_sensors_x_points_down_at_home():
    home = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    np.testing.assert_allclose(
        force_in_base(home, np.array([2.0, 0, 0, 0, 0, 0])), [0, 0, -2.0], atol=1e-12
    )
