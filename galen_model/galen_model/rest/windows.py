# SPDX-License-Identifier: Apache-2.0
"""Half-second windows of a live stream in which the arm was still, and whether the wrench was.

Live, there is no recording to look back into, as `galen_model.rest.binned` does: a window is
judged when it is full, from what came before. The arm is still while all angles stay within a
narrow band; a window that a motion or a gap breaks is dropped, and the time right after a motion
(the arm rings, the joint stamps lag) is left out.

The wrench is steady when it scatters no more than the sensor itself. A hand trembles: the force of
a steady human grip varies by 2 to 5 % of itself, some of it at 8 to 12 Hz, the rest below 2 Hz
(Enoka et al., *J. Biomech.* 36, 2003), so that both scatters are looked at, that of samples within
a fifth of a window and that of the fifths' means. What the sensor's own scatters are is learned
from the quietest quarter of the still windows: noise is always there, a hand is not. A hand that
trembles for more than three quarters of the still time can't be recognised by its trembling.

Pushing a sample costs a few appends; the arithmetic is done once a window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.rest.segments import ENCODER_STEP, allowed_travel

WINDOW_S = 0.5
_RIM_S = 0.3
_GAP_S = 0.25
_MAX_RATE_RAD_S = 1e-3
_BAND_RAD = float(allowed_travel(_MAX_RATE_RAD_S, WINDOW_S, ENCODER_STEP[1], steps=2.0))
_CELLS = 5
_FEWEST_SAMPLES = 4 * _CELLS
_REMEMBERED = 200
_FEWEST_REMEMBERED = 8
_QUIETEST = 0.25
_FALSE_UNSTEADY = 1e-4
# The level itself is learned, and neighbouring samples of a filtered sensor hang together.
_MARGIN = 1.3


class StillWindow(NamedTuple):
    """Mean of a wrench (6,) over a window with the arm at rest, N and N.m.

    std_of_mean (6,): by the sensor's own noise as it was learned; angles (k,): their mean,
    rad; steady: whether the wrench scattered no more than the sensor does.
    """

    start_ns: int
    end_ns: int
    samples: int
    mean: Array
    std_of_mean: Array
    angles: tuple[float, ...]
    steady: bool


class StillWindows:
    """Takes samples one by one; gives a window whenever one is full."""

    def __init__(self) -> None:
        self._level = _NoiseLevel()
        self.clear()

    def clear(self) -> None:
        """Forget the samples and the sensor's noise."""
        self._level.clear()
        self._last_ns: int | None = None
        self._rim_end_ns: int | None = None
        self.drop()

    def drop(self) -> None:
        """Begin the window anew."""
        self._stamps: list[int] = []
        self._wrenches: list[Array] = []
        self._first: tuple[float, ...] = ()

    def push(self, stamp_ns: int, angles: Sequence[float], wrench: Array) -> StillWindow | None:
        """Take one sample; give a window when one is full.

        A stamp that is not later than the one before is passed over.

        Args:
            stamp_ns: time of the sample.
            angles: joints that count (k,), rad.
            wrench: (6,), N and N.m; it must not be written into later.

        Returns:
            The window that this sample completes, or None.

        """
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is not None and stamp_ns <= last_ns:
            self._last_ns = last_ns
            return None
        if not self._first:  # dropped: away from home, the arm counts as moved
            self._first = (0.0,) * len(angles)
        moved = not self._near(angles)
        if last_ns is None or moved or stamp_ns - last_ns > _GAP_S * 1e9:
            self.drop()
            self._first = tuple(angles)
            if last_ns is not None and moved:
                self._rim_end_ns = stamp_ns + round(_RIM_S * 1e9)
        if self._rim_end_ns is not None:
            if stamp_ns < self._rim_end_ns:
                return None
            self._rim_end_ns = None
        stamps = self._stamps
        stamps.append(stamp_ns)
        self._wrenches.append(wrench)
        if stamp_ns - stamps[0] < WINDOW_S * 1e9 or len(stamps) < _FEWEST_SAMPLES:
            return None
        window = self._window(angles)
        self.drop()
        self._first = tuple(angles)
        return window

    def _near(self, angles: Sequence[float]) -> bool:
        # A loop, for it runs at every sample: a generator takes twice as long.
        for now, then in zip(angles, self._first, strict=True):
            if not abs(now - then) <= _BAND_RAD:
                return False
        return True

    def _window(self, angles: Sequence[float]) -> StillWindow:
        wrenches = np.array(self._wrenches)
        count = len(wrenches)
        size = count // _CELLS
        cells = wrenches[count - size * _CELLS :].reshape(_CELLS, size, 6)
        means = cells.mean(axis=1)
        within = cells.var(axis=1, ddof=1).mean(axis=0)
        between = means.var(axis=0, ddof=1)
        steady = self._level.take(within, between, _CELLS * (size - 1))
        return StillWindow(
            self._stamps[0],
            self._stamps[-1],
            count,
            wrenches.mean(axis=0),
            self._level.std_of_mean(count),
            tuple((then + now) / 2 for then, now in zip(self._first, angles, strict=True)),
            steady,
        )


class _NoiseLevel:
    """Variances (6,) of samples within a cell and of the cells' means, as the quietest have them.

    A low quantile of many windows' variances, over what that quantile of chi-square over its
    degrees of freedom is, estimates the variance of the windows without a hand; half the sensor's
    quantum is its floor.
    """

    def __init__(self) -> None:
        self._within: deque[Array] = deque(maxlen=_REMEMBERED)
        self._between: deque[Array] = deque(maxlen=_REMEMBERED)
        self.clear()

    @property
    def known(self) -> bool:
        return len(self._within) >= _FEWEST_REMEMBERED

    def clear(self) -> None:
        self._within.clear()
        self._between.clear()
        self._floor: Array = (np.asarray(SENSOR.quantum) / 2.0) ** 2
        self._of_within, self._of_between = self._floor, self._floor

    def take(self, within: Array, between: Array, freedom: int) -> bool:
        """Learn from a still window; returns whether it was steady by what is known with it."""
        self._within.append(within)
        self._between.append(between)
        self._of_within = self._quiet(self._within, freedom)
        self._of_between = self._quiet(self._between, _CELLS - 1)
        if not self.known:
            return False
        return bool(
            np.all(within <= self._of_within * _most(freedom))
            and np.all(between <= self._of_between * _most(_CELLS - 1))
        )

    def std_of_mean(self, count: int) -> Array:
        """Return the std (6,) of a window's mean: white noise, or more by the cells."""
        return np.asarray(np.sqrt(np.maximum(self._of_within / count, self._of_between / _CELLS)))

    def _quiet(self, variances: deque[Array], freedom: int) -> Array:
        # A sort of 200 x 6 is cheaper than numpy's quantile.
        ordered = np.sort(np.array(variances), axis=0)
        low = ordered[int(_QUIETEST * (len(ordered) - 1))]
        return np.maximum(low / _quantile(_QUIETEST, freedom), self._floor)


@lru_cache(maxsize=256)
def _quantile(probability: float, freedom: int) -> float:
    """Of chi-square over its degrees of freedom."""
    return float(chi2_ppf(probability, freedom) / freedom)


def _most(freedom: int) -> float:
    return _MARGIN * _quantile(1.0 - _FALSE_UNSTEADY / 12.0, freedom)
