"""How much structure a fit leaves: the energy of means over cells, in excess of noise's.

White rows averaged over a cell and scaled by the root of their number are again white; what is slow
adds up. With c cells the sum of squares of such means is chi-square of c degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.observation.rows import BAGS, CHANNELS, Rows

_CELL_S = 0.5
_SURE = 2.0
_FLOOR_ERROR = 0.04


class Leftover(NamedTuple):
    """excess: of the cells' energy over noise; sure: what of it noise and its estimate can't be.

    floor: mean square of a row about its cell's mean, what noise alone gives a row.
    """

    excess: float
    sure: float
    floor: float


def cells(rows: Rows) -> np.ndarray:
    """Cell (N,) of each row: a channel of a pose of the sweep, else of half a second."""
    piece = np.zeros(len(rows), dtype=np.int64)
    for number, name in enumerate(BAGS):
        here = rows.bag == number
        halves = np.floor(rows.bag_s[here] / _CELL_S).astype(np.int64)
        if name == "sweep":
            # A pose is a cell; a move, over which everything changes, is several.
            still = rows.pose[here] >= 0
            halves[still] = -1 - rows.block[here][still]
        piece[here] = halves
    key = (piece * len(BAGS) + rows.bag) * len(CHANNELS) + rows.channel
    return np.unique(key, return_inverse=True)[1]


def leftover(rows: Rows, residual: Array, cell: np.ndarray | None = None) -> Leftover:
    """Of residual rows (N,)."""
    if cell is None:
        cell = cells(rows)
    number = np.bincount(cell)
    total = np.bincount(cell, residual)
    energy = float(np.sum(total**2 / number))
    count = len(number)
    within = float(residual @ residual) - energy
    floor = within / max(len(residual) - count, 1)
    excess = energy - count * floor
    chance = _SURE * floor * np.sqrt(2.0 * count) + _FLOOR_ERROR * count
    return Leftover(excess, max(0.0, excess - chance), floor)
