# SPDX-License-Identifier: Apache-2.0
"""Evidence of linear hypotheses with Gaussian priors and noise.

For rows y = X w + e with weights w ~ N(0, P^-1) and noise e ~ N(0, S), the data enter by

    A = X^T S^-1 X,   r = X^T S^-1 y,   q = y^T S^-1 y + log|S| + n log 2 pi,

which add up over independent blocks. The weights' posterior is N(C r, C) with C = (A + P)^-1, and
the evidence, the density of y with w integrated out, is (C. M. Bishop, *Pattern Recognition and
Machine Learning*, 2006, section 3.5.1)

    2 log Z = log|P| - log|A + P| + r^T C r - q,

so that a wide prior costs what it should. A block b is predicted by the others with the density
Z(all) / Z(all but b).

**Whitened rows** (`Background`, `evidence`). Rows are r = N nu + T theta + e with e white of unit
variance. N holds the unknowns that are no gap and what a healthy arm's tolerances do, both with a
prior of mean zero; T an effect's change of the rows by its numbers, with the prior theta ~ N(0, s^2
diag(typical^2)). Against the hypothesis without the effect the evidence is (Laplace's, exact in the
linear case; MacKay, *Information Theory, Inference, and Learning Algorithms*, 2003, chapter 28)

    log B = 1/2 b^T (G + L^-1)^-1 b - 1/2 log det(1 + L G),    b = T^T P r,  G = T^T P T,

with P what is left after fitting N, L the prior's covariance. How large an effect is isn't known
beforehand: B is averaged over s = 0.1 ... 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.sparse import csc_array
from scipy.special import logsumexp

from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.estimation.least_squares import Information

LOG_2PI = float(np.log(2.0 * np.pi))


class Prior(NamedTuple):
    """Precision (..., k, k) of the weights about zero, and the logarithm of its determinant."""

    precision: Array
    log_det: Array

    @classmethod
    def of_precision(cls, precision: Array) -> Prior:
        """Make a prior from its precision.

        Args:
            precision: P (..., k, k), of full rank.

        Returns:
            The prior, with log|P| (...).

        """
        return cls(precision, np.asarray(np.linalg.slogdet(precision)[1]))

    @classmethod
    def unit(cls, size: int) -> Prior:
        """Make the prior of independent weights of about one.

        Args:
            size: number of weights, k.

        Returns:
            P of identity (k, k).

        """
        return cls(np.eye(size), np.zeros(()))


class Posterior(NamedTuple):
    """Weights (..., k) and their covariance (..., k, k)."""

    values: Array
    covariance: Array


def log_evidence(information: Information, prior: Prior) -> Array:
    """Compute log Z of each set.

    Args:
        information: sums over rows, leading axes (...), with log|S| + n log 2 pi in `rest`.
        prior: of the k weights.

    Returns:
        Natural logarithms (...).

    Raises:
        numpy.linalg.LinAlgError: A + P is not positive definite.

    """
    factor = np.linalg.cholesky(information.matrix + prior.precision)
    solved = np.linalg.solve(factor, information.right[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    gain = (solved**2).sum(axis=-1)
    return np.asarray(0.5 * (prior.log_det - log_det + gain - information.rest))


def posterior(information: Information, prior: Prior) -> Posterior:
    """Compute the weights of each set with their covariances.

    Args:
        information: sums over rows, leading axes (...).
        prior: of the k weights.

    Returns:
        Weights (..., k) and covariances (..., k, k).

    """
    covariance = np.asarray(np.linalg.inv(information.matrix + prior.precision))
    return Posterior((covariance @ information.right[..., None])[..., 0], covariance)


def distance(values: Array, covariance: Array) -> Array:
    """Compute v^T C^-1 v.

    Args:
        values: v (..., k).
        covariance: C (..., k, k).

    Returns:
        Squared Mahalanobis distances (...).

    """
    solved = np.linalg.solve(covariance, values[..., None])[..., 0]
    return np.asarray(np.sum(values * solved, axis=-1))


def log_density(values: Array, covariance: Array) -> Array:
    """Compute the log of the normal density about zero.

    Args:
        values: (..., k).
        covariance: (..., k, k).

    Returns:
        Natural logarithms (...).

    """
    log_det = np.linalg.slogdet(covariance)[1]
    size = values.shape[-1]
    return np.asarray(-0.5 * (distance(values, covariance) + log_det + size * LOG_2PI))


def chance(values: Array, covariance: Array) -> float:
    """Compute the probability that noise of a covariance makes as much as some values.

    Args:
        values: (k,).
        covariance: (k, k).

    Returns:
        Tail probability of chi-square with k degrees of freedom.

    """
    return float(chi2_sf(distance(values, covariance), len(values)))


SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
_ROUNDING = 1e-9


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
    """Compute Cholesky's factor of a gram matrix.

    Where columns are alike to rounding, each gets 1e-9 of itself more: they then share what they
    explain.

    Args:
        gram: (p, p), symmetric.

    Returns:
        SciPy's factor and whether it is the lower one, for `cho_solve`.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite even so.

    """
    try:
        return cho_factor(gram)
    except np.linalg.LinAlgError:
        return cho_factor(gram + np.diag(1e-9 * np.abs(np.diag(gram))))


class Background:
    """N with its prior: what is fitted beside every hypothesis, in blocks of columns."""

    def __init__(self, columns: Array, prior_std: Array) -> None:
        """Take columns and their prior.

        Args:
            columns: N (N, n).
            prior_std: (n,), infinite for none.

        """
        self._base: Background | None = None
        self._set(columns, prior_std, columns.T @ columns)

    def _set(self, block: Array | csc_array, prior_std: Array, products: Array) -> None:
        self._block = block
        self.prior_std = prior_std
        self.precision = np.where(np.isfinite(prior_std), 1.0 / prior_std**2, 0.0)
        self._products = products
        gram = products + np.diag(self.precision)
        # A column that shows nowhere has no information and, without prior, no value either.
        silent = np.diag(gram) <= 0.0
        gram[silent, silent] = 1.0
        self._factor = factor(gram)
        self._remembered: tuple[Array, Array] | None = None
        self._asked: tuple[Array, Array] | None = None

    @property
    def columns(self) -> Array:
        """N (N, n), dense."""
        own = self._block if isinstance(self._block, np.ndarray) else self._block.toarray()
        return own if self._base is None else np.concatenate([self._base.columns, own], axis=1)

    def beside(self, more: Array | csc_array, prior_std: float | Array = np.inf) -> Background:
        """Add columns; what is remembered counts there, too.

        Args:
            more: (N, m), dense or sparse.
            prior_std: of the new unknowns, one or (m,); infinite: without a prior.

        Returns:
            A background of n + m columns.

        """
        if not more.shape[1]:
            return self
        cross, own = self.dot(more), more.T @ more
        own = own if isinstance(own, np.ndarray) else own.toarray()
        extended = Background.__new__(Background)
        extended._base = self
        extended._set(
            more,
            np.concatenate([self.prior_std, np.full(more.shape[1], prior_std)]),
            np.block([[self._products, cross], [cross.T, own]]),
        )
        return extended

    def first(self, count: int) -> Background:
        """Return the background of its first columns.

        Args:
            count: How many.

        Returns:
            A background of `count` columns, nothing remembered.

        """
        base = 0 if self._base is None else len(self._base.prior_std)
        if self._base is not None and count <= base:
            return self._base.first(count)
        block, prior_std = self._block[:, : count - base], self.prior_std[base:count]
        if self._base is None:
            return Background(block, prior_std)
        return self._base.beside(block, prior_std)

    def averaged(self, means: csc_array) -> Background:
        """Average the rows, or leave some out.

        Args:
            means: M (C, N), which takes rows r (N,) to M r (C,).

        Returns:
            The background of the rows M r.

        """
        block = means @ self._block
        if self._base is None:
            return Background(block, self.prior_std)
        return self._base.averaged(means).beside(block, self.prior_std[len(self._base.prior_std) :])

    def dot(self, values: Array | csc_array) -> Array:
        """Compute N^T v.

        Args:
            values: v (N,) or (N, k), dense or sparse.

        Returns:
            (n,) or (n, k).

        """
        if self._remembered is not None and self._remembered[0] is values:
            return self._remembered[1]
        if isinstance(values, np.ndarray):
            own = self._block.T @ values
        else:
            own = (values.T @ self._block).T
            own = own if isinstance(own, np.ndarray) else own.toarray()
        return own if self._base is None else np.concatenate([self._base.dot(values), own])

    def times(self, nu: Array) -> Array:
        """Compute N nu.

        Args:
            nu: (n,) or (n, k).

        Returns:
            (N,) or (N, k).

        """
        if self._base is None:
            return np.asarray(self._block @ nu)
        first = len(self._base.prior_std)
        return np.asarray(self._base.times(nu[:first]) + self._block @ nu[first:])

    def remember(self, values: Array) -> None:
        """Keep the product with an array that will be asked for often.

        Args:
            values: (N, k); `dot` recognises this very array.

        """
        self._remembered = values, self.dot(values)

    def solve(self, projections: Array) -> Array:
        """Apply (N^T N + prior)^-1.

        Args:
            projections: N^T times something, (n, ...).

        Returns:
            (n, ...).

        """
        return np.asarray(cho_solve(self._factor, projections))

    def half(self, projections: Array) -> Array:
        """Apply L^-1, with N^T N + prior = L L^T: products of two are those with `solve`.

        Args:
            projections: N^T times something, (n, ...).

        Returns:
            (n, ...).

        """
        root, lower = self._factor
        return np.asarray(
            solve_triangular(root, projections, trans=0 if lower else "T", lower=lower)
        )

    def fit(self, rows: Array) -> Array:
        """Fit nu to rows, under the prior.

        Args:
            rows: (N,) or (N, k).

        Returns:
            nu (n,) or (n, k).

        """
        return self.solve(self.dot(rows))

    def left(self, rows: Array) -> Array:
        """Subtract what is fitted to rows.

        Args:
            rows: (N,) or (N, k).

        Returns:
            Residuals (N,) or (N, k).

        """
        return np.asarray(rows - self.times(self.fit(rows)))

    def penalty(self, nu: Array) -> float:
        """Compute what the prior adds to the sum of squares.

        Args:
            nu: (n,).

        Returns:
            Sum of (nu / prior_std)^2.

        """
        return float(self.precision @ nu**2)

    def sum_of_squares(self, rows: Array) -> float:
        """Compute r^T P r, the prior's share with it.

        Args:
            rows: r (N,), which may not be changed later.

        Returns:
            Sum of squares, of whitened rows.

        """
        projected = self.along(rows)
        return float(rows @ rows - projected @ self.solve(projected))

    def projected(self, columns: Array) -> Projected:
        """Compute what does not depend on the rows of columns beside this background.

        Args:
            columns: T (N, p).

        Returns:
            G = T^T P T and what `Projected.along` needs.

        """
        cross = self.dot(columns)
        back = self.solve(cross)
        return Projected(self, columns, back, columns.T @ columns - cross.T @ back)

    def reduced(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Compute G = T^T P T and b = T^T P r.

        Args:
            columns: T (N, p).
            rows: r (N,), which may not be changed later.

        Returns:
            G (p, p) and b (p,).

        """
        projected = self.projected(columns)
        return projected.gram, projected.along(rows)

    def along(self, rows: Array) -> Array:
        """Compute N^T r, and keep it for the next call with the same array.

        Args:
            rows: r (N,), which may not be changed later.

        Returns:
            (n,).

        """
        if self._asked is None or self._asked[0] is not rows:
            self._asked = rows, self.dot(rows)
        return self._asked[1]


