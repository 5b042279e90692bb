"""The linear picture of whitened rows: nuisance columns, effects' columns, and their evidence.

Rows are r = N nu + T theta + e with e white of unit variance. N holds the unknowns that are no gap
and what a healthy arm's tolerances do, both with a prior of mean zero; T an effect's change of
the rows by its numbers, with the prior theta ~ N(0, s^2 diag(typical^2)). Against the hypothesis
without the effect the evidence is (Laplace's, exact in the linear case; MacKay, *Information
Theory, Inference, and Learning Algorithms*, 2003, chapter 28)

    log B = 1/2 b^T (G + L^-1)^-1 b - 1/2 log det(1 + L G),    b = T^T P r,  G = T^T P T,

with P what is left after fitting N, L the prior's covariance. How large an effect is isn't known
beforehand: B is averaged over s = 0.1 ... 10.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from galen_model.arrays import Array

SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)


@dataclass(frozen=True)
class Evidence:
    """What columns are worth.

    log_bayes: log B, averaged over scales; theta (p,), covariance (p, p): posterior at the best
    scale; gain: by how much the sum of squares falls.
    """

    log_bayes: float
    theta: Array
    covariance: Array
    gain: float


def factor(gram: Array) -> tuple[Array, bool]:
    """Cholesky's factor of a gram matrix (p, p), for `cho_solve`.

    Where columns are alike to rounding, each gets 1e-9 of itself more: they then share what they
    explain.
    """
    try:
        return cho_factor(gram)
    except np.linalg.LinAlgError:
        return cho_factor(gram + np.diag(1e-9 * np.abs(np.diag(gram))))


class Background:
    """N with its prior: what is fitted beside every hypothesis."""

    def __init__(self, columns: Array, prior_std: Array) -> None:
        """Of columns (N, n), prior_std (n,), infinite for none."""
        self._set(columns, prior_std, columns.T @ columns)
        self._base: Background | None = None

    def _set(self, columns: Array, prior_std: Array, products: Array) -> None:
        self.columns = columns
        self.prior_std = prior_std
        self.precision = np.where(np.isfinite(prior_std), 1.0 / prior_std**2, 0.0)
        self._products = products
        gram = products + np.diag(self.precision)
        # A column that shows nowhere has no information and, without prior, no value either.
        silent = np.diag(gram) <= 0.0
        gram[silent, silent] = 1.0
        self._factor = factor(gram)
        self._remembered: dict[int, tuple[Array, Array, Array]] = {}

    def with_free(self, more: Array) -> Background:
        """Add columns (N, m) without a prior; what is remembered counts there as well."""
        cross = self.columns.T @ more
        extended = Background.__new__(Background)
        extended._set(
            np.concatenate([self.columns, more], axis=1),
            np.concatenate([self.prior_std, np.full(more.shape[1], np.inf)]),
            np.block([[self._products, cross], [cross.T, more.T @ more]]),
        )
        extended._base = self
        return extended

    def remember(self, columns: Array) -> None:
        """Keep the products of columns (N, p), this very array, that will be asked for often."""
        products = self.columns.T @ columns, columns.T @ columns
        self._remembered[id(columns)] = (columns, *products)

    def _products_with(self, columns: Array) -> tuple[Array, Array]:
        """N^T T (n, p) and T^T T (p, p)."""
        known = self._remembered.get(id(columns))
        if known is not None:
            return known[1], known[2]
        if self._base is not None and id(columns) in self._base._remembered:
            cross, gram = self._base._products_with(columns)
            more = self.columns[:, len(cross) :]
            return np.concatenate([cross, more.T @ columns]), gram
        return self.columns.T @ columns, columns.T @ columns

    def solve(self, projections: Array) -> Array:
        """(N^T N + prior)^-1 of N^T times something, (n, ...)."""
        return np.asarray(cho_solve(self._factor, projections))

    def fit(self, rows: Array) -> Array:
        """Fit nu (n,) of rows (N,)."""
        return self.solve(self.columns.T @ rows)

    def penalty(self, nu: Array) -> float:
        """What the prior adds to the sum of squares."""
        return float(self.precision @ nu**2)

    def sum_of_squares(self, rows: Array) -> float:
        """Tell r^T P r with the prior's share: rows (N,) after the fit."""
        projected = self.columns.T @ rows
        return float(rows @ rows - projected @ self.solve(projected))

    def reduced(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """G = T^T P T (p, p) and b = T^T P r (p,)."""
        cross, products = self._products_with(columns)
        back = self.solve(cross)
        gram = products - cross.T @ back
        return gram, columns.T @ rows - back.T @ (self.columns.T @ rows)


def evidence(gram: Array, projection: Array, typical: Array) -> Evidence:
    """Of columns with G (p, p), b (p,) and typical sizes (p,)."""
    return evidences(gram[None], projection[None], typical)[0]


def evidences(grams: Array, projections: Array, typical: Array) -> list[Evidence]:
    """Of m sets of columns with G (m, p, p) and b (m, p), all with the same typical sizes (p,).

    In the axes in which L^1/2 G L^1/2 is diagonal, d, every scale is a sum over axes.
    """
    size, vectors = np.linalg.eigh(grams * np.outer(typical, typical))
    size = np.maximum(size, 0.0)
    along = np.einsum("mij,mi->mj", vectors, projections * typical)
    scales = np.array(SCALES)[:, None, None]
    logs = 0.5 * np.sum(along**2 / (scales**-2.0 + size) - np.log1p(scales**2 * size), axis=-1)
    best = scales[np.argmax(logs, axis=0), 0, 0]
    inverse = 1.0 / (best[:, None] ** -2.0 + size)
    theta = np.einsum("mij,mj->mi", vectors, along * inverse) * typical
    gain = np.sum(along**2 * inverse * (2.0 - size * inverse), axis=1)
    mean = logsumexp(logs, axis=0) - np.log(len(SCALES))
    covariance = np.einsum("mij,mj,mkj->mik", vectors, inverse, vectors) * np.outer(
        typical, typical
    )
    return [
        Evidence(float(log), one, spread, float(more))
        for log, one, spread, more in zip(mean, theta, covariance, gain, strict=True)
    ]
