"""Whether there is more energy in a cell than noise gives it, with many cells looked at.

A gap adds energy: the sum of squared whitened residuals of a cell of n rows is chi-square with n
degrees of freedom where there is noise alone, and larger where there is a gap. Flipping signs
doesn't change an energy, and resampling the recording's own blocks keeps its gap, so neither gives
the null. Here the null is drawn: each block's energy in each cell anew from the chi-square that
noise gives it, and with what a real recording has beside white noise,

    E*_c = (1 + s g_c) sum_b m_b chi2(n_bc) + d^T M_c d + 2 sqrt(d^T M_c d) g'_c,

with s how far the noise's estimate may be off, E[m_b] = 1, var m_b = t^2 what is left of
correlation within a block and of noise that isn't always the same; g, g' ~ N(0, 1). t^2 is
estimated from blocks with less energy than the floor: a gap can't put them there (`block_spread`).
The last two terms are a healthy arm's: no arm is nominal to the last micrometre, and with its
deviations d ~ N(0, 1) in units of their tolerances, rows are off by H d, M_c = H_c^T H_c; the cross
term with the noise is Gaussian. One d holds for all cells of a draw.

Each cell's ratio E_c / n_c is made comparable by Wilson and Hilferty's cube root (Proc. Natl. Acad.
Sci. 17, 684, 1931), which makes a chi-square nearly normal, less its mean in the draws, over its
standard deviation there. The p-value of a cell is how often the largest of all cells' scores in a
draw reaches the cell's (Westfall and Young, Resampling-based multiple testing, 1993: single-step
max T). So the chance that any cell of a healthy recording is marked at all is the level, however
many cells there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

_CHUNK = 250
_MIN_ROWS = 6
"""A block of fewer rows tells nothing of its own level."""
_MIN_BLOCKS = 10


@dataclass(frozen=True)
class CellSettings:
    """How the null is drawn.

    draws: of the null; no p-value is below 1 / (draws + 1). level_std: standard deviation of the
    noise's estimated variance over it. level: a cell with a smaller p-value is marked.
    """

    draws: int = 1000
    level_std: float = 0.02
    level: float = 0.05
    seed: int = 20190101


DEFAULTS = CellSettings()


@dataclass(frozen=True)
class Tested:
    """K cells. ratio: mean square over the floor; excess: sum of squares beyond it, in floors."""

    count: Array
    ratio: Array
    excess: Array
    p: Array

    def shares(self, level: float) -> Array:
        """Each cell's part of the excess; 0 everywhere where no cell is beyond noise."""
        over = np.maximum(self.excess, 0.0)
        if not len(over) or self.p.min() >= level:
            return np.zeros_like(over)
        return np.asarray(over / over.sum())


def cube_root_score(ratio: Array, freedom: Array) -> Array:
    """Wilson and Hilferty's: standard normal where ratio is chi2(freedom) / freedom."""
    spread = 2.0 / (9.0 * freedom)
    return np.asarray((np.cbrt(ratio) - (1.0 - spread)) / np.sqrt(spread))


def block_spread(energy: Array, block: np.ndarray) -> float:
    """t: relative standard deviation of the blocks' noise levels, from the quiet side alone.

    energy (N,): squares over the floor; block (N,). Under chi-square noise the cube-root score of a
    quiet block has mean square 1; what is beyond it is t^2 over 2 / n.
    """
    _, which = np.unique(block, return_inverse=True)
    count = np.bincount(which).astype(float)
    ratio = np.bincount(which, energy) / count
    score = cube_root_score(ratio, count)
    quiet = (score < 0.0) & (count >= _MIN_ROWS)
    if quiet.sum() < _MIN_BLOCKS:
        return 0.0
    beyond = np.mean((score[quiet] ** 2 - 1.0) * 2.0 / count[quiet])
    return float(np.sqrt(max(0.0, beyond)))


