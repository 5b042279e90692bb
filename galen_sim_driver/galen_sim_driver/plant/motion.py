# SPDX-License-Identifier: Apache-2.0
"""Trajectories as joint_trajectory_controller takes them, and joints that follow within limits.

Between two points the reference is linear where they give positions only, cubic where they give
velocities too, quintic where they give accelerations as well. The first piece starts at the arm's
state at the moment the trajectory comes in. After the last point the reference stands there.

Each joint moves by v' T in one period T, with |v' - v| <= u = a T and |v'| <= v_max.

- Where that is enough to be on the reference at the end of the period, and to go on as fast as
  the reference went, the joint is there, exactly. A reference within the limits is so followed
  without lag.
- Otherwise the joint goes for the reference's place as for a target at rest, in the least number
  of periods n: the distance e left must be the sum of v' T, (v' - u) T, ... (n terms), which gives
  v' = e / (n T) + u (n - 1) / 2  with the least n that has  u T n (n + 1) / 2 >= e.
  This is bang-bang control made for sampled time: it brakes at the limit, arrives exactly and
  never chatters.
- The same bound against the position limits keeps the joint inside them in any case.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from galen_model.arm.arm import Arm

from galen_sim_driver.plant.config import PlantError, acceleration_limits, velocity_limits

_NS = 1e-9
_LARGEST_RATE = 1e6
"""m/s, rad/s and per s: beyond any arm, and far from where the polynomials would overflow."""


@dataclass(frozen=True)
class TrajectoryPoint:
    """Hold one point: time after the trajectory's start (s), values in the order of its joints.

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


def check_trajectory(trajectory: Trajectory, arm: Arm, now_ns: int) -> None:
    """Check that a trajectory can be taken.

    The points must be inside the joint limits; what a polynomial does between them is held inside
    by the motion itself.

    Args:
        trajectory: with at least one point.
        arm: with the joints' limits.
        now_ns: simulated time, ns.

    Raises:
        PlantError: it can't be taken; the message names joint or point, and value.

    """
    names = list(trajectory.joint_names)
    for name in names:
        if name not in arm.joint_names:
            known = ", ".join(arm.joint_names)
            raise PlantError(f"unknown joint '{name}'; the arm has {known}")
        if names.count(name) > 1:
            raise PlantError(f"joint '{name}' is named twice")
    if not names:
        raise PlantError("the trajectory has points but no joint names")
    previous_s = -1.0
    for index, point in enumerate(trajectory.points):
        where = f"point {index}"
        if not math.isfinite(point.time_s) or point.time_s < 0.0:
            raise PlantError(f"{where}: time_from_start is {point.time_s} s")
        if point.time_s <= previous_s:
            raise PlantError(
                f"{where}: time_from_start {point.time_s} s is not after the {previous_s} s of "
                "the point before"
            )
        previous_s = point.time_s
        _check_sizes(where, names, point)
        for name, value in zip(names, point.positions, strict=True):
            joint = arm.joint_names.index(name)
            low, high = arm.lower[joint], arm.upper[joint]
            if not low <= value <= high:
                raise PlantError(
                    f"{where}: {name} at {value:.6g} is outside its limits {low:g} to {high:g}"
                )
    if trajectory.start_ns and trajectory.start_ns + round(previous_s / _NS) < now_ns:
        late_s = (now_ns - trajectory.start_ns) * _NS - previous_s
        raise PlantError(f"the trajectory's last point is {late_s:.3f} s in the past")


def _check_sizes(where: str, names: Sequence[str], point: TrajectoryPoint) -> None:
    for what, values, may_be_empty in (
        ("positions", point.positions, False),
        ("velocities", point.velocities, True),
        ("accelerations", point.accelerations, True),
    ):
        if len(values) != len(names) and not (may_be_empty and len(values) == 0):
            raise PlantError(f"{where}: {len(values)} {what} for {len(names)} joints")
        for name, value in zip(names, values, strict=False):
            if not abs(value) <= _LARGEST_RATE:  # a position's limit is checked with the joint's
                raise PlantError(f"{where}: {what} of {name} hold {value}")
    if len(point.accelerations) and not len(point.velocities):
        raise PlantError(f"{where}: accelerations without velocities")


