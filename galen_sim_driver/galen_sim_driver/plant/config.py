# SPDX-License-Identifier: Apache-2.0
"""Describe the simulated cell of any arm; the defaults are the nominal Galen.

SI units. Each `validate()` raises ConfigError naming the value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from galen_model.arm.arm import Arm
from galen_model.arm.galen import SENSOR, SensorParameters
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, TOOLS, Load, ToolGeometry
from galen_model.rest.segments import ENCODER_STEP

from galen_sim_driver.effects.effect import ConfigError, Effect

Vector3 = tuple[float, float, float]
JointVector = tuple[float, ...]

_VELOCITY = (0.2, 1.5)
"""Of the fastest joint by its unit, m/s and rad/s."""
_ACCELERATION = (1.0, 6.0)
"""Largest acceleration, m/s^2 and rad/s^2."""
VELOCITY_WINDOW_S = 0.02
"""Over which the encoders' velocity is a difference."""

LONGEST_PUSH_S = 3600.0
"""A hand that pushes for ever would keep every other push out."""
LARGEST_PUSH = 1e4
"""N, or N.m about the tip: beyond what any arm of this size bears, and no number overflows."""

ZERO3: Vector3 = (0.0, 0.0, 0.0)


def velocity_limits(arm: Arm) -> JointVector:
    """Return how fast each joint goes; a description may ask for less.

    Args:
        arm: with the speeds of its description.

    Returns:
        (n,), m/s and rad/s.

    """
    usual = zip(arm.joints, _by_unit(arm, _VELOCITY), strict=True)
    return tuple(min(speed, joint.max_velocity) for joint, speed in usual)


def acceleration_limits(arm: Arm) -> JointVector:
    """Return the largest acceleration of each joint.

    Args:
        arm: whose joints slide or turn.

    Returns:
        (n,), m/s^2 and rad/s^2.

    """
    return _by_unit(arm, _ACCELERATION)


def _by_unit(arm: Arm, values: tuple[float, float]) -> JointVector:
    return tuple(arm.by_unit(*values).tolist())


class PlantError(GalenError):
    """Reject a command to the plant; the message gives the reason."""


@dataclass(frozen=True)
class Pose:
    """A fixed pose: translation in m and rotation vector in rad."""

    translation_m: Vector3 = ZERO3
    rotvec_rad: Vector3 = ZERO3


BASE_IN_TRACKER = Pose((0.15, -0.35, 1.80), (0.1, 2.9, 0.3))
"""base_link seen by the tracker."""
BASE_MARKER = Pose((0.32, 0.21, 0.05), (0.05, -0.1, 0.7))
"""In base_link; no other package uses it."""


@dataclass(frozen=True)
class HandPush:
    """One push of the scripted hand at tool_tip.

    It starts `start_s` after the script, rises smoothly over `ramp_s` and falls over `fall_s`
    (None: as it rises), both within `duration_s`. Force (N) and torque about the tip (N.m) are
    along the axes of `frame`: "base" for base_link, "tip" for tool_tip.
    """

    start_s: float
    duration_s: float
    force_n: Vector3 = ZERO3
    torque_nm: Vector3 = ZERO3
    frame: str = "base"
    ramp_s: float = 0.2
    fall_s: float | None = None

    @property
    def falling_s(self) -> float:
        """Time in which it falls."""
        return self.ramp_s if self.fall_s is None else self.fall_s

    def validate(self) -> None:
        """Check times, forces and frame."""
        _require(self.start_s >= 0.0, f"a push starts at {self.start_s} s, before its script")
        _require(
            0.0 < self.duration_s <= LONGEST_PUSH_S,
            f"a push lasts {self.duration_s:g} s; it must be up to {LONGEST_PUSH_S:g} s",
        )
        _require(
            self.ramp_s >= 0.0
            and self.falling_s >= 0.0
            and self.ramp_s + self.falling_s <= self.duration_s,
            f"a push of {self.duration_s} s can't rise and fall over {self.ramp_s} s and"
            f" {self.falling_s} s",
        )
        values = (*self.force_n, *self.torque_nm)
        _require(
            all(abs(value) <= LARGEST_PUSH for value in values),  # NaN fails it, too
            f"a push of {list(values)} N and Nm; each up to {LARGEST_PUSH:g}",
        )
        _require(
            self.frame in ("base", "tip"), f'a push\'s frame is "{self.frame}", not "base" or "tip"'
        )


