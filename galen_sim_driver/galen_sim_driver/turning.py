"""Where a load turns: what a friction's state hangs on, and nothing between.

A law without memory of time goes the same way whether it is looked at often or seldom, as long as
the load goes on in one direction. So its state is computed from turn to turn, and every sample from
the turn before it.

Noise makes a measured load turn at every other sample. Small swings wear a friction of Dahl's kind
off, which no real joint knows, and swings below a gate are therefore none.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from galen_model.arrays import Array


def turning_points(values: Array, gate: float) -> np.ndarray:
    """Indices, increasing, at which values (n,) turn by more than `gate`; the first is always 0.

    A turn is where the values were farthest, before they came back by more than the gate.
    """
    turns = [0]
    if not len(values):
        return np.array(turns)
    plain = values.tolist()
    high = low = plain[0]
    at_high = at_low = 0
    direction = 0
    for index, value in enumerate(plain):
        if value > high:
            high, at_high = value, index
        if value < low:
            low, at_low = value, index
        if direction <= 0 and value - low > gate:
            if direction < 0 or at_low > 0:
                turns.append(at_low)
            direction, high, at_high = 1, value, index
        elif direction >= 0 and high - value > gate:
            if direction > 0 or at_high > 0:
                turns.append(at_high)
            direction, low, at_low = -1, value, index
    return np.array(turns)


def along_turns(
    load: Array,
    gate: float,
    slide: Callable[[Array, Array], Array],
    before: float = 0.0,
    start: float = 0.0,
) -> Array:
    """State (n,) of a friction under load (n,), which was `before` with the state `start`.

    slide(state, change) gives the states after the load has changed straight by `change`, for
    arrays of one shape.
    """
    path = np.concatenate([[before], load])
    turns = turning_points(path, gate)
    state = np.empty(len(turns))
    state[0] = start
    for leg, change in enumerate(np.diff(path[turns])):
        state[leg + 1] = slide(state[leg : leg + 1], np.array([change]))[0]
    last = np.searchsorted(turns, np.arange(1, len(path)), side="right") - 1
    return slide(state[last], load - path[turns[last]])
