# SPDX-License-Identifier: Apache-2.0
"""The noise floor of a channel, from the recording itself, its colour included.

Noise is taken as autoregressive,

    e_t = a_1 e_{t-1} + ... + a_p e_{t-p} + s w_t,   w white with unit variance,

with a by Yule and Walker (Box, Jenkins, *Time Series Analysis*, 1976, section 3.2.2) from what is
left of the residual after a smooth curve in each stretch, and the order p by the smallest BIC with
twice its penalty: colour that isn't sure is taken for chance.
Taking the curve away makes the autocovariances too small. With P the projection, C the process'
covariance and D_k the shift by k samples,

    E[sum_t r_t r_{t+k}] = tr(D_k P C P),

and the process is the one whose expected sums are those that were seen: a few fixed-point steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from scipy.linalg import solve_toeplitz, toeplitz

_HIGHEST_ORDER = 4
_LONGEST = 150
_ENOUGH_PIECES = 30


@dataclass(frozen=True)
class ChannelNoise:
    """AR coefficients (p,) and the innovation's standard deviation, in the channel's unit."""

    coefficients: Array
    innovation: float

    @property
    def order(self) -> int:
        """How many coefficients."""
        return len(self.coefficients)

    @property
    def gain(self) -> float:
        """What whitening makes of a constant 1: (1 - sum a) / s."""
        return float((1.0 - self.coefficients.sum()) / self.innovation)

    def lead_s(self, step_s: float) -> float:
        """Return by how much whitening lets a slow signal come earlier.

        To first order x_t - sum a_k x_{t-k} = (1 - sum a) x(t + lead), lead = sum k a_k step / (1 -
        sum a).

        Args:
            step_s: Time between samples.

        Returns:
            The lead, s.

        """
        lags = np.arange(1, self.order + 1)
        return float(step_s * (lags @ self.coefficients) / (1.0 - self.coefficients.sum()))

    @property
    def std(self) -> float:
        """Standard deviation of a sample."""
        return float(np.sqrt(self.covariance(1)[0]))

    def covariance(self, lags: int) -> Array:
        """Return autocovariances of the process, by its spectrum.

        Args:
            lags: Number of lags, in samples, from 0 on.

        Returns:
            Autocovariances (lags,), in the channel's unit squared.

        """
        frequency = np.fft.rfftfreq(4096, 1.0 / (2.0 * np.pi))
        turns = np.exp(-1j * np.outer(frequency, np.arange(1, self.order + 1)))
        density = self.innovation**2 / np.abs(1.0 - turns @ self.coefficients) ** 2
        return np.asarray(np.fft.irfft(density, 4096)[:lags])

    def whitened(self, residual: Array) -> Array:
        """Return white rows of unit variance.

        Args:
            residual: Samples of one stretch without a gap, (n, ...), in the channel's unit.

        Returns:
            Rows of the same shape; the first `order` are NaN.

        """
        out = residual.astype(float).copy()
        for lag, coefficient in enumerate(self.coefficients, start=1):
            out[lag:] -= coefficient * residual[:-lag]
        out[: self.order] = np.nan
        return out / self.innovation


def smooth_basis(at_s: Array, knot_s: float) -> Array:
    """Return cubic B-splines over times.

    Args:
        at_s: Times in increasing order, (n,), s.
        knot_s: About how far apart knots are.

    Returns:
        Splines (n, k), k at most n / 3 from 12 times on; of fewer than 8 a constant.

    """
    from scipy.interpolate import BSpline

    length = at_s[-1] - at_s[0]
    pieces = int(min(max(np.floor(length / knot_s), 1), max(len(at_s) // 3 - 3, 1)))
    inner = np.linspace(at_s[0], at_s[-1], pieces + 1)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    if length <= 0.0 or len(at_s) < 8:
        return np.ones((len(at_s), 1))
    basis = BSpline.design_matrix(np.clip(at_s, inner[0], inner[-1]), knots, 3)
    return np.asarray(basis.toarray())


def channel_noise(
    stretches: list[tuple[Array, Array]], knot_s: float, quantum_floor: float = 1e-12
) -> list[ChannelNoise]:
    """Return the noise of each channel, from stretches of its residual.

    Args:
        stretches: Times (n,), s, and residuals (n, k) in the channels' units, each without a gap.
        knot_s: The smooth curve that is taken away bends this often; what is slower isn't noise
            here.
        quantum_floor: Innovation of a channel that doesn't vary at all (frozen), in its unit.

    Returns:
        One for each of k channels; empty where no stretch is long enough.

    """
    lags = _HIGHEST_ORDER + 1
    pieces: list[tuple[Array, Array]] = []
    for at_s, residual in stretches:
        # Projections are dense, so long stretches go in parts.
        for rows in np.array_split(np.arange(len(at_s)), max(1, len(at_s) // _LONGEST)):
            if len(rows) >= 3 * lags:
                basis, _ = np.linalg.qr(smooth_basis(at_s[rows], knot_s))
                pieces.append((basis, residual[rows] - basis @ (basis.T @ residual[rows])))
    if not pieces:
        return []
    count = sum(len(left) for _, left in pieces)
    sums = np.array(
        [
            sum(np.einsum("ij,ij->j", left[lag:], left[: len(left) - lag]) for _, left in pieces)
            for lag in range(lags)
        ]
    )
    return [_fitted(column, pieces, count, quantum_floor) for column in sums.T]


def _fitted(
    sums: Array, pieces: list[tuple[Array, Array]], count: int, floor: float
) -> ChannelNoise:
    """Return the noise whose sums of products, after the projection, are those that were seen."""
    covariance = sums / count
    for turn in range(4):
        noise = _autoregressive(covariance, count, floor)
        if turn and not noise.order:
            # White so far: only its variance has to be corrected, which the first turn did.
            break
        process = noise.covariance(_LONGEST * 2)
        expected = _expected_sums(pieces, process, len(sums))
        covariance = covariance + (sums - expected) / count
    return _autoregressive(covariance, count, floor)


def _expected_sums(pieces: list[tuple[Array, Array]], process: Array, lags: int) -> Array:
    """E[sum_t r_t r_{t+k}] for k < lags, r = (1 - B B^T) e and cov(e_t, e_s) = process[|t - s|].

    Pieces are much alike: some of them stand for all.
    """
    total = np.zeros(lags)
    some = pieces[:: -(-len(pieces) // _ENOUGH_PIECES)]
    for basis, _ in some:
        size = len(basis)
        cov = toeplitz(process[:size])
        half = basis.T @ cov
        left = cov - basis @ half - half.T @ basis.T + basis @ (half @ basis) @ basis.T
        total += [np.trace(left, offset=lag) for lag in range(lags)]
    return total * sum(len(one) for _, one in pieces) / sum(len(one) for _, one in some)


def _autoregressive(covariance: Array, count: int, floor: float) -> ChannelNoise:
    variance = float(covariance[0])
    if variance <= floor**2:
        return ChannelNoise(np.zeros(0), floor)
    best = ChannelNoise(np.zeros(0), float(np.sqrt(variance)))
    best_score = count * np.log(variance)
    for order in range(1, _HIGHEST_ORDER + 1):
        try:
            coefficients = solve_toeplitz(covariance[:order], covariance[1 : order + 1])
        except np.linalg.LinAlgError:  # one sample tells the next exactly
            break
        innovation = variance - float(coefficients @ covariance[1 : order + 1])
        if innovation <= 0.0 or np.abs(np.roots([1.0, *(-coefficients)])).max() >= 0.995:
            break
        score = count * np.log(innovation) + 2.0 * order * np.log(count)
        if score < best_score:
            best, best_score = ChannelNoise(coefficients, float(np.sqrt(innovation))), score
    return best