def _default_script() -> tuple[HandPush, ...]:
    """Six pushes of 5 N along each axis of base_link and back, 2 s each with pauses of 1 s."""
    pushes = []
    for axis in range(3):
        for half, sign in enumerate((1.0, -1.0)):
            force = [0.0, 0.0, 0.0]
            force[axis] = 5.0 * sign
            start_s = 1.0 + 3.0 * (2 * axis + half)
            pushes.append(HandPush(start_s, 2.0, (force[0], force[1], force[2])))
    return tuple(pushes)


@dataclass(frozen=True)
class PlantConfig:
    """The whole simulated cell.

    start_joints (n,): empty for home. encoder_quantum (n,): empty for 5 um and 50 urad. noise: of
    sensor and tracker. quantise: the sensor's quanta. tool_marker: in tool_tip. effects: what the
    nominal model leaves out. admittance_timeout_s: a wrench older than this moves nothing.
    """

    rate_hz: float = 500.0
    start_ns: int = 1_000_000_000
    start_joints: JointVector = ()
    encoder_quantum: JointVector = ()
    arm: Arm = field(kw_only=True)
    adapter: Load = ADAPTER
    tools: Mapping[str, ToolGeometry] = field(default_factory=lambda: dict(TOOLS))
    noise: bool = True
    quantise: bool = True
    sensor: SensorParameters = SENSOR
    tracker_rate_hz: float = 100.0
    tool_marker: Pose = Pose()
    admittance_timeout_s: float = 0.05
    effects: tuple[Effect, ...] = ()
    hand: Sequence[HandPush] = field(default_factory=_default_script)

    @property
    def period_ns(self) -> int:
        """Time between two samples, ns."""
        return round(1e9 / self.rate_hz)

    @property
    def start(self) -> JointVector:
        """Joints (n,) at the start, m and rad."""
        return self.start_joints or tuple(self.arm.home.tolist())

    @property
    def quantum(self) -> JointVector:
        """Step of each joint's encoder (n,), m and rad."""
        return self.encoder_quantum or _by_unit(self.arm, ENCODER_STEP)

    def validate(self) -> None:
        """Check every part, and that the parts fit together."""
        _require(
            self.rate_hz * VELOCITY_WINDOW_S >= 1.0 and self.rate_hz <= 10_000.0,
            f"rate is {self.rate_hz} Hz, but must be {1.0 / VELOCITY_WINDOW_S:g} to 10000",
        )
        parts: tuple[Effect | HandPush, ...] = (*self.effects, *self.hand)
        for part in parts:
            part.validate()
        _require(
            0.0 < self.tracker_rate_hz <= self.rate_hz,
            f"tracker rate is {self.tracker_rate_hz} Hz, not above 0 and up to the plant's "
            f"{self.rate_hz} Hz",
        )
        _require(
            self.admittance_timeout_s > 0.0,
            f"admittance timeout is {self.admittance_timeout_s} s, but must be positive",
        )
        names = self.arm.joint_names
        _require(
            len(self.start) == len(names),
            f"start_joints has {len(self.start)} numbers, but must have {len(names)}: "
            f"{', '.join(names)}",
        )
        for joint, value, low, high in zip(
            names, self.start, self.arm.lower, self.arm.upper, strict=True
        ):
            _require(
                low <= value <= high, f"{joint} starts at {value}, outside {low:g} to {high:g}"
            )
        loads = {"adapter": self.adapter} | {name: tool.load for name, tool in self.tools.items()}
        for name, load in loads.items():
            _require(
                load.mass_kg >= 0.0 and math.isfinite(load.mass_kg),
                f"mass of {name} is {load.mass_kg} kg, but can't be negative",
            )


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)
