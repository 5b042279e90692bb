"""Linear least squares on poses of six channels, robust to whole poses that don't belong.

A pose is an outlier as a whole (it was touched, or the arm still moved), so its distance
d_i^2 = sum_k (r_ik / sigma_k)^2 decides over all six channels of it. The fit starts from
iteratively reweighted least squares with Tukey's bisquare on d_i (Maronna, Martin, Yohai, *Robust
Statistics*, 2006, section 5.4) with the channels' scales from the median absolute deviation, then
rejects what lies beyond the quantile of one false rejection in a hundred sweeps, of d^2 / 6 as an
F-distribution, because sigma is known no better than from the freedom that the fit leaves, and
ends as ordinary weighted least squares of the poses left, whose covariance is (A^T W A)^-1 times
nu / (nu - 2) for the nu degrees of freedom that sigma was found with.
The noise sigma_k of a channel comes from that channel's own residuals and degrees of freedom,
drawn towards the mean of its kind (force or torque) as much as ten further readings would: with
few poses a channel's own residuals alone make weights that run away (the variances' posterior
mean under an inverse-gamma prior; Smyth, *Stat. Appl. Genet. Mol. Biol.* 3, 2004, section 3).
Under twelve poses nothing is rejected: too few to say which of them don't belong.
"""

from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf, f_ppf
from galen_model.errors import IdentificationError

FALSE_REJECTIONS_PER_SWEEP = 0.01
_MAD_TO_STD = 1.4826
_ITERATIONS = 50
PRIOR_READINGS = 10.0
MIN_POSES_TO_REJECT = 12
_LEAST_SHARE_OF_KIND = 0.1


@dataclass(frozen=True)
class RobustFit:
    """Values (p,), covariance (p, p), residuals (n, 6), noise per channel sigma (6,).

    used: mask (n,) of the poses kept; distance: (n,) of every pose in units of sigma.
    """

    values: Array
    covariance: Array
    residuals: Array
    sigma: Array
    used: np.ndarray
    distance: Array


@dataclass(frozen=True)
class Prior:
    """Gaussian knowledge rows (k, p) @ values = values (k,) +- std (k,).

    The six values in `offset_columns`, if any, are zero within the noise of one reading, which the
    fit itself finds.
    """

    rows: Array
    values: Array
    std: Array
    offset_columns: slice | None = None

    def information(self, parameters: int, sigma: Array) -> tuple[Array, Array]:
        """Return its part of the normal equations: matrix (p, p) and right side (p,)."""
        weighted = self.rows.reshape(-1, parameters) / self.std[:, None] ** 2
        matrix = weighted.T @ self.rows.reshape(-1, parameters)
        if self.offset_columns is not None:
            offsets = np.arange(parameters)[self.offset_columns]
            matrix[offsets, offsets] += 1.0 / sigma**2
        return matrix, weighted.T @ self.values


NO_PRIOR = Prior(np.zeros((0, 0)), np.zeros(0), np.zeros(0))


def fit_robust(design: Array, readings: Array, prior: Prior = NO_PRIOR) -> RobustFit:
    """Fit readings (n, 6) = design (n, 6, p) @ values.

    Raises IdentificationError when the poses leave no degrees of freedom.
    """
    count, channels, parameters = design.shape
    if count * channels <= parameters:
        raise IdentificationError(f"{count} poses are too few for {parameters} parameters")
    scale = np.maximum(np.std(readings, axis=0), tiny(readings))
    if count < MIN_POSES_TO_REJECT:
        values, covariance, sigma = _weighted(design, readings, prior, scale)
        residuals = readings - design @ values
        everything = np.ones(count, dtype=bool)
        return RobustFit(
            values, covariance, residuals, sigma, everything, _distance(residuals, sigma)
        )
    values = _irls(design, readings, prior, scale)

    used = np.ones(count, dtype=bool)
    # The fit has bent towards the readings: their residuals are smaller than their noise, and
    # the noise is known no better than from the freedom left to a channel.
    freedom = max(count - parameters / channels, 1.0)
    sigma = mad_scale(readings - design @ values) * np.sqrt(count / freedom)
    cut = channels * f_ppf(1.0 - FALSE_REJECTIONS_PER_SWEEP / count, channels, freedom)
    for _ in range(_ITERATIONS):
        distance = _distance(readings - design @ values, sigma)
        next_used = distance**2 <= cut
        if next_used.sum() * channels <= parameters:
            raise IdentificationError(
                f"only {int(next_used.sum())} of {count} poses agree on a load"
            )
        settled = np.array_equal(next_used, used)
        used = next_used
        values, covariance, sigma = _weighted(design[used], readings[used], prior, sigma)
        if settled:
            break
    residuals = readings - design @ values
    return RobustFit(values, covariance, residuals, sigma, used, _distance(residuals, sigma))