def compare_cells(
    energy: Array,
    block: np.ndarray,
    cell: np.ndarray,
    cells: int,
    settings: CellSettings = DEFAULTS,
    *,
    count: Array | None = None,
    spread: float | None = None,
    healthy: Array | None = None,
) -> Tested:
    """Test K = `cells` cells at once.

    energy (N,): sums of squares over the floor, of `count` (N,) rows each (default: 1); block, cell
    (N,): where they belong. A row may be given twice, for cells that overlap: the null then takes
    their noise for independent, which errs to the safe side. spread: `block_spread`'s, None to
    estimate it here. healthy (N, q): H, how rows change with a healthy arm's deviations, in units
    of the rows' noise, each by one tolerance. A cell without rows has p = 1 and ratio 1.
    """
    freedom = np.ones(len(energy)) if count is None else count
    total = np.bincount(cell, freedom, minlength=cells).astype(float)
    own = np.bincount(cell, energy, minlength=cells).astype(float)
    there = np.flatnonzero(total > 0)
    p, ratio = np.ones(cells), np.ones(cells)
    if not len(there):
        return Tested(total, ratio, own - total, p)
    if spread is None:
        spread = block_spread(energy, block)
    n = total[there]
    ratio[there] = own[there] / n
    sums = _Null(block, cell, there, freedom, spread).draw(settings)
    if healthy is not None and healthy.size:
        sums += _deviations(healthy, cell, there, settings)
    drawn = np.cbrt(np.maximum(sums, 0.0) / n)
    mean, std = drawn.mean(axis=0), drawn.std(axis=0)
    largest = ((drawn - mean) / std).max(axis=1)
    score = (np.cbrt(ratio[there]) - mean) / std
    reached = len(largest) - np.searchsorted(np.sort(largest), score)
    p[there] = (1.0 + reached) / (1.0 + len(largest))
    return Tested(total, ratio, own - total, p)


class _Null:
    """Energies of noise alone: of K cells that have rows."""

    def __init__(
        self, block: np.ndarray, cell: np.ndarray, there: np.ndarray, freedom: Array, spread: float
    ) -> None:
        names, number = np.unique(block, return_inverse=True)
        rows = np.bincount(cell * len(names) + number, freedom)
        keys = np.flatnonzero(rows > 0)
        self._rows, self._block = rows[keys], keys % len(names)
        self._starts = np.searchsorted(keys // len(names), there)
        self._blocks, self._spread = len(names), spread

    def draw(self, settings: CellSettings) -> Array:
        """Sums of squares (draws, K)."""
        rng = np.random.default_rng(settings.seed)
        found = []
        for first in range(0, settings.draws, _CHUNK):
            size = min(_CHUNK, settings.draws - first)
            if self._spread > 0.0:
                energy = 2.0 * rng.standard_gamma(0.5 * self._rows, (size, len(self._rows)))
                levels = rng.gamma(self._spread**-2, self._spread**2, (size, self._blocks))
                sums = np.add.reduceat(energy * levels[:, self._block], self._starts, axis=1)
            else:
                n = np.add.reduceat(self._rows, self._starts)
                sums = 2.0 * rng.standard_gamma(0.5 * n, (size, len(n)))
            found.append(sums * (1.0 + settings.level_std * rng.standard_normal(sums.shape)))
        return np.concatenate(found)


def _deviations(
    healthy: Array, cell: np.ndarray, there: np.ndarray, settings: CellSettings
) -> Array:
    """What a healthy arm adds to the sums of squares (draws, K)."""
    rng = np.random.default_rng([settings.seed, 1])
    deviation = rng.standard_normal((settings.draws, healthy.shape[1]))
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], there)
    ends = np.searchsorted(cell[order], there, side="right")
    added = np.empty((settings.draws, len(there)))
    for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
        own = healthy[order[start:end]]
        added[:, k] = np.sum((deviation @ (own.T @ own)) * deviation, axis=1)
    cross = 2.0 * np.sqrt(np.maximum(added, 0.0)) * rng.standard_normal(added.shape)
    return np.asarray(added + cross)
