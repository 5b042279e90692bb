"""Whether there is more energy in a cell than noise gives it, with many cells looked at.

A gap adds energy: the sum of squared whitened residuals of a cell of n rows is chi-square with n
degrees of freedom where there is noise alone, and larger where there is a gap. Flipping signs
doesn't change an energy, and resampling the recording's own blocks keeps its gap, so neither gives
the null. Here the null is drawn: each block's energy in each cell anew from the chi-square that
noise gives it, times two things that a real recording has and white noise hasn't,

    E*_c = (1 + s g_c) * sum_b m_b chi2(n_bc),   E[m_b] = 1, var m_b = t^2, g_c ~ N(0, 1)

with s how far the noise's estimate may be off, and m_b what is left of correlation within a block
and of noise that isn't always the same. t^2 is estimated from blocks with less energy than the
floor: a gap can't put them there (`block_spread`). Each cell's ratio E_c / n_c is made comparable
by Wilson and Hilferty's cube root (Proc. Natl. Acad. Sci. 17, 684, 1931),

    T_c = ((E_c / n_c)^(1/3) - (1 - 2/(9 v_c))) / sqrt(2/(9 v_c)),   v_c = 2 / var(E*_c / n_c)

and the p-value of a cell is how often the largest T* of all cells reaches T_c (Westfall and Young,
Resampling-based multiple testing, 1993: single-step max T). So the chance that any cell of a
healthy recording is marked at all is the level, however many cells there are.
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
) -> Tested:
    """Test K = `cells` cells at once.

    energy (N,): sums of squares over the floor, of `count` (N,) rows each (default: 1); block, cell
    (N,): where they belong, cell -1 for nowhere. A row may be given twice, for cells that overlap:
    the null then takes them for independent, which errs to the safe side. spread: `block_spread`'s,
    None to estimate it here. A cell without rows has p = 1 and ratio 1.
    """
    freedom = np.ones(len(energy)) if count is None else count
    used = cell >= 0
    energy, block, cell, freedom = energy[used], block[used], cell[used], freedom[used]
    total = np.bincount(cell, freedom, minlength=cells).astype(float)
    own = np.bincount(cell, energy, minlength=cells).astype(float)
    there = np.flatnonzero(total > 0)
    p, ratio = np.ones(cells), np.ones(cells)
    if not len(there):
        return Tested(total, ratio, own - total, p)
    if spread is None:
        spread = block_spread(energy, block)
    keys, pair = np.unique(
        np.stack([cell, np.unique(block, return_inverse=True)[1]]), axis=1, return_inverse=True
    )
    pairs = np.bincount(pair.ravel(), freedom).astype(float)
    starts = np.searchsorted(keys[0], there)
    n = total[there]
    clumps = np.add.reduceat(pairs**2, starts) / n**2
    variance = 2.0 / n + spread**2 * (clumps + 2.0 / n) + settings.level_std**2
    ratio[there] = own[there] / n
    score = cube_root_score(ratio[there], 2.0 / variance)
    largest = _largest(keys[1], pairs, starts, n, variance, spread, settings)
    reached = len(largest) - np.searchsorted(np.sort(largest), score)
    p[there] = (1.0 + reached) / (1.0 + len(largest))
    return Tested(total, ratio, own - total, p)


def _largest(
    block: np.ndarray,
    pairs: Array,
    starts: np.ndarray,
    n: Array,
    variance: Array,
    spread: float,
    settings: CellSettings,
) -> Array:
    """The largest score of all cells in each draw of the null."""
    rng = np.random.default_rng(settings.seed)
    found = []
    for first in range(0, settings.draws, _CHUNK):
        size = min(_CHUNK, settings.draws - first)
        if spread > 0.0:
            energy = 2.0 * rng.standard_gamma(0.5 * pairs, (size, len(pairs)))
            levels = rng.gamma(spread**-2, spread**2, (size, int(block.max()) + 1))
            sums = np.add.reduceat(energy * levels[:, block], starts, axis=1)
        else:
            sums = 2.0 * rng.standard_gamma(0.5 * n, (size, len(n)))
        sums *= np.maximum(1.0 + settings.level_std * rng.standard_normal(sums.shape), 0.0)
        found.append(cube_root_score(sums / n, 2.0 / variance).max(axis=1))
    return np.concatenate(found)
