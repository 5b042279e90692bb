# SPDX-License-Identifier: Apache-2.0
"""How near the arm comes to boxes around it and to itself, at a pose and on the way to another.

An arm's parts are the collision shapes of its description, a mesh as its convex hull, and the tool
as a capsule from the sensor to the tip. Links that only fixed joints join are one body. Looked at
are all pairs of bodies but neighbours, and but those that touch at the present pose and at most of
the poses that the limits allow, which is how their shapes were drawn. Joints that are not between
base and sensor stand where `Arm.beside` has them, mimic joints accordingly, else at zero; a warning
names those that could move shapes.

The Galen's description has no collision shapes. Its moving parts are capsules along its known
points: platform to roll axis, the roll link, tilt axis to sensor, sensor and adapter, and the tool
as a triangle of capsules: out along the adapter to the tip's height, across to the tip, and
straight back. Their radii are estimates, for no drawing of the arm is public. The delta's rods and
carriages are left out: they don't move where only roll and tilt do.

Kinematics are Pinocchio's, distances are the library coal's. A way is straight in joint space, as
the arm goes. Between body i and a part of body j no point moves further on it than

    L = sum_m |delta q_m| rho_m,  m = i + 1 ... j,

rho_m = 1 for a prismatic joint, and else the largest distance of the part's points from the joint's
axis, at most the lengths of the links between and the part's own. Where a pair is d apart, it
can't be nearer than d - L s on the next share s of the way; so the next look is at the smallest
s = (d - clearance) / L of all pairs. Nothing slips through, and few looks do where all is far
(conservative advancement: Mirtich, *Impulse-based Dynamic Simulation of Rigid Body Systems*, 1996,
section 2.3).
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio
from pinocchio import SE3

from galen_model.arm.arm import Arm
from galen_model.arm.galen import galen_urdf
from galen_model.arrays import Array, evenly_spread
from galen_model.errors import GalenError

PLATFORM_RADIUS_M = 0.06
LINK_RADIUS_M = 0.04  # of roll link, tilt link, sensor and adapter
ADAPTER_LENGTH_M = 0.05
TOOL_RADIUS_M = 0.02
SELF_CLEARANCE_M = 0.005  # between parts of the arm, whose places are known
MOST_MESH_BYTES = 50_000_000
MOST_BOXES = 100  # all are looked at, at every pose, while a goal's sender waits
MOST_BOX_M = 100.0  # the library's distances fail at absurd numbers
MOST_TIP_M = 2.0  # ways would be looked at in steps too small to come to an end

# A look finds at least this more than the clearance, so that the looks' number is finite.
_SLACK_M = 1e-3
_POSES_FOR_PAIRS = 100
_MOST_NAMES = 20
_BODY = pinocchio.FrameType.BODY


class ObstacleError(GalenError):
    """Boxes that are none, or that leave the arm no way; the message names box and pose."""


@dataclass(frozen=True)
class Box:
    """An obstacle with its edges along base_link's axes: corners (3,), m. `name` as in "box 1"."""

    name: str
    lower_m: Array
    upper_m: Array


def boxes_from_numbers(numbers: Sequence[float]) -> tuple[Box, ...]:
    """Make boxes of a parameter's numbers.

    Args:
        numbers: six a box: smallest x, y, z, largest x, y, z, m, in base_link.

    Returns:
        Boxes, named "box 1" and on.

    Raises:
        ObstacleError: there are too few or too many numbers, or some make no box.

    """
    if len(numbers) % 6:
        raise ObstacleError(
            f"obstacles has {len(numbers)} numbers: six a box are needed, smallest x y z, then"
            " largest x y z"
        )
    if len(numbers) > 6 * MOST_BOXES:
        raise ObstacleError(
            f"obstacles has {len(numbers) // 6} boxes; at most {MOST_BOXES} are looked at: put"
            " those together that stand close"
        )
    boxes = []
    for index, row in enumerate(np.reshape(np.asarray(numbers, dtype=float), (-1, 6))):
        name = f"box {index + 1}"
        if not np.all(np.isfinite(row)):
            raise ObstacleError(f"obstacles: {name} holds a value that is not finite")
        if np.any(np.abs(row) > MOST_BOX_M):
            raise ObstacleError(
                f"obstacles: {name} goes further than {MOST_BOX_M:g} m from base_link; are its"
                " numbers in m?"
            )
        if not np.all(row[:3] < row[3:]):
            raise ObstacleError(
                f"obstacles: {name} is empty: its smallest corner {row[:3].tolist()} must be below"
                f" its largest {row[3:].tolist()}"
            )
        boxes.append(Box(name, row[:3], row[3:]))
    return tuple(boxes)


