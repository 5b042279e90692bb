"""How near the arm comes to boxes that stand around it, at a pose and on the way to another.

The moving parts are capsules along the arm's known points: platform to roll axis, the roll link,
tilt axis to sensor, sensor and adapter, and the tool as a triangle of capsules: out along the
adapter to the tip's height, across to the tip, and straight back. Their radii are estimates, for
no drawing of the arm is public. The delta's rods and carriages are left out: they don't move
where only roll and tilt do. Distances from capsule to box are the library coal's.

A way is straight in joint space, as the arm goes. No point of a part moves further on it than

    L = |delta p| + |delta roll| rho_roll + |delta tilt| rho_tilt

with rho the largest distance of any such point from the joint's axis. Where the nearest part is d
from a box, nothing can come nearer than d - L s on the next share s of the way; so the next look is
at s = (d - clearance) / L. Nothing slips through, and far from all boxes few looks do (conservative
advancement: Mirtich, *Impulse-based Dynamic Simulation of Rigid Body Systems*, 1996, section 2.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rotation import rot_x, rot_y

PLATFORM_RADIUS_M = 0.06
LINK_RADIUS_M = 0.04  # of roll link, tilt link, sensor and adapter
ADAPTER_LENGTH_M = 0.05
TOOL_RADIUS_M = 0.02
MOST_BOXES = 100  # all are looked at, at every pose, while a goal's sender waits
MOST_BOX_M = 100.0  # the library's distances fail at absurd numbers
MOST_TIP_M = 2.0  # ways would be looked at in steps too small to come to an end

# A look finds at least this more than the clearance, so that the looks' number is finite.
_SLACK_M = 1e-3


class ObstacleError(GalenError):
    """Boxes that are none, or that leave the arm no way; the message names box and pose."""


@dataclass(frozen=True)
class Box:
    """An obstacle with its edges along base_link's axes: corners (3,), m. `name` as in "box 1"."""

    name: str
    lower_m: Array
    upper_m: Array


def boxes_from_numbers(numbers: Sequence[float]) -> tuple[Box, ...]:
    """Six numbers a box: smallest x, y, z, largest x, y, z, m; raises ObstacleError."""
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


@dataclass(frozen=True)
class _Part:
    """A capsule from `start_m` to `end_m` (3,) in the frame with this index."""

    name: str
    frame: int
    start_m: Array
    end_m: Array
    radius_m: float


class ArmClearance:
    """Distances of the arm with a tool to boxes; poses are joints (5,), m and rad."""

    def __init__(
        self,
        boxes: Sequence[Box],
        clearance_m: float,
        tip_m: Array,
        arm: Arm = GALEN,
    ) -> None:
        """`clearance_m`: nothing may come nearer; tip_m (3,): the tool's tip in ft_sensor.

        Raises ObstacleError for a tip that is no tool's.
        """
        if not np.linalg.norm(tip_m) <= MOST_TIP_M:
            raise ObstacleError(
                f"the tool's tip would be {np.linalg.norm(tip_m):g} m from ft_sensor, further than"
                f" the {MOST_TIP_M:g} m that ways around obstacles are looked for; is it in m?"
            )
        self._boxes = tuple(boxes)
        self._clearance_m = clearance_m
        self.arm = arm
        parts = _parts(np.asarray(tip_m, dtype=float), arm)
        self._parts = [
            (part, coal.Capsule(part.radius_m, _length(part)), *_placement(part)) for part in parts
        ]
        self._shapes = [
            (
                box,
                coal.Box(*(box.upper_m - box.lower_m)),
                coal.Transform3s(np.eye(3), (box.lower_m + box.upper_m) / 2.0),
            )
            for box in self._boxes
        ]
        self._reach = _reach(parts, arm)

    @property
    def boxes(self) -> tuple[Box, ...]:
        """What it keeps away from."""
        return self._boxes

    def nearest(self, joints: Array) -> tuple[float, str, str] | None:
        """Return the smallest distance at a pose, m, its part and its box; None without boxes.

        Negative inside a box.
        """
        frames = _frames(joints, self.arm)
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        best: tuple[float, str, str] | None = None
        for part, capsule, turn, middle in self._parts:
            rotation, origin = frames[part.frame]
            place = coal.Transform3s(rotation @ turn, origin + rotation @ middle)
            for box, shape, where in self._shapes:
                result.clear()
                distance = float(coal.distance(capsule, place, shape, where, request, result))
                if best is None or distance < best[0]:
                    best = (distance, part.name, box.name)
        return best

    def pose_fault(self, joints: Array) -> str:
        """Why the arm can't stand here: limit, carriage or box; empty when it can."""
        q = np.asarray(joints, dtype=float)
        return self.arm.limit_fault(q) or self._too_near(q)[1]

    def path_fault(self, start: Array, goal: Array) -> str:
        """Why the arm can't go straight from `start` to `goal`, both included; empty when it can.

        Limits are not asked here: between two poses inside them a straight way is inside.
        """
        q, way = np.asarray(start, dtype=float), np.asarray(goal, dtype=float) - start
        furthest = float(np.linalg.norm(way[:3]) + np.abs(way[3:]) @ self._reach)
        share = 0.0
        while True:
            distance, fault = self._too_near(q + share * way)
            if fault or share == 1.0:
                return fault
            free = distance - self._clearance_m
            share = 1.0 if furthest * (1.0 - share) <= free else share + free / furthest

    def _too_near(self, joints: Array) -> tuple[float, str]:
        nearest = self.nearest(joints)
        if nearest is None:
            return np.inf, ""
        distance_m, part, box = nearest
        if distance_m >= self._clearance_m + _SLACK_M:
            return distance_m, ""
        where = (
            f"{distance_m * 1e3:.0f} mm from"
            if distance_m > 0.0
            else "in"  # the library's depth of contact is no distance
        )
        return distance_m, f"the {part} would be {where} {box}"


