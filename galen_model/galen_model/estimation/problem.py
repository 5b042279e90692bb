# SPDX-License-Identifier: Apache-2.0
"""Least squares of readings in channels whose biases are curves in time, robust to outliers.

    y_ik = X_ik x + b_k(t_i) + e_ik,    e_ik ~ N(0, sigma_k^2),   b_k = B beta_k

x are the parameters; the curves have the prior beta_k ~ N(0, sigma_k^2 Q^-1) (`curves`; constants
where nothing drifts). Given Q this is generalised least squares with the covariance
V_k = sigma_k^2 (I + B Q^-1 B'), in the form that needs no inverse of a singular Q (Woodbury): with
M = B'B + Q,

    N_k = X_k'X_k - X_k'B M^-1 B'X_k,   C = (sum N_k / sigma_k^2)^-1,   x = C sum (...) / sigma_k^2
    beta_k = M^-1 B'(y_k - X_k x)

so that C, the covariance of x, holds what the curves cost.

**Noise.** sigma_k^2 is the restricted maximum likelihood's (Harville, *J. Am. Stat. Assoc.* 72,
1977): (r'r + beta'Q beta) over the freedom left, drawn towards the mean of its kind (force or
torque) as much as ten further readings would: with few readings a channel's own residuals alone
make weights that run away (the variances' posterior mean under an inverse-gamma prior; Smyth,
*Stat. Appl. Genet. Mol. Biol.* 3, 2004, section 3). The covariance is (A^T W A)^-1 times
nu / (nu - 2) for the nu degrees of freedom that sigma was found with.

**Outliers.** A reading is an outlier as a whole (the tool was touched, or the arm still moved), so
its distance d_i^2 = sum_k (r_ik / sigma_k)^2 decides over all its channels, with r studentised,
r / sqrt(1 - h), h the leverage of a reading on its own fitted value, because a curve bends towards
what it is to be compared with. The fit starts from iteratively reweighted least squares with
Tukey's bisquare on d_i (Maronna, Martin, Yohai, *Robust Statistics*, 2006, section 5.4) with the
channels' scales from the median absolute deviation, rejects what lies beyond the quantile of one
false rejection in a hundred sweeps, of d^2 / 6 as an F-distribution, because sigma is known no
better than from the freedom that the fit leaves, and ends as weighted least squares of the readings
that remain. Under twelve readings nothing is rejected: too few to say which of them don't belong. A
hand that stays over several readings looks like a drift, and no fit of this kind distinguishes
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf, f_ppf
from galen_model.errors import IdentificationError
from galen_model.estimation.curves import CONSTANT, BiasBasis, BiasShape, Shapes

PRIOR_READINGS = 10.0
MIN_POSES_TO_REJECT = 12
_FALSE_REJECTIONS_PER_SWEEP = 0.01
_MAD_TO_STD = 1.4826
_LEAST_SHARE_OF_KIND = 0.1
_ITERATIONS = 30
_LEAST_CHANGE = 1e-3  # of a weight
_NEAREST_DISTANCE = 0.1 * np.sqrt(6)
_LARGEST_DISTANCE = 1.5 * np.sqrt(chi2_ppf(0.9999, 6))


@dataclass(frozen=True)
class Known:
    """Gaussian knowledge beforehand: rows (k, p) @ x = values (k,) +- std (k,)."""

    rows: Array
    values: Array
    std: Array

    @property
    def whitened(self) -> Array:
        """Rows (k, p) over their standard deviations."""
        return self.rows / self.std[:, None]

    def beside(self, more: int) -> Known:
        """Add further parameters to x, of which nothing is known beforehand.

        Args:
            more: how many, after those of `rows`.

        Returns:
            The same knowledge with rows (k, p + more).

        """
        return replace(self, rows=np.pad(self.rows, ((0, 0), (0, more))))


@dataclass(frozen=True)
class Problem:
    """n readings of c channels that are linear in p parameters.

    Args:
        design: (n, c, p), without the biases.
        readings: (n, c).
        time_s: (n,) when each was taken.
        segment: (n,) which sweep it belongs to, from 0 on. Each sweep has biases of its own.
        known: what is known of x beforehand, or None.
        zeroed: the sensor was zeroed just before the only sweep's first reading, so that its bias
            there is zero within one reading's noise.
        temperature_c: (n,), or None.
        shapes: of the channels' biases.

    """

    design: Array
    readings: Array
    time_s: Array
    segment: np.ndarray
    known: Known | None = None
    zeroed: bool = False
    temperature_c: Array | None = None
    shapes: Shapes = (CONSTANT,) * 6
    _bases: dict[BiasShape, tuple[BiasBasis, Array, Array]] = field(
        default_factory=dict, repr=False, compare=False
    )

    @classmethod
    def untimed(cls, design: Array, readings: Array) -> Problem:
        """Make the problem of readings of one sweep whose biases are constant.

        Args:
            design: (n, 6, p), without the biases.
            readings: (n, 6).

        Returns:
            The problem, the readings at 0, 1, ... s.

        """
        return cls(design, readings, np.arange(float(len(design))), np.zeros(len(design), int))

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.readings)

    def under(self, shapes: Shapes) -> Problem:
        """Change the shapes of the biases.

        Args:
            shapes: (c,) of the channels.

        Returns:
            The problem of the same readings.

        """
        return replace(self, shapes=shapes)

    @cached_property
    def by_channel(self) -> Array:
        """The design, (c, n, p)."""
        return np.ascontiguousarray(self.design.transpose(1, 0, 2))

    def basis(self, shape: BiasShape) -> tuple[BiasBasis, Array, Array]:
        """Compute the curves of a shape; they are kept for the next call.

        Args:
            shape: of a channel's bias.

        Returns:
            The curves, B (n, width) at the readings, and Q (width, width), which holds the zeroing.

        """
        if shape not in self._bases:
            basis = BiasBasis(shape, self.time_s, self.segment, self.temperature_c)
            rows = basis.rows(self.time_s, self.segment, self.temperature_c)
            penalty = basis.penalty()
            if self.zeroed:  # one more reading of the bias alone, which is zero
                start = rows[int(np.argmin(self.time_s))]
                penalty = penalty + np.outer(start, start)
            self._bases[shape] = basis, rows, penalty
        return self._bases[shape]

    def solve(self, weights: np.ndarray) -> Equations:
        """Make the normal equations for given weights of the readings.

        Args:
            weights: (n,), 0 to 1, or a mask; (..., n) for as many fits at once.

        Returns:
            The equations.

        Raises:
            IdentificationError: the weights leave a curve of a sweep open.

        """
        return Equations(self, np.asarray(weights, dtype=float))

    def robust(self) -> Fit:
        """Fit the readings that agree; all where they are too few to reject any.

        Returns:
            The fit.

        Raises:
            IdentificationError: too few readings agree, or they leave a parameter open.

        """
        used = np.ones(len(self), dtype=bool)
        if self.readings.size <= self._unknowns:
            raise IdentificationError(
                f"{len(self)} poses are too few for {self._unknowns} parameters"
            )
        if len(self) >= MIN_POSES_TO_REJECT:
            used = self.agreeing()
        return self.fit(used)

    def fit(self, used: np.ndarray, *, equal: bool = False) -> Fit:
        """Fit some of the readings.

        Args:
            used: mask (n,).
            equal: all channels weigh alike, as in plain least squares, whatever their noise; the
                covariance holds it all the same.

        Returns:
            Values and covariance, with residuals and distances of all readings.

        Raises:
            IdentificationError: where they leave a parameter open.

        """
        equations = self.solve(used)
        if equal:
            values, bread = equations.values(np.ones(self.readings.shape[1]))
            sigma, freedom = equations.noise(values, bread, np.ones(self.readings.shape[1]))
            meat = np.einsum("kij,k->ij", equations.information, sigma**2)
            settled = Settled(values, bread @ meat @ bread, sigma, freedom)
        else:
            settled = equations.settle()
        known = settled.freedom + PRIOR_READINGS
        # sigma is itself estimated: the values' errors follow Student's t, whose variance is larger
        wider = float(np.mean(known / (known - 2.0)))
        values, covariance = equations.with_ends(settled)
        residuals = equations.residuals(settled.values)
        growth = np.ones(len(settled.values))
        if any(shape != CONSTANT for shape in self.shapes):
            constant = self.under((CONSTANT,) * len(self.shapes)).solve(used)
            variance = np.diag(constant.values(settled.sigma)[1])
            if np.any(np.diag(settled.covariance) <= 0.0) or np.any(variance <= 0.0):
                # rounding: nothing but the prior holds a parameter
                raise IdentificationError("the poses agree on no load")
            growth = np.sqrt(np.diag(settled.covariance) / variance)
        return Fit(
            values,
            covariance * wider,
            residuals,
            settled.sigma,
            used,
            equations.distance(settled),
            growth,
            equations.bias(settled.values),
            self.shapes,
            tuple(equations.curves(settled.values)),
        )

    @property
    def _unknowns(self) -> int:
        """Number of parameters and of what no prior holds of the curves."""
        channels, parameters = self.design.shape[1:]
        return int(parameters + channels * self._free)

    @property
    def _free(self) -> int:
        return max(self.basis(shape)[0].free for shape in set(self.shapes))

    def agreeing(self) -> np.ndarray:
        """Find the readings that agree on one x: bisquare, then a limit.

        Returns:
            Mask (n,).

        Raises:
            IdentificationError: where too few agree.

        """
        count, channels = self.readings.shape
        sigma = np.maximum(np.std(self.readings, axis=0), _tiny(self.readings))
        weights = np.ones(count)
        # The first is a start that few outliers can't lead.
        for weights_of in (_least_absolute, _bisquare):
            for _ in range(_ITERATIONS):
                equations = self.solve(weights)
                values, covariance = equations.values(sigma)
                studentised = equations.studentised(equations.residuals(values), covariance, sigma)
                sigma = _mad_scale(studentised)
                distance = _norm(studentised / sigma)
                before, weights = weights, weights_of(distance)
                if np.abs(weights - before).max() < _LEAST_CHANGE:
                    break
        freedom = max(count - self._unknowns / channels, 1.0)
        limit = channels * f_ppf(1.0 - _FALSE_REJECTIONS_PER_SWEEP / count, channels, freedom)
        used = distance**2 <= limit
        for _ in range(_ITERATIONS):
            if used.sum() * channels <= self._unknowns:
                raise IdentificationError(
                    f"only {int(used.sum())} of {count} poses agree on a load"
                )
            equations = self.solve(used)
            next_used = equations.distance(equations.settle()) ** 2 <= limit
            if np.array_equal(next_used, used):
                break
            used = next_used
        return used


class Settled(NamedTuple):
    """Values x (p,), their covariance (p, p), noise and freedom (c,) of the channels."""

    values: Array
    covariance: Array
    sigma: Array
    freedom: Array

    @property
    def std(self) -> Array:
        """Standard deviations of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Fit:
    """What was found.

    values: (p + c segments,) x, then each sweep's biases at its last reading; covariance: of all.
    residuals: (n, c); sigma: (c,) noise of a reading; used: mask (n,) of the readings kept;
    distance: (n,) studentised, of every reading, in units of sigma. growth: (p,) how many times
    larger the drift of the biases makes the standard deviations of x. bias: (n, c) at the readings;
    shapes, curves: of the channels' biases.
    """

    values: Array
    covariance: Array
    residuals: Array
    sigma: Array
    used: np.ndarray
    distance: Array
    growth: Array
    bias: Array
    shapes: Shapes
    curves: tuple[tuple[BiasBasis, Array], ...]

    @property
    def std(self) -> Array:
        """Standard deviations of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def bias_at(
        self, time_s: Array, segment: np.ndarray, temperature_c: Array | None = None
    ) -> Array:
        """Compute the biases at other times.

        Args:
            time_s: (m,), on the clock of the fitted readings.
            segment: (m,) which sweep each is of.
            temperature_c: (m,); None: the part that goes with the temperature is left at zero.

        Returns:
            Biases (m, c), in the readings' units.

        """
        return np.column_stack(
            [basis.rows(time_s, segment, temperature_c) @ curve for basis, curve in self.curves]
        )


_Estimate = TypeVar("_Estimate", Settled, Fit)


class _Eliminated(NamedTuple):
    """The curves of the channels that have one shape.

    rows: B (n, width); penalty: Q; inverse: M^-1; by_design, by_readings: M^-1 B'W of the channels'
    design, (channels, width, p), and readings, (channels, width). free: design (channels, n, p)
    less what the curves can take of it. All but rows and penalty have the weights' first axes.
    """

    channels: list[int]
    basis: BiasBasis
    rows: Array
    penalty: Array
    inverse: Array
    by_design: Array
    by_readings: Array
    free: Array


class Equations:
    """Normal equations of a problem for given weights of its readings, the curves eliminated.

    Weights (..., n) make as many equations; values, covariances, noise and all that follows of them
    have the same first axes.
    """

    def __init__(self, problem: Problem, weights: Array) -> None:
        self.problem = problem
        self.weights = weights
        channels, parameters = problem.design.shape[1:]
        self.information = np.zeros((*weights.shape[:-1], channels, parameters, parameters))
        """N_k"""
        self.right = np.zeros((*weights.shape[:-1], channels, parameters))
        self._eliminated = [
            self._eliminate(shape, [k for k in range(channels) if problem.shapes[k] == shape])
            for shape in dict.fromkeys(problem.shapes)
        ]

    def _eliminate(self, shape: BiasShape, channels: list[int]) -> _Eliminated:
        basis, rows, penalty = self.problem.basis(shape)
        weighted = rows.T * self.weights[..., None, :]
        moment = weighted @ rows + penalty
        try:
            np.linalg.cholesky(moment)
            inverse: Array = np.asarray(np.linalg.inv(moment), dtype=np.float64)
        # a sweep all of whose readings were weighted to nothing, or numbers without end
        except np.linalg.LinAlgError:
            raise IdentificationError("the poses agree on no load") from None
        onto = inverse @ weighted
        readings = self.problem.readings[:, channels]
        design = self.problem.by_channel
        if len(channels) < len(design):
            design = design[channels]
        by_design = onto[..., None, :, :] @ design
        free = design - rows @ by_design
        weighted_free = np.swapaxes(free * self.weights[..., None, :, None], -1, -2)
        self.information[..., channels, :, :] = weighted_free @ design
        self.right[..., channels, :] = (weighted_free @ readings.T[:, :, None])[..., 0]
        by_readings = np.swapaxes(onto @ readings, -1, -2)
        return _Eliminated(channels, basis, rows, penalty, inverse, by_design, by_readings, free)

    def values(self, sigma: Array) -> tuple[Array, Array]:
        """Solve for x under given noise of the channels.

        Args:
            sigma: (c,), in the channels' units.

        Returns:
            x (p,) and its covariance (p, p).

        Raises:
            IdentificationError: the weighted readings leave a parameter open.

        """
        information = np.einsum("...kij,...k->...ij", self.information, 1.0 / sigma**2)
        right = _sum(1.0 / sigma**2, self.right)
        known = self.problem.known
        if known is not None:
            information = information + known.whitened.T @ known.whitened
            right = right + known.whitened.T @ (known.values / known.std)
        covariance = _balanced_inverse(information)
        return _times(covariance, right), covariance

    def settle(self, tolerance: float = 1e-9, sigma: Array | None = None) -> Settled:
        """Find x, its covariance, and each channel's noise and freedom together.

        Args:
            tolerance: largest relative change of sigma in the last step.
            sigma: (c,) where to begin; None: the readings' scatter.

        Returns:
            What was found, also where it has not settled after the most steps.

        Raises:
            IdentificationError: the weighted readings leave a parameter open.

        """
        readings = self.problem.readings
        if sigma is None:
            sigma = np.maximum(np.std(readings, axis=0), _tiny(readings))
        sigma = np.broadcast_to(sigma, (*self.weights.shape[:-1], len(sigma)))
        freedom = np.zeros_like(sigma)
        settled = np.zeros((*self.weights.shape[:-1], 1), dtype=bool)
        for _ in range(_ITERATIONS):
            values, covariance = self.values(sigma)
            found, free = self.noise(values, covariance, sigma)
            change = np.abs(found - sigma)
            near = np.all(change <= tolerance * sigma, axis=-1, keepdims=True)
            sigma = np.where(settled, sigma, found)
            freedom = np.where(settled, freedom, free)
            settled = settled | near
            if np.all(settled):
                break
        return Settled(*self.values(sigma), sigma, freedom)

    def noise(self, values: Array, covariance: Array, sigma: Array) -> tuple[Array, Array]:
        """Compute the channels' noise and freedom at given x.

        Args:
            values: x (p,).
            covariance: of x, (p, p).
            sigma: (c,) noise that the covariance was computed with.

        Returns:
            Noise (c,), in the channels' units, and degrees of freedom (c,).

        """
        squares = _sum(self.weights, self.residuals(values) ** 2)
        free = np.empty(squares.shape[-1])
        for part in self._eliminated:
            curve = self._curve(part, values)
            squares[..., part.channels] += np.sum((curve @ part.penalty) * curve, axis=-1)
            free[part.channels] = part.basis.free
        taken = np.einsum("...kij,...ji->...k", self.information, covariance) / sigma**2
        count = np.count_nonzero(self.weights, axis=-1, keepdims=True) + self.problem.zeroed
        freedom = np.maximum(count - free - taken, 1.0)
        return np.maximum(_pooled(squares, freedom), _tiny(self.problem.readings)), freedom

    def _curve(self, part: _Eliminated, values: Array) -> Array:
        """Return beta (channels, width)."""
        return np.asarray(part.by_readings - _times(part.by_design, values[..., None, :]))

    def curves(self, values: Array) -> Iterator[tuple[BiasBasis, Array]]:
        """Compute the channels' curves at given x.

        Args:
            values: x (p,).

        Returns:
            An iterator over the channels, of each the basis and beta (width,).

        """
        found = {
            channel: (part.basis, curve)
            for part in self._eliminated
            for channel, curve in zip(part.channels, self._curve(part, values), strict=True)
        }
        return (found[channel] for channel in range(len(found)))

    def bias(self, values: Array) -> Array:
        """Compute the curves at the readings.

        Args:
            values: x (p,).

        Returns:
            Biases (n, c), in the readings' units.

        """
        bias = np.empty((*values.shape[:-1], *self.problem.readings.shape))
        for part in self._eliminated:
            curve = self._curve(part, values)
            bias[..., part.channels] = part.rows @ np.swapaxes(curve, -1, -2)
        return bias

    def residuals(self, values: Array) -> Array:
        """Subtract from the readings what x and the curves give.

        Args:
            values: x (p,).

        Returns:
            Residuals (n, c), in the readings' units.

        """
        readings = self.problem.readings
        of_design = values @ self.problem.design.reshape(readings.size, -1).T
        of_design = of_design.reshape(*values.shape[:-1], *readings.shape)
        return np.asarray(readings - of_design - self.bias(values))

    def leverage(self, covariance: Array, sigma: Array) -> Array:
        """Compute the variance of what is fitted to a reading, in units of sigma squared.

        Args:
            covariance: of x, (p, p).
            sigma: (c,) noise of the channels.

        Returns:
            h (n, c), of a reading of weight one.

        """
        leverage = np.empty((*sigma.shape[:-1], *self.problem.readings.shape))
        for part in self._eliminated:
            of_x = np.sum((part.free @ covariance[..., None, :, :]) * part.free, axis=-1)
            of_x = np.swapaxes(of_x, -1, -2) / sigma[..., None, part.channels] ** 2
            of_curve = np.sum((part.rows @ part.inverse) * part.rows, axis=-1)
            leverage[..., part.channels] = np.maximum(of_x, 0.0) + of_curve[..., None]
        return leverage

    def studentised(self, residuals: Array, covariance: Array, sigma: Array) -> Array:
        """Divide residuals by the root of 1 - h; of a reading without weight, of 1 + h.

        Args:
            residuals: (n, c).
            covariance: of x, (p, p).
            sigma: (c,) noise of the channels.

        Returns:
            Residuals (n, c), still in the readings' units.

        """
        own, weights = self.leverage(covariance, sigma), self.weights[:, None]
        variance = np.where(weights > 0.0, 1.0 - own * weights, 1.0 + own)
        return residuals / np.sqrt(np.maximum(variance, 1e-3))

    def distance(self, found: Settled) -> Array:
        """Compute how far off each reading is, over its channels, in standard deviations.

        Args:
            found: x with its covariance and the channels' noise.

        Returns:
            Distances (n,): root of the sum of squares of the studentised residuals over sigma.

        """
        residuals = self.residuals(found.values)
        return _norm(self.studentised(residuals, found.covariance, found.sigma) / found.sigma)

    def with_ends(self, found: Settled) -> tuple[Array, Array]:
        """Append each sweep's biases at its last reading to x.

        Args:
            found: x with its covariance and the channels' noise.

        Returns:
            Values (p + c segments,), x and then the biases sweep by sweep, and their covariance.

        """
        channels, parameters = self.right.shape
        segments = self._eliminated[0].basis.segments
        # e = const - (E M^-1 B'X) x + E (beta's own error)
        slope = np.zeros((segments * channels, parameters))
        own = np.zeros((segments * channels, segments * channels))
        ends = np.zeros(segments * channels)
        for part in self._eliminated:
            at = part.basis.ends()
            curves = self._curve(part, found.values)
            spread = at @ part.inverse @ at.T
            for number, channel in enumerate(part.channels):
                places = channel + channels * np.arange(segments)
                ends[places] = at @ curves[number]
                slope[places] = -at @ part.by_design[number]
                own[np.ix_(places, places)] = found.sigma[channel] ** 2 * spread
        across = slope @ found.covariance
        return np.concatenate([found.values, ends]), np.block(
            [[found.covariance, across.T], [across, own + across @ slope.T]]
        )


def gauss_newton(
    solve: Callable[[Array], _Estimate], values: Array, largest: Array, steps: int
) -> _Estimate:
    """Find the estimate at which a problem that is linear near x agrees with itself.

    Args:
        solve: the estimate from the problem made linear at x (p,).
        values: (p,) where to begin.
        largest: (p,) sizes beyond which the problem is not linear any more.
        steps: as many are tried.

    Returns:
        The last estimate; its first p values are x.

    Raises:
        IdentificationError: where it does not settle.

    """
    for _ in range(steps):
        found = solve(values)
        change = np.abs(found.values[: len(values)] - values)
        values = found.values[: len(values)]
        if np.any(np.abs(values) > largest):
            break
        if np.all(change <= _SETTLED * found.std[: len(values)] + _ROUNDING):
            return found
    raise IdentificationError(
        "sensor and mounting: the fit does not settle; the readings fit no small rotation, gain"
        " or inclination"
    )


_SETTLED = 0.05  # of a standard deviation: the step after that is smaller by two orders
_ROUNDING = 1e-11  # kg, kg.m, rad


def _times(matrix: Array, vector: Array) -> Array:
    """Multiply matrices (..., m, n) by vectors (..., n)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _sum(weights: Array, rows: Array) -> Array:
    """Sum rows (..., n, m) by weights (..., n)."""
    return np.asarray((weights[..., None, :] @ rows)[..., 0, :])


