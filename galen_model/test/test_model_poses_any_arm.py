# SPDX-License-Identifier: Apache-2.0
"""Poses of another arm than the Galen: what they tell, where they lie, what they keep clear of."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from galen_model.arm.clearance import ArmClearance, ObstacleError, boxes_from_numbers
from galen_model.arm.description import read_arm
from galen_model.errors import NotExcitedError
from galen_model.poses.design import PoseDesign, compensation_std, reading_noise, workspace_gravity
from galen_model.poses.plan import Surroundings, SweepRange, SweepTimes, plan_as_is, plan_chosen
from model_files import SIX_AXIS as ARM
from model_files import SIX_AXIS_URDF as URDF

HERE = np.array([0.2, -1.2, 1.6, -1.2, -1.57, 0.3])
FOLDED = np.array([0.0, -0.5, 2.7, 0.2, -1.57, 0.0])  # ft_sensor in the upper arm
TIP = np.array([0.05, 0.0, 0.15])
# A plate that is turned on a stand, a slide, and a joint without limits.
SLIDE_AND_TURN = """<robot name="other"><link name="stand"/><link name="plate"/><link name="sled"/>
<link name="ft_sensor"/>
<joint name="fixed" type="fixed"><parent link="stand"/><child link="plate"/>
<origin xyz="0.3 0 1" rpy="0.4 0 0.7"/></joint>
<joint name="slide" type="prismatic"><parent link="plate"/><child link="sled"/>
<origin xyz="0 0.1 0.2" rpy="0 0.3 0"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="turn" type="continuous"><parent link="sled"/><child link="ft_sensor"/>
<origin xyz="0.1 0 0.3"/><axis xyz="0 1 0"/></joint></robot>"""
TIMES = SweepTimes(HERE, np.full(6, 0.8), np.full(6, 3.0), 1.9)
COUNT = 18


def around(reach_rad=1.2, here=HERE, arm=ARM):
    return SweepRange.around(here, reach_rad, arm, remedy="enlarge pose_box_rad")


def chosen(reach_rad=1.2, boxes=(), here=HERE, count=COUNT, arm=ARM):
    surroundings = Surroundings(boxes_from_numbers(boxes), 0.03)
    return plan_chosen(count, around(reach_rad, here, arm), surroundings, TIP, TIMES)


def beside():
    """Return a box beside the tool."""
    _, origin = ARM.sensor_pose(HERE)
    return np.concatenate([origin + [0.0, 0.15, -0.3], origin + [0.4, 0.5, 0.3]])


def ways(plan, here=HERE, arm=ARM):
    """Every leg of a sweep from home to home, the poses between included."""
    stops = [here]
    for joints in [*arm.with_angles(plan.poses, here), here]:
        stops += plan.router.route(stops[-1], joints)
    return list(itertools.pairwise(stops))


class Shapes:
    """The description's own shapes in Pinocchio's own model, without any of the suite's rules."""

    def __init__(self):
        self.model = pinocchio.buildModelFromXML(URDF)
        kind = pinocchio.GeometryType.COLLISION
        self.shapes = pinocchio.buildGeomFromUrdfString(self.model, URDF, kind)
        joint = [shape.parentJoint for shape in self.shapes.geometryObjects]
        for one, other in itertools.combinations(range(len(joint)), 2):
            if abs(joint[one] - joint[other]) > 1:
                self.shapes.addCollisionPair(pinocchio.CollisionPair(one, other))
        self.data, self.found = self.model.createData(), self.shapes.createData()

    def collide(self, joints):
        return pinocchio.computeCollisions(
            self.model, self.data, self.shapes, self.found, joints, True
        )


def tip_to_box(joints, box, arm=ARM):
    """From the line of the tool to a box, m, by points on the line."""
    rotation, origin = arm.sensor_pose(joints)
    line = origin + np.linspace(0.0, 1.0, 200)[:, None] * (rotation @ TIP)
    outside = np.maximum(np.maximum(box[:3] - line, line - box[3:]), 0.0)
    return np.min(np.linalg.norm(outside, axis=1))


@pytest.fixture(scope="module")
def plan():
    return chosen()


def test_chosen_poses_tell_nearly_what_directions_all_over_the_sphere_do(plan):
    gravity = workspace_gravity(ARM)
    assert len(gravity) == 625  # the arm turns its sensor anyhow
    assert np.linalg.norm(gravity.mean(axis=0)) < 0.01
    at_best = np.sqrt(10.0 / (6.0 * COUNT))  # Cramer-Rao of evenly spread directions
    std = compensation_std(plan.poses, reading_noise(), ARM) / reading_noise()
    assert at_best < np.sqrt(np.mean(std**2)) < 1.15 * at_best
    design = PoseDesign(plan.poses, arm=ARM)
    assert design.best_value(COUNT) == pytest.approx(at_best**2)
    assert design.value(plan.poses) == pytest.approx(np.mean(std**2))


