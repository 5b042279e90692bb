# SPDX-License-Identifier: Apache-2.0
"""What the two procedures ask of the node that runs them, and how they end."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from galen_common.goal.procedure import End, MoveTo, Stop
from galen_model.arrays import Array
from galen_model.load.readings import StillPoses

from galen_calibration_behavior.common.check_decision import QuickCheck


class CalibrationState(IntEnum):
    """States as in CalibrateTool's feedback."""

    HOME = 0
    REMOVE_TOOL = 1
    ZERO = 2
    SWEEP_BARE = 3
    ATTACH_TOOL = 4
    SWEEP_TOOL = 5
    ESTIMATE = 6


class CheckState(IntEnum):
    """States as in CheckTool's feedback."""

    MEASURE = 0
    RETURN = 1


class CalibrationCode(IntEnum):
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


class CheckCode(IntEnum):
    """Error codes as in CheckTool's result."""

    NONE = 0
    INVALID_NAME = 1
    CANCELED = 2
    DRIVER_SILENT = 3
    MOTION_TIMEOUT = 4
    POSES_NOT_STILL = 6
    TOOL_FILE = 7
    BAD_INPUT = 11
    INTERNAL = 99


CALIBRATION_PHASES = {
    CalibrationState.HOME: "going home",
    CalibrationState.REMOVE_TOOL: "tool off",
    CalibrationState.ZERO: "zeroing",
    CalibrationState.SWEEP_BARE: "sweep without tool",
    CalibrationState.ATTACH_TOOL: "tool on",
    CalibrationState.SWEEP_TOOL: "sweep with tool",
    CalibrationState.ESTIMATE: "estimating",
}
CHECK_PHASES = {CheckState.MEASURE: "checking", CheckState.RETURN: "going back"}


@dataclass(frozen=True)
class ZeroSensor:
    """Call `zero_ft_sensor`; answer with `on_service`."""


@dataclass(frozen=True)
class AttachTool:
    """Call `attach_tool` with this name, "" to remove the tool; answer with `on_service`."""

    tool: str


WARNING = "warning: "
"""Begins feedback that an operator must see before the arm moves."""


@dataclass(frozen=True)
class PoseFeedback:
    """Feedback of either action; angles (k,), rad, and wrench (6,) of the pose just finished."""

    state: CalibrationState | CheckState
    message: str
    pose: int = 0
    poses: int = 0
    done: int = 0
    total: int = 0
    angles: tuple[float, ...] = ()
    accepted: bool = False
    wrench: tuple[float, ...] = (float("nan"),) * 6


@dataclass(frozen=True)
class Measurements:
    """Identify the load from these, write the file; answer with `on_estimated` or `fail`.

    The zero pose (rad) is where the sensor was zeroed; `zeroed`: whether it was, None: not known.
    """

    bare: StillPoses | None
    tool: StillPoses
    zero_angles: Array
    bare_indices: list[int]
    tool_indices: list[int]
    rejected: list[str]
    warnings: list[str]
    zeroed: bool | None = None


@dataclass(frozen=True)
class PosesEnd(End):
    """Either goal is over: poses left out, warnings, and the check's answer where there is one."""

    rejected: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    check: QuickCheck | None = None


Command = MoveTo | Stop | ZeroSensor | AttachTool | PoseFeedback | Measurements | PosesEnd