class Reference:
    """Where the joints should be at any time: pieces of polynomials, then the last point."""

    def __init__(
        self,
        trajectory: Trajectory,
        arm: Arm,
        now_ns: int,
        start: TrajectoryPoint,
        hold: Sequence[float],
    ) -> None:
        """Plan from `start`, the arm's state at `now_ns`; joints not named go to `hold` (n,).

        The trajectory must have passed `check_trajectory`.
        """
        self._joints = [arm.joint_names.index(name) for name in trajectory.joint_names]
        self._hold = list(hold)
        self._origin_ns = now_ns
        delay_s = ((trajectory.start_ns or now_ns) - now_ns) * _NS
        points = list(trajectory.points)
        times = [point.time_s + delay_s for point in points]
        if times[0] > 0.0:
            # The usual case: from the state now to the first point.
            now = (start.positions, start.velocities, start.accelerations)
            first = ([values[joint] for joint in self._joints] for values in now)
            points, times = [TrajectoryPoint(0.0, *first), *points], [0.0, *times]
        self._times = times
        self._pieces = [
            _piece(a, b, end_s - begin_s)
            for (a, b), (begin_s, end_s) in zip(pairwise(points), pairwise(times), strict=True)
        ]
        self._last = list(points[-1].positions)
        self.end_ns = now_ns + round(times[-1] / _NS)

    def sample(self, now_ns: int) -> list[float]:
        """Return where the joints should be.

        Args:
            now_ns: simulated time, ns, not before the planning.

        Returns:
            Positions (n,), m and rad.

        """
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


_Coefficients = tuple[float, float, float, float, float, float]
"""Of one joint in one piece, the lowest order first."""


def _piece(start: TrajectoryPoint, end: TrajectoryPoint, duration_s: float) -> list[_Coefficients]:
    """Linear, cubic or quintic Hermite polynomial: as many derivatives as both ends give."""
    if not (len(start.velocities) and len(end.velocities)):
        return [
            (p0, (p1 - p0) / duration_s, 0.0, 0.0, 0.0, 0.0)
            for p0, p1 in zip(start.positions, end.positions, strict=True)
        ]
    ends = zip(start.positions, end.positions, start.velocities, end.velocities, strict=True)
    if not (len(start.accelerations) and len(end.accelerations)):
        return [_cubic(*values, duration_s) for values in ends]
    accelerations = zip(start.accelerations, end.accelerations, strict=True)
    return [_quintic(*a, *b, duration_s) for a, b in zip(ends, accelerations, strict=True)]


def _cubic(p0: float, p1: float, v0: float, v1: float, t: float) -> _Coefficients:
    d = p1 - p0
    return (p0, v0, (3 * d / t - 2 * v0 - v1) / t, (v0 + v1 - 2 * d / t) / t**2, 0.0, 0.0)


def _quintic(
    p0: float, p1: float, v0: float, v1: float, a0: float, a1: float, t: float
) -> _Coefficients:
    d = p1 - p0
    return (
        p0,
        v0,
        a0 / 2,
        (20 * d - (8 * v1 + 12 * v0) * t - (3 * a0 - a1) * t**2) / (2 * t**3),
        (-30 * d + (14 * v1 + 16 * v0) * t + (3 * a0 - 2 * a1) * t**2) / (2 * t**4),
        (12 * d - 6 * (v1 + v0) * t + (a1 - a0) * t**2) / (2 * t**5),
    )


# Rounding must not make a step that just fits the acceleration limit look as if it didn't.
_SLACK = 1.0 + 1e-9


def braking_velocity(distance: float, velocity_step: float, period_s: float) -> float:
    """Return the largest velocity from which a joint still stops within a distance.

    Args:
        distance: not negative, m or rad.
        velocity_step: u = a T, largest change of velocity in a period, m/s or rad/s.
        period_s: T, s.

    Returns:
        Velocity, not negative, m/s or rad/s.

    """
    total = distance / period_s
    count = math.ceil((math.sqrt(1.0 + 8.0 * total / velocity_step) - 1.0) / 2.0)
    if count <= 1:
        return total
    return total / count + velocity_step * (count - 1) / 2.0