def _pooled(squares: Array, freedom: Array) -> Array:
    """Noise (..., c) of the channels from sums of squares and degrees of freedom, each (..., c).

    Drawn towards the mean of its kind, force or torque, as `PRIOR_READINGS` more would.
    """
    kinds = (*squares.shape[:-1], -1, 3)
    kind_mean = squares.reshape(kinds).sum(axis=-1) / freedom.reshape(kinds).sum(axis=-1)
    drawn = squares + PRIOR_READINGS * np.repeat(kind_mean, 3, axis=-1)
    return np.asarray(np.sqrt(drawn / (freedom + PRIOR_READINGS)))


def _balanced_inverse(information: Array) -> Array:
    """Invert information (..., p, p) whose columns differ by orders of magnitude (kg beside kg.m).

    Raises IdentificationError where the readings, as they are weighted, leave a parameter open.
    """
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    if np.any(diagonal <= 0.0):
        raise IdentificationError("the poses agree on no load")
    balance = 1.0 / np.sqrt(diagonal)
    both = balance[..., :, None] * balance[..., None, :]
    try:
        inverse = np.linalg.inv(information * both)
    except np.linalg.LinAlgError:
        raise IdentificationError("the poses agree on no load") from None
    return np.asarray(inverse * both, dtype=np.float64)


def _least_absolute(distance: Array) -> Array:
    weights = 1.0 / np.maximum(distance, _NEAREST_DISTANCE)
    return np.asarray(weights / weights.max())


def _bisquare(distance: Array) -> Array:
    return np.asarray(np.clip(1.0 - (distance / _LARGEST_DISTANCE) ** 2, 0.0, None) ** 2)


def _mad_scale(residuals: Array) -> Array:
    """Scales (c,); where most residuals of a channel are exactly zero, a part of its kind's."""
    scale = _MAD_TO_STD * np.median(np.abs(residuals), axis=0)
    kind = np.repeat(np.sqrt(np.mean(scale.reshape(-1, 3) ** 2, axis=1)), 3)
    return np.maximum(np.maximum(scale, _LEAST_SHARE_OF_KIND * kind), _tiny(residuals))


def _tiny(values: Array) -> Array:
    """Return a floor that keeps noise-free channels from dividing by zero, per channel."""
    return np.maximum(np.max(np.abs(values), axis=0) * 1e-12, 1e-15)


def _norm(rows: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(rows**2, axis=1)))
