# SPDX-License-Identifier: Apache-2.0
"""What of an arm's description is drawn, where, and which files a description can name."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from fake_suite import FakeSuite
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.rotation import quaternion_to_matrix
from galen_panel.page.arm import FORCE_M_PER_N, middle_and_size, parts, place
from galen_panel.server import mesh_answer
from galen_panel.state import shapes
from galen_panel.state.shapes import draw, mesh_file
from starlette.requests import Request

SIX_AXIS = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
TIP, COM = np.array([0.15, 0.0, 0.05]), np.array([0.055, 0.002, 0.045])
BEND = np.array([2e-2, -1e-2, 3e-2, 1e-2, 2e-2, -1e-2])
WRENCH = np.array([3.0, -2.0, 1.0, 0.0, 0.0, 0.0])
JOINTS = np.array([0.03, -0.02, 0.42, 0.7, -0.3])
SIX_JOINTS = np.array([0.3, -1.2, 1.4, 0.5, -0.7, 2.1])
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>
<unit name="mm" meter="0.001"/><up_axis>Z_UP</up_axis></asset><library_geometries>
<geometry id="g"><mesh><source id="p"><float_array id="a" count="9">0 0 0 500 0 0 0 250 0
</float_array><technique_common><accessor source="#a" count="3" stride="3"><param name="X"
type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#s"/></scene></COLLADA>"""


def described(visual, collision="", extra=""):
    """Two joints, the second of which slides; the arm begins at its second link."""
    return f"""<robot name="small"><material name="red"><color rgba="1 0 0 0.5"/></material>
      <link name="world"/><link name="stand">{visual}</link>
      <link name="column">{visual}{collision}</link><link name="slide"/><link name="finger">
      <visual><geometry><sphere radius="0.1"/></geometry></visual></link>
      <joint name="wheel" type="continuous"><parent link="world"/><child link="stand"/></joint>
      <joint name="turn" type="continuous"><parent link="stand"/><child link="column"/>
        <origin xyz="0 0 0.5" rpy="0.3 0 0"/><axis xyz="0 0 1"/></joint>
      <joint name="lift" type="prismatic"><parent link="column"/><child link="slide"/>
        <origin xyz="0.1 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0.4" effort="1"
        velocity="1"/></joint>
      <joint name="grip" type="prismatic"><parent link="slide"/><child link="finger"/>
        <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>{extra}</robot>"""


def small(visual, collision=""):
    return read_arm(described(visual, collision), base_frame="stand", sensor_frame="slide")


def meshes(*references):
    return "".join(
        f'<visual><geometry><mesh filename="{one}" scale="2 1 1"/></geometry></visual>'
        for one in references
    )


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package's folder among the prefixes, with two meshes; a secret lies beside it."""
    folder = tmp_path / "prefix" / "share" / "arm_description"
    folder.mkdir(parents=True)
    (folder / "link.obj").write_text(TETRAHEDRON)
    (folder / "link.dae").write_text(COLLADA)
    (folder.parent / "secret.stl").write_text("secret")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"))
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    return folder


def corners(stl):
    rows = np.frombuffer(stl, shapes._STL_ROW, offset=84)
    assert len(rows) == np.frombuffer(stl, "<u4", 1, 80)[0]
    return rows["corners"]


def ends(placed):
    half = quaternion_to_matrix(placed[3:7])[:, 2] * placed[7] / 2.0
    return np.array(placed[:3]) - half, np.array(placed[:3]) + half


# Where shapes are


def test_shapes_of_a_described_arm_are_where_pinocchio_has_them():
    arm = read_arm(SIX_AXIS, sensor_frame="tool0")
    model = pinocchio.buildModelFromXML(SIX_AXIS)
    visual = pinocchio.buildGeomFromUrdfString(model, SIX_AXIS, pinocchio.GeometryType.VISUAL)
    data, geometry = model.createData(), visual.createData()
    drawing = draw(arm)
    assert drawing.note == "" and len(drawing.links) == 7
    drawn = {part["name"]: part["shapes"] for part in parts(drawing)}
    assert sum(len(one) for name, one in drawn.items() if "straight" in name) == 11
    rng = np.random.default_rng(4)
    for joints in rng.uniform(arm.lower, arm.upper, (20, 6)):
        pinocchio.updateGeometryPlacements(model, data, visual, geometry, joints)
        placed = place(drawing, joints, np.zeros(3), None, None, None)
        found = []
        for piece in range(7):
            group = placed[f"straight/{piece}"]
            for shape in drawn[f"straight/{piece}"]:
                turn, at = quaternion_to_matrix(group[3:]), np.array(shape["place"][:3])
                axis = quaternion_to_matrix(shape["place"][3:])[:, 2]
                found.append([*(group[:3] + turn @ at), *(turn @ axis)])
        wanted = [[*one.translation, *one.rotation[:, 2]] for one in geometry.oMg]
        for row in wanted:
            assert np.abs(np.array(found) - row).max(axis=1).min() < 1e-4