def stopping_distance(velocity: float, velocity_step: float, period_s: float) -> float:
    """Return the braking distance at `velocity_step` in each period.

    Args:
        velocity: m/s or rad/s.
        velocity_step: u = a T, m/s or rad/s.
        period_s: T, s.

    Returns:
        Distance with the velocity's sign, m or rad.

    """
    speed = abs(velocity)
    count = math.floor(speed / velocity_step)
    distance = period_s * (count * speed - velocity_step * count * (count + 1) / 2.0)
    return math.copysign(distance, velocity)


class LimitedMotion:
    """Hold positions and velocities of the joints; `step` takes them one period on."""

    def __init__(self, arm: Arm, positions: Sequence[float], period_s: float) -> None:
        self.positions = list(positions)
        self.velocities = [0.0] * len(self.positions)
        self.accelerations = [0.0] * len(self.positions)
        self._period_s = period_s
        self._targets = list(positions)
        # For each joint: v_max, u, lower and upper limit, and how near to a limit it matters.
        self._joints = [
            (
                velocity,
                acceleration * period_s,
                low,
                high,
                velocity**2 / (2.0 * acceleration) + 2.0 * velocity * period_s,
            )
            for velocity, acceleration, low, high in zip(
                velocity_limits(arm),
                acceleration_limits(arm),
                arm.lower.tolist(),
                arm.upper.tolist(),
                strict=True,
            )
        ]

    def step(self, targets: Sequence[float]) -> None:
        """Move one period on.

        Args:
            targets: where the joints (n,) should be at the period's end, m and rad; held inside the
                limits.

        """
        period_s = self._period_s
        for index, (v_max, u, low, high, near) in enumerate(self._joints):
            position, velocity = self.positions[index], self.velocities[index]
            target = targets[index]
            if target < low:
                target = low
            elif target > high:
                target = high
            reference_step = target - self._targets[index]
            self._targets[index] = target
            distance = target - position
            if distance == 0.0 and velocity == 0.0:
                self.accelerations[index] = 0.0
                continue
            wanted = distance / period_s
            exact = (
                abs(wanted - velocity) <= u * _SLACK
                and abs(distance - reference_step) <= u * period_s * _SLACK
                and abs(wanted) <= v_max * _SLACK
            )
            if not exact:
                wanted = math.copysign(braking_velocity(abs(distance), u, period_s), distance)
            # Near a limit, never faster than what still stops before it.
            if high - position < near:
                bound = braking_velocity(max(high - position, 0.0), u, period_s)
                if wanted > bound:
                    wanted, exact = bound, False
            if position - low < near:
                bound = -braking_velocity(max(position - low, 0.0), u, period_s)
                if wanted < bound:
                    wanted, exact = bound, False
            if not exact:
                wanted = min(max(wanted, velocity - u), velocity + u)
                wanted = min(max(wanted, -v_max), v_max)
            # The bounds above hold it between the limits but for rounding.
            self.positions[index] = (
                target if exact else min(max(position + wanted * period_s, low), high)
            )
            self.accelerations[index] = (wanted - velocity) / period_s
            self.velocities[index] = wanted

    def stopping_positions(self, excepted: Sequence[float]) -> list[float]:
        """Return where the joints stop when they brake at their limits from now on.

        Args:
            excepted: part of the velocity (n,) that isn't to be braked, m/s and rad/s.

        Returns:
            Positions (n,), m and rad.

        """
        return [
            position + stopping_distance(velocity - other, joint[1], self._period_s)
            for position, velocity, other, joint in zip(
                self.positions, self.velocities, excepted, self._joints, strict=True
            )
        ]

    @property
    def moving(self) -> bool:
        """Whether any joint has a velocity."""
        return any(self.velocities)
