# SPDX-License-Identifier: Apache-2.0
"""Least squares of rows with known noise, and the sums over blocks that such fits need."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array

_RELATIVE_RANK = 1e-9
"""Of the largest singular value: a combination below it is not identifiable."""


class LeastSquares(NamedTuple):
    """Values x (p,), their covariance (p, p), and residuals (n, c)."""

    values: Array
    covariance: Array
    residuals: Array


def least_squares(design: Array, readings: Array, std: ArrayLike = 1.0) -> LeastSquares:
    """Fit readings = design @ x; of values that the readings don't identify, the smallest.

    Args:
        design: (n, c, p).
        readings: (n, c).
        std: of the readings, any shape that broadcasts to (n, c).

    Returns:
        x (p,), its covariance (p, p), zero along what is not identified, and residuals (n, c) in
        the readings' units.

    """
    scale = 1.0 / np.broadcast_to(np.asarray(std, dtype=float), readings.shape)
    rows = (design * scale[:, :, None]).reshape(-1, design.shape[2])
    left, size, right = np.linalg.svd(rows, full_matrices=False)
    kept = size > _RELATIVE_RANK * size.max(initial=0.0)
    across = right[kept] / size[kept, None]
    values = ((readings * scale).reshape(-1) @ left[:, kept]) @ across
    return LeastSquares(values, across.T @ across, readings - design @ values)


class Information(NamedTuple):
    """All that a fit needs of blocks of rows y = X w + e, e ~ N(0, S).

    matrix: A = X^T S^-1 X, (..., k, k); right: r = X^T S^-1 y, (..., k); rest: (...) y^T S^-1 y,
    and where an evidence asks for it log|S| + n log 2 pi. Leading axes are sets of blocks.
    """

    matrix: Array
    right: Array
    rest: Array

    @classmethod
    def of_blocks(cls, blocks: Iterable[tuple[Array, Array]]) -> Information:
        """Sum up the rows of each block by itself.

        Args:
            blocks: of each, whitened columns (r, k) and whitened readings (r,); at least one block.

        Returns:
            Sums with the leading axis (blocks,); `rest` is y^T y alone.

        """
        # not by BLAS: its threads, woken for so little, wait for a busy machine's cores
        parts = [
            (np.einsum("rp,rq->pq", x, x), np.einsum("rp,r->p", x, y), y @ y) for x, y in blocks
        ]
        return cls(*(np.array(column) for column in zip(*parts, strict=True)))

    def part(self, places: Any) -> Information:
        """Select some of the sets.

        Args:
            places: index of the leading axes, as of numpy.

        Returns:
            Those sets.

        """
        return Information(*(field[places] for field in self))

    def total(self) -> Information:
        """Sum over the last of the leading axes: the blocks together.

        Returns:
            Sums without that axis.

        """
        return Information(
            self.matrix.sum(axis=-3), self.right.sum(axis=-2), self.rest.sum(axis=-1)
        )

    def without_each(self) -> Information:
        """Leave out each block in turn, along the last of the leading axes.

        Returns:
            Sums of the other blocks, in the same shape.

        """
        whole = self.total()
        return Information(
            whole.matrix[..., None, :, :] - self.matrix,
            whole.right[..., None, :] - self.right,
            whole.rest[..., None] - self.rest,
        )

    def combined(self, combination: Array) -> Information:
        """Change to other columns.

        Args:
            combination: (k, q); the new columns are combinations of these.

        Returns:
            Sums of the q columns.

        """
        return Information(
            combination.T @ self.matrix @ combination, self.right @ combination, self.rest
        )

    def cost(self, weights: Array) -> Array:
        """Compute sums of squared residuals, (y - X w)^T S^-1 (y - X w).

        Args:
            weights: w (k,), the same of all sets.

        Returns:
            Sums (...) of each set.

        """
        fitted = np.einsum("...pq,p,q->...", self.matrix, weights, weights)
        return np.asarray(self.rest - 2.0 * self.right @ weights + fitted)
