"""What a quick check answers, and by what."""

from __future__ import annotations

from dataclasses import dataclass

from galen_model.arrays import Array
from galen_model.evidence.verdict import Cause, CheckAnswer, Limits


@dataclass(frozen=True)
class CheckLimits(Limits):
    """What a compensation may be off by, anywhere, and how often chance may call a change."""

    false_alarm: float = 0.05


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
    """What the readings differ by, and in words.

    found_mass_kg, found_offset (6,): the smallest changes that are told from noise with 95 %.
    """

    cause: Cause
    text: str
    found: Differences
    poses: int
    found_mass_kg: float
    found_offset: Array

    @property
    def answer(self) -> CheckAnswer:
        """What to do."""
        return self.cause.answer
