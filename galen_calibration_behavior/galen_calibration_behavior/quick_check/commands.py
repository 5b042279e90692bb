"""What a quick check asks of the node that runs it, and how it ends."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from galen_ros.goal.commands import End, MoveTo, Stop

from galen_calibration_behavior.quick_check.answer import QuickCheck


class State(IntEnum):
    """States as in CheckTool's feedback."""

    MEASURE = 0
    RETURN = 1


class ErrorCode(IntEnum):
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


@dataclass(frozen=True)
class Feedback:
    """One feedback message of the action; roll and tilt (rad) of the pose just finished."""

    state: State
    message: str
    done: int = 0
    total: int = 0
    roll: float = float("nan")
    tilt: float = float("nan")
    accepted: bool = False


@dataclass(frozen=True)
class Finished(End):
    """The check is over; `check` is None where it could not be made."""

    error_code: ErrorCode
    check: QuickCheck | None = None
    rejected: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


Command = MoveTo | Stop | Feedback | Finished
