# SPDX-License-Identifier: Apache-2.0
"""Rate-independent hysteresis: operators in a load, with corners and without.

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

With corners, a play remembers the extremes of its load and nothing else: coming back to an earlier
extreme it goes on as if it had never left. Friction of Dahl's kind does not: its loops shift. A
smooth operator of threshold r, with z of one sign with the motion or against it,

    y = x - r z,   r dz/dx = 1 - z sgn(dx) where z sgn(dx) > 0, and 1 where it is not,

is the model of Bouc and Wen with n = 1 and both its shape parameters 1/2 (Y.-K. Wen, *Method for
Random Vibration of Hysteretic Systems*, Journal of the Engineering Mechanics Division 102, 1976):
straight while it unloads, then bending towards z = +-1. Like a play it lags by r at last, and the
same is to be said of where it starts: z is in [-1, 1], two starts never part, and they meet.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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


class Operators(ABC):
    """m operators, each with its own threshold and input; they remember."""

    def __init__(self, thresholds: Array) -> None:
        """Start as `reset` does.

        Args:
            thresholds: (m,), in their inputs' units.

        Raises:
            ValueError: a threshold is negative.

        """
        self._thresholds = np.asarray(thresholds, dtype=float)
        if np.any(self._thresholds < 0.0):
            raise ValueError(f"a threshold is negative: {self._thresholds.min()}")
        self.reset()

    @abstractmethod
    def reset(self) -> None:
        """Forget all loads: a virgin start, and nothing known of what was before."""

    @abstractmethod
    def run(self, inputs: Array) -> Played:
        """Take inputs in their order, from where the last call ended.

        The results are the same to the last bit however the inputs are cut into calls.

        Args:
            inputs: (n, m), of each operator, in its threshold's unit.

        Returns:
            Outputs, spread and what is unknown of them, each (n, m), in the inputs' units.

        """


class PlayOperators(Operators):
    """Play operators: with corners."""

    def reset(self) -> None:
        """Forget all loads, as `Operators.reset`."""
        self._state = np.zeros((3, len(self._thresholds)))
        self._state[1] = -np.inf
        self._state[2] = np.inf

    def run(self, inputs: Array) -> Played:
        """Run play operators: beside input -+ threshold nothing is calculated, only compared.

        Args:
            inputs: (n, m), as of `Operators.run`.

        Returns:
            Outputs, spread and what is unknown of them, each (n, m).

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
        return _played(states)


class SmoothOperators(Operators):
    """Smooth operators, of thresholds above zero."""

    def __init__(self, thresholds: Array) -> None:
        """Start as `Operators`.

        Args:
            thresholds: (m,), in their inputs' units.

        Raises:
            ValueError: a threshold is negative or zero.

        """
        super().__init__(thresholds)
        if np.any(self._thresholds == 0.0):
            raise ValueError("a threshold is zero: a smooth operator divides by it")

    def reset(self) -> None:
        """Forget all loads, as `Operators.reset`."""
        self._z = np.zeros((3, len(self._thresholds)))
        self._input: Array | None = None

    def run(self, inputs: Array) -> Played:
        """Run smooth operators, exactly for an input that goes straight from sample to sample.

        Args:
            inputs: (n, m), as of `Operators.run`.

        Returns:
            Outputs, spread and what is unknown of them, each (n, m).

        """
        states = np.empty((len(inputs), *self._z.shape))
        z = self._z
        for x, now in zip(inputs, states, strict=True):
            if self._input is None:  # what came before may have left z anywhere
                z = _moved(z, x / self._thresholds)
                z[1:] = [[1.0], [-1.0]]
            else:
                z = _moved(z, (x - self._input) / self._thresholds)
            self._input = x.copy()
            np.subtract(x, self._thresholds * z, out=now)
        self._z = z
        return _played(states)


def _moved(z: Array, steps: Array) -> Array:
    """Z (3, m) after inputs have moved by steps (m,), in thresholds."""
    sign = np.sign(steps)
    left = np.abs(steps)
    along = z * sign
    back = np.minimum(np.maximum(-along, 0.0), left)  # straight, until nothing is left of z
    along += back
    along -= (1.0 - along) * np.expm1(back - left)
    return np.where(sign == 0.0, z, along * sign)


def _played(states: Array) -> Played:
    """From outputs (n, 3, m) of the virgin start and of the two outermost ones."""
    output, low, high = states[:, 0], states[:, 1], states[:, 2]
    spread = high - low
    off_middle = 0.5 * (low + high) - output
    return Played(output, spread, np.sqrt(spread * spread / 12.0 + off_middle * off_middle))
