# SPDX-License-Identifier: Apache-2.0
"""Distances to boxes, straight ways that nothing slips through, and ways around."""

import itertools

import numpy as np
import pytest
from galen_model.arm.clearance import (
    TOOL_RADIUS_M,
    ArmClearance,
    ObstacleError,
    boxes_from_numbers,
)
from galen_model.arm.galen import GALEN
from galen_model.arm.routes import Router
from galen_model.poses.design import angle_grid

TIP = np.array([0.15, 0.0, 0.05])
CLEARANCE = 0.02
SIDE = [0.5, 0.08, 0.2, 0.9, 0.5, 0.44]


def clearance(*boxes, tip=TIP):
    return ArmClearance(boxes_from_numbers(np.ravel(boxes)), CLEARANCE, tip, arm=GALEN)


def at(roll, tilt):
    return np.array([*GALEN.home[:3], roll, tilt])


def test_a_wall_beside_the_tip_is_as_far_as_the_tip_says():
    # A wall across y that only the tip comes near: its distance is the tip's own.
    wall = [0.0, 0.3, 0.0, 2.0, 0.4, 0.6]
    arm = clearance(wall)
    for roll in (0.6, 0.9, 1.2):
        _, tip = GALEN.tip_pose(at(roll, 0.5), TIP)
        distance_m, part, _ = arm.nearest(at(roll, 0.5))
        assert part == "tool"
        assert distance_m == pytest.approx(0.3 - tip[1] - TOOL_RADIUS_M, abs=1e-6)


def test_a_thin_wall_between_two_free_poses_is_seen():
    wall = [0.6, 0.0, 0.0, 1.2, 0.0005, 0.42]  # half a millimetre, across the tool's way
    arm = clearance(wall)
    left, right = np.array([0.0, -0.1, 0.408, 0.0, 0.0]), np.array([0.0, 0.1, 0.408, 0.0, 0.0])
    assert not arm.pose_fault(left)
    assert not arm.pose_fault(right)
    assert arm.path_fault(left, right) == "the tool would be 20 mm from box 1"
    assert not arm.path_fault(left, left - [0.0, 0.03, 0.0, 0.0, 0.0])


def test_ways_lead_around_and_every_leg_is_free():
    arm = clearance([0.5, 0.05, 0.2, 0.9, 0.5, 0.44])
    router = Router(arm, GALEN.home, angle_grid((-1.5, -1.0), (1.5, 0.9), 9, 7))
    start, goal = at(0.0, -0.6), at(1.5, -0.6)
    assert "box 1" in arm.path_fault(start, goal)
    way = router.route(start, goal)
    assert len(way) > 1
    np.testing.assert_array_equal(way[-1], goal)
    for one, other in itertools.pairwise([start, *way]):
        assert not arm.path_fault(one, other)
    # where nothing is in the way it goes straight ahead
    assert len(router.route(start, at(-0.7, 0.2))) == 1


def test_what_can_not_be_reached_is_named():
    wall = [0.3, -0.6, 0.0, 1.2, -0.09, 0.8]
    arm = clearance(wall)
    lattice = angle_grid((-1.5, -1.0), (1.5, 0.9), 9, 7)
    router = Router(arm, GALEN.home, lattice)
    faults = router.lattice_faults
    assert 0 < sum(map(bool, faults)) < len(faults)
    assert all("box 1" in fault for fault in faults if fault)
    assert "box 1" in router.fault(at(*lattice[next(k for k, f in enumerate(faults) if f)]))
    with pytest.raises(ObstacleError, match=r"home can't be taken: the .* in box 1"):
        Router(
            clearance([0.5, -0.1, 0.4, 0.9, 0.1, 0.6]),
            GALEN.home,
            angle_grid((0, 0), (1, 0.5), 3, 3),
        )
    assert "limits" in arm.pose_fault(at(0.0, -1.2))
    with pytest.raises(ObstacleError, match=r"tip would be 150 m from ft_sensor.* in m"):
        clearance(wall, tip=np.array([150.0, 0.0, 0.0]))
    high = np.array([0.14, 0.14, 0.6, 0.0, 0.0])
    assert "carriage" in clearance([5, 5, 5, 6, 6, 6]).pose_fault(high)


def test_a_node_straight_ahead_is_reached_where_home_is_far_from_the_lattice():
    router = Router(clearance(), GALEN.home, angle_grid((1.0, 0.5), (1.2, 0.7), 2, 2))
    assert router.lattice_faults == [""] * 4


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ([1, 2, 3, 4, 5], "has 5 numbers"),
        ([0, 0, 0, 1, -1, 1], "box 1 is empty"),
        ([0, 0, 0, 1, 1, 1, 0, 0, 0, 1, float("nan"), 1], "box 2 holds a value that is not finite"),
        ([0, 0, 0, 1, 1, 500], "box 1 goes further than 100 m .* in m"),
        ([0, 0, 0, 1, 1, 1] * 101, "has 101 boxes; at most 100"),
    ],
)
def test_boxes_that_are_none(numbers, message):
    with pytest.raises(ObstacleError, match=message):
        boxes_from_numbers(numbers)
