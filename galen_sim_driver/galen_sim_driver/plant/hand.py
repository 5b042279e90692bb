# SPDX-License-Identifier: Apache-2.0
"""The hand at tool_tip: scripted pushes, and hand-over-hand control.

In admittance mode the wrench, moved from the sensor's origin to the tip, times the gains is the
tip's twist t = (v, w). Joint velocities follow by damped least squares, min |J q' - t|^2 +
d^2 |q'|^2. What the joints can't do (turn about the axis perpendicular to roll and tilt) is lost,
and so is what they could do in a singular pose only at any speed; of the many ways that a redundant
arm has the slowest is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from galen_model.arm.arm import Arm

from galen_sim_driver.plant.config import HandPush, PlantError, velocity_limits
from galen_sim_driver.plant.geometry import Matrix, cross, rotate, rotate_back, tip_jacobian

_GAINS = np.repeat([0.01, 0.5], 3)
"""Velocity of the tip over force, m/s/N, and over torque, rad/s/N.m."""
_DAMPING = 0.02


class Hand:
    """Plays a script of pushes, or one push, from the moment it is started."""

    def __init__(self, script: Sequence[HandPush]) -> None:
        self._script = list(script)
        self._played: list[HandPush] = []
        self._end_s = 0.0
        self._start_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether it is pushing, or has still to."""
        return self._start_ns is not None

    def start(self, now_ns: int) -> None:
        """Play the script from its beginning, instead of what is played.

        Args:
            now_ns: simulated time, ns, from which the pushes count.

        """
        self._play(self._script, now_ns)

    def push(self, push: HandPush, now_ns: int) -> None:
        """Push once.

        Args:
            push: force and times.
            now_ns: simulated time, ns, from which it counts.

        Raises:
            PlantError: something is played.
            ConfigError: the push makes no sense.

        """
        push.validate()
        if self.active:
            raise PlantError("the hand is pushing already")
        self._play([push], now_ns)

    def _play(self, pushes: list[HandPush], now_ns: int) -> None:
        self._played = pushes
        self._end_s = max((push.start_s + push.duration_s for push in pushes), default=0.0)
        self._start_ns = now_ns

    def wrench_at_tip(self, now_ns: int, matrix: Matrix) -> list[float] | None:
        """Return what the hand does to the tip; note the end of what is played.

        Args:
            now_ns: simulated time, ns.
            matrix: R_base_tip, nine floats.

        Returns:
            Force and torque (6,) about tool_tip along its axes, N and N.m; None for no touch.

        """
        if self._start_ns is None:
            return None
        time_s = (now_ns - self._start_ns) * 1e-9
        if time_s > self._end_s:
            self._start_ns = None
            return None
        total: list[float] | None = None
        for push in self._played:
            strength = push_strength(push, time_s)
            if strength == 0.0:
                continue
            force: Sequence[float] = push.force_n
            torque: Sequence[float] = push.torque_nm
            if push.frame == "base":
                force, torque = rotate_back(matrix, force), rotate_back(matrix, torque)
            part = [strength * value for value in (*force, *torque)]
            total = part if total is None else [a + b for a, b in zip(total, part, strict=True)]
        return total


def push_strength(push: HandPush, time_s: float) -> float:
    """Return a push's strength: a half cosine up, full, a half cosine down.

    Args:
        push: of which the times count.
        time_s: since the script's start, s.

    Returns:
        0 to 1.

    """
    since = time_s - push.start_s
    left = push.duration_s - since
    if since <= 0.0 or left <= 0.0:
        return 0.0
    return min(_edge(since, push.ramp_s), _edge(left, push.falling_s))


def _edge(time_s: float, ramp_s: float) -> float:
    if time_s >= ramp_s:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * time_s / ramp_s)


class Admittance:
    """The last wrench fed, and the joint velocities that follow from it."""

    def __init__(self, timeout_s: float, arm: Arm) -> None:
        self._arm = arm
        self._fastest = velocity_limits(arm)
        self._timeout_ns = round(timeout_s * 1e9)
        self._wrench: list[float] | None = None
        self._stamp_ns = 0

    def feed(self, stamp_ns: int, wrench: Sequence[float]) -> None:
        """Take a wrench.

        Args:
            stamp_ns: its stamp, ns.
            wrench: (6,) in ft_sensor about its origin, N and N.m; a non-finite one counts as none.

        """
        self._wrench = list(wrench) if all(math.isfinite(value) for value in wrench) else None
        self._stamp_ns = stamp_ns

    def forget(self) -> None:
        """Forget the last wrench."""
        self._wrench = None

    def joint_velocities(
        self,
        now_ns: int,
        joints: Sequence[float],
        tip: Sequence[float],
    ) -> list[float] | None:
        """Return the joint velocities that follow from the last wrench.

        Where a joint would be too fast all are slowed alike, so that the direction stays.

        Args:
            now_ns: simulated time, ns.
            joints: (n,), m and rad.
            tip: (3,) in ft_sensor, m.

        Returns:
            (n,), m/s and rad/s; None without a fresh wrench.

        """
        if self._wrench is None or abs(now_ns - self._stamp_ns) > self._timeout_ns:
            return None
        force, torque = self._wrench[:3], self._wrench[3:]
        # About the tip, its force having no lever there: tau_tip = tau - tip x f.
        at_tip = [t - m for t, m in zip(torque, cross(tip, force), strict=True)]
        matrix, columns = tip_jacobian(self._arm, joints, tip)
        twist = _GAINS * np.array([*rotate(matrix, force), *rotate(matrix, at_tip)])
        transposed = np.array(columns)
        damped = transposed @ transposed.T + _DAMPING**2 * np.eye(len(joints))
        velocities = np.linalg.solve(damped, transposed @ twist)
        excess = float(np.max(np.abs(velocities) / self._fastest))
        return (velocities / max(excess, 1.0)).tolist()