class ArmClearance:
    """Distances of the arm with a tool to boxes and to itself; poses are joints (n,), m and rad."""

    def __init__(
        self,
        boxes: Sequence[Box],
        clearance_m: float,
        tip_m: Array,
        arm: Arm,
        here: Array | None = None,
    ) -> None:
        """Take the shapes; parts of the arm that touch at most poses and at `here` are no pair.

        Args:
            boxes: obstacles.
            clearance_m: nothing may come nearer to a box.
            tip_m: the tool's tip (3,) in the sensor's frame.
            arm: with its description.
            here: the present joints (n,), m and rad; None: home.

        Raises:
            ObstacleError: the tip is no tool's.

        """
        if not np.linalg.norm(tip_m) <= MOST_TIP_M:
            raise ObstacleError(
                f"the tool's tip would be {np.linalg.norm(tip_m):g} m from {arm.sensor_frame},"
                f" further than the {MOST_TIP_M:g} m that ways around obstacles are looked for; is"
                " it in m?"
            )
        self.arm = arm
        self.boxes = tuple(boxes)
        tip = np.asarray(tip_m, dtype=float)
        self._model, parts, self._order, lacking, self.locked = _chain(
            arm.urdf if arm.delta is None else galen_urdf(arm),
            arm.joint_names,
            arm.base_frame,
            arm.sensor_frame,
            arm.beside,
        )
        self.unchecked = ""
        """Why shapes of the arm lack, in words; empty where none does."""
        if lacking:
            self.unchecked = f"the meshes of {', '.join(lacking)} are not reachable"
        elif not parts and arm.delta is None:
            self.unchecked = "the robot description has no collision shapes"
        self._data = self._model.createData()
        joints = self._model.joints[1:]
        self._continuous = [joint.nq == 2 for joint in joints]
        self._slides = np.array(["P" in joint.shortname() for joint in joints])
        places = self._model.jointPlacements[1:]
        self._lengths_m = np.array([np.linalg.norm(place.translation) for place in places])
        self.not_looked_at: tuple[str, ...] = ()
        self._set_pairs([*parts, *_own_parts(self._model, arm, tip)], clearance_m)
        if parts:
            self._judge_pairs(arm.home if here is None else np.asarray(here, dtype=float))

    def _set_pairs(self, parts: list[pinocchio.GeometryObject], near: float) -> None:
        """Make pairs of parts and boxes, and of parts; those of the Galen's capsules are none."""
        pinocchio.framesForwardKinematics(self._model, self._data, pinocchio.neutral(self._model))
        base = self._data.oMf[self._model.getFrameId(self.arm.base_frame, _BODY)]
        self._shapes = pinocchio.GeometryModel()
        for part in parts:
            self._shapes.addGeometryObject(part)
        for box in self.boxes:
            middle = SE3(np.eye(3), (box.lower_m + box.upper_m) / 2.0)
            solid = coal.Box(*(box.upper_m - box.lower_m))
            self._shapes.addGeometryObject(
                pinocchio.GeometryObject(box.name, 0, base * middle, solid)
            )
        pairs = []
        for one, part in enumerate(parts):
            body = part.parentJoint
            if body:
                pairs += [(one, len(parts) + k, near) for k in range(len(self.boxes))]
            if self.arm.delta is not None:
                continue
            tool = part.name == "tool"
            pairs += [
                (one, other, SELF_CLEARANCE_M)
                for other, second in enumerate(parts)
                if second.parentJoint < body - (0 if tool else 1)
            ]
        self._keep(pairs)

    def _keep(self, pairs: list[tuple[int, int, float]]) -> None:
        self._pairs = pairs
        self._shapes.removeAllCollisionPairs()
        for one, other, _ in pairs:
            self._shapes.addCollisionPair(pinocchio.CollisionPair(one, other))
        self._found = self._shapes.createData()
        self._near_m = np.array([near for _, _, near in pairs])
        objects = self._shapes.geometryObjects
        self._bodies, first = (
            np.array([objects[pair[k]].parentJoint for pair in pairs], dtype=int) for k in (0, 1)
        )
        joints = np.arange(1, self._model.njoints)
        # rows: pairs, columns: joints that move one part of a pair against the other
        self._moved = (first[:, None] < joints) & (joints <= self._bodies[:, None])
        self._size_m = np.array([_size(objects[one]) for one, _, _ in pairs])

    def _judge_pairs(self, here: Array) -> None:
        """Drop pairs of parts that touch by their shapes; an arm that stands is free there."""
        low, high = np.maximum(self.arm.lower, -np.pi), np.minimum(self.arm.upper, np.pi)
        poses = low + (high - low) * evenly_spread(_POSES_FOR_PAIRS, len(low))
        touching = np.mean([self._distances(pose) < self._limits_m for pose in poses], axis=0)
        now = self._distances(here)
        nearer = np.clip(now / 2.0 - _SLACK_M, 0.0, self._near_m)
        objects = self._shapes.geometryObjects
        parts, kept, touch = len(objects) - len(self.boxes), [], []
        for pair, near, often, m in zip(self._pairs, nearer, touching, now, strict=True):
            one, other, limit_m = pair
            if other >= parts:
                kept.append(pair)
            elif often <= 0.5 or m >= limit_m + _SLACK_M:
                kept.append((one, other, float(near)))
            else:
                touch.append(f"{objects[one].name} and {objects[other].name}")
        self.not_looked_at = tuple(dict.fromkeys(touch))
        self._keep(kept)

    def require_shapes(self) -> None:
        """Check that all shapes of the arm are there.

        Raises:
            ObstacleError: some lack; the message has the remedy.

        """
        if self.unchecked:
            raise ObstacleError(
                f"{self.unchecked}, so that the arm could hit itself unseen: make its collision"
                " shapes reachable (source the workspace of its description, or set"
                " ROS_PACKAGE_PATH), or set require_collision_shapes to false and watch the arm"
            )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Which collisions are not checked, in sentences."""
        found = []
        if self.unchecked:
            found.append(f"collisions are not checked: {self.unchecked}")
        if self.not_looked_at:
            found.append(
                f"collisions between {', '.join(self.not_looked_at)} are not checked: their shapes"
                " touch at most poses"
            )
        if self.locked:
            more = " ..." if len(self.locked) > _MOST_NAMES else ""
            found.append(
                "collisions are checked with the joints beside the arm at zero, wherever they are:"
                f" {', '.join(self.locked[:_MOST_NAMES])}{more}"
            )
        return tuple(found)

    @property
    def _limits_m(self) -> Array:
        return self._near_m + _SLACK_M

    def _distances(self, joints: Array, pairs: np.ndarray | None = None) -> Array:
        """Of each pair, or of those with these numbers, m, negative where the two overlap."""
        values = np.asarray(joints, dtype=float)[self._order]
        if any(self._continuous):
            parts = zip(values, self._continuous, strict=True)
            values = np.hstack([[np.cos(v), np.sin(v)] if turns else v for v, turns in parts])
        model, data, shapes, found = self._model, self._data, self._shapes, self._found
        if pairs is None:
            pinocchio.computeDistances(model, data, shapes, found, values)
            return np.array([result.min_distance for result in found.distanceResults])
        pinocchio.updateGeometryPlacements(model, data, shapes, found, values)
        one = pinocchio.computeDistance
        return np.array([one(shapes, found, pair).min_distance for pair in pairs.tolist()])

    def nearest(self, joints: Array) -> tuple[float, str, str] | None:
        """Find the smallest distance at a pose.

        Args:
            joints: (n,), m and rad.

        Returns:
            Distance, m, negative where the two overlap; the part; and what it is from. None where
            no pair is looked at.

        """
        if not self._pairs:
            return None
        distances = self._distances(joints)
        pair = int(np.argmin(distances))
        return self._named(pair, distances[pair])

    def pose_fault(self, joints: Array) -> str:
        """Name why the arm can't stand at a pose: limit, carriage, box or itself.

        Args:
            joints: (n,), m and rad.

        Returns:
            A clause; empty when it can.

        """
        q = np.asarray(joints, dtype=float)
        return self.arm.limit_fault(q) or self._fault(self._distances(q))

    def path_fault(self, start: Array, goal: Array) -> str:
        """Name why the arm can't go straight in joint space from pose to pose, both included.

        Limits are not asked here: between two poses inside them a straight way is inside.

        Args:
            start: joints (n,), m and rad.
            goal: joints (n,), m and rad.

        Returns:
            A clause; empty when it can.

        """
        q, way = np.asarray(start, dtype=float), np.asarray(goal, dtype=float) - start
        travel_m = self._furthest_m(q, way)
        share, pairs = 0.0, np.arange(len(travel_m))
        distances = self._distances(q)
        while not (fault := self._fault(distances, pairs)):
            free, left = distances - self._near_m[pairs], travel_m[pairs]
            # The others stay far enough until the end.
            pairs, free, left = (part[free < left * (1.0 - share)] for part in (pairs, free, left))
            if not len(pairs):
                return self._fault(self._distances(np.asarray(goal, dtype=float)))
            share += float(np.min(free / left))
            distances = self._distances(q + share * way, pairs)
        return fault

    def _furthest_m(self, start: Array, way: Array) -> Array:
        """L (pairs,) of the module's text."""
        values = np.stack([start, start + way]).T[self._order]
        steps = np.abs(values[:, 1] - values[:, 0])
        reached = np.where(self._slides, np.max(np.abs(values), axis=1), 0.0)
        along = np.concatenate([[0.0], np.cumsum(self._lengths_m + reached)])
        levers = self._size_m[:, None] + along[self._bodies, None] - along[1:]
        each = np.where(self._slides, 1.0, levers) * steps
        return np.asarray(np.sum(np.where(self._moved, each, 0.0), axis=1))

    def _fault(self, distances: Array, pairs: np.ndarray | None = None) -> str:
        short = distances - (self._limits_m if pairs is None else self._limits_m[pairs])
        if not np.any(short < 0.0):
            return ""
        worst = int(np.argmin(short))
        distance_m, part, other = self._named(
            worst if pairs is None else pairs[worst], distances[worst]
        )
        where = (
            f"{distance_m * 1e3:.0f} mm from"
            if distance_m > 0.0
            else "in"  # the library's depth of contact is no distance
        )
        return f"the {part} would be {where} {other}"

    def _named(self, pair: int, distance_m: float) -> tuple[float, str, str]:
        one, other, _ = self._pairs[pair]
        objects = self._shapes.geometryObjects
        return float(distance_m), objects[one].name, objects[other].name


