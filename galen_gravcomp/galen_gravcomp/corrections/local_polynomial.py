"""Value and derivatives of samples, causal, a known time behind the newest of them.

A polynomial is fitted by least squares to the samples in a window around a moment T, from
T + delay - window to T + delay, and read off at T (Savitzky, Golay, *Anal. Chem.* 36, 1964, here
for stamps as they come, and not only in the window's middle). It needs samples up to T + delay and
gives its answer that much later: the delay is known, and no phase is lost.

With independent errors sigma of n samples evenly in a window W, a cubic has in its middle

    std(x') = sqrt(75) sigma / (W sqrt(n)),    std(x'') = sqrt(720) sigma / (W^2 sqrt(n)),
    bias(x'') = W^2 x'''' / 56,

so noise falls with W^2.5 at a given rate, while the bias grows with W^2. Away from the middle both
grow; a cubic's x'' then has a bias of x'''' too, a parabola's already one of x'''.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

_US = 1000


class Derivatives(NamedTuple):
    """A value and its derivatives, (k,) each: x, x' (1/s), x'' (1/s^2)."""

    value: Array
    first: Array
    second: Array


class LocalPolynomial:
    """Differentiates samples of k values in windows; remembers the weights of the last window."""

    def __init__(self, window_s: float, delay_s: float, degree: int = 3) -> None:
        """The moment asked for lies `delay_s` before the end of a window of `window_s`."""
        if not 0.0 <= delay_s < window_s or degree < 2:
            raise ValueError(
                f"window_s = {window_s}, delay_s = {delay_s}, degree = {degree}:"
                " need 0 <= delay < window and a degree of at least 2"
            )
        self.window_s = window_s
        self.delay_s = delay_s
        self.degree = degree
        half_s = window_s / 2.0
        self._half_s = half_s
        self._powers = np.arange(degree + 1)
        self._scales = np.array([[1.0], [1.0 / half_s], [2.0 / half_s**2]])
        self._key = b""
        self._weights = np.zeros((3, 0))

    def derivatives(self, stamp_ns: np.ndarray, values: Array, at_ns: int) -> Derivatives:
        """At `at_ns`, from samples stamp_ns (n,), values (n, k); n > degree, stamps distinct."""
        # Less the first sample, so that the level costs no digits.
        value, first, second = self.weights(stamp_ns - at_ns) @ (values - values[0])
        return Derivatives(value + values[0], first, second)

    def weights(self, after_ns: np.ndarray) -> Array:
        """W (3, n): value and derivatives = W samples, of samples so long after the moment, ns.

        Stamps are taken to the microsecond, in which the arm moves less than an encoder's step.
        """
        after_us = (after_ns + _US // 2) // _US
        key = after_us.tobytes()
        if key != self._key:
            design = (after_us * (1e-6 / self._half_s))[:, None] ** self._powers
            rows = np.linalg.solve(design.T @ design, design.T)[:3]
            self._weights, self._key = rows * self._scales, key
        return self._weights

    def noise_gain(self, rate_hz: float) -> Array:
        """Standard deviations (3,) for samples at a rate, each with an error of one unit."""
        first = int(np.ceil((self.delay_s - self.window_s) * rate_hz - 1e-6))
        last = int(np.floor(self.delay_s * rate_hz + 1e-6))
        after_ns = np.round(np.arange(first, last + 1) * (1e9 / rate_hz)).astype(np.int64)
        return np.asarray(np.sqrt(np.sum(self.weights(after_ns) ** 2, axis=1)))
