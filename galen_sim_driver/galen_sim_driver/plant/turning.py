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
    far, since = np.abs(values - values[0]) > gate, np.arange(len(values))
    if not far.any():
        return np.array(turns)
    # The first value that is off by the gate tells the direction that it starts in.
    up = bool(values[int(since[far][0])] > values[0])
    plain = values.tolist()
    farthest, at = plain[0], 0
    for index, value in enumerate(plain):
        if up:
            if value >= farthest:
                farthest, at = value, index
            elif farthest - value > gate:
                turns.append(at)
                farthest, at, up = value, index, False
        elif value <= farthest:
            farthest, at = value, index
        elif value - farthest > gate:
            turns.append(at)
            farthest, at, up = value, index, True
    return np.array(turns)


def along_turns(
    loads: Array,
    gates: Array,
    slide: Callable[[Array, Array], Array],
    before: Array,
    start: Array,
) -> Array:
    """States (n, k) of k frictions under loads (n, k), before which they had `before` and `start`.

    before, start (k,): load and state of the last sample. gates (k,). slide(states, changes) gives
    the states after the loads have changed straight by `changes`, for arrays (..., k).
    """
    path = np.concatenate([before[None], loads])
    turns = [turning_points(column, gate) for column, gate in zip(path.T, gates, strict=True)]
    legs = max(map(len, turns)) - 1
    # One with fewer turns than others stays at its last.
    at = np.stack([np.pad(t, (0, legs + 1 - len(t)), mode="edge") for t in turns], axis=1)
    at_turns = np.take_along_axis(path, at, axis=0)
    states = np.empty_like(at_turns)
    states[0] = start
    for leg in range(legs):
        states[leg + 1] = slide(states[leg], at_turns[leg + 1] - at_turns[leg])
    samples = np.arange(1, len(path))
    last = np.stack([np.searchsorted(t, samples, side="right") - 1 for t in turns], axis=1)
    since = loads - np.take_along_axis(at_turns, last, axis=0)
    return slide(np.take_along_axis(states, last, axis=0), since)
