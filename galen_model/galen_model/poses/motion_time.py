"""How long a smooth move from rest to rest has to take."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Rest-to-rest quintic s(x) = 10 x^3 - 15 x^4 + 6 x^5 over x = t/T in 0..1:
# s' peaks at x = 1/2 with 15/8; s'' peaks at x = (3 -+ sqrt 3)/6 with 10/sqrt 3.
PEAK_VELOCITY = 15.0 / 8.0
PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)


def quintic_duration_s(
    displacement: ArrayLike,
    max_velocity: ArrayLike,
    max_acceleration: ArrayLike,
    shortest_s: float = 0.05,
) -> float:
    """Shortest duration (s) of a quintic from rest to rest that keeps every joint in its limits.

    displacement (n,) in m or rad; max_velocity and max_acceleration (n,) in the same unit per s
    and s^2, positive. Peaks are 15/8 * d/T and 10/sqrt(3) * d/T^2.
    `shortest_s` keeps a move of no distance from being a step.
    """
    distance = np.abs(np.asarray(displacement, float))
    by_velocity = PEAK_VELOCITY * distance / np.asarray(max_velocity, float)
    by_acceleration = np.sqrt(PEAK_ACCELERATION * distance / np.asarray(max_acceleration, float))
    return float(max(np.max(by_velocity), np.max(by_acceleration), shortest_s))
