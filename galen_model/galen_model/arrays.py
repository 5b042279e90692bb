# SPDX-License-Identifier: Apache-2.0
"""The array type that the maths is written in, and what every module does with arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; shapes and units are in the docstrings."""


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Find the runs of True in a mask.

    Args:
        mask: (n,) booleans.

    Returns:
        First row and one past the last row of each run, in order.

    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def evenly_spread(count: int, dimensions: int) -> Array:
    """Spread points in the unit cube, the first ones as even as all of them.

    The additive recurrence n / phi^k mod 1 with phi^(d + 1) = phi + 1 (Roberts, *The unreasonable
    effectiveness of quasirandom sequences*, 2018).

    Args:
        count: number of points.
        dimensions: number of axes, d.

    Returns:
        Points (count, dimensions), each coordinate in [0, 1).

    """
    phi = 2.0
    for _ in range(60):
        phi = (1.0 + phi) ** (1.0 / (dimensions + 1))
    steps = phi ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0)
