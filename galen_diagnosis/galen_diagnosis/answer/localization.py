# SPDX-License-Identifier: Apache-2.0
"""Where the gap lies: cells of the residual that hold more energy than a healthy arm gives them.

A view cuts the squared whitened residual into cells (by channel, bag, regime, pose). A cell has a
share of what is above the floor, and a p-value, corrected for all cells of its view. Where no cell
is beyond noise and tolerances, all shares are 0.

A gap adds energy: the sum of squares of a cell of n rows is chi-square with n degrees of freedom
where there is noise alone, and larger where there is a gap. Flipping signs doesn't change an
energy, and resampling the recording's own blocks keeps its gap, so neither gives the null. Here it
is drawn: each block's energy in each cell anew from the chi-square that noise gives it, and with
what a real recording has beside white noise,

    E*_c = (1 + s g_c) sum_b m_b chi2(n_bc) + d^T M_c d + 2 sqrt(d^T M_c d) g'_c,

with s how far the noise's estimate may be off, E[m_b] = 1, var m_b = t^2 the remaining correlation
within a block and noise that isn't always the same; g, g' ~ N(0, 1). t^2 is estimated from blocks
with less energy than the floor: a gap can't put them there (`block_spread`). The last two terms are
a healthy arm's: with its deviations d ~ N(0, 1) in units of their tolerances, rows are off by H d,
M_c = H_c^T H_c; the cross term with the noise is Gaussian. One d holds for all cells of a draw.

Each cell's ratio E_c / n_c is made comparable by Wilson and Hilferty's cube root (Proc. Natl. Acad.
Sci. 17, 684, 1931), which makes a chi-square nearly normal, less its mean in the draws, over its
standard deviation there. The p-value of a cell is how often the largest of all cells' scores in a
draw reaches the cell's (Westfall and Young, Resampling-based multiple testing, 1993: single-step
max T): the chance that any cell of a healthy recording is marked is the level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.observation.rows import BAGS, CHANNELS, REGIMES, ResidualRows

LEVEL = 0.05
"""A cell with a smaller corrected p-value is marked."""
_DRAWS = 1000
_LEVEL_STD = 0.02
"""Standard deviation of the noise's estimated variance, over it."""
_SEED = 20190101
_CHUNK = 250
_MIN_ROWS = 6
"""A block of fewer rows doesn't show its own level."""
_MIN_BLOCKS = 10


@dataclass(frozen=True)
class View:
    """K cells of the rows.

    labels, details: name, and content for JSON, of each cell. row, cell (M,): which of Rows lies in
    which cell.
    """

    labels: tuple[str, ...]
    details: tuple[dict[str, Any], ...]
    row: np.ndarray
    cell: np.ndarray


def localize(
    rows: ResidualRows, residual: Array, floor: float = 1.0, healthy: Array | None = None
) -> dict[str, Any]:
    """Return the contract's `where`, with ratios and p-values beside the shares.

    Args:
        rows: N rows.
        residual: (N,), whitened, unknowns fitted.
        floor: Mean square that noise alone gives a row.
        healthy: (N, q), how rows change by each of q tolerances of a healthy arm, unknowns
            projected out; None for an arm that is the nominal one.

    Returns:
        JSON content: shares by channel, bag and regime, poses, and `p` and `ratio` by the same.

    """
    found: dict[str, Any] = {"p": {}, "ratio": {}}
    for name, index, names in (
        ("channels", rows.channel, CHANNELS),
        ("bags", rows.bag, BAGS),
        ("regimes", rows.regime, REGIMES),
    ):
        if rows.labels and name != "channels":  # a table's readings are of one kind
            found[name] = {}
            continue
        view = _by_names(index, names)
        share, ratio, p = cell_scores(rows, residual, view, floor, healthy)
        found[name] = _numbers(view, share)
        found["p"][name] = _numbers(view, p)
        found["ratio"][name] = _numbers(view, ratio)
    poses = by_pose(rows)
    scores = cell_scores(rows, residual, poses, floor, healthy)
    found["poses"] = [
        {**detail, "share": _rounded(share), "ratio": _rounded(ratio), "p": _rounded(p)}
        for detail, share, ratio, p in zip(poses.details, *scores, strict=True)
    ]
    return found


