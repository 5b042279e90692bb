"""What the procedure asks of the node that runs it, and how it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from galen_model.arrays import Array
from galen_model.files.calibration_file import LoadEstimate
from galen_model.load.bias.choice import BiasMode
from galen_model.load.identification import StillPoses


class State(IntEnum):
    """States as in CalibrateTool's feedback."""

    HOME = 0
    REMOVE_TOOL = 1
    ZERO = 2
    SWEEP_BARE = 3
    ATTACH_TOOL = 4
    SWEEP_TOOL = 5
    ESTIMATE = 6


class ErrorCode(IntEnum):
    """Error codes as in CalibrateTool's result."""

    NONE = 0
    INVALID_NAME = 1
    CANCELED = 2
    DRIVER_SILENT = 3
    MOTION_TIMEOUT = 4
    SERVICE_FAILED = 5
    POSES_NOT_STILL = 6
    NOT_EXCITED = 7
    IMPLAUSIBLE = 8
    WRITE_FAILED = 9
    CONFIRM_TIMEOUT = 10
    BAD_INPUT = 11
    INTERNAL = 99


@dataclass(frozen=True)
class MoveTo:
    """Go to `joints` (5,), m and rad, from rest to rest in `duration_s`."""

    joints: Array
    duration_s: float


@dataclass(frozen=True)
class Stop:
    """Decelerate and stay where the arm then is."""


@dataclass(frozen=True)
class End:
    """A goal is over, and the arm stands still as far as can be told."""

    error_code: IntEnum
    error_msg: str


@dataclass(frozen=True)
class ZeroSensor:
    """Call `zero_ft_sensor`; answer with `on_service`."""


@dataclass(frozen=True)
class AttachTool:
    """Call `attach_tool` with this name, "" to take the tool off; answer with `on_service`."""

    tool: str


@dataclass(frozen=True)
class Feedback:
    """One feedback message of the action; roll and tilt (rad), wrench (6,) of the pose."""

    state: State
    message: str
    pose: int = 0
    poses: int = 0
    done: int = 0
    total: int = 0
    roll: float = float("nan")
    tilt: float = float("nan")
    accepted: bool = False
    wrench: tuple[float, ...] = (float("nan"),) * 6


@dataclass(frozen=True)
class Measurements:
    """All that the estimate needs; the bias pose (rad) is where the sensor was zeroed.

    `known_adapter`: the adapter of an earlier calibration; with one sweep it tells adapter and tool
    apart. `notes`: how it went, where nothing is wrong. `bias_mode`: whether the sensor's bias may
    bias drift over a sweep; then the poses need times.
    """

    bare: StillPoses | None
    tool: StillPoses
    zero_roll: float
    zero_tilt: float
    bare_indices: list[int]
    tool_indices: list[int]
    rejected: list[str]
    warnings: list[str]
    known_adapter: LoadEstimate | None = None
    notes: list[str] = field(default_factory=list)
    bias_mode: BiasMode = BiasMode.CONSTANT


@dataclass(frozen=True)
class Estimate:
    """Identify the load and write the file; answer with `on_estimated` or `fail`."""

    measurements: Measurements


@dataclass(frozen=True)
class Finished(End):
    """The calibration is over: the poses left out, and warnings."""

    error_code: ErrorCode
    rejected: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


Command = MoveTo | Stop | ZeroSensor | AttachTool | Feedback | Estimate | Finished
