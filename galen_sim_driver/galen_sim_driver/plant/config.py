"""Everything about the simulated arm that can be chosen; the defaults are the nominal Galen.

SI units. Each `validate()` raises ConfigError naming the value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from galen_model.arm.galen import (
    ENCODER_QUANTUM,
    GALEN,
    HOME,
    JOINT_NAMES,
    LIMITS,
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
    ArmParameters,
    JointLimits,
    SensorParameters,
)
from galen_model.errors import GalenError
from galen_model.load.model import Load
from galen_model.load.nominal_tools import ADAPTER, TOOLS, ToolGeometry

from galen_sim_driver.effects.effect import ConfigError, Effect

Vector3 = tuple[float, float, float]
JointVector = tuple[float, float, float, float, float]

LONGEST_PUSH_S = 3600.0
"""A hand that pushes for ever would keep every other push out."""
LARGEST_PUSH = 1e4
"""N, or N.m about the tip: beyond what any arm of this size bears, and no number overflows."""


class PlantError(GalenError):
    """Reject a command to the plant; the message gives the reason."""


ZERO3: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class MotionConfig:
    """How fast the joints may go: velocity in m/s and rad/s, acceleration in m/s^2 and rad/s^2."""

    velocity: JointVector = (0.2, 0.2, 0.2, 1.5, 1.5)
    acceleration: JointVector = (1.0, 1.0, 1.0, 6.0, 6.0)
    limits: JointLimits = LIMITS

    def validate(self) -> None:
        """Every limit is positive."""
        for name, values in (("velocity", self.velocity), ("acceleration", self.acceleration)):
            for joint, value in zip(JOINT_NAMES, values, strict=True):
                _require(value > 0.0, f"{name} limit of {joint} is {value}, but must be positive")


@dataclass(frozen=True)
class SensorConfig:
    """The force/torque sensor; noise and quanta can be switched off for exact readings."""

    parameters: SensorParameters = SENSOR
    noise: bool = True
    quantise: bool = True


@dataclass(frozen=True)
class Pose:
    """A fixed pose: translation in m and rotation vector in rad."""

    translation_m: Vector3 = ZERO3
    rotvec_rad: Vector3 = ZERO3


@dataclass(frozen=True)
class TrackerConfig:
    """The optical tracker: its rate, its noise (one sigma an axis) and where things stand.

    `base_in_tracker` is base_link seen by the tracker. `base_marker` is in base_link, and
    nobody but this configuration knows it. `tool_marker` is in tool_tip.
    """

    rate_hz: float = 100.0
    noise: bool = True
    position_noise_m: float = TRACKER_POSITION_NOISE_M
    rotation_noise_rad: float = TRACKER_ROTATION_NOISE_RAD
    base_in_tracker: Pose = Pose((0.15, -0.35, 1.80), (0.1, 2.9, 0.3))
    base_marker: Pose = Pose((0.32, 0.21, 0.05), (0.05, -0.1, 0.7))
    tool_marker: Pose = Pose()

    def validate(self) -> None:
        """The rate is positive, the noise not negative."""
        _require(self.rate_hz > 0.0, f"tracker rate is {self.rate_hz} Hz, but must be positive")
        for name, value in (
            ("position", self.position_noise_m),
            ("rotation", self.rotation_noise_rad),
        ):
            _require(value >= 0.0, f"tracker {name} noise is {value}, but can't be negative")


@dataclass(frozen=True)
class AdmittanceConfig:
    """Hand-over-hand control: the tip's twist is proportional to the wrench at the tip."""

    linear_gain_m_s_n: float = 0.01
    angular_gain_rad_s_nm: float = 0.5
    damping: float = 0.02
    timeout_s: float = 0.05

    def validate(self) -> None:
        """Gains and damping aren't negative, the time-out is positive."""
        for name, value in (
            ("linear gain", self.linear_gain_m_s_n),
            ("angular gain", self.angular_gain_rad_s_nm),
            ("damping", self.damping),
        ):
            _require(value >= 0.0, f"admittance {name} is {value}, but can't be negative")
        _require(
            self.timeout_s > 0.0, f"admittance timeout is {self.timeout_s} s, but must be positive"
        )


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
        """Times make sense, forces are finite, the frame is known."""
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
    """The whole simulated cell."""

    rate_hz: float = 500.0
    start_ns: int = 1_000_000_000
    start_joints: JointVector = tuple(HOME.tolist())
    velocity_window_s: float = 0.02
    encoder_quantum: JointVector = tuple(ENCODER_QUANTUM.tolist())
    arm: ArmParameters = GALEN
    adapter: Load = ADAPTER
    tools: Mapping[str, ToolGeometry] = field(default_factory=lambda: dict(TOOLS))
    motion: MotionConfig = MotionConfig()
    sensor: SensorConfig = SensorConfig()
    tracker: TrackerConfig = TrackerConfig()
    admittance: AdmittanceConfig = AdmittanceConfig()
    effects: tuple[Effect, ...] = ()
    """What the nominal model leaves out."""
    hand: Sequence[HandPush] = field(default_factory=_default_script)

    @property
    def period_ns(self) -> int:
        """Time between two samples, ns."""
        return round(1e9 / self.rate_hz)

    def validate(self) -> None:
        """Every part is valid, and the parts fit together."""
        _require(
            math.isfinite(self.rate_hz) and 0.0 < self.rate_hz <= 10_000.0,
            f"rate is {self.rate_hz} Hz, but must be above 0 and at most 10000",
        )
        self.motion.validate()
        self.tracker.validate()
        self.admittance.validate()
        for effect in self.effects:
            effect.validate()
        for push in self.hand:
            push.validate()
        _require(
            self.tracker.rate_hz <= self.rate_hz,
            f"tracker rate is {self.tracker.rate_hz} Hz, above the plant's {self.rate_hz} Hz",
        )
        _require(
            self.velocity_window_s * self.rate_hz >= 1.0,
            f"velocity window is {self.velocity_window_s} s, less than one sample",
        )
        for joint, value, low, high in zip(
            JOINT_NAMES,
            self.start_joints,
            self.motion.limits.lower,
            self.motion.limits.upper,
            strict=True,
        ):
            _require(
                low <= value <= high, f"{joint} starts at {value}, outside {low:g} to {high:g}"
            )
        for name, load in [
            ("adapter", self.adapter),
            *((name, tool.load) for name, tool in self.tools.items()),
        ]:
            _require(
                load.mass_kg >= 0.0, f"mass of {name} is {load.mass_kg} kg, but can't be negative"
            )


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)
