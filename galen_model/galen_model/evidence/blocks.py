"""Readings cut into blocks, and the columns that could explain them.

A reading has C channels. What may be in it is linear: columns, each of one or more channels, scaled
so that one unit is what is usual (the prior's standard deviation). A block (a stop, a stretch of
time, a run) is held out as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from galen_model.arrays import Array


@dataclass(frozen=True)
class Columns:
    """One way in which an effect shows: k columns and what their weights mean.

    values (n, C, k): what the reading gains by a weight of one; weights are about one. parameters:
    by the contract's name, from weights (k,) to the number or numbers. words: parameters that are
    no number (`axis`), or were set beforehand (`time_s`). allowed: whether weights are this effect.
    beyond: names among `parameters` that the contract hasn't.
    """

    values: Array
    parameters: Mapping[str, Callable[[Array], Array]]
    words: Mapping[str, Any] = field(default_factory=dict)
    allowed: Callable[[Array], bool] = lambda weights: True
    beyond: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """How many columns."""
        return int(self.values.shape[2])


@dataclass(frozen=True)
class Effects:
    """What may be there: of each effect, the ways in which it shows (one of them holds).

    nominal: columns that are always fitted. cannot_tell: sentences on effects that the data can't
    show.
    """

    nominal: Columns
    of: Mapping[str, Sequence[Columns]]
    cannot_tell: tuple[str, ...] = ()


@dataclass(frozen=True)
class BlockRows:
    """n readings of C channels.

    residual (n, C): reading less the nominal prediction, in the channels' own units. floor (C,):
    standard deviation that noise alone gives a row. alike, memory_s: how noise hangs together,
    correlation alike * exp(-dt / memory_s) beside white. at_s (n,); block (n,): 0 ... B - 1;
    labels: of the blocks. floor_known: whether anything told the floor; if not, `floor` is only a
    unit. memories_s: how long what a model lacks may hang together; inf: all of a block.
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    residual: Array
    floor: Array
    at_s: Array
    block: np.ndarray
    labels: tuple[str, ...]
    alike: float = 0.0
    memory_s: float = 1.0
    floor_known: bool = True
    memories_s: tuple[float, ...] = (float("inf"),)

    def __len__(self) -> int:
        """Number of readings."""
        return len(self.residual)

    def finer(self, parts: int) -> BlockRows:
        """The same with every block cut into parts of about equal length, in the order of rows."""
        block = np.zeros(len(self), dtype=int)
        labels: list[str] = []
        for number, label in enumerate(self.labels):
            rows = np.flatnonzero(self.block == number)
            for k, part in enumerate(np.array_split(rows, min(parts, len(rows)))):
                block[part] = len(labels)
                labels.append(f"{label}, part {k + 1}")
        return replace(self, block=block, labels=tuple(labels))


@dataclass(frozen=True)
class NoiseForm:
    """Covariance of a channel within a block, in units of its floor squared.

    white^2 (floor's own correlation) + size^2 exp(-dt / memory_s): noise, and what a model lacks.
    """

    white: float
    size: float = 0.0
    memory_s: float = float("inf")

    def covariance(self, rows: BlockRows, at_s: Array) -> Array:
        """(m, m) of readings at times at_s (m,) of one block."""
        apart = np.abs(at_s[:, None] - at_s[None, :])
        floor = rows.alike * np.exp(-apart / rows.memory_s) + (1.0 - rows.alike) * np.eye(len(at_s))
        lacking = np.exp(-apart / self.memory_s) if np.isfinite(self.memory_s) else 1.0
        # A little of it is white: a law that isn't quite the right one scatters as well.
        lacking = 0.98 * lacking + 0.02 * np.eye(len(at_s))
        return np.asarray(self.white**2 * floor + self.size**2 * lacking)


FLOOR_FORMS = (NoiseForm(0.8), NoiseForm(1.0), NoiseForm(1.25))
"""Noise alone: an estimated floor may be wrong by a quarter."""

_SIZES = (0.7, 2.0, 6.0, 18.0, 50.0, 150.0)


def noise_forms(rows: BlockRows) -> tuple[NoiseForm, ...]:
    """FLOOR_FORMS first, then what something that is missing may be like."""
    more = [NoiseForm(1.0, size, memory) for memory in rows.memories_s for size in _SIZES]
    return (*FLOOR_FORMS, *more)
