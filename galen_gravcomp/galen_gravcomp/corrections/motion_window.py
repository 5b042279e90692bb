"""Samples around a stamp, differentiated there, or why they can't be. No ROS.

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

import math
from enum import Enum
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_ros.stream.results import Rejection

from galen_gravcomp.parameters import GravcompParameters

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


# Of the window: samples further apart leave the polynomial to guess.
_LARGEST_GAP = 0.25


DEGREE = 3
# Fewer leave nearly no freedom to average noise.
FEWEST_SAMPLES = 2 * (DEGREE + 1)


class NoMotion(NamedTuple):
    """Why the inertial forces at a stamp are not known: a `Rejection` and a sentence."""

    reason: Enum
    detail: str


# Samples kept: more than a window's, and than come while a wrench waits.
_CAPACITY = 4096


class _Ring:
    """The newest samples of k values in arrays, so that a window of them is a view."""

    def __init__(self) -> None:
        self._stamps = np.zeros(2 * _CAPACITY, dtype=np.int64)
        self._values = np.zeros((0, 0))
        self._count = 0
        self.newest_ns: int | None = None

    def clear(self) -> None:
        self._count, self.newest_ns = 0, None

    def push(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            return
        if not len(self._values):
            self._values = np.zeros((2 * _CAPACITY, len(values)))
        if self._count == 2 * _CAPACITY:
            self._stamps[:_CAPACITY] = self._stamps[_CAPACITY:]
            self._values[:_CAPACITY] = self._values[_CAPACITY:]
            self._count = _CAPACITY
        self._stamps[self._count] = self.newest_ns = stamp_ns
        self._values[self._count] = values
        self._count += 1

    def window(self, first_ns: int, last_ns: int) -> tuple[np.ndarray, Array]:
        """Stamps (n,) and values (n, k) from `first_ns` to `last_ns`."""
        stamps = self._stamps[: self._count]
        rows = slice(
            int(stamps.searchsorted(first_ns)), int(stamps.searchsorted(last_ns, side="right"))
        )
        return stamps[rows], self._values[rows]


class MotionWindow:
    """Keeps one stream's samples and differentiates them at a stamp."""

    def __init__(self, parameters: GravcompParameters, topic: str) -> None:
        """`topic`: as it is called in sentences."""
        self._topic = topic
        self._polynomial = LocalPolynomial(
            parameters.motion_window_s, parameters.motion_delay_s, DEGREE
        )
        self._delay_ns = round(parameters.motion_delay_s * 1e9)
        self._lag_ns = round(parameters.motion_lag_s * 1e9)
        self._window_ns = round(parameters.motion_window_s * 1e9)
        self._gap_ns = round(_LARGEST_GAP * parameters.motion_window_s * 1e9)
        self._samples = _Ring()

    @property
    def newest_ns(self) -> int | None:
        """The newest sample's stamp."""
        return self._samples.newest_ns

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp of a wrench whose samples have come; None before the first one."""
        newest = self._samples.newest_ns
        return None if newest is None else newest - self._delay_ns + self._lag_ns

    def push(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        """Take a sample (k,); one that is not newer than the newest is dropped.

        One with a value that is not finite is kept as such: nothing is known around it.
        """
        if not math.isfinite(sum(values)):
            values = (math.nan,) * len(values)
        self._samples.push(stamp_ns, values)

    def clear(self) -> None:
        """Forget every sample."""
        self._samples.clear()

    def at(self, stamp_ns: int) -> Derivatives | NoMotion:
        """Value and derivatives (k,) at a wrench's stamp."""
        at_ns = stamp_ns - self._lag_ns
        end_ns = at_ns + self._delay_ns
        start_ns = end_ns - self._window_ns
        stamps, values = self._samples.window(start_ns, end_ns)
        if len(stamps) < FEWEST_SAMPLES:
            return self._none(
                f"holds {len(stamps)} samples of {self._topic}; {FEWEST_SAMPLES} are"
                " needed (a longer motion_window_s, or more samples a second)"
            )
        lacking = self._lacking(stamps, start_ns, end_ns)
        if lacking:
            return self._none(lacking)
        found = self._polynomial.derivatives(stamps, values, at_ns)
        if not np.isfinite(found.second.sum()):
            return self._none(f"holds a value of {self._topic} that is not finite, or jumps")
        return found

    def _lacking(self, stamps: np.ndarray, start_ns: int, end_ns: int) -> str:
        """What makes stamps (n,) too far apart to differentiate; empty if nothing."""
        before_ns, after_ns = int(stamps[0]) - start_ns, end_ns - int(stamps[-1])
        gap_ns = int((stamps[1:] - stamps[:-1]).max())
        if gap_ns > self._gap_ns:
            return f"has a gap of {gap_ns * 1e-6:.0f} ms in {self._topic}"
        if before_ns > self._gap_ns:
            return f"has no sample of {self._topic} in its first {before_ns * 1e-6:.0f} ms"
        # At the end, where it is read off, the polynomial must not hang over by more than the
        # sample that is always still to come there.
        period_ns = int(stamps[-1] - stamps[0]) // (len(stamps) - 1)
        if after_ns > max(self._delay_ns // 2, period_ns):
            return f"has no sample of {self._topic} in its last {after_ns * 1e-6:.0f} ms"
        return ""

    def _none(self, what: str) -> NoMotion:
        window_ms = self._polynomial.window_s * 1e3
        return NoMotion(
            Rejection.NO_MOTION,
            f"inertial forces are not known: the window of {window_ms:.0f} ms {what}",
        )
