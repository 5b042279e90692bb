"""Which joint the error follows: how much of the gap is a function of one joint alone.

Of each channel c the residual's mean in the ranges b of a joint explains
sum_b n_b (mean_cb - mean_c)^2 of its squares, of which noise alone gives one floor for each range
but one. What is beyond that, over the gap, is the joint's part: 1 for an error that depends on
nothing else, near 0 for one that has nothing to do with it. It is tested by dealing the blocks
anew to where the joint was, which destroys any relation to joints and keeps each block as it is;
the p-value is corrected for the five joints (largest part of all in each deal).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array

from galen_diagnosis.answer.views import JOINT_BINS, joint_bins
from galen_diagnosis.observation.rows import BAGS, Rows

_FEWEST_BLOCKS = 8


@dataclass(frozen=True)
class Followed:
    """A joint; part: of the gap that is a function of it alone; p: that this is chance."""

    joint: str
    part: float
    p: float


def joints_followed(
    rows: Rows, residual: Array, floor: float, deals: int = 400, seed: int = 0
) -> tuple[Followed, ...]:
    """The joints that move in the sweep, the largest part first; empty without a gap there.

    residual (N,): whitened. Of the wrench in the sweep, whose poses are a grid of the joints; where
    there is none, in whatever bags there are. A block counts with its median joint.
    """
    chosen = rows.channel < len(WRENCH_AXES)
    in_sweep = chosen & (rows.bag == BAGS.index("sweep"))
    chosen = in_sweep if in_sweep.any() else chosen
    own = _subset(rows, chosen)
    values = residual[chosen]
    excess = float(np.sum(values**2) - floor * len(values))
    names, block = np.unique(own.block, return_inverse=True)
    if len(names) < _FEWEST_BLOCKS or excess <= 0.0:
        return ()
    _, channel = np.unique(own.channel, return_inverse=True)
    table = _Table(values, block.ravel(), channel.ravel(), len(names))
    found: list[str] = []
    of_blocks: list[np.ndarray] = []
    for joint, name in enumerate(JOINT_NAMES):
        bins, edges = joint_bins(own, joint)
        if len(edges):
            found.append(name)
            of_blocks.append(_block_bins(bins, block.ravel(), len(names)))
    if not found:
        return ()
    parts = np.array([table.explained(bins, floor) for bins in of_blocks]) / excess
    rng = np.random.default_rng(seed)
    largest = np.empty(deals)
    for deal in range(deals):
        order = rng.permutation(len(names))
        largest[deal] = max(table.explained(bins[order], floor) for bins in of_blocks) / excess
    return tuple(
        sorted(
            (
                Followed(
                    name,
                    float(np.clip(part, 0.0, 1.0)),
                    float((1 + np.sum(largest >= part)) / (1 + deals)),
                )
                for name, part in zip(found, parts, strict=True)
            ),
            key=lambda one: -one.part,
        )
    )


class _Table:
    """Sums and counts of blocks by channel, from which ranges' are added up."""

    def __init__(self, values: Array, block: np.ndarray, channel: np.ndarray, blocks: int) -> None:
        channels = int(channel.max()) + 1
        key = block * channels + channel
        shape = (blocks, channels)
        self._sum = np.bincount(key, values, blocks * channels).reshape(shape)
        self._count = np.bincount(key, minlength=blocks * channels).reshape(shape).astype(float)

    def explained(self, bins: np.ndarray, floor: float) -> float:
        """Squares that the ranges' means explain, less what noise gives. bins: of the blocks."""
        into = np.equal.outer(np.arange(JOINT_BINS), bins).astype(float)
        sums, counts = into @ self._sum, into @ self._count
        there = counts > 0
        between = np.sum(sums[there] ** 2 / counts[there])
        of_mean = np.sum(self._sum.sum(axis=0) ** 2 / self._count.sum(axis=0))
        return float(between - of_mean - floor * (there.sum() - there.any(axis=0).sum()))


def _block_bins(bins: np.ndarray, block: np.ndarray, blocks: int) -> np.ndarray:
    """The commonest range of each block."""
    table = np.bincount(block * JOINT_BINS + bins, minlength=blocks * JOINT_BINS)
    return table.reshape(blocks, JOINT_BINS).argmax(axis=1)


def _subset(rows: Rows, chosen: np.ndarray) -> Rows:
    return Rows(**{name: getattr(rows, name)[chosen] for name in rows.__dataclass_fields__})
