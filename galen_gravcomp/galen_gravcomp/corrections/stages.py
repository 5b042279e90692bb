"""What a compensator can do beside the tool's weight, stage by stage. No ROS.

    expected = weight(roll, tilt) + pull of a cable     as the sensor reads them, in its own axes
    untared  = C (raw - expected) - inertial forces    C: undoes its gains and rotation
    out      = untared - bias drift - tare

Every stage is optional. A stage sees each sample once, in the order of its arrival, by its stamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile


class NoMotion(NamedTuple):
    """Why the inertial forces at a stamp are not known: a `Rejection` and a sentence."""

    reason: Enum
    detail: str


class MotionStage(Protocol):
    """Inertial forces of tool and adapter."""

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp whose forces the samples that came tell; None: none yet.

        A wrench waits until it is reached: that is the latency which motion costs.
        """

    def late(self, newest_wrench_ns: int) -> NoMotion | None:
        """Why wrenches must not wait any longer for what the stage lacks; None: they may."""

    @property
    def needs_positions(self) -> bool:
        """Whether `push_joints` must be given the platform's position."""

    @property
    def needs_imu(self) -> bool:
        """Whether `push_imu` must be called."""

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Take the loads of another tool."""

    def clear(self) -> None:
        """Forget every sample."""

    def push_joints(
        self, stamp_ns: int, roll_rad: float, tilt_rad: float, position_m: tuple[float, ...] | None
    ) -> None:
        """Take a joint sample: angles, and the platform's position (3,) in base_link."""

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> None:
        """Take an IMU's angular velocity and specific force, (3,) each in its axes."""

    def reading(self, stamp_ns: int, roll_rad: float, tilt_rad: float) -> Array | NoMotion:
        """Inertial forces (6,) at a stamp, N and N.m in ft_sensor, beside the weight.

        With a lag also what the weight was before, less what it is at the stamp.
        """

    def values(self) -> dict[str, object]:
        """What there is to say of it on /diagnostics; units are in the names."""


class BiasDriftStage(Protocol):
    """bias drift of the sensor, learned while nobody touches the tool."""

    @property
    def active(self) -> bool:
        """Whether it has to see samples one by one, or takes anything off."""

    def offset_at(self, stamp_ns: int) -> Array:
        """Offset (6,) to take off at a stamp, N and N.m in ft_sensor; it never jumps."""

    def push(self, stamp_ns: int, roll_rad: float, tilt_rad: float, untared: Array) -> None:
        """Take an untared wrench (6,), which must not be written into later."""

    @property
    def settled(self) -> Array:
        """Offset (6,) that is taken off when no ramp runs; not to be written into."""

    def set_enabled(self, enabled: bool) -> None:
        """Switch on or off; what it took off goes along a ramp."""

    def tared(self, stamp_ns: int, roll_rad: float, tilt_rad: float, offset: Array) -> None:
        """From a stamp on a tare takes `offset` (6,) off the untared wrench, along its own ramp.

        What the bias drift took off is in it, so that goes to zero along a ramp as long.
        """

    @property
    def trouble(self) -> str:
        """What a person should be warned of, empty if nothing."""

    def values(self) -> dict[str, object]:
        """What there is to say of it on /diagnostics; units are in the names."""

    def clear(self, why: str) -> None:
        """Forget everything, for the reason given: another tool, another life of the driver."""


class FitWatch(Protocol):
    """Watches whether the tool's file still fits, while nobody touches the tool."""

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Watch another tool; what was seen is forgotten."""

    def push(self, stamp_ns: int, roll_rad: float, tilt_rad: float, output: Array) -> None:
        """Take a wrench (6,) as it goes out when no ramp runs, and the angles at its stamp.

        It must not be written into later.
        """

    def offset_changed(self, change: Array) -> None:
        """From now on `change` (6,) more is taken off than before, by a tare."""

    @property
    def trouble(self) -> str:
        """Why the file seems not to fit, empty while nothing says so."""

    def values(self) -> dict[str, object]:
        """What there is to say of it on /diagnostics; units are in the names."""

    def clear(self, why: str) -> None:
        """Forget everything, for the reason given."""


@dataclass(frozen=True)
class Stages:
    """The stages of one compensator; None: it does without."""

    motion: MotionStage | None = None
    bias_drift: BiasDriftStage | None = None
    fit: FitWatch | None = None
