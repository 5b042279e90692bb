# SPDX-License-Identifier: Apache-2.0
"""The links of an arm as shapes, from its description: primitives, and meshes found here. No ROS.

A mesh of the description becomes triangles here, and only those are offered to a browser, under a
name made of their content: no path comes from a browser, and no file's own bytes go to one.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import GalenError, one_line

if TYPE_CHECKING:
    from pinocchio import SE3

Shape = dict[str, Any]
"""kind, sizes (m) or url, place (x, y, z, m, and a quaternion x, y, z, w), colour, opacity."""

MESHES_PATH = "/meshes"
GREY = "#98a4b0"
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
_SUFFIXES = (".dae", ".obj", ".stl")
_MOST_BYTES = 20_000_000
"""Of a mesh's file."""
_MOST_TRIANGLES = 500_000
"""Of all meshes together: 25 MB for the browser."""
_MOST_SHAPES = 500
_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]+)[\"']")
_STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True, eq=False)
class Drawing:
    """An arm and how its links look.

    links: shapes of the base's link and of the link after each joint (n + 1), none where a link is
    to be drawn as a line. meshes: binary STL by name. note: what is not drawn and why.
    """

    arm: Arm
    links: tuple[tuple[Shape, ...], ...]
    meshes: dict[str, bytes]
    note: str

    def link_places(self, joints: Array) -> list[tuple[Array, Array]]:
        """Return where base and links are.

        Args:
            joints: (n,), m and rad.

        Returns:
            R_base_link (3, 3) and origin (3,), m, in the base's frame, of each of the n + 1.

        """
        places = [(np.eye(3), np.zeros(3))]
        for count in range(1, len(self.links)):
            # The chain up to a joint is an arm whose "sensor" is that joint's link.
            chain = self.arm.joints[:count]
            before = replace(
                self.arm, joints=chain, sensor_origin_m=np.zeros(3), sensor_rotation=np.eye(3)
            )
            places.append(before.sensor_pose(joints[:count]))
        return places


def draw(arm: Arm, *, shapes: bool = True) -> Drawing:
    """Return an arm's drawing; meshes may take seconds to read.

    An arm on rods, or without a description, has no shapes. Links that joints beside the chain move
    are left out: where they are is not known.

    Args:
        arm: with its description.
        shapes: False leaves all shapes out, which is quick.

    Returns:
        The drawing; its `note` names what is not drawn.

    """
    links: list[list[Shape]] = [[] for _ in range(len(arm.joints) + 1)]
    if not shapes or arm.delta is not None or not arm.urdf:
        return Drawing(arm, tuple(map(tuple, links)), {}, "")
    root = ElementTree.fromstring(arm.urdf)
    reader = _Reader(root)
    places = _link_places(arm)
    reasons, elsewhere = [], 0
    for link in root.iter("link"):
        name = str(link.get("name"))
        if name not in places:
            elsewhere += link.find("visual") is not None
            continue
        group, place = places[name]
        # Where a visual shape can't be drawn, the collision shapes have the link's outline, too.
        for kind in ("visual", "collision"):
            try:
                found = [reader.shape(element, place) for element in link.findall(kind)]
            except GalenError as error:
                reasons.append(f"{name} ({error})")
                continue
            links[group] += found
            if found:
                break
    if elsewhere:
        reasons.append(f"{elsewhere} links that joints beside this chain move")
    note = one_line(f"Not drawn as described: {'; '.join(reasons)}") if reasons else ""
    return Drawing(arm, tuple(map(tuple, links)), reader.meshes, note)


def _link_places(arm: Arm) -> dict[str, tuple[int, SE3]]:
    """Which link of the chain (0: the base) carries a link of the description, and its place."""
    from galen_model.load.frames import placed_frames
    from pinocchio import SE3

    frames = placed_frames(arm.urdf)
    base_carrier, *base = frames[arm.base_frame]
    groups = {name: (k + 1, SE3.Identity()) for k, name in enumerate(arm.joint_names)}
    groups[base_carrier] = (0, SE3(*base).inverse())
    found = {}
    for name, (carrier, *place) in frames.items():
        if carrier in groups:
            group, before = groups[carrier]
            found[name] = (group, before * SE3(*place))
    return found


