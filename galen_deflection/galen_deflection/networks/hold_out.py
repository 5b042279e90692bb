"""Which of the samples that a training may use it only checks itself on."""

from __future__ import annotations

import numpy as np

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.least_squares import blocks

SHARE = 0.25


def hold_out(samples: DeflectionSamples, used: np.ndarray) -> np.ndarray:
    """About a quarter (n,) bool of the used samples, no more, of positions that also remain.

    The last repetitions of positions that have several, as the report held out sets; of as many
    positions as make up a quarter. Where no position has several, the last blocks of each (blocks:
    as `least_squares`, about a push); nothing of a position that has only one.
    """
    held = np.zeros(len(samples), dtype=bool)
    for position in np.unique(samples.position[used]):
        there = used & (samples.position == position)
        sets = np.unique(samples.set_number[there])
        last = there & (samples.set_number == sets[-1])
        if len(sets) > 1 and np.count_nonzero(held | last) <= SHARE * np.count_nonzero(used):
            held |= last
    if held.any():
        return held
    parts = [part for part in blocks(samples) if used[part].any()]
    places = np.array([samples.position[part.start] for part in parts])
    for position in np.unique(places):
        of_position = np.flatnonzero(places == position)
        if len(of_position) > 1:
            for k in of_position[-max(1, round(SHARE * len(of_position))) :]:
                held[parts[k]] = used[parts[k]]
    return held
