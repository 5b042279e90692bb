# SPDX-License-Identifier: Apache-2.0
"""Settings of nodes that move the arm from rest to rest; each is a parameter of the node."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.rest.segments import StillnessSettings

from galen_common.goal.arrival import ArrivalSettings
from galen_common.parameters import param

# The arm moves on while the message is under way; and no stop takes for ever.
_SHORTEST_STOP_S, _LONGEST_STOP_S = 0.1, 2.0


@dataclass(frozen=True)
class MotionParameters:
    """How fast it goes, when it has arrived, and how long anything is waited for."""

    settle_s: float = param(
        0.3,
        "wait after the arm has stopped (the report's cyclesB4Recording), s of stamps",
        minimum=0.0,
        maximum=60.0,
    )

    max_delta_velocity_m_s: float = param(0.08, "peak speed of each sliding joint", 0.001, 1.0)
    max_delta_acceleration_m_s2: float = param(
        0.4, "peak acceleration of each sliding joint", 0.01, 10
    )
    max_angle_velocity_rad_s: float = param(0.8, "peak speed of each turning joint", 0.01, 5.0)
    max_angle_acceleration_rad_s2: float = param(
        3.0, "peak acceleration of each turning joint", 0.1, 50
    )
    motion_timeout_s: float = param(
        5.0, "time beyond a move's own to arrive and stop, s of stamps", 0.1, 600.0
    )

    position_tolerance_m: float = param(
        0.0005, "at the target within this, sliding joints", 1e-6, 0.1
    )
    position_tolerance_rad: float = param(
        0.003, "at the target within this, turning joints", 1e-5, 0.5
    )
    velocity_tolerance_m_s: float = param(0.0005, "stopped below this, sliding joints", 1e-6, 0.1)
    velocity_tolerance_rad_s: float = param(0.002, "stopped below this, turning joints", 1e-5, 1.0)
    velocity_window_s: float = param(
        0.1, "the speed is looked at over this time, s of stamps", 0.005, 10.0
    )
    max_stamp_step_s: float = param(
        0.05, "a longer step of the stamps, or one backward, is a jump", 0.001, 10.0
    )

    require_collision_shapes: bool = param(
        True,
        "whether to reject a goal where collision shapes of the description's links are missing or"
        " not reachable; if not, the arm is not kept from hitting itself there",
    )

    silent_timeout_s: float = param(
        2.0, "a driver silent for this long, by the wall clock, ends it", 0.2, 600.0
    )
    service_timeout_s: float = param(
        15.0, "a service without an answer for this long, by the wall clock, ends it", 0.2, 600.0
    )
    # No arm needed others: a stop takes a fraction of a second, clocks agree or differ by far more.
    stop_timeout_s: ClassVar[float] = 3.0
    max_stamp_offset_s: ClassVar[float] = 0.2

    arm: Arm = field(default=GALEN, repr=False, compare=False)

    def beside(self, joints: Mapping[str, float]) -> Self:
        """Return the same settings of an arm beside which other joints stand so.

        Args:
            joints: position by the joint's name, m or rad, as the driver reports them.

        Returns:
            A copy whose arm has these in `beside`.

        """
        return replace(self, arm=replace(self.arm, beside=dict(joints)))

    @property
    def arrival(self) -> ArrivalSettings:
        """When the arm has arrived, each joint with its own unit's number."""
        return ArrivalSettings(
            position_tolerance=self.arm.by_unit(
                self.position_tolerance_m, self.position_tolerance_rad
            ),
            velocity_tolerance=self.arm.by_unit(
                self.velocity_tolerance_m_s, self.velocity_tolerance_rad_s
            ),
            velocity_window_s=self.velocity_window_s,
            settle_s=self.settle_s,
            max_stamp_step_s=self.max_stamp_step_s,
            arm=self.arm,
        )

    @property
    def max_velocity(self) -> Array:
        """Of each joint (n,), m/s or rad/s, no more than its description allows."""
        wanted = self.arm.by_unit(self.max_delta_velocity_m_s, self.max_angle_velocity_rad_s)
        return np.minimum(wanted, [joint.max_velocity for joint in self.arm.joints])

    @property
    def max_acceleration(self) -> Array:
        """Of each joint (n,), m/s^2 or rad/s^2."""
        return self.arm.by_unit(
            self.max_delta_acceleration_m_s2, self.max_angle_acceleration_rad_s2
        )

    def braking(self, joints: Array, velocity: Array | None) -> tuple[Array, float]:
        """Return where the arm comes to rest if it brakes now, and after how long.

        The quintic to rest over v T / 2 accelerates by 1.5 v / T at most, the one back by 3.94 v /
        T.

        Args:
            joints: (n,) as measured, m and rad.
            velocity: (n,) as measured, m/s and rad/s; None, or not finite: the arm comes back to
                where it was measured.

        Returns:
            Joints (n,) at rest, m and rad, within the arm's limits; duration, s.

        """
        most = self.max_velocity
        if velocity is None or not np.all(np.isfinite(velocity)):
            speed, way, factor = most, 0.0, 3.94
        else:
            speed, way, factor = np.clip(velocity, -most, most), 0.5, 1.5
        needed_s = factor * float(np.max(np.abs(speed) / self.max_acceleration))
        duration_s = min(max(needed_s, _SHORTEST_STOP_S), _LONGEST_STOP_S)
        rest = joints + way * duration_s * speed
        return np.clip(rest, self.arm.lower, self.arm.upper), duration_s


@dataclass(frozen=True)
class PoseParameters(MotionParameters):
    """How long a pose is averaged, and when it was still."""

    average_s: float = param(
        0.5,
        "length of the average (the report's waitLimit), s of stamps",
        minimum=0.01,
        maximum=60.0,
    )

    joint_motion_m: float = param(
        0.0001, "largest motion of a sliding joint during an average", 1e-7, 0.1
    )
    joint_motion_rad: float = param(
        0.0005, "largest motion of a turning joint during an average", 1e-6, 0.5
    )
    max_scatter_ratio: float = param(
        1.5, "a pose whose wrench scatters more, in units of the sweep's median, is rejected", 1.01
    )
    max_trend_sigmas: float = param(
        6.0,
        "a pose whose wrench changes more between the average's halves, in standard deviations,"
        " is rejected",
        2.0,
    )
    min_samples: int = param(20, "fewest wrenches in an average", 4, 1_000_000)

    @property
    def stillness(self) -> StillnessSettings:
        """When a pose was still, each joint with its own unit's number."""
        return StillnessSettings(
            joint_motion=self.arm.by_unit(self.joint_motion_m, self.joint_motion_rad),
            scatter_ratio=self.max_scatter_ratio,
            trend_sigmas=self.max_trend_sigmas,
            min_samples=self.min_samples,
        )