class _Reader:
    """Reads shapes of one description, no more than a browser can take."""

    def __init__(self, root: ElementTree.Element) -> None:
        self._colours = dict(_colours(root))
        self._names: dict[tuple[str, ...], str] = {}
        self._shapes = self._triangles = 0
        self.meshes: dict[str, bytes] = {}

    def shape(self, element: ElementTree.Element, link: SE3) -> Shape:
        """Read a visual or a collision element of a link placed there; raises GalenError."""
        import pinocchio

        self._shapes += 1
        if self._shapes > _MOST_SHAPES:
            raise GalenError(f"more than {_MOST_SHAPES} shapes")
        given = element.find("geometry/*")
        if given is None:
            raise GalenError("a shape without a geometry")
        shape: Shape = {"kind": given.tag}
        if given.tag in _SIZES:
            counts = 3 if given.tag == "box" else 1
            sizes = [_numbers(given.get(name), counts) for name in _SIZES[given.tag]]
            shape["sizes"] = [size for part in sizes for size in part]
        elif given.tag == "mesh":
            name = self._mesh(given.get("filename", ""), given.get("scale", "1 1 1"))
            shape["url"] = f"{MESHES_PATH}/{name}"
        else:
            raise GalenError(f"a shape '{given.tag}', which is none of URDF")
        origin = element.find("origin")
        xyz, rpy = (
            _numbers("0 0 0" if origin is None else origin.get(name, "0 0 0"), 3)
            for name in ("xyz", "rpy")
        )
        place = pinocchio.SE3(pinocchio.rpy.rpyToMatrix(*rpy), np.array(xyz))
        shape["place"] = pinocchio.SE3ToXYZQUAT(link * place).tolist()
        material = element.find("material")
        named = "" if material is None else str(material.get("name"))
        colours = self._colours | dict(_colours(element))
        shape["colour"], shape["opacity"] = colours.get(named, (GREY, 1.0))
        return shape

    def _mesh(self, reference: str, scale: str) -> str:
        """Read a mesh, unless it was; returns its name. Raises GalenError."""
        if (reference, scale) not in self._names:
            corners = _corners(mesh_file(reference), np.array(_numbers(scale, 3)))
            self._triangles += len(corners)
            if self._triangles > _MOST_TRIANGLES:
                raise GalenError(f"meshes of more than {_MOST_TRIANGLES} triangles")
            rows = np.zeros(len(corners), _STL_ROW)
            rows["corners"] = corners
            content = bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes()
            name = f"{hashlib.sha256(content).hexdigest()[:32]}.stl"
            self._names[reference, scale], self.meshes[name] = name, content
        return self._names[reference, scale]


def _colours(root: ElementTree.Element) -> Iterator[tuple[str, tuple[str, float]]]:
    """Colour and opacity of materials, by their names."""
    for material in root.iter("material"):
        colour = material.find("color")
        try:
            rgba = _numbers("" if colour is None else colour.get("rgba", ""), 4)
        except GalenError:
            continue
        *rgb, opacity = np.clip(rgba, 0.0, 1.0).tolist()
        text = "".join(f"{round(255 * part):02x}" for part in rgb)
        yield str(material.get("name")), (f"#{text}", opacity)


def _numbers(text: str | None, count: int) -> list[float]:
    """Read numbers of an attribute; raises GalenError."""
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise GalenError(f"{text!r}, where finite numbers are needed: {count}")
    return numbers


def mesh_file(reference: str) -> Path:
    """Return the file of a description's mesh, in a package or named as a whole.

    Args:
        reference: as the description names it: package://, file:// or an absolute path.

    Returns:
        The file, links followed.

    Raises:
        GalenError: it can't be had: a path that leaves its package, no such file, an ending that is
            no mesh's, or more than 20 MB.

    """
    from galen_model.arm.clearance import mesh_path

    found = None if ".." in reference.split("/") else mesh_path(reference)
    if found is None or not found.is_absolute():
        raise GalenError(f"{reference}: no such file here; is its workspace sourced?")
    file = found.resolve()
    if file.suffix.lower() not in _SUFFIXES:
        raise GalenError(f"{reference}: is none of {', '.join(_SUFFIXES)}")
    if file.stat().st_size > _MOST_BYTES:
        raise GalenError(f"{reference}: has more than {_MOST_BYTES // 1_000_000} MB")
    return file


def _corners(file: Path, scale: Array) -> Array:
    """Read a mesh's triangles (t, 3 corners, 3), m; raises GalenError."""
    import coal

    try:
        # The loader leaves a file's own unit out.
        unit = _UNIT.search(file.read_bytes()) if file.suffix.lower() == ".dae" else None
        mesh = coal.MeshLoader().load(str(file), scale * (float(unit[1]) if unit else 1.0))
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).split("message:")[-1]
        raise GalenError(f"{file.name}: is no mesh that can be read: {reason}") from error
    triangles = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    corners: Array = mesh.vertices()[np.array([(t[0], t[1], t[2]) for t in triangles], dtype=int)]
    if not len(corners) or not np.all(np.isfinite(corners)):
        raise GalenError(f"{file.name}: has no triangles, or corners that are not finite")
    return corners
