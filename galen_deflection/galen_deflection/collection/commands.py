"""What the collection of pushes asks of the node that runs it, and how it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from galen_model.arrays import Array
from galen_ros.goal.procedure import End, MoveTo, Stop

NOTHING = np.full(6, np.nan)
NOTHING.setflags(write=False)
"""A load that isn't looked at."""


class State(IntEnum):
    """States as in CollectPushes's feedback."""

    CALIBRATION = 0
    MOVE = 1
    UNTOUCHED = 2
    PUSH = 3
    HOLD = 4
    RELEASE = 5
    REST = 6


COLLECTION_PHASES = {
    State.CALIBRATION: "calibration set: keep off",
    State.MOVE: "moving: keep off",
    State.UNTOUCHED: "without contact: keep off",
    State.PUSH: "push",
    State.HOLD: "hold",
    State.RELEASE: "let go",
    State.REST: "keep off until the next push",
}
"""The states in words."""


class ErrorCode(IntEnum):
    """Error codes as in CollectPushes's result."""

    NONE = 0
    INVALID_NAME = 1
    CANCELED = 2
    DRIVER_SILENT = 3
    MOTION_TIMEOUT = 4
    SERVICE_FAILED = 5
    TOOL_FILE = 6
    OUT_OF_REACH = 7
    BAD_INPUT = 8
    NOT_UNTOUCHED = 9
    OVERLOAD = 10
    NO_PUSHES = 11
    WRITE_FAILED = 12
    INTERNAL = 99


@dataclass(frozen=True)
class Record:
    """Record into this bag from now on, and no more into the one before.

    Answer with `on_recording` as soon as every topic has been recorded at least once.
    """

    bag: str


@dataclass(frozen=True)
class Push:
    """Call `push_tool`: wrench (6,) about the tip along base_link's axes, N and N.m, times in s.

    Answer with `on_service`.
    """

    wrench: Array
    rise_s: float
    hold_s: float
    fall_s: float


@dataclass(frozen=True)
class Feedback:
    """One feedback message of the action; loads (6,) at the tip in base_link, N and N.m."""

    state: State
    message: str
    set_number: int = 0
    position: int = 0
    done: int = 0
    wanted: Array = field(default_factory=lambda: NOTHING)
    load: Array = field(default_factory=lambda: NOTHING)
    along: float = float("nan")
    aside: float = float("nan")


@dataclass(frozen=True)
class Collected:
    """What came of it.

    left_out: pushes that were not as asked, each with its reason. shift (6,): by the second
    calibration set, as `collection_shift` has it, NaN without one; holds: within the tolerance.
    """

    pushes: int = 0
    left_out: tuple[str, ...] = ()
    shift: Array = field(default_factory=lambda: NOTHING)
    holds: bool = False
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finished(End):
    """The collection is over, and this has come of it."""

    error_code: ErrorCode
    collected: Collected = field(default_factory=Collected)


Command = MoveTo | Stop | Record | Push | Feedback | Finished
