"""Overlapping Allan deviation of a reading, with its confidence band and fitted coefficients.

With y cells of tau_0 and their means over m neighbours, tau = m tau_0,

    AVAR(tau) = mean over i of (ybar_{i+m} - ybar_i)^2 / 2,   all starts i (overlapping)

(Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065, 2008, section 5.2.4). Cells that
are missing leave out the pairs that need them. The band is chi-squared's, with the degrees of
freedom of table 5 there, by the noise that the slope tells. IEEE Std 952-1997, annex C, has what
sensors are made of:

    AVAR = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2

white noise N (N/sqrt(Hz)), bias instability B (N), random walk K (N/sqrt(s)), ramp R (N/s); fitted
with non-negative least squares, each tau weighted by its degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from scipy.optimize import nnls

_PER_DECADE = 8
_FEWEST_PAIRS = 3  # whole, that don't overlap


@dataclass(frozen=True)
class Allan:
    """Of one channel: tau_s (k,), deviation (k,) and its 95 % band low, high (k,).

    white (unit/sqrt(Hz)), instability (unit), walk (unit/sqrt(s)), ramp (unit/s): coefficients.
    """

    tau_s: Array
    deviation: Array
    low: Array
    high: Array
    white: float
    instability: float
    walk: float
    ramp: float

    def fitted(self, tau_s: Array) -> Array:
        """Deviation (n,) that the coefficients give."""
        return np.sqrt(_basis(tau_s, 1.0 / tau_s) @ np.square(self._coefficients()))

    def _coefficients(self) -> Array:
        return np.array([self.white, self.instability, self.walk, self.ramp])


def allan_deviation(cells: Array, cell_s: float) -> Allan:
    """Of cells (n,), NaN where there is none."""
    there = np.isfinite(cells)
    total = np.concatenate([[0.0], np.cumsum(np.where(there, cells - np.nanmean(cells), 0.0))])
    number = np.concatenate([[0], np.cumsum(there)])
    longest = max(1, len(cells) // (_FEWEST_PAIRS + 1))
    steps = int(_PER_DECADE * np.log10(longest)) + 1
    rows: list[tuple[int, float, int, float]] = []
    for m in np.unique(np.round(np.logspace(0, np.log10(longest), steps)).astype(int)):
        used = number[m:] - number[:-m]
        mean = (total[m:] - total[:-m]) / np.maximum(used, 1)
        enough = 2 * used > m
        pairs = enough[m:] & enough[:-m]
        if pairs.sum() < _FEWEST_PAIRS * m and m > 1:
            continue
        if not pairs.any():
            continue
        half = float(np.mean((mean[m:] - mean[:-m])[pairs] ** 2) / 2.0)
        white = float(np.mean(1.0 / used[m:][pairs] + 1.0 / used[:-m][pairs]) / 2.0)
        rows.append((int(m), half, int(pairs.sum()) + 2 * int(m) - 1, white / cell_s))
    factor, variance, cells_used, white_part = np.array(rows).T
    tau = factor * cell_s
    deviation = np.sqrt(variance)
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(deviation, 1e-300))
    slope = np.gradient(logs, np.log(tau)) if len(tau) > 1 else np.array([-0.5])
    freedom = np.array(
        [_freedom(s, n + 1, m) for s, n, m in zip(slope, cells_used, factor, strict=True)]
    )
    low = deviation * np.sqrt(freedom / chi2_ppf(0.975, freedom))
    high = deviation * np.sqrt(freedom / chi2_ppf(0.025, freedom))
    coefficients = _fit(tau, variance, freedom, white_part)
    return Allan(tau, deviation, low, high, *np.sqrt(coefficients).tolist())


def _basis(tau: Array, white: Array) -> Array:
    return np.column_stack(
        [white, np.full(len(tau), 2.0 * np.log(2.0) / np.pi), tau / 3.0, tau**2 / 2.0]
    )


def _fit(tau: Array, variance: Array, freedom: Array, white: Array) -> Array:
    """Squares (4,) of the coefficients."""
    if not variance.max() > 0.0:  # a sensor that stands at one value
        return np.zeros(4)
    floor = float(variance.max()) * 1e-12
    expected = np.maximum(variance, floor)
    for _ in range(10):  # the error of a variance is a part of the true one, not of the measured
        weight = np.sqrt(freedom / 2.0) / expected
        basis = _basis(tau, white) * weight[:, None]
        size = np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
        squares = nnls(basis / size, variance * weight)[0] / size
        expected = np.maximum(_basis(tau, white) @ squares, floor)
    return np.asarray(squares)


def _freedom(slope: float, n: int, m: int) -> float:
    """Degrees of freedom of n phase points averaged over m (NIST SP 1065, table 5)."""
    if slope < -0.25:  # white
        value = (3.0 * (n - 1) / (2.0 * m) - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    elif slope < 0.25:  # flicker
        first = 2.0 * (n - 2) ** 2 / (2.3 * n - 4.9)
        value = first if m == 1 else 5.0 * n**2 / (4.0 * m * (n + 3.0 * m))
    else:  # walk
        shrink = ((n - 1) ** 2 - 3.0 * m * (n - 1) + 4.0 * m**2) / (n - 3.0) ** 2
        value = (n - 2) / m * shrink
    return max(float(value), 1.0)
