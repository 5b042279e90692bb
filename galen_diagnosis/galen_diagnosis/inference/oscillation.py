"""What a fit leaves that oscillates: faster than any mean over half a second shows.

By `bands.py` a stream's coefficients are independent with the noise's variance. In a band of n
coefficients whose squares sum to E, a variance of its own, E / n, against the noise's has

    log LR = 1/2 (E - n - n log(E / n)),

looked for in bands of several widths, in each channel and in all of them, with the price of the
looks. Noise is known to _UNSURE.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from galen_model.arm.galen import WRENCH_AXES

from galen_diagnosis.answer.bands import coefficients
from galen_diagnosis.observation.rows import Stream

_WIDTHS_HZ = (0.5, 2.0, 8.0)
_FROM_HZ = 1.0
_UNSURE = 0.05


class Oscillation(NamedTuple):
    """log_bayes: that this band of a bag's wrench holds more than noise; energy beyond it."""

    bag: str
    from_hz: float
    to_hz: float
    log_bayes: float
    energy: float


def oscillation(streams: Sequence[Stream]) -> Oscillation | None:
    """The clearest, over the wrench's streams of a residual; None where nothing was looked at."""
    found: list[Oscillation] = []
    looks = 0
    for stream in streams:
        if stream.channels[0] != WRENCH_AXES[0]:
            continue
        known = coefficients(stream)
        fast = known.frequency_hz >= _FROM_HZ
        frequency, square = known.frequency_hz[fast], known.square[fast]
        if not len(frequency):
            continue
        each = square.shape[1]
        for width in _WIDTHS_HZ:
            number = np.floor(frequency / width).astype(int)
            count = np.bincount(number).astype(float)
            energies = [np.bincount(number, column) for column in square.T]
            for energy, channels in (
                (np.sum(energies, axis=0), each),
                *((one, 1) for one in energies),
            ):
                n = count * channels
                known_to = energy / (1.0 + _UNSURE)
                for k in np.flatnonzero(known_to > n):
                    e = known_to[k]
                    log = 0.5 * (e - n[k] - n[k] * np.log(e / n[k]))
                    place = (stream.bag, k * width, (k + 1) * width)
                    found.append(Oscillation(*place, float(log), float(energy[k] - n[k])))
            looks += int(np.sum(count > 0)) * (each + 1)
    if not found:
        return None
    best = max(found, key=lambda one: one.log_bayes)
    return best._replace(log_bayes=best.log_bayes - float(np.log(looks)))