class Projected(NamedTuple):
    """Columns T (N, p) beside a background: (N^T N + prior)^-1 N^T T and G = T^T P T (p, p)."""

    behind: Background
    columns: Array
    back: Array
    gram: Array

    def along(self, rows: Array) -> Array:
        """Compute b = T^T P r.

        Args:
            rows: r (N,), which may not be changed later.

        Returns:
            b (p,).

        """
        return np.asarray(self.columns.T @ rows - self.back.T @ self.behind.along(rows))


def explained(gram: Array, along: Array) -> tuple[float, int]:
    """Compute how much columns explain, and in how many directions.

    Args:
        gram: G = T^T P T of columns of norm 1, (p, p).
        along: b = T^T P r, (p,).

    Returns:
        b^T G^+ b, and the rank of G: a direction of which the background takes all but rounding
        doesn't count.

    """
    squares, ways = np.linalg.eigh(gram)
    seen = squares > _ROUNDING * len(squares)
    return float(np.sum((ways[:, seen].T @ along) ** 2 / squares[seen])), int(np.sum(seen))


def any_shape(energy: float, directions: float) -> float:
    """Compute the log evidence of something of unknown shape against white noise of unit variance.

    Its projections on n directions have any variance g beside the noise's: Zellner's prior (1986),
    with the g that fits best (E. I. George, D. P. Foster, Biometrika 87, 2000),

        log B = 1/2 (E - n - n log(E / n)),    1 + g = E / n.

    Args:
        energy: E, sum of the projections' squares.
        directions: n.

    Returns:
        log B; 0 where there is no more than the noise.

    """
    if energy <= directions:
        return 0.0
    return float(0.5 * (energy - directions - directions * np.log(energy / directions)))


def evidence(gram: Array, projection: Array, typical: Array) -> Evidence:
    """Compute what columns are worth.

    Args:
        gram: G (p, p).
        projection: b (p,).
        typical: usual sizes (p,) of their numbers theta, in theta's units.

    Returns:
        Evidence, averaged over SCALES.

    """
    return evidences(gram[None], projection[None], typical)[0]


def evidences(grams: Array, projections: Array, typical: Array) -> list[Evidence]:
    """Compute what m sets of columns are worth, each by itself.

    In the axes in which L^1/2 G L^1/2 is diagonal, d, every scale is a sum over axes.

    Args:
        grams: G (m, p, p).
        projections: b (m, p).
        typical: usual sizes (p,) of the numbers theta of every set, in theta's units.

    Returns:
        Evidence of each set, averaged over SCALES.

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
