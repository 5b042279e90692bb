"""What a quick check answers, and by what."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from galen_model.arrays import Array


class Answer(IntEnum):
    """Answers as in CheckTool's result."""

    GOOD = 0
    RETARE = 1
    RECALIBRATE = 2
    UNSURE = 3


class Cause(IntEnum):
    """What it looks like, as in CheckTool's result."""

    NOTHING = 0
    OFFSET = 1
    ZERO_LOST = 2
    OTHER_TOOL = 3
    NO_TOOL = 4
    LOAD = 5
    UNEXPLAINED = 6
    TOUCHED = 7
    NOISE = 8


@dataclass(frozen=True)
class CheckLimits:
    """What a compensation may be off by, anywhere, and how often chance may call a change."""

    force_n: float = 0.05
    torque_nm: float = 0.002
    false_alarm: float = 0.05

    @property
    def axes(self) -> Array:
        """By axis (6,), N and N.m."""
        return np.repeat([self.force_n, self.torque_nm], 3)

    def size(self, values: Array) -> float:
        """The largest of `values` (6,), N and N.m, in units of its limit."""
        return float(np.max(np.abs(values) / self.axes))


@dataclass(frozen=True)
class Differences:
    """Load and offset that the readings at still poses differ by, all in ft_sensor, SI.

    moments (4,): mass and first moment, true less file's, with covariance (4, 4); offset (6,), its
    std (6,): with no other load where that isn't told, else beside it; rest (n, 6): what neither
    explains; sigma (6,): noise of one pose's mean. rest_p, load_p, offset_p: how often chance alone
    does as much. load_effect, effect (6,): by how much a compensation is off at worst, by the load
    and by all; effect_std (6,): its largest standard deviation.
    """

    moments: Array
    moments_covariance: Array
    offset: Array
    offset_std: Array
    rest: Array
    sigma: Array
    rest_p: float
    load_p: float
    offset_p: float
    load_effect: Array
    effect: Array
    effect_std: Array


@dataclass(frozen=True)
class QuickCheck:
    """The answer, its cause, and both in words.

    found_mass_kg, found_offset (6,): the smallest changes that are told from noise with 95 %.
    """

    answer: Answer
    cause: Cause
    text: str
    found: Differences
    poses: int
    found_mass_kg: float
    found_offset: Array
