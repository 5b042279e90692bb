# SPDX-License-Identifier: Apache-2.0
"""Curves in time of a sensor's bias, and what is known of them beforehand.

b(t) = B(t) beta, linear between knots, with the prior beta ~ N(0, sigma^2 Q^-1), where sigma is one
averaged reading's noise and Q is singular where nothing is known beforehand:

    constant   b = c                            Q = 0
    linear     b = c + d t                      Q = 0
    walk       db = q dw, a random walk         beta' Q beta = sum (beta_j+1 - beta_j)^2 / (q^2 h_j)
    smooth     d^2b = q dw, its integral        the same of slopes: a cubic smoothing spline

(Wahba, *Spline Models for Observational Data*, 1990, chapter 1; Harvey, *Forecasting, Structural
Time Series Models*, 1989, section 2.3.) The roughness says how far a curve gets from a constant (a
straight line, for `smooth`) over the sweep's length T, in sigma: q^2 T = roughness^2, and
q^2 T^3 / 3 = roughness^2. Between two knots the posterior mean of a walk is a straight line, so
linear interpolation is exact there; beyond the ends it stays, and a smooth curve goes on straight.

Several sweeps have curves of their own (`segment`), which share the roughness.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from galen_model.arrays import Array

_MOST_KNOTS = 60


class Shape(StrEnum):
    """Kind of curve."""

    CONSTANT = "constant"
    LINEAR = "linear"
    WALK = "walk"
    SMOOTH = "smooth"


@dataclass(frozen=True)
class BiasShape:
    """A kind of curve, and for a drifting one its roughness in sigma (see above).

    steps: of each jump, the sweep and the times, s, of the readings before and after it; between
    them the bias is taken as a straight line. thermal: it also goes with the temperature.
    """

    shape: Shape = Shape.CONSTANT
    roughness: float = 0.0
    steps: tuple[tuple[int, float, float], ...] = ()
    thermal: bool = False

    def __str__(self) -> str:
        """In words, as in "walk (10 sigma over a sweep)"."""
        text = self.shape.value
        if self.shape in (Shape.WALK, Shape.SMOOTH):
            text += f" ({self.roughness:g} sigma over a sweep)"
        if self.steps:
            at = ", ".join(f"{before:.1f} and {after:.1f}" for _, before, after in self.steps)
            text += f" with a step between {at} s"
        return f"{text} with temperature" if self.thermal else text


class BiasBasis:
    """Curves of one shape over given times."""

    def __init__(
        self,
        shape: BiasShape,
        time_s: Array,
        segment: np.ndarray,
        temperature_c: Array | None = None,
    ) -> None:
        """Lay knots among the times of all readings, held out or not.

        Args:
            shape: of the curves.
            time_s: (n,).
            segment: (n,) which sweep each is of, from 0 on.
            temperature_c: (n,), or None.

        """
        self.shape = shape
        self.segments = int(segment.max()) + 1
        times = [np.unique(time_s[segment == s]) for s in range(self.segments)]
        longest = max(float(np.ptp(t)) for t in times)
        self._length_s = longest if longest > 0.0 else 1.0
        self._end_s = [float(t[-1]) for t in times]
        if shape.shape is Shape.CONSTANT:
            self._knots = [t[-1:] for t in times]
        elif shape.shape is Shape.LINEAR:
            self._knots = [t[[0, -1]] if len(t) > 1 else t for t in times]
        else:
            self._knots = [_thinned(t) for t in times]
        self._first = np.cumsum([0, *(len(knots) for knots in self._knots)])
        self._thermal = shape.thermal and temperature_c is not None
        if self._thermal:
            assert temperature_c is not None
            self._mean_c = float(np.mean(temperature_c))
            last = [
                np.flatnonzero(segment == s)[np.argmax(time_s[segment == s])]
                for s in range(self.segments)
            ]
            self._end_c = temperature_c[last]

    @property
    def width(self) -> int:
        """Number of the curves' parameters."""
        return int(self._first[-1]) + len(self.shape.steps) + self._thermal

    @property
    def free(self) -> int:
        """How many of them the prior says nothing of."""
        order = 1 if self.shape.shape in (Shape.CONSTANT, Shape.WALK) else 2
        further = len(self.shape.steps) + self._thermal
        return sum(min(order, len(knots)) for knots in self._knots) + further

    def rows(self, time_s: Array, segment: np.ndarray, temperature_c: Array | None = None) -> Array:
        """Compute B, which takes the curves' parameters to their values.

        Args:
            time_s: (n,).
            segment: (n,) which sweep each is of, from 0 on.
            temperature_c: (n,); None: the part that goes with the temperature is left at zero.

        Returns:
            B (n, width).

        """
        rows = np.zeros((len(time_s), self.width))
        for number, (sweep, *gap) in enumerate(self.shape.steps, start=int(self._first[-1])):
            rows[:, number] = (segment == sweep) * np.interp(time_s, gap, [0.0, 1.0])
        if self._thermal and temperature_c is not None:
            rows[:, -1] = temperature_c - self._mean_c
        for s, knots in enumerate(self._knots):
            at = np.flatnonzero(segment == s)
            first = self._first[s]
            if len(knots) == 1:
                rows[at, first] = 1.0
                continue
            place = time_s[at]
            if self.shape.shape is Shape.WALK:
                place = np.clip(place, knots[0], knots[-1])
            left = np.clip(np.searchsorted(knots, place, side="right") - 1, 0, len(knots) - 2)
            part = (place - knots[left]) / (knots[left + 1] - knots[left])
            rows[at, first + left] = 1.0 - part
            rows[at, first + left + 1] = part
        return rows

    def ends(self) -> Array:
        """Compute B at each sweep's last reading.

        Returns:
            (segments, width).

        """
        end_c = self._end_c if self._thermal else None
        return self.rows(np.array(self._end_s), np.arange(self.segments), end_c)

    def penalty(self) -> Array:
        """Compute Q.

        A step or a part that goes with the temperature is known to be within 1000 sigma, so that
        a fit to readings without either is no singular one.

        Returns:
            (width, width).

        """
        further = np.arange(self.width) >= self._first[-1]
        matrix = np.diag(np.where(further, 1e-6, 0.0))
        if self.shape.shape in (Shape.CONSTANT, Shape.LINEAR):
            return matrix
        order = 1 if self.shape.shape is Shape.WALK else 2
        for s, knots in enumerate(self._knots):
            if len(knots) <= order:
                continue
            place = knots / self._length_s
            steps = np.diff(place)
            slopes = np.diff(np.eye(len(knots)), axis=0) / steps[:, None]
            if order == 1:
                rows = slopes * np.sqrt(steps)[:, None]
            else:
                rows = np.diff(slopes, axis=0) / np.sqrt((steps[1:] + steps[:-1]) / 2.0)[:, None]
                rows /= np.sqrt(3.0)
            here = slice(self._first[s], self._first[s + 1])
            matrix[here, here] = rows.T @ rows / self.shape.roughness**2
        return matrix


def _thinned(times: Array) -> Array:
    """Knots among the times, both ends with them."""
    if len(times) <= _MOST_KNOTS:
        return times
    return np.asarray(times[np.round(np.linspace(0, len(times) - 1, _MOST_KNOTS)).astype(int)])


Shapes = tuple[BiasShape, ...]
"""Shapes of the channels' curves."""

CONSTANT = BiasShape()
