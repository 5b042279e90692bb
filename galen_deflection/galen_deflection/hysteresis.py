"""Rate-independent hysteresis: play operators in a load, after Prandtl and Ishlinskii.

The play (backlash) operator of threshold r follows its input x by as little as it has to:

    y(t) = min(max(y(t-1), x(t) - r), x(t) + r).

A weighted sum  c x + sum_i w_i y_i  with w_i >= 0 is a Prandtl-Ishlinskii operator (K. Kuhnen,
*Modeling, Identification and Compensation of Complex Hysteretic Nonlinearities*, European Journal
of Control 9, 2003). It is what springs and dry friction make of a load: n Maxwell-slip elements
beside a spring give a force that is a Prandtl-Ishlinskii operator of stops in the displacement (F.
Al-Bender, V. Lampaert, J. Swevers, *The generalized Maxwell-slip model*, IEEE Trans. Automatic
Control 50, 2005), and its inverse is one of plays in the force (Kuhnen, section 4): displacement
from load, without solving anything. Properties that follow and are tested: the loop depends on the
order of loads, not on their speed; loops between the same two loads are congruent; a larger load
wipes out the memory of smaller ones; and weights that aren't negative dissipate.

Where it starts: never loaded before, y = 0 taken to its first load, the virgin curve. What happened
before is not known, though: at the load x, y may be anything in [x - r, x + r], whether the arm is
loaded at the start or not. The operator is monotone in where it starts, so these two starts bound
all others; their distance never grows, and is zero once the load has swept over 2 r. It is carried
along as the spread of what the start leaves unknown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array


class Played(NamedTuple):
    """Outputs (n, m) from a virgin start, and what is unknown of them.

    spread (n, m): distance of the outputs from the two outermost starts. unknown (n, m): root mean
    square distance from this output, were all between them as likely: the virgin start need not lie
    in their middle, and under load it lies at one end.
    """

    output: Array
    spread: Array
    unknown: Array


class PlayOperators:
    """m play operators, each with its own threshold and input; they remember."""

    def __init__(self, thresholds: Array) -> None:
        """Thresholds (m,), in their inputs' units, none negative. Starts as `reset` does."""
        self._thresholds = np.asarray(thresholds, dtype=float)
        if np.any(self._thresholds < 0.0):
            raise ValueError(f"a threshold is negative: {self._thresholds.min()}")
        self._state = np.zeros((3, len(self._thresholds)))
        self.reset()

    def reset(self) -> None:
        """Forget all loads: outputs of a virgin start, and nothing known of what was before."""
        self._state[0] = 0.0
        self._state[1] = -np.inf
        self._state[2] = np.inf

    def run(self, inputs: Array) -> Played:
        """Take inputs (n, m) in their order, from where the last call left off.

        The results are the same to the last bit however the inputs are cut into calls: beside
        input -+ threshold nothing is calculated, only compared.
        """
        lower = inputs - self._thresholds
        upper = inputs + self._thresholds
        states = np.empty((len(inputs), *self._state.shape))
        before = self._state
        for low, high, now in zip(lower, upper, states, strict=True):
            np.maximum(before, low, out=now)
            np.minimum(now, high, out=now)
            before = now
        self._state = before.copy()
        output, low, high = states[:, 0], states[:, 1], states[:, 2]
        spread = high - low
        off_middle = 0.5 * (low + high) - output
        return Played(output, spread, np.sqrt(spread * spread / 12.0 + off_middle * off_middle))
