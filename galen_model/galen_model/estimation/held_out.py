# SPDX-License-Identifier: Apache-2.0
"""Held-out blocks: how well a problem predicts readings that it has not seen.

**Score.** Blocks of readings that follow each other in time are held out in turn, and each held-out
reading has a log density under the fit to the rest: a block inside a sweep is bridged by the curve
between its neighbours, a block at an end is reached by extrapolation (a walk stays where it was, a
straight line and a smooth curve go on). It is that of Student's t, because sigma is estimated; it
is a proper score (Gneiting and Raftery, *J. Am. Stat. Assoc.* 102, 2007), so that it shows whether
the stated errors are true as well as whether the predictions are near, which a mean square alone
doesn't. A block counts by the mean over its readings, each on its own: their joint density would
ask how readings of one moment follow each other, such as creep within a stop, and not how well the
gap is bridged, on which the parameters hang.

**Comparison.** The difference of two models' scores is taken block by block, so that what a block
has in common for both drops out; the blocks are few and independent, so that the mean's standard
error comes from their scatter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.distributions import student_t_logpdf
from galen_model.errors import IdentificationError
from galen_model.estimation.problem import PRIOR_READINGS, Problem

CLEAR_SIGMAS = 2.0
"""Standard errors beyond which a gain is more than chance."""

FEWEST_BLOCKS = 5  # four say too little of chance
_LEAST_GAIN, _BEST_OF_MANY_SIGMAS = 0.1, 3.0
"""Log density per block, and standard errors of it, that more than chance needs.

Several candidates are compared, so that two standard errors are often chance.
"""
_TOLERANCE = 1e-2  # of sigma: a prediction's density needs no more
_MOST_NUMBERS = 1_000_000  # of the designs of blocks that are fitted at once


class BlockGain(NamedTuple):
    """Mean gain of one model over another on held-out blocks, and its standard error."""

    mean: float
    std: float

    @property
    def clear(self) -> bool:
        """Whether the model is better beyond chance."""
        return self.mean > CLEAR_SIGMAS * self.std

    @property
    def clear_loss(self) -> bool:
        """Whether the model is worse beyond chance."""
        return self.mean < -CLEAR_SIGMAS * self.std


def block_gain(better_by: ArrayLike) -> BlockGain:
    """Judge the differences of two models' scores on held-out blocks.

    Args:
        better_by: (blocks,) at least two, by how much the model is better on each.

    Returns:
        Mean and standard error, in the scores' unit.

    """
    gains = np.asarray(better_by, dtype=float)
    return BlockGain(float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))))


def is_clear_gain(gains: Array) -> bool:
    """Check whether the gains of the best of several models are beyond chance.

    Args:
        gains: (blocks,) in log density; those that are not finite don't count.

    Returns:
        False also where fewer than FEWEST_BLOCKS count.

    """
    gains = gains[np.isfinite(gains)]
    if len(gains) < FEWEST_BLOCKS:
        return False
    # a block in which a curve gains far more would, by the scatter, speak against the curve
    mean, std = block_gain(np.minimum(gains, 2.0 * np.median(gains)))
    return mean > _LEAST_GAIN + _BEST_OF_MANY_SIGMAS * std


def is_clear_loss(gains: Array) -> bool:
    """Check whether gains are losses beyond chance.

    Args:
        gains: (blocks,) in log density; those that are not finite don't count.

    Returns:
        False also where fewer than FEWEST_BLOCKS count.

    """
    gains = gains[np.isfinite(gains)]
    return len(gains) >= FEWEST_BLOCKS and block_gain(gains).clear_loss


def time_blocks(time_s: Array, segment: np.ndarray, blocks: int) -> np.ndarray:
    """Label blocks of readings that follow each other, none across two sweeps.

    Args:
        time_s: (n,), or any number that orders the readings of a sweep.
        segment: (n,) which sweep each is of, from 0 on.
        blocks: wanted number over all sweeps; each sweep has its share, at least one.

    Returns:
        Labels (n,), from 0 on.

    """
    order = np.lexsort((time_s, segment))
    labels = np.empty(len(time_s), dtype=int)
    first = 0
    counts = np.bincount(segment)
    for count in counts:
        share = max(1, round(blocks * count / len(time_s)))
        share = min(share, count)
        labels[order[first : first + count]] = first + np.arange(count) * share // count
        first += count
    return np.unique(labels, return_inverse=True)[1]


def held_out(
    problem: Problem, used: np.ndarray, groups: np.ndarray, *, equal: bool = False
) -> tuple[Array, Array]:
    """Hold out each block in turn.

    Args:
        problem: n readings of c channels.
        used: (n,) readings that may be fitted.
        groups: (n,) labels of blocks; one below zero is not held out.
        equal: all channels weigh alike, as in plain least squares, and there is no density.

    Returns:
        Residuals (n, c) and log densities (n, c); NaN where the rest leaves a parameter open.

    """
    residuals = np.full(problem.readings.shape, np.nan)
    density = residuals.copy()
    try:
        sigma = problem.solve(used).settle(_TOLERANCE).sigma
    except IdentificationError:
        return residuals, density
    blocks = np.unique(groups[groups >= 0])
    together = np.array_split(blocks, 1 + len(blocks) * problem.design.size // _MOST_NUMBERS)
    while together:
        labels = together.pop()
        held = groups == labels[:, None]
        fit, reading = np.nonzero(held)
        try:
            equations = problem.solve(used & ~held)
            if equal:
                values, _ = equations.values(np.ones((len(labels), len(sigma))))
                residuals[reading] = equations.residuals(values)[fit, reading]
                continue
            found = equations.settle(_TOLERANCE, sigma)
        except IdentificationError:
            if len(labels) > 1:  # one of them leaves a parameter open
                together += np.array_split(labels, 2)
            continue
        residuals[reading] = equations.residuals(found.values)[fit, reading]
        variance = 1.0 + equations.leverage(found.covariance, found.sigma)[fit, reading]
        density[reading] = student_t_logpdf(
            residuals[reading],
            found.freedom[fit] + PRIOR_READINGS,
            found.sigma[fit] * np.sqrt(variance),
        )
    return residuals, density


def block_means(density: Array, used: np.ndarray, groups: np.ndarray) -> Array:
    """Average the log density over each block's used readings.

    Args:
        density: (n, c), natural logarithms, as `held_out` returns them.
        used: mask (n,).
        groups: (n,) labels of blocks; those below zero don't count.

    Returns:
        Means (blocks, c), by ascending label of the blocks with a used reading.

    """
    return np.array(
        [
            np.mean(density[used & (groups == label)], axis=0)
            for label in np.unique(groups[used & (groups >= 0)])
        ]
    )
