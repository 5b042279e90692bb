"""What of the arm is drawn and where: plain lists for the browser. No ROS, no page.

A part is a frame with shapes fixed to it, sent once; a placement says where the frames are, sent
again and again: x, y, z (m), a quaternion x, y, z, w, and where a part has a length of its own,
that (m). The straight arm is as the joints say, the bent one is displaced by the deflection,
exaggerated.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from galen_model.arm.galen import BASE_FRAME, GALEN, HOME, SENSOR_FRAME, TIP_FRAME, ArmParameters
from galen_model.arm.urdf import galen_urdf
from galen_model.arrays import Array
from galen_model.errors import KinematicsError
from galen_model.rotation import matrix_to_quaternion, quaternion_to_matrix

from galen_panel.page.live.arm_view import (
    HERE,
    ArmPose,
    ArmShape,
    Model,
    bent_frames,
    delta_parts,
    force_in_base,
    frames,
    read_urdf,
    share,
)

Part = dict[str, Any]
Placement = dict[str, list[float] | None]

FORCE_M_PER_N = 0.03
_FORCE_MIN_N = 0.15
_FORCE_MAX_M = 0.4
_TOOL_RADIUS_M = 0.004
_COM_RADIUS_M = 0.012
_ROD_RADIUS_M = 0.005
_CARRIAGE_M = (0.03, 0.05, 0.04)
_RAIL_RADIUS_M = 0.006
_STRAIGHT, _BENT, _DELTA, _COM, _FORCE = (
    "#98a4b0", "#ff8c1a", "#6c7a89", "#2f9e6e", "#e0316f",
)  # fmt: skip
_BENT_OPACITY = 0.6
_DECIMALS = 5
"""Of places, m, and of quaternions."""


class Drawing:
    """The arm with one tool: tip_m (3,) and com_m (3,) in ft_sensor."""

    def __init__(self, tip_m: Array, com_m: Array | None, arm: ArmParameters = GALEN) -> None:
        self._tip_m = np.asarray(tip_m, dtype=float)
        self._com_m = com_m
        self._arm = arm
        self._model: Model = read_urdf(galen_urdf(self._tip_m, arm))
        self._moving = [
            *(f"bent/{shape.link}" for shape in self._model.shapes if shape.link != BASE_FRAME),
            *(f"rod/{rod}" for rod in range(6)),
            *(f"carriage/{leg}" for leg in range(3)),
            "force",
        ]

    def parts(self) -> list[Part]:
        """All parts: name and shapes, each with kind, sizes (m), place, colour, opacity."""
        rail_m = 2.0 * self._arm.carriage_travel_m
        rails = delta_parts(HOME[:3], self._arm)
        assert rails is not None
        parts = [
            *(
                _part(f"{arm}/{link}", shapes, colour, opacity)
                for arm, colour, opacity in (
                    ("straight", _STRAIGHT, 1.0), ("bent", _BENT, _BENT_OPACITY),
                )
                for link, shapes in self._shapes().items()
                if arm == "straight" or link != BASE_FRAME
            ),
            *(
                _part(f"rail/{leg}", [
                    ArmShape("", "cylinder", (_RAIL_RADIUS_M, rail_m), ArmPose(np.eye(3), foot)),
                ], _DELTA, 0.5)
                for leg, foot in enumerate(rails.carriages_m)
            ),
            *(
                _part(f"rod/{rod}", [
                    ArmShape("", "cylinder", (_ROD_RADIUS_M, self._arm.rod_length_m), HERE),
                ], _DELTA, 1.0)
                for rod in range(6)
            ),
            *(
                _part(f"carriage/{leg}", [ArmShape("", "box", _CARRIAGE_M, HERE)], _DELTA, 1.0)
                for leg in range(3)
            ),
        ]  # fmt: skip
        arrow = [ArmShape("", "arrow", (0.006, 0.018), HERE)]
        return [*parts, _part("force", arrow, _FORCE, 1.0)]

    def place(
        self, joints: Array, deflection: Array | None, wrench: Array | None, factor: float
    ) -> Placement:
        """Where the parts are; None for one that isn't to be seen.

        joints (5,), m and rad; deflection (6,) of the tip in base_link, m and rad, and wrench (6,)
        in ft_sensor, N and N·m, where they are known.
        """
        straight = frames(self._model, joints)
        bent = self._bent(joints, deflection, factor)
        placed: Placement = dict.fromkeys(self._moving)
        placed |= _places(
            {f"straight/{link}": pose for link, pose in straight.items()}
            | {f"bent/{link}": pose for link, pose in bent.items()}
        )
        delta = delta_parts(joints[:3], self._arm)
        if delta is not None:
            rods = zip(delta.start_m.tolist(), delta.end_m.tolist(), strict=True)
            for rod, (start, end) in enumerate(rods):
                placed[f"rod/{rod}"] = _between(start, end)
            for leg, middle in enumerate(delta.carriages_m.tolist()):
                placed[f"carriage/{leg}"] = _facing(middle)
        force = np.zeros(3) if wrench is None else force_in_base(joints, wrench)
        size_n = float(np.linalg.norm(force))
        if size_n >= _FORCE_MIN_N:
            tip_m = bent.get(TIP_FRAME, straight[TIP_FRAME]).origin_m
            length_m = min(FORCE_M_PER_N * size_n, _FORCE_MAX_M)
            turn = _turn_of_z((force / size_n).tolist())
            placed["force"] = [*_rounded([*tip_m.tolist(), *turn]), round(length_m, 3)]
        return placed

    def _bent(self, joints: Array, deflection: Array | None, factor: float) -> dict[str, ArmPose]:
        if deflection is None:
            return {}
        try:
            bend = share(joints, deflection, self._tip_m, self._arm)
        except KinematicsError:
            return {}
        return bent_frames(self._model, joints, bend.times(factor))

    def _shapes(self) -> dict[str, list[ArmShape]]:
        shapes: dict[str, list[ArmShape]] = {}
        for shape in self._model.shapes:
            shapes.setdefault(shape.link, []).append(shape)
        length_m = float(np.linalg.norm(self._tip_m))
        if length_m > 0.0:
            turn = quaternion_to_matrix(_turn_of_z((self._tip_m / length_m).tolist()))
            place = ArmPose(turn, self._tip_m / 2.0)
            tool = ArmShape(SENSOR_FRAME, "cylinder", (_TOOL_RADIUS_M, length_m), place)
            shapes[SENSOR_FRAME].append(tool)
        if self._com_m is not None:
            place = ArmPose(np.eye(3), np.asarray(self._com_m, dtype=float))
            shapes[SENSOR_FRAME].append(ArmShape("com", "sphere", (_COM_RADIUS_M,), place))
        return shapes


def _part(name: str, shapes: list[ArmShape], colour: str, opacity: float) -> Part:
    return {
        "name": name,
        "shapes": [
            {
                "kind": shape.kind,
                "sizes": list(shape.sizes_m),
                "place": [
                    *np.round(shape.pose.origin_m, 6).tolist(),
                    *np.round(matrix_to_quaternion(shape.pose.rotation), 6).tolist(),
                ],
                "colour": _COM if shape.link == "com" else colour,
                "opacity": opacity,
            }
            for shape in shapes
        ],
    }


def _places(poses: dict[str, ArmPose]) -> Placement:
    # All at once: a quaternion costs more to ask for than to compute.
    turns = matrix_to_quaternion(np.stack([pose.rotation for pose in poses.values()]))
    rows = np.column_stack([np.stack([pose.origin_m for pose in poses.values()]), turns])
    return dict(zip(poses, np.round(rows, _DECIMALS).tolist(), strict=True))


def _between(start_m: list[float], end_m: list[float]) -> list[float]:
    """Of a part whose axis is z, from start to end."""
    length_m = math.dist(start_m, end_m)
    direction = [(end - start) / length_m for start, end in zip(start_m, end_m, strict=True)]
    middle = [(start + end) / 2.0 for start, end in zip(start_m, end_m, strict=True)]
    return _rounded([*middle, *_turn_of_z(direction)])


def _facing(point_m: list[float]) -> list[float]:
    """Of a part at this point whose x axis points away from base_link's z axis."""
    half = math.atan2(point_m[1], point_m[0]) / 2.0
    return _rounded([*point_m, 0.0, 0.0, math.sin(half), math.cos(half)])


def _turn_of_z(direction: list[float]) -> list[float]:
    """The quaternion x, y, z, w that turns the z axis to this unit vector the shortest way."""
    x, y, z = direction
    if z < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    size = math.sqrt(2.0 * (1.0 + z))
    return [-y / size, x / size, 0.0, size / 2.0]


def _rounded(numbers: list[float]) -> list[float]:
    return [round(number, _DECIMALS) for number in numbers]
