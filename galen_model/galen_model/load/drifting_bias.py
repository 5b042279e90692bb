"""Least squares of a load whose sensor's bias drifts while the poses are visited.

    y_ik = X_ik x + b_k(t_i) + e_ik,    e_ik ~ N(0, sigma_k^2),   b_k = B beta_k

x are the loads' moments; the six curves have the prior beta_k ~ N(0, sigma_k^2 Q^-1), with one Q
for the forces and one for the torques. Given Q this is generalised least squares with the
covariance V_k = sigma_k^2 (I + B Q^-1 B'), in the form that needs no inverse of a singular Q
(Woodbury): with M = B'B + Q,

    N_k = X_k'X_k - X_k'B M^-1 B'X_k,   C = (sum N_k / sigma_k^2)^-1,   x = C sum (...) / sigma_k^2
    beta_k = M^-1 B'(y_k - X_k x)

so that C, the covariance of x, holds what the bias drift costs. sigma_k^2 is the restricted maximum
likelihood's (Harville, *J. Am. Stat. Assoc.* 72, 1977): (r'r + beta'Q beta) over the freedom left,
drawn towards its kind's mean, and the covariance widened for its own error, as `robust_fit` does.

A pose is an outlier by its studentised residuals, r / (sigma sqrt(1 - h)) with h its leverage on
its own fitted value, because a curve bends towards what it is to be compared with. A hand that
stays over several poses looks like a bias drift, and no fit of this kind distinguishes them.

**The curves** are b(t) = B(t) beta, linear between knots, with the prior beta ~ N(0, (sigma^2)
Q^-1), where sigma is one averaged reading's noise and Q is singular where nothing is known
beforehand:

    constant   b = c                            Q = 0
    linear     b = c + d t                      Q = 0
    walk       db = q dw, a random walk         beta' Q beta = sum (beta_j+1 - beta_j)^2 / (q^2 h_j)
    smooth     d^2b = q dw, its integral        the same of slopes: a cubic smoothing spline

(Wahba, *Spline Models for Observational Data*, 1990, chapter 1; Harvey, *Forecasting, Structural
Time Series Models*, 1989, section 2.3.) The roughness says how far a curve gets from a constant (a
straight line, for `smooth`) over the sweep's length T, in sigma: q^2 T = roughness^2, and
q^2 T^3 / 3 = roughness^2. Between two knots the posterior mean of a walk is a straight line, so
linear interpolation is exact there; beyond the ends it stays, and a smooth curve goes on straight.

Several sweeps have curves of their own (`segment`), which share the roughness.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf, f_ppf
from galen_model.errors import IdentificationError
from galen_model.load.robust_fit import (
    FALSE_REJECTIONS_PER_SWEEP,
    MIN_POSES_TO_REJECT,
    PRIOR_READINGS,
    RobustFit,
    balanced_inverse,
    mad_scale,
    pooled_sigma,
    tiny,
)

_MOST_KNOTS = 60


class Shape(StrEnum):
    """Kind of curve."""

    CONSTANT = "constant"
    LINEAR = "linear"
    WALK = "walk"
    SMOOTH = "smooth"


@dataclass(frozen=True)
class BiasShape:
    """A kind of curve, and for a drifting one its roughness in sigma (see above).

    steps: of each jump, the sweep and the times, s, of the readings before and after it; between
    them the bias is taken as a straight line. thermal: it also goes with the temperature.
    """

    shape: Shape = Shape.CONSTANT
    roughness: float = 0.0
    steps: tuple[tuple[int, float, float], ...] = ()
    thermal: bool = False

    def __str__(self) -> str:
        """In words, as in "walk (10 sigma over a sweep)"."""
        text = self.shape.value
        if self.shape in (Shape.WALK, Shape.SMOOTH):
            text += f" ({self.roughness:g} sigma over a sweep)"
        if self.steps:
            at = ", ".join(f"{before:.1f} and {after:.1f}" for _, before, after in self.steps)
            text += f" with a step between {at} s"
        return f"{text} with temperature" if self.thermal else text


class BiasBasis:
    """Curves of one shape over given times."""

    def __init__(
        self,
        shape: BiasShape,
        time_s: Array,
        segment: np.ndarray,
        temperature_c: Array | None = None,
    ) -> None:
        """Take times (n,), s, sweeps (n,), from 0 on, temperatures of all readings, held or not."""
        self.shape = shape
        self.segments = int(segment.max()) + 1
        times = [np.unique(time_s[segment == s]) for s in range(self.segments)]
        longest = max(float(np.ptp(t)) for t in times)
        self._length_s = longest if longest > 0.0 else 1.0
        self._end_s = [float(t[-1]) for t in times]
        if shape.shape is Shape.CONSTANT:
            self._knots = [t[-1:] for t in times]
        elif shape.shape is Shape.LINEAR:
            self._knots = [t[[0, -1]] if len(t) > 1 else t for t in times]
        else:
            self._knots = [_thinned(t) for t in times]
        self._first = np.cumsum([0, *(len(knots) for knots in self._knots)])
        self._thermal = shape.thermal and temperature_c is not None
        if self._thermal:
            assert temperature_c is not None
            self._mean_c = float(np.mean(temperature_c))
            last = [
                np.flatnonzero(segment == s)[np.argmax(time_s[segment == s])]
                for s in range(self.segments)
            ]
            self._end_c = temperature_c[last]

    @property
    def width(self) -> int:
        """Number of the curves' parameters."""
        return int(self._first[-1]) + len(self.shape.steps) + self._thermal

    @property
    def free(self) -> int:
        """How many of them the prior says nothing of."""
        order = 1 if self.shape.shape in (Shape.CONSTANT, Shape.WALK) else 2
        further = len(self.shape.steps) + self._thermal
        return sum(min(order, len(knots)) for knots in self._knots) + further

    def rows(self, time_s: Array, segment: np.ndarray, temperature_c: Array | None = None) -> Array:
        """B (n, width) at times (n,), s, of the sweeps `segment` (n,), and temperatures (n,)."""
        rows = np.zeros((len(time_s), self.width))
        for number, (sweep, *gap) in enumerate(self.shape.steps, start=int(self._first[-1])):
            rows[:, number] = (segment == sweep) * np.interp(time_s, gap, [0.0, 1.0])
        if self._thermal and temperature_c is not None:
            rows[:, -1] = temperature_c - self._mean_c
        for s, knots in enumerate(self._knots):
            at = np.flatnonzero(segment == s)
            first = self._first[s]
            if len(knots) == 1:
                rows[at, first] = 1.0
                continue
            place = time_s[at]
            if self.shape.shape is Shape.WALK:
                place = np.clip(place, knots[0], knots[-1])
            left = np.clip(np.searchsorted(knots, place, side="right") - 1, 0, len(knots) - 2)
            part = (place - knots[left]) / (knots[left + 1] - knots[left])
            rows[at, first + left] = 1.0 - part
            rows[at, first + left + 1] = part
        return rows

    def ends(self) -> Array:
        """B (segments, width) at each sweep's last reading."""
        end_c = self._end_c if self._thermal else None
        return self.rows(np.array(self._end_s), np.arange(self.segments), end_c)

    def penalty(self) -> Array:
        """Q (width, width).

        A step or a part that goes with the temperature is known to be within 1000 sigma, so that
        a fit to readings without either is no singular one.
        """
        further = np.arange(self.width) >= self._first[-1]
        matrix = np.diag(np.where(further, 1e-6, 0.0))
        if self.shape.shape in (Shape.CONSTANT, Shape.LINEAR):
            return matrix
        order = 1 if self.shape.shape is Shape.WALK else 2
        for s, knots in enumerate(self._knots):
            if len(knots) <= order:
                continue
            place = knots / self._length_s
            steps = np.diff(place)
            slopes = np.diff(np.eye(len(knots)), axis=0) / steps[:, None]
            if order == 1:
                rows = slopes * np.sqrt(steps)[:, None]
            else:
                rows = np.diff(slopes, axis=0) / np.sqrt((steps[1:] + steps[:-1]) / 2.0)[:, None]
                rows /= np.sqrt(3.0)
            here = slice(self._first[s], self._first[s + 1])
            matrix[here, here] = rows.T @ rows / self.shape.roughness**2
        return matrix


