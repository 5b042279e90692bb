"""What a hand pushes at the tip: nobody pushes twice the same way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.turning import cross, unit

_RAMPS = 3
"""Straight, rounded, and quick at first."""


@dataclass(frozen=True)
class Pushes:
    """k pushes, in ft_sensor: each rises, stays a while with a tremor, and goes.

    start_s, rise_s, hold_s, fall_s (k,); force_n (k, 3); at_m (k, 3): where the finger is; ramp
    (k,) of 0, 1, 2; tremor (k, 2): share of the force, Hz.
    """

    start_s: Array
    rise_s: Array
    hold_s: Array
    fall_s: Array
    force_n: Array
    at_m: Array
    ramp: np.ndarray
    tremor: Array

    @property
    def end_s(self) -> Array:
        """When each is over (k,)."""
        return self.start_s + self.rise_s + self.hold_s + self.fall_s

    def touched(self, at_s: Array) -> np.ndarray:
        """Whether a hand is there (n,)."""
        number = self._number(at_s)
        return np.asarray((number >= 0) & (at_s < self.end_s[np.maximum(number, 0)]))

    def wrench(self, at_s: Array) -> Array:
        """(n, 6) about the sensor's origin in ft_sensor."""
        number = np.maximum(self._number(at_s), 0)
        since = at_s - self.start_s[number]
        up = np.clip(since / self.rise_s[number], 0.0, 1.0)
        down = np.clip((self.end_s[number] - at_s) / self.fall_s[number], 0.0, 1.0)
        share = self._shape(up, number) * self._shape(down, number)
        size, frequency = self.tremor[number].T
        held = np.sin(np.pi * np.clip((since - self.rise_s[number]) / self.hold_s[number], 0, 1))
        share = share * (1.0 + size * held * np.sin(2.0 * np.pi * frequency * since))
        force = share[:, None] * self.force_n[number]
        return np.concatenate([force, cross(self.at_m[number], force)], axis=1)

    def _number(self, at_s: Array) -> np.ndarray:
        return np.asarray(np.searchsorted(self.start_s, at_s, side="right") - 1)

    def _shape(self, part: Array, number: np.ndarray) -> Array:
        kind = self.ramp[number]
        rounded = part**2 * (3.0 - 2.0 * part)
        quick = 1.0 - (1.0 - part) ** 2
        return np.where(kind == 0, part, np.where(kind == 1, rounded, quick))


def draw_pushes(
    rng: np.random.Generator, rest_until_s: Array, tip_m: Array, gap_s: float
) -> Pushes:
    """18 pushes from each of the times (p,) on: about 3, 6 and 11 N along every axis both ways."""
    way = rng.integers(_RAMPS)
    kinds: dict[str, list[Any]] = {
        name: [] for name in ("start", "rise", "hold", "fall", "force", "at", "ramp", "tremor")
    }
    directions = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    by_level = bool(rng.random() < 0.5)
    for begin in rest_until_s:
        plan = [(level, way) for way in directions for level in (3.0, 6.0, 11.0)]
        if by_level:
            plan = [(level, way) for level in (3.0, 6.0, 11.0) for way in directions]
        at_s = float(begin)
        for level, direction in plan:
            rise, hold, fall = (
                rng.uniform(0.2, 0.45),
                rng.uniform(0.35, 0.6),
                rng.uniform(0.2, 0.45),
            )
            kinds["start"].append(at_s)
            kinds["rise"].append(rise)
            kinds["hold"].append(hold)
            kinds["fall"].append(fall)
            aside = unit(direction + 0.04 * rng.standard_normal(3))
            kinds["force"].append(level * (1.0 + 0.04 * rng.standard_normal()) * aside)
            kinds["at"].append(tip_m + 0.002 * rng.standard_normal(3))
            kinds["ramp"].append((way + rng.integers(2)) % _RAMPS)
            kinds["tremor"].append([rng.uniform(0.0, 0.03), rng.uniform(1.0, 5.0)])
            at_s += rise + hold + fall + gap_s * rng.uniform(0.8, 1.2)
    made = {name: np.array(values) for name, values in kinds.items()}
    return Pushes(
        made["start"], made["rise"], made["hold"], made["fall"], made["force"], made["at"],
        made["ramp"], made["tremor"],
    )  # fmt: skip


def longest_s(gap_s: float) -> float:
    """How long 18 pushes may take."""
    return 18.0 * (0.45 + 0.6 + 0.45 + 1.2 * gap_s)
