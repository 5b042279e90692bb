"""Samples around a stamp, differentiated there, or why they can't be. No ROS."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_ros.stream.results import Rejection

from galen_gravcomp.corrections.local_polynomial import Derivatives, LocalPolynomial
from galen_gravcomp.parameters import GravcompParameters

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
