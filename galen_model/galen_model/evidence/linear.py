r"""Evidence of linear hypotheses with Gaussian priors and noise.

For rows y = X w + e with weights w ~ N(0, P^-1) and noise e ~ N(0, S), the data enter by

    A = X^T S^-1 X,   r = X^T S^-1 y,   q = y^T S^-1 y + log|S| + n log 2 pi,

which add up over independent blocks. The weights' posterior is N(C r, C) with C = (A + P)^-1, and
the evidence, the density of y with w integrated out, is (C. M. Bishop, *Pattern Recognition and
Machine Learning*, 2006, section 3.5.1)

    2 log Z = log|P| - log|A + P| + r^T C r - q,

so that a wide prior costs what it should. A block b is predicted by the others with the density
Z(all) / Z(all but b).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from galen_model.arrays import Array
from galen_model.distributions import chi2_sf

LOG_2PI = float(np.log(2.0 * np.pi))


class Information(NamedTuple):
    """What rows say of k weights: A (..., k, k), r (..., k), q (...); leading axes are sets."""

    matrix: Array
    right: Array
    rest: Array

    def total(self) -> Information:
        """Sum over the last of the leading axes: the blocks together."""
        return Information(
            self.matrix.sum(axis=-3), self.right.sum(axis=-2), self.rest.sum(axis=-1)
        )

    def without_each(self) -> Information:
        """Leave out each block in turn, along the last of the leading axes."""
        whole = self.total()
        return Information(
            whole.matrix[..., None, :, :] - self.matrix,
            whole.right[..., None, :] - self.right,
            whole.rest[..., None] - self.rest,
        )


class Prior(NamedTuple):
    """Precision (..., k, k) of the weights about zero, and the logarithm of its determinant."""

    precision: Array
    log_det: Array

    @classmethod
    def of_precision(cls, precision: Array) -> Prior:
        """Make a prior from P (..., k, k)."""
        return cls(precision, np.asarray(np.linalg.slogdet(precision)[1]))

    @classmethod
    def unit(cls, size: int) -> Prior:
        """Make the prior of independent weights of about one."""
        return cls(np.eye(size), np.zeros(()))


class Posterior(NamedTuple):
    """Weights (..., k) and their covariance (..., k, k)."""

    values: Array
    covariance: Array


def log_evidence(information: Information, prior: Prior) -> Array:
    """Return log Z (...) of each set."""
    factor = np.linalg.cholesky(information.matrix + prior.precision)
    solved = np.linalg.solve(factor, information.right[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    gain = (solved**2).sum(axis=-1)
    return np.asarray(0.5 * (prior.log_det - log_det + gain - information.rest))


def posterior(information: Information, prior: Prior) -> Posterior:
    """Return the weights of each set with their covariances."""
    covariance = np.asarray(np.linalg.inv(information.matrix + prior.precision))
    return Posterior((covariance @ information.right[..., None])[..., 0], covariance)


def distance(values: Array, covariance: Array) -> Array:
    """Return v^T C^-1 v (...) of values (..., k) with covariances (..., k, k)."""
    solved = np.linalg.solve(covariance, values[..., None])[..., 0]
    return np.asarray(np.sum(values * solved, axis=-1))


def log_density(values: Array, covariance: Array) -> Array:
    """Return the log of the normal density (...) of values (..., k) about zero."""
    log_det = np.linalg.slogdet(covariance)[1]
    size = values.shape[-1]
    return np.asarray(-0.5 * (distance(values, covariance) + log_det + size * LOG_2PI))


def chance(values: Array, covariance: Array) -> float:
    """Return the probability that noise of this covariance makes as much as values (k,)."""
    return float(chi2_sf(distance(values, covariance), len(values)))