def _thinned(times: Array) -> Array:
    """Knots among the times, both ends with them."""
    if len(times) <= _MOST_KNOTS:
        return times
    return np.asarray(times[np.round(np.linspace(0, len(times) - 1, _MOST_KNOTS)).astype(int)])


_ITERATIONS = 30
Shapes = tuple[BiasShape, ...]
"""Shapes of the six channels' curves."""


@dataclass(frozen=True)
class Sweeps:
    """Readings to fit: design (n, 6, p) of the loads without offsets, readings (n, 6), times.

    time_s (n,): when each was taken; segment (n,): which sweep it belongs to, from 0 on. Each sweep
    has curves of its own. prior_matrix (p, p), prior_right (p,): what is known of x beforehand, as
    a part of its normal equations; None: nothing. zeroed: the sensor was zeroed just before the
    only sweep's first reading, so that its bias there is zero within one reading's noise.
    """

    design: Array
    readings: Array
    time_s: Array
    segment: np.ndarray
    prior_matrix: Array | None = None
    prior_right: Array | None = None
    zeroed: bool = False
    temperature_c: Array | None = None
    _bases: dict[BiasShape, tuple[BiasBasis, Array, Array]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def basis(self, shape: BiasShape) -> tuple[BiasBasis, Array, Array]:
        """Return the curves of a shape, B (n, width) at the readings, and Q (width, width)."""
        if shape not in self._bases:
            basis = BiasBasis(shape, self.time_s, self.segment, self.temperature_c)
            rows = basis.rows(self.time_s, self.segment, self.temperature_c)
            penalty = basis.penalty()
            if self.zeroed:  # one more reading of the bias alone, which is zero
                start = rows[int(np.argmin(self.time_s))]
                penalty = penalty + np.outer(start, start)
            self._bases[shape] = basis, rows, penalty
        return self._bases[shape]

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.readings)