def cell_scores(
    rows: ResidualRows,
    residual: Array,
    view: View,
    floor: float = 1.0,
    healthy: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Test a view's K cells on whitened residuals.

    Args:
        rows: N rows.
        residual: (N,), whitened, unknowns fitted.
        view: The cells.
        floor: Mean square that noise alone gives a row.
        healthy: (N, q), how rows change by each of q tolerances of a healthy arm; None for an arm
            that is the nominal one.

    Returns:
        Share of the excess, mean square over the floor, corrected p-value, each (K,); shares are 0
        where no cell is marked.

    """
    energy = residual**2 / floor
    off = None if healthy is None else healthy[view.row] / np.sqrt(floor)
    ratio, excess, p = compare_cells(
        energy[view.row],
        rows.block[view.row],
        view.cell,
        len(view.labels),
        spread=block_spread(energy, rows.block) if len(rows) else 0.0,
        healthy=off,
    )
    over = np.maximum(excess, 0.0)
    if not len(over) or p.min() >= LEVEL:
        return np.zeros_like(over), ratio, p
    return over / over.sum(), ratio, p


def _numbers(view: View, values: Array) -> dict[str, float]:
    return {label: _rounded(value) for label, value in zip(view.labels, values, strict=True)}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


# Views


def _by_names(index: np.ndarray, names: tuple[str, ...]) -> View:
    present, cell = np.unique(index, return_inverse=True)
    labels = tuple(names[number] for number in present)
    return View(labels, tuple({} for _ in labels), np.arange(len(index)), cell.ravel())


def by_regime_of_bag(rows: ResidualRows) -> View:
    """Cut by channel in each regime of each bag, for the picture.

    Args:
        rows: N rows.

    Returns:
        A cell for each combination that has rows.

    """
    shape = (len(BAGS), len(REGIMES), len(CHANNELS))
    keys = np.ravel_multi_index((rows.bag, rows.regime, rows.channel), shape)
    present, cell = np.unique(keys, return_inverse=True)
    details = tuple(
        {"channel": CHANNELS[channel], "bag": BAGS[bag], "regime": REGIMES[regime]}
        for bag, regime, channel in zip(*np.unravel_index(present, shape), strict=True)
    )
    labels = tuple(f"{one['channel']}, {one['bag']} {one['regime']}" for one in details)
    return View(labels, details, np.arange(len(rows)), cell.ravel())


def by_pose(rows: ResidualRows) -> View:
    """Cut by the sweep's still poses and the arm's positions among the pushes.

    Args:
        rows: N rows; those in motion are in no cell.

    Returns:
        A cell for each pose of a bag, with the median of its reported joints, m and rad.

    """
    row = np.flatnonzero(rows.pose >= 0)
    poses = int(rows.pose.max(initial=0)) + 1
    present, cell = np.unique(rows.bag[row] * poses + rows.pose[row], return_inverse=True)
    labels: list[str] = []
    details: list[dict[str, Any]] = []
    for number, (bag, pose) in enumerate(zip(present // poses, present % poses, strict=True)):
        if rows.labels:
            labels.append(rows.labels[pose])
            details.append({"pose": rows.labels[pose]})
            continue
        joints = np.median(rows.joints[row[cell.ravel() == number]], axis=0).round(5).tolist()
        at = dict(zip(rows.arm.joint_names, joints, strict=True))
        labels.append(f"{BAGS[bag]} {'pose' if BAGS[bag] == 'sweep' else 'position'} {pose}")
        details.append({"bag": BAGS[bag], "pose": int(pose), "joints": at})
    return View(tuple(labels), tuple(details), row, cell.ravel())


# Test of many cells


def cube_root_score(ratio: Array, freedom: Array) -> Array:
    """Return Wilson and Hilferty's score, standard normal where ratio is chi2(n) / n.

    Args:
        ratio: Sums of squares over their degrees of freedom, any shape.
        freedom: Degrees of freedom n, of the same shape.

    Returns:
        Scores of the same shape.

    """
    spread = 2.0 / (9.0 * freedom)
    return np.asarray((np.cbrt(ratio) - (1.0 - spread)) / np.sqrt(spread))


def block_spread(energy: Array, block: np.ndarray) -> float:
    """Estimate t, the blocks' noise levels' relative standard deviation, from quiet blocks alone.

    Under chi-square noise the cube-root score of a quiet block has mean square 1; what is beyond it
    is t^2 over 2 / n.

    Args:
        energy: Squares over the floor, (N,).
        block: Number of each row's block, (N,).

    Returns:
        t; 0 of fewer than 10 quiet blocks.

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
    *,
    spread: float,
    healthy: Array | None = None,
    draws: int = _DRAWS,
    level_std: float = _LEVEL_STD,
    seed: int = _SEED,
) -> tuple[Array, Array, Array]:
    """Test K = `cells` cells at once.

    Args:
        energy: (N,), squares over the floor.
        block: (N,), where each lies.
        cell: (N,), where each lies.
        cells: K.
        spread: `block_spread`'s.
        healthy: (N, q), how rows change by a healthy arm's deviations, each by one tolerance, in
            units of the rows' noise.
        draws: Of the null; no p-value is below 1 / (draws + 1).
        level_std: Standard deviation of the noise's estimated variance, over it.
        seed: Of the draws.

    Returns:
        Mean square over the floor, excess and p, each (K,); 1, 0 and 1 of an empty cell.

    """
    total = np.bincount(cell, minlength=cells).astype(float)
    own = np.bincount(cell, energy, minlength=cells).astype(float)
    there = np.flatnonzero(total > 0)
    p, ratio = np.ones(cells), np.ones(cells)
    if not len(there):
        return ratio, own - total, p
    ratio[there] = own[there] / total[there]
    sums = _noise_alone(block, cell, there, spread, (draws, level_std, seed))
    if healthy is not None and healthy.size:
        sums += _deviations(healthy, cell, there, draws, seed)
    drawn = np.cbrt(np.maximum(sums, 0.0) / total[there])
    mean, std = drawn.mean(axis=0), drawn.std(axis=0)
    largest = ((drawn - mean) / std).max(axis=1)
    score = (np.cbrt(ratio[there]) - mean) / std
    reached = len(largest) - np.searchsorted(np.sort(largest), score)
    p[there] = (1.0 + reached) / (1.0 + len(largest))
    return ratio, own - total, p


