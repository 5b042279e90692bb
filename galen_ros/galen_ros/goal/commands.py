"""What every procedure on the arm asks of the node that runs it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from galen_model.arrays import Array


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
    """A goal is over, and the arm stands still as far as can be seen."""

    error_code: IntEnum
    error_msg: str