def test_chosen_poses_move_the_wrist_within_box_and_limits(plan):
    assert plan.poses.shape == (COUNT, 6)
    assert np.all(np.abs(plan.poses - HERE) <= 1.2 + 1e-12)
    np.testing.assert_array_equal(plan.poses[:, :4], np.tile(HERE[:4], (COUNT, 1)))
    at_limit = HERE.copy()
    at_limit[4] = ARM.upper[4] - 0.1
    moved = chosen(here=at_limit).poses
    assert moved[:, 4].max() <= ARM.upper[4]
    assert np.ptp(moved[:, 4]) > 1.5  # the box is moved away from the limit, not made smaller
    # where two joints tell too little in the box, more take part
    assert np.ptp(chosen(reach_rad=0.5).poses, axis=0)[3] > 0.5


def test_no_way_of_a_sweep_touches_the_arm_itself_or_a_box(plan):
    shapes, box = Shapes(), beside()
    assert min(tip_to_box(joints, box) for joints in plan.poses) < 0.02
    for start, goal in ways(chosen(boxes=box)):
        for share in np.linspace(0.0, 1.0, 60):
            joints = start + share * (goal - start)
            assert not shapes.collide(joints)
            assert tip_to_box(joints, box) >= 0.03 + 0.02 - 1e-3  # and the tool's radius


def test_nothing_slips_through_a_way_of_all_joints():
    rng, shapes = np.random.default_rng(3), Shapes()
    clearance = ArmClearance((), 0.0, np.zeros(3), ARM, HERE)
    ends = rng.uniform(-2.5, 2.5, (30, 6))
    blocked = 0
    for start, goal in itertools.pairwise(ends):
        hits = any(shapes.collide(start + s * (goal - start)) for s in np.linspace(0, 1, 100))
        fault = clearance.path_fault(start, goal)
        assert fault or not hits
        blocked += bool(fault)
    assert 2 < blocked < 28


def test_boxes_are_in_the_base_frame_of_an_arm_with_a_slide_and_an_endless_joint():
    arm, rng = read_arm(SLIDE_AND_TURN, base_frame="plate"), np.random.default_rng(4)
    box = np.array([-0.2, 0.0, 0.5, 0.3, 0.2, 0.6])
    clearance = ArmClearance(boxes_from_numbers(box), 0.05, TIP, arm)
    ends = np.column_stack([rng.uniform(-1, 1, 21), rng.uniform(-3, 3, 21)])
    seen = set()
    for start, goal in itertools.pairwise(ends):
        line = tip_to_box(start, box, arm)
        assert line == 0.0 or clearance.nearest(start)[0] == pytest.approx(line - 0.02, abs=1e-4)
        way = np.linspace(0.0, 1.0, 200)[:, None] * (goal - start) + start
        nearest = min(tip_to_box(joints, box, arm) for joints in way) - 0.02
        seen.add(fault := bool(clearance.path_fault(start, goal)))
        assert nearest >= 0.05 - 1e-3 if not fault else nearest < 0.06
    assert seen == {True, False}


def test_an_arm_that_touches_itself_is_rejected_with_both_links():
    with pytest.raises(
        ObstacleError, match="present pose can't be taken: the ft_sensor would be in upper_arm_link"
    ):
        chosen(here=FOLDED)
    poses = np.vstack([HERE, FOLDED])
    with pytest.raises(ObstacleError, match=r"pose 1 of .* ft_sensor would be in upper_arm_link"):
        plan_as_is(poses, around(), Surroundings(), TIP, source="listed_poses_rad")


def test_links_that_are_drawn_into_each_other_are_told_and_no_reason():
    big = URDF.replace('radius="0.036" length="0.04"', 'radius="0.12" length="0.3"')
    plan = chosen(arm=read_arm(big))
    assert "wrist_3_link and wrist_1_link" in plan.warnings[0]
    assert "touch at most poses" in plan.warnings[0]


def test_too_small_a_box_and_too_many_obstacles_are_named():
    with pytest.raises(NotExcitedError, match=r"about the tool's .*; enlarge pose_box_rad"):
        chosen(reach_rad=0.03)
    with pytest.raises(ObstacleError, match=r"can't be visited: \d+ by box 1.*pose_box"):
        chosen(boxes=beside(), count=250)