def test_a_base_that_is_no_root_and_a_sliding_joint_are_followed_and_loose_links_are_left_out():
    shape = '<visual><origin xyz="0 0 0.2"/><geometry><box size="1 2 3"/></geometry></visual>'
    arm = small(shape + '<visual><geometry><sphere radius="1"/></geometry></visual>')
    drawing = draw(arm)
    assert [len(one) for one in drawing.links] == [2, 2, 0]
    assert drawing.links[0][0]["sizes"] == [1, 2, 3] and drawing.links[0][1]["sizes"] == [1]
    assert "1 links that joints beside this chain move" in drawing.note
    places = drawing.link_places(np.array([0.4, 0.3]))
    turn = quaternion_to_matrix([np.sin(0.15), 0, 0, np.cos(0.15)])
    rotation = turn @ quaternion_to_matrix([0, 0, np.sin(0.2), np.cos(0.2)])
    np.testing.assert_allclose(places[1][0], rotation, atol=1e-12)
    np.testing.assert_allclose(places[2][1], [0, 0, 0.5] + rotation @ [0.1, 0.3, 0], atol=1e-12)


def test_links_without_a_shape_are_lines_from_joint_to_joint():
    arm = small("")
    drawing = draw(arm)
    assert not any(drawing.links) and drawing.meshes == {}
    joints = np.array([0.7, 0.2])
    placed = place(drawing, joints, TIP, None, None, None)
    origins, _ = arm.joint_axes(joints)
    np.testing.assert_allclose(ends(placed["straight/0"]), [np.zeros(3), origins[0]], atol=2e-5)
    np.testing.assert_allclose(ends(placed["straight/1"]), origins, atol=2e-5)
    assert "joint/0" in placed and {part["name"] for part in parts(drawing)} == set(placed)
    assert draw(GALEN).links == ((),) * 6, "the Galen keeps its picture"


@pytest.mark.parametrize(
    ("arm", "joints"),
    [(GALEN, JOINTS), (read_arm(SIX_AXIS), SIX_JOINTS)],
    ids=["galen", "six_axis"],
)
def test_the_arm_ends_at_the_tip_and_the_bent_one_at_the_displaced_tip(arm, joints):
    placed = place(draw(arm), joints, TIP, COM, BEND, WRENCH)
    assert {part["name"] for part in parts(draw(arm))} == set(placed)
    assert json.loads(json.dumps([parts(draw(arm)), placed]))
    rotation, sensor = arm.sensor_pose(joints)
    _, tip = arm.tip_pose(joints, TIP)
    last = len(arm.joints) + 1
    np.testing.assert_allclose(ends(placed[f"straight/{last}"]), [sensor, tip], atol=2e-5)
    np.testing.assert_allclose(ends(placed[f"bent/{last}"])[1], tip + BEND[:3], atol=2e-5)
    np.testing.assert_allclose(placed["com"][:3], sensor + rotation @ COM, atol=2e-5)
    force, arrow = rotation @ WRENCH[:3], placed["force"]
    size = np.linalg.norm(force)
    np.testing.assert_allclose(arrow[:3], tip + BEND[:3], atol=2e-5)
    np.testing.assert_allclose(quaternion_to_matrix(arrow[3:7])[:, 2], force / size, atol=1e-4)
    assert arrow[7] == pytest.approx(FORCE_M_PER_N * size, abs=1e-4)


def test_the_galens_pieces_make_a_chain_from_its_base():
    placed = place(draw(GALEN), JOINTS, TIP, COM, BEND, WRENCH)
    np.testing.assert_allclose(ends(placed["straight/0"])[0], 0.0, atol=2e-5)
    for piece in range(6):
        before, after = ends(placed[f"straight/{piece}"]), ends(placed[f"straight/{piece + 1}"])
        np.testing.assert_allclose(before[1], after[0], atol=4e-5)


def test_the_base_does_not_bend_and_what_is_further_out_bends_more():
    placed = place(draw(read_arm(SIX_AXIS)), SIX_JOINTS, TIP, None, BEND, WRENCH)
    assert placed["bent/0"] is None and placed["straight/0"] is not None
    moved = [
        np.linalg.norm(np.subtract(placed[f"bent/{k}"][:3], placed[f"straight/{k}"][:3]))
        for k in range(1, 7)
    ]
    assert moved[0] < 0.3 * moved[-1] and max(moved) < 0.06


def test_what_is_not_known_is_not_drawn():
    placed = place(draw(GALEN), GALEN.home, np.zeros(3), None, None, 0.01 * WRENCH)
    assert placed["force"] is None and placed["com"] is None
    assert {value for name, value in placed.items() if name.startswith("bent/")} == {None}
    assert placed["straight/6"] is None, "no tool"