def mesh_path(filename: str) -> Path | None:
    """Find where a description's mesh lies.

    package:// is looked for in AMENT_PREFIX_PATH and ROS_PACKAGE_PATH; file:// and an absolute path
    are taken as they are.

    Args:
        filename: as the URDF names it.

    Returns:
        The file; None where it is not reachable, or above 50 MB.

    """
    kind, _, rest = filename.rpartition("://")
    found = [Path(rest)] if kind == "file" or (not kind and Path(rest).is_absolute()) else []
    if kind == "package":
        for name, inside in (("AMENT_PREFIX_PATH", "share"), ("ROS_PACKAGE_PATH", "")):
            folders = filter(None, os.environ.get(name, "").split(os.pathsep))
            found += [Path(folder) / inside / rest for folder in folders]
    for path in found:
        if path.is_file() and path.stat().st_size <= MOST_MESH_BYTES:
            return path
    return None


def _described(
    urdf: str,
) -> tuple[str, list[tuple[str, SE3, coal.CollisionGeometry]], tuple[str, ...]]:
    """Return the description without meshes; link, place and hull of each; links of bad ones."""
    root, loader, without = ElementTree.fromstring(urdf), coal.MeshLoader(), []
    hulls = []
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            link.remove(collision)
            name, path = str(link.get("name")), mesh_path(mesh.get("filename") or "")
            try:
                if path is None:
                    raise ValueError
                origin = collision.find("origin")
                get = {} if origin is None else origin.attrib
                turn = pinocchio.rpy.rpyToMatrix(_numbers(get.get("rpy", "0 0 0")))
                place = SE3(turn, _numbers(get.get("xyz", "0 0 0")))
                shape = _hull(loader.load(str(path), _numbers(mesh.get("scale", "1 1 1"))))
            except (ValueError, RuntimeError):
                without.append(name)
            else:
                hulls.append((name, place, shape))
    return ElementTree.tostring(root, encoding="unicode"), hulls, tuple(dict.fromkeys(without))


