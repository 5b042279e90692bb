import json

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, HOME
from galen_model.arm.kinematics import tip_pose
from galen_model.rotation import quaternion_to_matrix
from galen_panel.page.live.arm_drawing import FORCE_M_PER_N, Drawing
from galen_panel.page.live.arm_view import delta_parts

TIP, COM = np.array([0.15, 0.0, 0.05]), np.array([0.055, 0.002, 0.045])
JOINTS = np.array([0.03, -0.02, 0.42, 0.7, -0.3])
DEFLECTION = np.array([2e-4, -1e-4, 3e-4, 1e-4, 2e-4, -1e-4])
WRENCH = np.array([3.0, -2.0, 1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def drawing():
    return Drawing(TIP, COM)


def ends(place, length):
    """Both ends of a part along z."""
    middle, axis = np.array(place[:3]), quaternion_to_matrix(place[3:7])[:, 2]
    return middle - axis * length / 2.0, middle + axis * length / 2.0


def test_every_part_that_is_placed_is_drawn_and_is_json(drawing):
    names = {part["name"] for part in drawing.parts()}
    placed = drawing.place(JOINTS, DEFLECTION, WRENCH, 100.0)
    # Links without a shape of their own have a place as well.
    assert names - set(placed) == {"rail/0", "rail/1", "rail/2"}
    assert {name for name in placed if name not in names} == {
        "straight/delta_x_link", "straight/delta_y_link",
    }  # fmt: skip
    assert json.loads(json.dumps([drawing.parts(), placed]))


def test_the_tip_is_where_the_kinematics_have_it(drawing):
    placed = drawing.place(JOINTS, None, None, 100.0)
    np.testing.assert_allclose(placed["straight/tool_tip"][:3], tip_pose(JOINTS, TIP)[1], atol=1e-5)
    assert placed["bent/tool_tip"] is None
    assert placed["force"] is None


@pytest.mark.parametrize("factor", [1.0, 300.0])
def test_the_bent_tip_is_displaced_as_often_as_the_factor_says(drawing, factor):
    small = DEFLECTION / factor
    placed = drawing.place(JOINTS, small, None, factor)
    moved = np.array(placed["bent/tool_tip"][:3]) - placed["straight/tool_tip"][:3]
    np.testing.assert_allclose(moved, DEFLECTION[:3], atol=2e-5)


def test_rods_reach_from_carriage_to_platform(drawing):
    placed = drawing.place(JOINTS, None, None, 1.0)
    parts = delta_parts(JOINTS[:3])
    for rod in range(6):
        start, end = ends(placed[f"rod/{rod}"], GALEN.rod_length_m)
        np.testing.assert_allclose(start, parts.start_m[rod], atol=2e-5)
        np.testing.assert_allclose(end, parts.end_m[rod], atol=2e-5)


def test_the_tool_lies_between_sensor_and_tip(drawing):
    part = next(part for part in drawing.parts() if part["name"] == "straight/ft_sensor")
    kinds = [shape["kind"] for shape in part["shapes"]]
    assert kinds == ["cylinder", "cylinder", "sphere"]
    _, tool, com = part["shapes"]
    start, end = ends(tool["place"], tool["sizes"][1])
    np.testing.assert_allclose(start, 0.0, atol=1e-5)
    np.testing.assert_allclose(end, TIP, atol=1e-5)
    np.testing.assert_allclose(com["place"][:3], COM, atol=1e-6)


def test_the_arrow_points_as_the_force_and_is_as_long_as_it_is_large(drawing):
    placed = drawing.place(JOINTS, None, WRENCH, 1.0)
    force = tip_pose(JOINTS, TIP)[0] @ WRENCH[:3]
    size = np.linalg.norm(force)
    *place, length = placed["force"]
    np.testing.assert_allclose(quaternion_to_matrix(place[3:])[:, 2], force / size, atol=1e-4)
    assert length == pytest.approx(FORCE_M_PER_N * size, abs=1e-3)
    np.testing.assert_allclose(place[:3], placed["straight/tool_tip"][:3], atol=1e-5)


def test_noise_is_no_force_and_a_large_one_has_an_end(drawing):
    assert drawing.place(JOINTS, None, 0.01 * WRENCH, 1.0)["force"] is None
    assert drawing.place(JOINTS, None, 1e3 * WRENCH, 1.0)["force"][7] == 0.4


def test_an_arrow_may_point_straight_down(drawing):
    # At home the sensor's x axis points down.
    place = drawing.place(HOME, None, np.array([5.0, 0, 0, 0, 0, 0]), 1.0)["force"]
    np.testing.assert_allclose(quaternion_to_matrix(place[3:7])[:, 2], [0, 0, -1], atol=1e-4)


def test_without_a_tool_there_is_neither_tool_nor_ball():
    parts = {part["name"]: part for part in Drawing(np.zeros(3), None).parts()}
    assert len(parts["straight/ft_sensor"]["shapes"]) == 1


def test_joints_that_the_rods_cannot_reach_leave_out_rods_and_bend(drawing):
    far = np.array([0.6, 0.0, 0.4, 0.0, 0.0])
    placed = drawing.place(far, DEFLECTION, None, 100.0)
    assert placed["rod/0"] is None
    assert placed["carriage/2"] is None
    assert placed["bent/tool_tip"] is None
    assert placed["straight/tool_tip"] is not None