def test_the_camera_sees_all_that_an_arm_can_reach():
    middle, size_m = middle_and_size(read_arm(SIX_AXIS))
    assert np.linalg.norm(middle - [0.0, 0.0, 0.1]) < 0.3 and 1.8 < size_m < 2.6


def test_a_colour_is_its_own_or_a_named_one_or_grey():
    sphere = '<visual><geometry><sphere radius="1"/></geometry>{}</visual>'
    materials = ['<material name="red"/>', "", '<material name="x"><color rgba="0 1 0 1"/>'
                 "</material>", '<material name="y"><color rgba="pink"/></material>']  # fmt: skip
    found = draw(small("".join(map(sphere.format, materials)))).links[0]
    assert [(one["colour"], one["opacity"]) for one in found] == [
        ("#ff0000", 0.5), (shapes.GREY, 1.0), ("#00ff00", 1.0), (shapes.GREY, 1.0)
    ]  # fmt: skip


# Meshes


def test_meshes_become_triangles_in_metres_and_are_served_by_their_content(package):
    drawing = draw(
        small(meshes("package://arm_description/link.obj", f"file://{package}/link.dae"))
    )
    assert [len(one) for one in drawing.links] == [2, 2, 0] and len(drawing.meshes) == 2
    first, second = (drawing.meshes[shape["url"].split("/")[-1]] for shape in drawing.links[0])
    assert np.ptp(corners(first).reshape(-1, 3), axis=0) == pytest.approx([2.0, 1.0, 1.0])
    assert np.ptp(corners(second).reshape(-1, 3), axis=0) == pytest.approx([1.0, 0.25, 0.0])
    suite = FakeSuite()
    suite.put(drawing=drawing)

    def asked(name):
        request = Request({"type": "http", "path_params": {"name": name}})
        return asyncio.run(mesh_answer(suite)(request))

    assert asked(drawing.links[0][0]["url"].removeprefix("/meshes/")).body == first
    for name in ("nothing.stl", "../../secret.stl", "link.obj", str(package / "link.obj")):
        assert asked(name).status_code == 404


@pytest.mark.parametrize(
    ("reference", "why"),
    [
        ("package://arm_description/../secret.stl", "no such file"),
        ("package://arm_description/%2e%2e/secret.stl", "no such file"),
        ("package://../secret.stl", "no such file"),
        ("package:///secret.stl", "no such file"),
        ("package://other_description/link.obj", "no such file"),
        ("package://arm_description/none.stl", "no such file"),
        ("package://arm_description/passwd.stl", "is none of .dae, .obj, .stl"),
        ("package://arm_description", "no such file"),
        ("file:///etc/passwd", "is none of .dae, .obj, .stl"),
        ("file://elsewhere/link.stl", "no such file"),
        ("http://elsewhere/link.stl", "no such file"),
        ("link.obj", "no such file"),
        ("", "no such file"),
        ("file://[", "no such file"),
        ("file://conftest.py", "no such file"),
        ("file:///a\0.stl", "no such file"),
    ],
)
def test_a_description_reaches_no_file_but_a_mesh_in_a_package_or_a_named_one(
    package, reference, why
):
    (package / "passwd.stl").symlink_to("/etc/passwd")
    with pytest.raises(GalenError, match=why):
        mesh_file(reference)


def test_a_mesh_that_is_too_large_or_none_is_rejected(package, monkeypatch):
    (package / "none.stl").write_text("solid none\nendsolid none\n")
    (package / "nan.obj").write_text(TETRAHEDRON.replace("v 1 0 0", "v nan 0 0"))
    for name, why in (("none.stl", "no mesh that can be read"), ("nan.obj", "not finite")):
        drawing = draw(small(meshes(f"file://{package}/{name}")))
        assert why in drawing.note and not any(drawing.links)
    obj = meshes(f"file://{package}/link.obj")
    monkeypatch.setattr(shapes, "_MOST_TRIANGLES", 3)
    assert "more than 3 triangles" in draw(small(obj)).note
    monkeypatch.setattr(shapes, "_MOST_SHAPES", 1)
    assert "more than 1 shapes" in draw(small(2 * meshes(f"file://{package}/link.dae"))).note
    monkeypatch.setattr(shapes, "_MOST_BYTES", 10)
    assert "has more than" in draw(small(obj)).note


@pytest.mark.parametrize("broken", ["<box/>", '<box size="1 2"/>', '<sphere radius="inf"/>',
                                    "<blob/>", ""])  # fmt: skip
def test_collision_shapes_stand_in_where_a_visual_one_can_not_be_drawn(broken):
    drawing = draw(
        small(
            f"<visual><geometry>{broken}</geometry></visual>",
            '<collision><geometry><cylinder radius="0.1" length="1"/></geometry></collision>',
        )
    )
    assert [[one["kind"] for one in link] for link in drawing.links] == [[], ["cylinder"], []]
    assert drawing.note.startswith("Not drawn as described: stand (")
