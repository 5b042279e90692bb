"""The array type that the maths is written in."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; shapes and units are in the docstrings."""