def _irls(design: Array, readings: Array, prior: Prior, scale: Array) -> Array:
    """Tukey's bisquare over poses from a start by least absolute distance."""
    channels = design.shape[1]
    weights = np.ones(len(design))
    values = _solve(design, readings, prior, scale, weights)[0]
    for _ in range(_ITERATIONS):  # least absolute distance: a start that few outliers can't lead
        residuals = readings - design @ values
        scale = mad_scale(residuals)
        distance = _distance(residuals, scale)
        weights = 1.0 / np.maximum(distance, 0.1 * np.sqrt(channels))
        values = _solve(design, readings, prior, scale, weights)[0]
    cut = np.sqrt(chi2_ppf(0.9999, channels)) * 1.5
    for _ in range(_ITERATIONS):
        residuals = readings - design @ values
        scale = mad_scale(residuals)
        weights = np.clip(1.0 - (_distance(residuals, scale) / cut) ** 2, 0.0, None) ** 2
        if np.count_nonzero(weights) * channels <= design.shape[2]:
            raise IdentificationError("the poses agree on no load")
        values = _solve(design, readings, prior, scale, weights)[0]
    return values


def _weighted(
    design: Array, readings: Array, prior: Prior, sigma: Array
) -> tuple[Array, Array, Array]:
    """Least squares with each channel's own noise, found together: values, covariance, sigma."""
    weights = np.ones(len(design))
    for _ in range(_ITERATIONS):
        values, covariance = _solve(design, readings, prior, sigma, weights)
        residuals = readings - design @ values
        # effective parameters of a channel: sum of its leverages
        leverage = np.einsum("ikp,pq,ikq->k", design, covariance, design) / sigma**2
        freedom = np.maximum(len(design) - leverage, 1.0)
        squares = np.sum(residuals**2, axis=0)
        next_sigma = np.maximum(pooled_sigma(squares, freedom), tiny(readings))
        settled = np.allclose(next_sigma, sigma, rtol=1e-9)
        sigma = next_sigma
        if settled:
            break
    values, covariance = _solve(design, readings, prior, sigma, weights)
    # sigma is itself estimated: the values' errors follow Student's t, whose variance is larger
    known = freedom + PRIOR_READINGS
    return values, covariance * float(np.mean(known / (known - 2.0))), sigma


def pooled_sigma(squares: Array, freedom: Array) -> Array:
    """Noise (6,) of the channels from sums of squares and degrees of freedom, each (6,).

    Drawn towards the mean of its kind, force or torque, as `PRIOR_READINGS` more would.
    """
    kind_mean = squares.reshape(-1, 3).sum(axis=1) / freedom.reshape(-1, 3).sum(axis=1)
    drawn = squares + PRIOR_READINGS * np.repeat(kind_mean, 3)
    return np.asarray(np.sqrt(drawn / (freedom + PRIOR_READINGS)))


def _solve(
    design: Array, readings: Array, prior: Prior, sigma: Array, weights: Array
) -> tuple[Array, Array]:
    parameters = design.shape[2]
    scaled = design * (np.sqrt(weights)[:, None] / sigma)[:, :, None]
    rows = scaled.reshape(-1, parameters)
    right = (readings * np.sqrt(weights)[:, None] / sigma).reshape(-1)
    prior_matrix, prior_right = prior.information(parameters, sigma)
    information = rows.T @ rows + prior_matrix
    covariance = balanced_inverse(information)
    return covariance @ (rows.T @ right + prior_right), covariance


def balanced_inverse(information: Array) -> Array:
    """Invert information (p, p) whose columns differ by orders of magnitude (kg beside kg.m).

    Raises IdentificationError where the poses, as they are weighted, leave a parameter open.
    """
    diagonal = np.diag(information)
    if np.any(diagonal <= 0.0):
        raise IdentificationError("the poses agree on no load")
    balance = 1.0 / np.sqrt(diagonal)
    both = balance[:, None] * balance
    try:
        inverse = np.linalg.inv(information * both)
    except np.linalg.LinAlgError:
        raise IdentificationError("the poses agree on no load") from None
    return np.asarray(inverse * both, dtype=np.float64)


def mad_scale(residuals: Array) -> Array:
    """Scales (6,); where most residuals of a channel are exactly zero, a part of its kind's."""
    scale = _MAD_TO_STD * np.median(np.abs(residuals), axis=0)
    kind = np.repeat(np.sqrt(np.mean(scale.reshape(-1, 3) ** 2, axis=1)), 3)
    return np.maximum(np.maximum(scale, _LEAST_SHARE_OF_KIND * kind), tiny(residuals))


def tiny(values: Array) -> Array:
    """Return a floor that keeps noise-free channels from dividing by zero, per channel."""
    return np.maximum(np.max(np.abs(values), axis=0) * 1e-12, 1e-15)


def _distance(residuals: Array, sigma: Array) -> Array:
    return np.asarray(np.sqrt(np.sum((residuals / sigma) ** 2, axis=1)))
