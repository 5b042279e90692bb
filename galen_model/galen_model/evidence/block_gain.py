"""Held-out gain: whether one model predicts held-out blocks better than another.

A model's score on a block is computed from the other blocks alone. The difference of two models'
scores is taken block by block, so that what a block has in common for both drops out; the blocks
are few and independent, so that the mean's standard error comes from their scatter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

CLEAR_SIGMAS = 2.0
"""Standard errors beyond which a gain is more than chance."""


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

    """
    gains = np.asarray(better_by, dtype=float)
    return BlockGain(float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))))