@dataclass(frozen=True)
class BiasDriftFit:
    """What was found.

    fit: values (p + 6 segments,) are x, then each sweep's six biases at its last reading.
    bias (n, 6): the curves at the readings' times, N and N.m. shapes: of force and torque.
    growth (p,): how many times larger the bias drift makes the standard deviations of x.
    bases, curves: of force and torque; of the six channels.
    """

    fit: RobustFit
    bias: Array
    shapes: Shapes
    growth: Array
    bases: list[BiasBasis]
    curves: list[Array]

    def bias_at(
        self, time_s: Array, segment: np.ndarray, temperature_c: Array | None = None
    ) -> Array:
        """Return the curves (m, 6) at other times (m,), s, of the sweeps `segment` (m,)."""
        rows = [basis.rows(time_s, segment, temperature_c) for basis in self.bases]
        return np.column_stack([row @ curve for row, curve in zip(rows, self.curves, strict=True)])


class Problem:
    """The normal equations of some rows, with the curves eliminated, for given pose weights."""

    def __init__(self, sweeps: Sweeps, shapes: Shapes, weights: Array) -> None:
        self.sweeps = sweeps
        self.weights = weights
        self.count = int(np.count_nonzero(weights))
        parameters = sweeps.design.shape[2]
        self.information = np.zeros((6, parameters, parameters))
        self.right = np.zeros((6, parameters))
        whole = [sweeps.basis(shape) for shape in shapes]
        self.bases, self.rows, self.penalty = map(list, zip(*whole, strict=True))
        self.free = np.array([basis.free for basis in self.bases])
        empty = np.zeros(0)
        self.inverse: list[Array] = [empty] * 6  # M^-1: (width, width)
        self.curve_x: list[Array] = [empty] * 6  # M^-1 B'W X_k: (width, p)
        self.curve_y: list[Array] = [empty] * 6  # M^-1 B'W y_k: (width,)
        for shape in dict.fromkeys(shapes):
            self._eliminate([k for k in range(6) if shapes[k] == shape])

    def _eliminate(self, channels: list[int]) -> None:
        """Eliminate the curves of these channels, which have one shape, all at once."""
        rows, weights = self.rows[channels[0]], self.weights
        weighted = (rows * weights[:, None]).T
        moment = weighted @ rows + self.penalty[channels[0]]
        try:
            np.linalg.cholesky(moment)
            inverse = np.linalg.inv(moment)
        # a sweep all of whose poses were weighted to nothing, or numbers without end
        except np.linalg.LinAlgError:
            raise IdentificationError("the poses agree on no load") from None
        onto = inverse @ weighted
        for k in channels:
            design, reading = self.sweeps.design[:, k], self.sweeps.readings[:, k]
            self.inverse[k] = inverse
            self.curve_x[k] = onto @ design
            self.curve_y[k] = onto @ reading
            free = (design - rows @ self.curve_x[k]) * weights[:, None]
            self.information[k] = design.T @ free
            self.right[k] = free.T @ reading

    def solve(self, sigma: Array) -> tuple[Array, Array]:
        """Moments x (p,) and their covariance (p, p)."""
        scale = 1.0 / sigma**2
        information = np.einsum("kij,k->ij", self.information, scale)
        right = self.right.T @ scale
        if self.sweeps.prior_matrix is not None and self.sweeps.prior_right is not None:
            information = information + self.sweeps.prior_matrix
            right = right + self.sweeps.prior_right
        covariance = balanced_inverse(information)
        return covariance @ right, covariance

    def curves(self, values: Array) -> list[Array]:
        """beta_k (width,) of the six channels."""
        return [y - x @ values for x, y in zip(self.curve_x, self.curve_y, strict=True)]

    def bias(self, values: Array) -> Array:
        """Return the curves (n, 6) at the readings."""
        curves = self.curves(values)
        return np.column_stack(
            [rows @ curve for rows, curve in zip(self.rows, curves, strict=True)]
        )

    def squares(self, values: Array, residuals: Array) -> Array:
        """Return sums r'W r + beta' Q beta, (6,), whose mean is sigma^2 times the freedom."""
        rough = [b @ q @ b for b, q in zip(self.curves(values), self.penalty, strict=True)]
        return np.asarray(self.weights @ residuals**2 + np.array(rough))

    def freedom(self, covariance: Array, sigma: Array) -> Array:
        """Return readings less what the fit has taken of each channel, (6,)."""
        taken = np.einsum("kij,ji->k", self.information, covariance) / sigma**2
        return np.asarray(np.maximum(self.count + self.sweeps.zeroed - self.free - taken, 1.0))

    def studentised(self, residuals: Array, covariance: Array, sigma: Array) -> Array:
        """Residuals (n, 6) over the root of 1 - h; of a pose without weight, of 1 + h."""
        result = np.empty(self.sweeps.readings.shape)
        of_curve = [_forms(rows, inv) for rows, inv in zip(self.rows, self.inverse, strict=True)]
        for channel in range(6):
            free = self.sweeps.design[:, channel] - self.rows[channel] @ self.curve_x[channel]
            own = of_curve[channel] + _forms(free, covariance) / sigma[channel] ** 2
            result[:, channel] = np.where(self.weights > 0.0, 1.0 - own * self.weights, 1.0 + own)
        return residuals / np.sqrt(np.maximum(result, 1e-3))


