"""What of the arm is drawn and where: plain lists for the browser. No ROS, no page.

A part is shapes fixed to a frame, sent once; a placement holds the frames' poses, sent again and
again: x, y, z (m), a quaternion x, y, z, w, and the length (m) of a part that is stretched along z.
The straight arm is drawn as the joints say, from joint to joint. The bent one is displaced by the
deflection, exaggerated: a point moves as the tip's rigid displacement has it, times its share of
the way from base to tip.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array

Part = dict[str, Any]
Placement = dict[str, list[float] | None]

FORCE_M_PER_N = 0.03
_FORCE_MIN_N = 0.15
_FORCE_MAX_M = 0.4
_LINK_RADIUS_M, _TOOL_RADIUS_M, _JOINT_RADIUS_M, _COM_RADIUS_M = 0.015, 0.004, 0.022, 0.012
_STRAIGHT, _BENT, _JOINT, _COM, _FORCE = "#98a4b0", "#ff8c1a", "#6c7a89", "#2f9e6e", "#e0316f"
_BENT_OPACITY = 0.6
_SHORTEST_M = 1e-4
_DECIMALS = 5
"""Of places, m, and of quaternions."""


def parts(arm: Arm) -> list[Part]:
    """List all parts: name and shapes, each with kind, sizes (m), place, colour, opacity."""
    pieces = len(arm.joints) + 2
    found = []
    for piece in range(pieces):
        radius = _TOOL_RADIUS_M if piece == pieces - 1 else _LINK_RADIUS_M
        found.append(_part(f"straight/{piece}", "cylinder", [radius, 1.0], _STRAIGHT))
        found.append(_part(f"bent/{piece}", "cylinder", [radius, 1.0], _BENT, _BENT_OPACITY))
    found += [_part(f"joint/{k}", "sphere", [_JOINT_RADIUS_M], _JOINT) for k in arm.turning]
    found.append(_part("com", "sphere", [_COM_RADIUS_M], _COM))
    return [*found, _part("force", "arrow", [0.006, 0.018], _FORCE)]


def place(
    arm: Arm,
    joints: Array,
    tip_m: Array,
    com_m: Array | None,
    deflection: Array | None,
    wrench: Array | None,
) -> Placement:
    """Return where the parts are; None for one that isn't to be seen.

    joints (n,), m and rad; tip_m, com_m (3,) and wrench (6,), N and N.m, in the sensor's frame;
    deflection (6,) of the tip in the base's frame, m and rad, as it is to be shown. None where
    there is none.
    """
    rotation, sensor = arm.sensor_pose(joints)
    origins, _ = arm.joint_axes(joints)
    tip = sensor + rotation @ tip_m
    # Base, joints, sensor, tip: the last piece between two of them is the tool.
    points = np.vstack([np.zeros(3), origins, sensor, tip])
    bent = None if deflection is None else _bent(points, deflection)
    placed: Placement = {}
    for name, chain in (("straight", points), ("bent", bent)):
        for piece in range(len(points) - 1):
            ends = None if chain is None else _between(*chain[piece : piece + 2].tolist())
            placed[f"{name}/{piece}"] = ends
    for k in arm.turning:
        placed[f"joint/{k}"] = _at(origins[k])
    placed["com"] = None if com_m is None else _at(sensor + rotation @ com_m)
    force = np.zeros(3) if wrench is None else rotation @ wrench[:3]
    size_n = float(np.linalg.norm(force))
    placed["force"] = None
    if size_n >= _FORCE_MIN_N:
        end = (tip if bent is None else bent[-1]).tolist()
        length_m = min(FORCE_M_PER_N * size_n, _FORCE_MAX_M)
        placed["force"] = _rounded([*end, *_turn_of_z((force / size_n).tolist()), length_m])
    return placed


def middle_and_size(arm: Arm) -> tuple[Array, float]:
    """Return the middle (3,) and the size of what the arm takes up at home, m."""
    origins, _ = arm.joint_axes(arm.home)
    points = np.vstack([np.zeros(3), origins, arm.sensor_pose(arm.home)[1]])
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2.0, float(np.linalg.norm(high - low))


def _bent(points: Array, deflection: Array) -> Array:
    """Points (n, 3) from base to tip, displaced by shares of the tip's twist (6,)."""
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    moved = deflection[:3] + np.cross(deflection[3:], points - points[-1])
    return np.asarray(points + (way / max(way[-1], _SHORTEST_M))[:, None] * moved)


def _part(name: str, kind: str, sizes: list[float], colour: str, opacity: float = 1.0) -> Part:
    here = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    shape = {"kind": kind, "sizes": sizes, "place": here, "colour": colour, "opacity": opacity}
    return {"name": name, "shapes": [shape]}


def _between(start_m: list[float], end_m: list[float]) -> list[float] | None:
    """Place a part of length 1 along z from start to end; None where they are one point."""
    length_m = math.dist(start_m, end_m)
    if length_m < _SHORTEST_M:
        return None
    direction = [(end - start) / length_m for start, end in zip(start_m, end_m, strict=True)]
    middle = [(start + end) / 2.0 for start, end in zip(start_m, end_m, strict=True)]
    return _rounded([*middle, *_turn_of_z(direction), length_m])


def _at(point_m: Array) -> list[float]:
    return _rounded([*point_m.tolist(), 0.0, 0.0, 0.0, 1.0])


def _turn_of_z(direction: list[float]) -> list[float]:
    """Return the quaternion x, y, z, w that turns z to this unit vector the shortest way."""
    x, y, z = direction
    if z < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    size = math.sqrt(2.0 * (1.0 + z))
    return [-y / size, x / size, 0.0, size / 2.0]


def _rounded(numbers: list[float]) -> list[float]:
    return [round(number, _DECIMALS) for number in numbers]