def _numbers(text: str) -> Array:
    numbers = np.array([float(part) for part in text.split()])
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers)):
        raise ValueError(text)
    return numbers


def _hull(mesh: coal.BVHModelBase) -> coal.CollisionGeometry:
    """Return a mesh's convex hull; a flat one as it is. Raises ValueError for no finite points."""
    points = mesh.vertices()
    if not np.all(np.isfinite(points)):
        raise ValueError
    spread = np.sqrt(np.abs(np.linalg.eigvalsh(np.cov(points.T))))
    if spread[0] <= 1e-4 * spread[2]:  # the library's hull of a flat mesh ends the process
        return mesh
    mesh.buildConvexHull(True, "Qt")
    return mesh.convex


@lru_cache(maxsize=2)  # a robot's meshes may take seconds
def _whole(urdf: str) -> tuple[pinocchio.Model, pinocchio.GeometryModel, tuple[str, ...]]:
    """Return the model of all joints, its shapes, and the links without their meshes."""
    text, hulls, without_shape = _described(urdf)
    whole = pinocchio.buildModelFromXML(text)
    shapes = pinocchio.buildGeomFromUrdfString(whole, text, pinocchio.GeometryType.COLLISION)
    for link, place, hull in hulls:
        frame = whole.getFrameId(link, _BODY)
        held, name = whole.frames[frame], f"{link}_{shapes.ngeoms}"
        shapes.addGeometryObject(  # without the frame's number a reduced model reads anywhere
            pinocchio.GeometryObject(name, held.parentJoint, frame, held.placement * place, hull)
        )
    return whole, shapes, without_shape


