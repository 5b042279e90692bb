"""The hand at tool_tip: a script of pushes, one after the other or at once, or a single push.

Hand-over-hand control: the tip moves as it is pushed.

The wrench, moved from the sensor's origin to the tip, times the gains is the tip's twist (v, w).
Joint velocities follow by damped least squares, min |J q' - (v, w)|^2 + d^2 |q'|^2.

The Jacobian has a simple form: J = [[I, L], [0, A]] with the platform's three columns, L the two
levers (axis x arm) and A the roll and tilt axes, which are always perpendicular: A^T A = I. With
m = d^2 / (1 + d^2) the normal equations shrink to two unknowns s = (roll', tilt'):

    ((1 + d^2) I + m L^T L) s = A^T w + m L^T v,      platform' = (v - L s) / (1 + d^2).

Roll and tilt can't turn the tip about the axis perpendicular to both; that part of w is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from galen_sim_driver.plant.config import AdmittanceConfig, HandPush, PlantError
from galen_sim_driver.plant.geometry import ArmGeometry, Matrix, cross, rotate, rotate_back


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
        """Play the script from its beginning, instead of what is played."""
        self._play(self._script, now_ns)

    def push(self, push: HandPush, now_ns: int) -> None:
        """Push once. Raises PlantError while something is played, ConfigError for nonsense."""
        push.validate()
        if self.active:
            raise PlantError("the hand is pushing already")
        self._play([push], now_ns)

    def _play(self, pushes: list[HandPush], now_ns: int) -> None:
        self._played = pushes
        self._end_s = max((push.start_s + push.duration_s for push in pushes), default=0.0)
        self._start_ns = now_ns

    def wrench_at_tip(self, now_ns: int, matrix: Matrix) -> list[float] | None:
        """Force and torque (6,) about tool_tip along its axes, N and N.m, or None for no touch.

        `matrix` is R_base_tip.
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
    """Between 0 and 1: a half cosine up, full, a half cosine down."""
    since = time_s - push.start_s
    left = push.duration_s - since
    if since <= 0.0 or left <= 0.0:
        return 0.0
    return min(_edge(since, push.ramp_s), _edge(left, push.falling_s))


def _edge(time_s: float, ramp_s: float) -> float:
    if time_s >= ramp_s:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * time_s / ramp_s)


def damped_joint_velocities(
    linear: Sequence[float],
    angular: Sequence[float],
    roll: float,
    from_roll: Sequence[float],
    from_tilt: Sequence[float],
    damping: float,
) -> list[float]:
    """Joint velocities (5,), m/s and rad/s, for a twist of the tip in base_link.

    `from_roll` and `from_tilt` are the vectors from the axes to the tip (m).
    """
    tilt_axis = (0.0, math.cos(roll), math.sin(roll))
    l1 = (0.0, -from_roll[2], from_roll[1])  # x axis x arm
    l2 = cross(tilt_axis, from_tilt)
    d2 = damping * damping
    m = d2 / (1.0 + d2)
    k11 = 1.0 + d2 + m * (l1[1] * l1[1] + l1[2] * l1[2])
    k22 = 1.0 + d2 + m * (l2[0] * l2[0] + l2[1] * l2[1] + l2[2] * l2[2])
    k12 = m * (l1[1] * l2[1] + l1[2] * l2[2])
    b1 = angular[0] + m * (l1[1] * linear[1] + l1[2] * linear[2])
    b2 = (
        tilt_axis[1] * angular[1]
        + tilt_axis[2] * angular[2]
        + m * (l2[0] * linear[0] + l2[1] * linear[1] + l2[2] * linear[2])
    )
    determinant = k11 * k22 - k12 * k12
    s1 = (k22 * b1 - k12 * b2) / determinant
    s2 = (k11 * b2 - k12 * b1) / determinant
    scale = 1.0 / (1.0 + d2)
    return [
        scale * (linear[0] - l2[0] * s2),
        scale * (linear[1] - l1[1] * s1 - l2[1] * s2),
        scale * (linear[2] - l1[2] * s1 - l2[2] * s2),
        s1,
        s2,
    ]


class Admittance:
    """The wrench it last heard of, and the velocities that follow from it."""

    def __init__(
        self, config: AdmittanceConfig, geometry: ArmGeometry, velocity_limits: Sequence[float]
    ) -> None:
        self._config = config
        self._geometry = geometry
        self._limits = list(velocity_limits)
        self._timeout_ns = round(config.timeout_s * 1e9)
        self._wrench: list[float] | None = None
        self._stamp_ns = 0

    def feed(self, stamp_ns: int, wrench: Sequence[float]) -> None:
        """Take a wrench (6,) in ft_sensor about its origin; a non-finite one counts as none."""
        self._wrench = list(wrench) if all(math.isfinite(value) for value in wrench) else None
        self._stamp_ns = stamp_ns

    def forget(self) -> None:
        """Forget the last wrench."""
        self._wrench = None

    def joint_velocities(
        self, now_ns: int, joints: Sequence[float], matrix: Matrix, tip: Sequence[float]
    ) -> list[float] | None:
        """Joint velocities (5,), m/s and rad/s; None without a wrench that is fresh enough.

        Where a joint would be too fast all are slowed alike, so that the direction stays.
        """
        if self._wrench is None or abs(now_ns - self._stamp_ns) > self._timeout_ns:
            return None
        force, torque = self._wrench[:3], self._wrench[3:]
        # About the tip, its force having no lever there: tau_tip = tau - tip x f.
        moment = cross(tip, force)
        at_tip = (torque[0] - moment[0], torque[1] - moment[1], torque[2] - moment[2])
        linear_gain = self._config.linear_gain_m_s_n
        angular_gain = self._config.angular_gain_rad_s_nm
        velocities = damped_joint_velocities(
            [linear_gain * value for value in rotate(matrix, force)],
            [angular_gain * value for value in rotate(matrix, at_tip)],
            joints[3],
            *self._geometry.arms_to_tip(joints, matrix, tip),
            self._config.damping,
        )
        excess = max(abs(v) / limit for v, limit in zip(velocities, self._limits, strict=True))
        if excess > 1.0:
            velocities = [velocity / excess for velocity in velocities]
        return velocities
