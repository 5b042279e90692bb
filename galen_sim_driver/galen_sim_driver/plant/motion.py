"""Joints that follow a reference within limits of velocity, acceleration and position.

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
from collections.abc import Sequence

from galen_sim_driver.plant.config import MotionConfig

# Rounding must not make a step that just fits the acceleration limit look as if it didn't.
_SLACK = 1.0 + 1e-9


def braking_velocity(distance: float, velocity_step: float, period_s: float) -> float:
    """Largest velocity of the next period from which a joint still stops `distance` away.

    `distance` and the result are not negative; `velocity_step` is u = a T.
    """
    total = distance / period_s
    count = math.ceil((math.sqrt(1.0 + 8.0 * total / velocity_step) - 1.0) / 2.0)
    if count <= 1:
        return total
    return total / count + velocity_step * (count - 1) / 2.0


def stopping_distance(velocity: float, velocity_step: float, period_s: float) -> float:
    """Signed distance that a joint goes on when it brakes by `velocity_step` in each period."""
    speed = abs(velocity)
    count = math.floor(speed / velocity_step)
    distance = period_s * (count * speed - velocity_step * count * (count + 1) / 2.0)
    return math.copysign(distance, velocity)


class LimitedMotion:
    """Positions and velocities of the joints; `step` takes them one period on."""

    def __init__(self, config: MotionConfig, positions: Sequence[float], period_s: float) -> None:
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
                config.velocity,
                config.acceleration,
                config.limits.lower.tolist(),
                config.limits.upper.tolist(),
                strict=True,
            )
        ]

    def step(self, targets: Sequence[float]) -> None:
        """Move one period towards `targets` (5,), where the joints should be at its end."""
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
        """Where the joints stand when they brake at their limits from now on.

        `excepted` (5,) is a part of the velocity that isn't to be braked.
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
