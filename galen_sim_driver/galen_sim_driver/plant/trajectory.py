"""A trajectory as joint_trajectory_controller takes it.

Between two points the reference is linear where they give positions only, cubic where they give
velocities too, quintic where they give accelerations as well. The first piece starts at the arm's
state at the moment the trajectory comes in. After the last point the reference stands there.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from galen_model.arm.galen import JOINT_NAMES, JointLimits

from galen_sim_driver.errors import TrajectoryError

_NS = 1e-9
_LARGEST_RATE = 1e6
"""m/s, rad/s and per s: beyond any arm, and far from where the polynomials would overflow."""


@dataclass(frozen=True)
class TrajectoryPoint:
    """One point: time after the trajectory's start (s), values in the order of its joints.

    Empty `velocities` or `accelerations` mean that the point doesn't say.
    """

    time_s: float
    positions: Sequence[float]
    velocities: Sequence[float] = ()
    accelerations: Sequence[float] = ()


@dataclass(frozen=True)
class Trajectory:
    """Points for some joints, in m, rad, s. `start_ns` 0 means now."""

    joint_names: Sequence[str]
    points: Sequence[TrajectoryPoint]
    start_ns: int = 0


@dataclass(frozen=True)
class JointState:
    """Positions, velocities and accelerations of all five joints, in the order of JOINT_NAMES."""

    positions: Sequence[float]
    velocities: Sequence[float]
    accelerations: Sequence[float]


def check_trajectory(trajectory: Trajectory, limits: JointLimits, now_ns: int) -> None:
    """Raise TrajectoryError, naming joint and value, unless the trajectory can be taken.

    The points must be inside the joint limits; what a polynomial does between them is held inside
    by the motion itself.
    """
    names = list(trajectory.joint_names)
    for name in names:
        if name not in JOINT_NAMES:
            raise TrajectoryError(f"unknown joint '{name}'; the arm has {', '.join(JOINT_NAMES)}")
        if names.count(name) > 1:
            raise TrajectoryError(f"joint '{name}' is named twice")
    if not names:
        raise TrajectoryError("the trajectory has points but no joint names")
    previous_s = -1.0
    for index, point in enumerate(trajectory.points):
        where = f"point {index}"
        if not math.isfinite(point.time_s) or point.time_s < 0.0:
            raise TrajectoryError(f"{where}: time_from_start is {point.time_s} s")
        if point.time_s <= previous_s:
            raise TrajectoryError(
                f"{where}: time_from_start {point.time_s} s is not after the {previous_s} s of "
                "the point before"
            )
        previous_s = point.time_s
        _check_sizes(where, names, point)
        for name, value in zip(names, point.positions, strict=True):
            joint = JOINT_NAMES.index(name)
            low, high = limits.lower[joint], limits.upper[joint]
            if not low <= value <= high:
                raise TrajectoryError(
                    f"{where}: {name} at {value:.6g} is outside its limits {low:g} to {high:g}"
                )
    if trajectory.start_ns and trajectory.start_ns + round(previous_s / _NS) < now_ns:
        late_s = (now_ns - trajectory.start_ns) * _NS - previous_s
        raise TrajectoryError(f"the trajectory's last point is {late_s:.3f} s in the past")


def _check_sizes(where: str, names: Sequence[str], point: TrajectoryPoint) -> None:
    for what, values, may_be_empty in (
        ("positions", point.positions, False),
        ("velocities", point.velocities, True),
        ("accelerations", point.accelerations, True),
    ):
        if len(values) != len(names) and not (may_be_empty and len(values) == 0):
            raise TrajectoryError(f"{where}: {len(values)} {what} for {len(names)} joints")
        for name, value in zip(names, values, strict=False):
            if not abs(value) <= _LARGEST_RATE:  # a position's limit is checked with the joint's
                raise TrajectoryError(f"{where}: {what} of {name} hold {value}")
    if len(point.accelerations) and not len(point.velocities):
        raise TrajectoryError(f"{where}: accelerations without velocities")


class Reference:
    """Where the joints should be at any time: pieces of polynomials, then the last point."""

    def __init__(
        self, trajectory: Trajectory, now_ns: int, start: JointState, hold: Sequence[float]
    ) -> None:
        """Plan from `start` at `now_ns`; joints not named go to `hold` (5,), m and rad.

        The trajectory must have passed `check_trajectory`.
        """
        self._joints = [JOINT_NAMES.index(name) for name in trajectory.joint_names]
        self._hold = list(hold)
        self._origin_ns = now_ns
        begin_ns = trajectory.start_ns or now_ns
        delay_s = (begin_ns - now_ns) * _NS
        first = TrajectoryPoint(
            0.0,
            [start.positions[joint] for joint in self._joints],
            [start.velocities[joint] for joint in self._joints],
            [start.accelerations[joint] for joint in self._joints],
        )
        points = list(trajectory.points)
        times = [point.time_s + delay_s for point in points]
        if times[0] > 0.0:
            # The usual case: from the state now to the first point.
            points, times = [first, *points], [0.0, *times]
        self._times = times
        self._pieces = [
            _piece(points[i], points[i + 1], times[i + 1] - times[i])
            for i in range(len(points) - 1)
        ]
        self._last = list(points[-1].positions)
        self.end_ns = now_ns + round(times[-1] / _NS)

    def sample(self, now_ns: int) -> list[float]:
        """Return the positions (5,) at a time not before the planning, m and rad."""
        result = self._hold.copy()
        if now_ns >= self.end_ns:
            for joint, value in zip(self._joints, self._last, strict=True):
                result[joint] = value
            return result
        time_s = (now_ns - self._origin_ns) * _NS
        index = min(max(bisect_right(self._times, time_s) - 1, 0), len(self._pieces) - 1)
        t = time_s - self._times[index]
        for joint, (c0, c1, c2, c3, c4, c5) in zip(self._joints, self._pieces[index], strict=True):
            result[joint] = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        return result


def _piece(
    start: TrajectoryPoint, end: TrajectoryPoint, duration_s: float
) -> list[tuple[float, float, float, float, float, float]]:
    """Coefficients, lowest order first, for every joint of one piece.

    Linear, cubic or quintic Hermite polynomial: as many derivatives as both ends give.
    """
    count = len(start.positions)
    if len(start.velocities) and len(end.velocities):
        quintic = len(start.accelerations) > 0 and len(end.accelerations) > 0
        return [
            _quintic(start, end, joint, duration_s)
            if quintic
            else _cubic(start, end, joint, duration_s)
            for joint in range(count)
        ]
    return [
        (p0, (p1 - p0) / duration_s, 0.0, 0.0, 0.0, 0.0)
        for p0, p1 in zip(start.positions, end.positions, strict=True)
    ]


def _cubic(
    start: TrajectoryPoint, end: TrajectoryPoint, joint: int, t: float
) -> tuple[float, float, float, float, float, float]:
    p0, p1 = start.positions[joint], end.positions[joint]
    v0, v1 = start.velocities[joint], end.velocities[joint]
    d = p1 - p0
    return (p0, v0, (3 * d / t - 2 * v0 - v1) / t, (v0 + v1 - 2 * d / t) / t**2, 0.0, 0.0)


def _quintic(
    start: TrajectoryPoint, end: TrajectoryPoint, joint: int, t: float
) -> tuple[float, float, float, float, float, float]:
    p0, p1 = start.positions[joint], end.positions[joint]
    v0, v1 = start.velocities[joint], end.velocities[joint]
    a0, a1 = start.accelerations[joint], end.accelerations[joint]
    d = p1 - p0
    return (
        p0,
        v0,
        a0 / 2,
        (20 * d - (8 * v1 + 12 * v0) * t - (3 * a0 - a1) * t**2) / (2 * t**3),
        (-30 * d + (14 * v1 + 16 * v0) * t + (3 * a0 - 2 * a1) * t**2) / (2 * t**4),
        (12 * d - 6 * (v1 + v0) * t + (a1 - a0) * t**2) / (2 * t**5),
    )
