"""Held-out gain: whether one model predicts held-out blocks better than another.

A model's score on a block is computed from the other blocks alone. The difference of two models'
scores is taken block by block, so that what a block has in common for both drops out; the blocks
are few and independent, so that the mean's standard error comes from their scatter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array

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


PLAIN, ROBUST, MOUNTED = "plain least squares", "galen", "galen, mounted"
"""The models' names."""


@dataclass(frozen=True)
class Worth:
    """Held-out residuals of the readings with the tool.

    rmse: (6,) by model, N and N.m, NaN where the model rejected some block; gain: by how much the
    mounting lowers the mean squared residual in units of the noise, and its standard deviation
    over the blocks; by_kind: the same of forces and of torques; against: the model compared with.
    """

    rmse: dict[str, Array]
    gain: float
    gain_std: float
    by_kind: tuple[BlockGain, BlockGain]
    against: str
    blocks: int

    @property
    def worse(self) -> str:
        """Which of "forces" and "torques" becomes worse beyond chance; else empty.

        A rotation, an inclination or a zero acts on both; one at the cost of the other is
        something else.
        """
        force, torque = self.by_kind
        return "forces" if force.clear_loss else "torques" if torque.clear_loss else ""

    @property
    def pays(self) -> bool:
        """Whether the gain is beyond chance, and not one kind's at the other's cost."""
        return BlockGain(self.gain, self.gain_std).clear and not self.worse

    @property
    def sentence(self) -> str:
        """The verdict for a person."""
        change = (
            f"on {self.blocks} held-out blocks they lower the squared residual by "
            f"{self.gain:.3g} +- {self.gain_std:.2g} of the noise's, against {self.against}"
        )
        if self.worse and self.gain > 0.0:
            change += f"; but the {self.worse} become worse, so that it is something else"
        if self.pays:
            return f"the mounting's parameters pay: {change}"
        return f"the mounting's parameters do not pay, calibrate without them: {change}"


def compare(parts: Mapping[str, Sequence[Array]], sigma: Array) -> Worth:
    """Of held-out residuals (k, 6) by model and block, NaN where one rejected; sigma (6,) noise.

    The models are `PLAIN`, `ROBUST` and `MOUNTED`; two blocks at least, empty ones don't count.
    """
    squares = {  # (blocks, 2): forces, torques
        name: np.array(
            [
                np.mean((part / sigma) ** 2, axis=0).reshape(2, 3).mean(axis=1)
                for part in of
                if len(part)
            ]
        )
        for name, of in parts.items()
    }
    against = ROBUST if np.all(np.isfinite(squares[ROBUST])) else PLAIN
    gains = squares[against] - squares[MOUNTED]
    return Worth(
        {name: np.sqrt(np.mean(np.concatenate(of) ** 2, axis=0)) for name, of in parts.items()},
        *block_gain(gains.mean(axis=1)),
        (block_gain(gains[:, 0]), block_gain(gains[:, 1])),
        against,
        len(gains),
    )