def test_links_without_a_reachable_mesh_are_told(tmp_path, monkeypatch):
    sphere = '<collision><origin xyz="0 0 0.2"/><geometry>{}</geometry></collision></link>'
    link = '<link name="forearm_link">'
    mesh = '<mesh filename="package://some_arm/forearm.stl"/>'
    start = URDF.index(link)
    end = URDF.index("</link>", start)
    text = URDF[:start] + link + sphere.format(mesh) + URDF[end + len("</link>") :]
    plan = chosen(arm=read_arm(text))
    assert "the meshes of forearm_link are not reachable" in plan.warnings[0]
    strict = Surroundings(require_shapes=True)
    with pytest.raises(ObstacleError, match=r"forearm_link are not reachable, so .*ROS_PACKAGE"):
        plan_as_is(HERE[None], around(arm=read_arm(text)), strict, TIP)
    bare = read_arm(re.sub(r"<collision>.*?</collision>", "", URDF))
    with pytest.raises(ObstacleError, match="description has no collision shapes, so that"):
        plan_as_is(HERE[None], around(arm=bare), strict, TIP)
    assert plan_as_is(HERE[None], around(), Surroundings(), TIP).warnings == ()
    # a pyramid of 0.1 m where the package is found
    lines = ["solid pyramid"]
    for three in itertools.combinations(["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"], 3):
        lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {corner}" for corner in three)]
        lines += ["endloop", "endfacet"]
    (tmp_path / "some_arm").mkdir()
    (tmp_path / "some_arm/forearm.stl").write_text("\n".join([*lines, "endsolid pyramid"]))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    found = read_arm(text.replace("<robot name=", "<!-- found --><robot name="))
    assert chosen(arm=found).warnings == ()


def one_axis(axis, limit=2.0):
    return read_arm(
        '<robot name="one"><link name="base"/><link name="ft_sensor"/><joint name="only"'
        ' type="revolute"><parent link="base"/><child link="ft_sensor"/>'
        f'<axis xyz="{axis}"/><limit lower="-{limit}" upper="{limit}" effort="1" velocity="1"/>'
        "</joint></robot>"
    )


def chosen_of_one(arm):
    times = SweepTimes(np.zeros(1), np.ones(1), np.ones(1), 1.9)
    where = SweepRange.around(np.zeros(1), 1.2, arm, remedy="enlarge pose_box_rad")
    return plan_chosen(COUNT, where, Surroundings(), TIP, times)


def test_one_joint_across_gravity_tells_the_load():
    arm = one_axis("1 0 0")
    poses = chosen_of_one(arm).poses
    assert len(np.unique(poses)) == COUNT and np.all(np.abs(poses) <= 1.2)
    assert np.all(np.isfinite(compensation_std(poses, reading_noise(), arm)))


def test_an_arm_that_turns_about_gravity_alone_is_named_and_not_its_box():
    with pytest.raises(
        NotExcitedError, match=r"arm \(only\) turn gravity .* no information"
    ) as error:
        chosen_of_one(one_axis("0 0 1"))
    assert "pose_box" not in str(error.value)


def test_joints_beside_the_arm_stand_where_they_are_reported():
    limit = '<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="1" velocity="1"/>'
    plate = '<collision><geometry><box size="3 3 0.02"/></geometry></collision>'
    text = URDF.replace(
        "</robot>",
        f'<link name="frame"/><link name="table">{plate}</link>'
        f'<joint name="lift" type="prismatic"><parent link="base_link"/><child link="frame"/>'
        f'<origin xyz="0 0 -3"/>{limit}</joint>'
        f'<joint name="second" type="prismatic"><parent link="frame"/><child link="table"/>{limit}'
        '<mimic joint="lift" multiplier="2" offset="0.1"/></joint></robot>',
    )
    arm = read_arm(text, base_frame="base_link")

    def clearance(**beside):
        return ArmClearance((), 0.0, TIP, replace(arm, beside=beside), HERE)

    height = ARM.sensor_pose(HERE)[1][2]
    assert clearance().pose_fault(HERE) == ""
    assert clearance().warnings[-1].endswith("lift, second")
    raised = clearance(lift=(height + 2.9) / 3.0, elbow=9.0)
    assert "table" in raised.pose_fault(HERE)
    assert not any("at zero" in warning for warning in raised.warnings)
    # The follower's own report counts more.
    assert clearance(lift=(height + 2.9) / 3.0, second=-2.0).pose_fault(HERE) == ""
    assert clearance(lift=np.nan, second=0.0).warnings[-1].endswith("lift")