def _forms(rows: Array, matrix: Array) -> Array:
    """Quadratic form (n,) of each of rows (n, m) with matrix (m, m)."""
    return np.asarray(np.sum((rows @ matrix) * rows, axis=1))


def fit_drifting(sweeps: Sweeps, shapes: Shapes) -> BiasDriftFit:
    """Fit robustly; raises IdentificationError when the poses leave no freedom."""
    count = len(sweeps)
    used = np.ones(count, dtype=bool)
    if count >= MIN_POSES_TO_REJECT:
        used = agreeing(sweeps, shapes)
    return finish(sweeps, shapes, used)


def finish(sweeps: Sweeps, shapes: Shapes, used: np.ndarray) -> BiasDriftFit:
    """Weighted least squares of the poses `used` (n,)."""
    problem = Problem(sweeps, shapes, used.astype(float))
    values, covariance, sigma, freedom = settle(problem)
    # as in robust_fit: sigma is itself estimated
    known = freedom + PRIOR_READINGS
    wider = float(np.mean(known / (known - 2.0)))
    bias = problem.bias(values)
    residuals = sweeps.readings - sweeps.design @ values - bias
    whole_values, whole_covariance = _with_ends(problem, values, covariance, sigma)
    distance = _distance(problem, residuals, covariance, sigma)
    fit = RobustFit(whole_values, whole_covariance * wider, residuals, sigma, used, distance)
    constant = Problem(sweeps, (BiasShape(),) * 6, problem.weights).solve(sigma)[1]
    variances = np.diag(covariance), np.diag(constant)
    if np.min(variances) <= 0.0:  # rounding: nothing but the prior holds a parameter
        raise IdentificationError("the poses agree on no load")
    growth = np.sqrt(variances[0] / variances[1])
    curves = problem.curves(values)
    return BiasDriftFit(fit, bias, shapes, growth, problem.bases, curves)