def _noise_alone(
    block: np.ndarray,
    cell: np.ndarray,
    there: np.ndarray,
    spread: float,
    drawing: tuple[int, float, int],
) -> Array:
    """Return sums of squares (draws, K) of noise alone."""
    draws, level_std, seed = drawing
    names, number = np.unique(block, return_inverse=True)
    count = np.bincount(cell * len(names) + number).astype(float)
    keys = np.flatnonzero(count > 0)
    rows, block_of = count[keys], keys % len(names)
    starts = np.searchsorted(keys // len(names), there)
    rng = np.random.default_rng(seed)
    found = []
    for first in range(0, draws, _CHUNK):
        size = min(_CHUNK, draws - first)
        if spread > 0.0:
            energy = 2.0 * rng.standard_gamma(0.5 * rows, (size, len(rows)))
            levels = rng.gamma(spread**-2, spread**2, (size, len(names)))
            sums = np.add.reduceat(energy * levels[:, block_of], starts, axis=1)
        else:
            n = np.add.reduceat(rows, starts)
            sums = 2.0 * rng.standard_gamma(0.5 * n, (size, len(n)))
        found.append(sums * (1.0 + level_std * rng.standard_normal(sums.shape)))
    return np.concatenate(found)


def _deviations(
    healthy: Array, cell: np.ndarray, there: np.ndarray, draws: int, seed: int
) -> Array:
    """Return what a healthy arm adds to the sums of squares (draws, K)."""
    rng = np.random.default_rng([seed, 1])
    deviation = rng.standard_normal((draws, healthy.shape[1]))
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], there)
    ends = np.searchsorted(cell[order], there, side="right")
    added = np.empty((draws, len(there)))
    for k, (start, end) in enumerate(zip(starts, ends, strict=True)):
        own = healthy[order[start:end]]
        added[:, k] = np.sum((deviation @ (own.T @ own)) * deviation, axis=1)
    cross = 2.0 * np.sqrt(np.maximum(added, 0.0)) * rng.standard_normal(added.shape)
    return np.asarray(added + cross)
