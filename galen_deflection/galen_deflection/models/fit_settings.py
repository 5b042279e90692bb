"""How a model is fitted, beside the samples themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FitSettings:
    """What every kind of model takes; a kind that doesn't need one of these leaves it alone.

    use (n,) bool, or None for all: the samples whose measured deflection a fit may look at. The
    loads of the others still count for what the arm remembers, as they would live. seed: of all
    that is drawn by chance. iterations: of a network's training, None for its kind's own number.
    patience: stop a training that has not become better for so many iterations, None for never.
    on_progress(done, total, what): called now and then.
    """

    use: np.ndarray | None = None
    seed: int = 0
    iterations: int | None = None
    patience: int | None = None
    on_progress: Callable[[int, int, str], None] | None = None

    def used(self, count: int) -> np.ndarray:
        """The samples (count,) to look at; raises ValueError for another number of them."""
        if self.use is None:
            return np.ones(count, dtype=bool)
        use = np.asarray(self.use, dtype=bool)
        if use.shape != (count,):
            raise ValueError(f"use has the shape {use.shape} for {count} samples")
        return use