def settle(
    problem: Problem, tolerance: float = 1e-9, sigma: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """x, its covariance, each channel's noise and freedom, found together.

    sigma: (6,) where to begin; None: the readings' scatter.
    """
    sweeps = problem.sweeps
    if sigma is None:
        sigma = np.maximum(np.std(sweeps.readings, axis=0), tiny(sweeps.readings))
    for _ in range(_ITERATIONS):
        values, covariance = problem.solve(sigma)
        residuals = sweeps.readings - sweeps.design @ values - problem.bias(values)
        freedom = problem.freedom(covariance, sigma)
        next_sigma = np.maximum(
            pooled_sigma(problem.squares(values, residuals), freedom), tiny(sweeps.readings)
        )
        settled = np.allclose(next_sigma, sigma, rtol=tolerance)
        sigma = next_sigma
        if settled:
            break
    values, covariance = problem.solve(sigma)
    return values, covariance, sigma, freedom


def _with_ends(
    problem: Problem, values: Array, covariance: Array, sigma: Array
) -> tuple[Array, Array]:
    """Values and covariance of x and of each sweep's biases at its end, sweep by sweep."""
    parameters, segments = len(values), problem.bases[0].segments
    curves = problem.curves(values)
    # e = const - (E M^-1 B'X) x + E (beta's own error)
    slope = np.zeros((6 * segments, parameters))
    own = np.zeros((6 * segments, 6 * segments))
    ends = np.zeros(6 * segments)
    for channel in range(6):
        at = problem.bases[channel].ends()
        places = channel + 6 * np.arange(segments)
        ends[places] = at @ curves[channel]
        slope[places] = -at @ problem.curve_x[channel]
        own[np.ix_(places, places)] = sigma[channel] ** 2 * at @ problem.inverse[channel] @ at.T
    joint = np.block(
        [
            [covariance, covariance @ slope.T],
            [slope @ covariance, own + slope @ covariance @ slope.T],
        ]
    )
    return np.concatenate([values, ends]), joint


def _distance(problem: Problem, residuals: Array, covariance: Array, sigma: Array) -> Array:
    """How far off (n,) each pose is, over its six channels, in standard deviations."""
    studentised = problem.studentised(residuals, covariance, sigma)
    return np.asarray(np.sqrt(np.sum((studentised / sigma) ** 2, axis=1)))


def agreeing(sweeps: Sweeps, shapes: Shapes) -> np.ndarray:
    """Mask (n,) of the poses that agree on one load: bisquare, then a limit (`robust_fit`)."""
    count = len(sweeps)
    sigma = np.maximum(np.std(sweeps.readings, axis=0), tiny(sweeps.readings))
    weights = np.ones(count)
    cut = np.sqrt(chi2_ppf(0.9999, 6)) * 1.5
    for step in range(2 * _ITERATIONS):
        problem = Problem(sweeps, shapes, weights)
        values, covariance = problem.solve(sigma)
        residuals = sweeps.readings - sweeps.design @ values - problem.bias(values)
        studentised = problem.studentised(residuals, covariance, sigma)
        sigma = mad_scale(studentised)
        distance = np.sqrt(np.sum((studentised / sigma) ** 2, axis=1))
        if step < _ITERATIONS:  # least absolute distance: a start that few outliers can't lead
            new = 1.0 / np.maximum(distance, 0.1 * np.sqrt(6.0))
            new /= new.max()
        else:
            new = np.clip(1.0 - (distance / cut) ** 2, 0.0, None) ** 2
        moved = float(np.abs(new - weights).max())
        weights = new
        if step >= _ITERATIONS and moved < 1e-3:
            break
    freedom = max(
        count - sweeps.design.shape[2] / 6.0 - max(basis.free for basis in problem.bases), 1.0
    )
    limit = 6.0 * f_ppf(1.0 - FALSE_REJECTIONS_PER_SWEEP / count, 6, freedom)
    used = distance**2 <= limit
    for _ in range(_ITERATIONS):
        if used.sum() * 6 <= sweeps.design.shape[2] + 6 * max(
            basis.free for basis in problem.bases
        ):
            raise IdentificationError(f"only {int(used.sum())} of {count} poses agree on a load")
        next_used = finish(sweeps, shapes, used).fit.distance ** 2 <= limit
        if np.array_equal(next_used, used):
            break
        used = next_used
    return used
