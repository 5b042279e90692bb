"""The array type that the maths is written in, and what every module does with arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; shapes and units are in the docstrings."""


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return first and one past the last row of each run of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