def _parts(tip: Array, arm: Arm) -> list[_Part]:
    here = np.zeros(3)
    out = np.array([0.0, 0.0, tip[2]])
    adapter = np.array([0.0, 0.0, ADAPTER_LENGTH_M])
    return [
        _Part("platform", 0, here, arm.joints[3].origin_m, PLATFORM_RADIUS_M),
        _Part("roll link", 1, here, arm.joints[4].origin_m, LINK_RADIUS_M),
        _Part("tilt link", 2, here, arm.sensor_origin_m, LINK_RADIUS_M),
        _Part("sensor", 3, here, adapter, LINK_RADIUS_M),
        _Part("tool", 3, here, out, TOOL_RADIUS_M),
        _Part("tool", 3, out, tip, TOOL_RADIUS_M),
        _Part("tool", 3, here, tip, TOOL_RADIUS_M),
    ]


def _length(part: _Part) -> float:
    return float(np.linalg.norm(part.end_m - part.start_m))


def _placement(part: _Part) -> tuple[Array, Array]:
    """R (3, 3) and middle (3,) of the capsule, whose axis is z, in its frame."""
    length = _length(part)
    if length < 1e-9:
        return np.eye(3), part.start_m
    axis = (part.end_m - part.start_m) / length
    side = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(side, axis)
    first /= np.linalg.norm(first)
    turn = np.column_stack([first, np.cross(axis, first), axis])
    return turn, (part.start_m + part.end_m) / 2.0


def _frames(joints: Array, arm: Arm) -> list[tuple[Array, Array]]:
    """R_base_frame and origin in base_link of platform, roll link, tilt link and sensor."""
    q = np.asarray(joints, dtype=float)
    roll_origin = q[:3] + arm.joints[3].origin_m
    roll = rot_x(q[3])
    return [
        (np.eye(3), q[:3]),
        (roll, roll_origin),
        (roll @ rot_y(q[4]), roll_origin + roll @ arm.joints[4].origin_m),
        arm.sensor_pose(q),
    ]


def _reach(parts: Sequence[_Part], arm: Arm) -> Array:
    """How far (2,), m, any moving point is from the axes of roll and tilt, at most.

    From the tilt axis's origin no point is further than `about_tilt`; roll's axis passes that
    origin at the distance of the roll link's offset across it.
    """
    ends = [
        (np.zeros(3) if part.frame == 2 else arm.sensor_origin_m, part)
        for part in parts
        if part.frame >= 2
    ]
    about_tilt = max(
        float(np.linalg.norm(origin) + max(map(np.linalg.norm, (part.start_m, part.end_m))))
        for origin, part in ends
    )
    return np.array([about_tilt + float(np.linalg.norm(arm.joints[4].origin_m[1:])), about_tilt])