def _followed(urdf: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the finite values of joints, and of those that follow one of them (mimic)."""
    known = {name: value for name, value in values.items() if np.isfinite(value)}
    for joint in ElementTree.fromstring(urdf).iter("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and (leader := str(mimic.get("joint"))) in known:
            factor, offset = (
                float(mimic.get(*of)) for of in (("multiplier", "1"), ("offset", "0"))
            )
            known.setdefault(str(joint.get("name")), factor * known[leader] + offset)
    return known


def _chain(
    urdf: str,
    joint_names: tuple[str, ...],
    base_frame: str,
    sensor_frame: str,
    beside: Mapping[str, float],
) -> tuple[
    pinocchio.Model, list[pinocchio.GeometryObject], list[int], tuple[str, ...], tuple[str, ...]
]:
    """Return the model of the joints from base to sensor, its shapes and its joints' order.

    All other joints are locked where they stand by `beside`, else at zero, or at the limit that is
    nearest to it. Last come the links without their meshes, and the joints locked at zero that
    could move shapes against the base.
    """
    whole, shapes, without_shape = _whole(urdf)
    sensor, base = (
        whole.frames[whole.getFrameId(name, _BODY)].parentJoint
        for name in (sensor_frame, base_frame)
    )
    kept = [k for k in whole.supports[sensor] if k not in list(whole.supports[base])]
    at = np.clip(pinocchio.neutral(whole), whole.lowerPositionLimit, whole.upperPositionLimit)
    locked = [k for k in range(1, whole.njoints) if k not in kept]
    supports = [list(whole.supports[shape.parentJoint]) for shape in shapes.geometryObjects]
    carried = set(whole.supports[base])
    known = _followed(urdf, beside)
    for k in locked:
        if (value := known.get(whole.names[k])) is not None:
            joint = whole.joints[k]
            turned = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            at[joint.idx_q : joint.idx_q + joint.nq] = turned
    locked_at_zero = [k for k in locked if whole.names[k] not in known]
    unknown = [
        k for k in locked_at_zero if any((k in support) != (k in carried) for support in supports)
    ]
    model, shapes = pinocchio.buildReducedModel(whole, shapes, locked, at)
    order = [joint_names.index(name) for name in model.names[1:]]
    parts = list(shapes.geometryObjects)
    for part in parts:
        part.name = part.name.rpartition("_")[0]  # of "link_0"
    return model, parts, order, without_shape, tuple(whole.names[k] for k in unknown)


def _own_parts(model: pinocchio.Model, arm: Arm, tip: Array) -> list[pinocchio.GeometryObject]:
    """Return the tool, and of the Galen all parts: its description has no collision shapes."""
    here, sensor = np.zeros(3), arm.sensor_frame
    if arm.delta is None:
        return [_capsule(model, "tool", sensor, here, tip, TOOL_RADIUS_M)]
    out, adapter = np.array([0.0, 0.0, tip[2]]), np.array([0.0, 0.0, ADAPTER_LENGTH_M])
    platform, roll, tilt = (joint.link for joint in arm.joints[2:])
    rows = [
        ("platform", platform, here, arm.joints[3].origin_m, PLATFORM_RADIUS_M),
        ("roll link", roll, here, arm.joints[4].origin_m, LINK_RADIUS_M),
        ("tilt link", tilt, here, arm.sensor_origin_m, LINK_RADIUS_M),
        ("sensor", sensor, here, adapter, LINK_RADIUS_M),
        ("tool", sensor, here, out, TOOL_RADIUS_M),
        ("tool", sensor, out, tip, TOOL_RADIUS_M),
        ("tool", sensor, here, tip, TOOL_RADIUS_M),
    ]
    return [_capsule(model, *row) for row in rows]


def _capsule(
    model: pinocchio.Model, name: str, frame: str, start: Array, end: Array, radius_m: float
) -> pinocchio.GeometryObject:
    """Return a capsule from `start` to `end` (3,), m, in a frame; its own axis is z."""
    length = float(np.linalg.norm(end - start))
    turn = np.eye(3)
    if length > 1e-9:
        axis = (end - start) / length
        turn = pinocchio.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix()
    held = model.frames[model.getFrameId(frame, _BODY)]
    place = held.placement * SE3(turn, (start + end) / 2.0)
    return pinocchio.GeometryObject(name, held.parentJoint, place, coal.Capsule(radius_m, length))


def _size(part: pinocchio.GeometryObject) -> float:
    """How far any point of a part is from its joint's origin, m, at most."""
    part.geometry.computeLocalAABB()
    centre = part.placement.act(part.geometry.aabb_center)
    return float(np.linalg.norm(centre) + part.geometry.aabb_radius)
