# SPDX-License-Identifier: Apache-2.0
"""What some rest segments show of a calibration file: it fits, or what is wrong, by Bayes' rule.

With u_k gravity in the sensor's frame in segment k, t_k its time before the newest one, and the
segment's mean output r_k (6,),

    r_k = G(u_k) d + b + t_k c + L(u_k) s + noise_k

d: what the load (mass, first moment) differs from the file's (`galen_model.load.model`); b, c: an
offset and its drift; s: how far the tool sags in its mount, its centre moving by s times the x and
y parts of gravity's unit vector u^ (the contract's `loose_tool`), times its mass: with g = |u|

    L(u) s = (0, 0, 0; m (u^_x, u^_y, 0) x u^ g) s.

Every explanation allows all of it by a normal prior, and differs only in how wide: where the file
fits, d is as uncertain as the calibration's covariance, and b within an allowance for bias drift;
with another load d is wide, and so on. `UNEXPLAINED` allows an error at each segment of its own.
The likelihood of an explanation is then the density of all r_k with the parameters integrated out
(Kass and Raftery, *J. Am. Stat. Assoc.* 90, 1995), so that a wide prior costs what it should, also
for one segment. Any segment may be contact: its r_k is then a force of newtons in any direction,
counted so where that is likelier than the other segments' prediction under that explanation, so
a hand on most segments proves nothing, and a load that turns with gravity from one to another does.

`galen_gravcomp.evaluate.residual` decomposes hours by least squares, with the noise from the
scatter of many segments. Live, two or three must do, and their noise is known: by the sensor, the
calibration's covariance and its RMSE.

Whether the residual is a pull that belongs to the pose, or a hand's: a cable's pull, and a wrong
angle, change with the pose, and little from one pose to another near it. A hand is whatever it is
at each segment, or what it was at the segment before. With y_i (n,) an axis' means at n segments
and u gravity's unit vector there, each is a normal density of y_i with

    covariance s^2 R + v_i 1,    R_kl = exp(-|u_k - u_l|^2 / (2 l^2))     a pull
                                 R_kl = exp(-|k - l| / 2)                 a hand that changes slowly

and the size s integrated out over a coarse scale of sizes (Rasmussen and Williams, *Gaussian
Processes for Machine Learning*, 2006, section 5.4). A hand that is another at each segment has
another size at each as well: pushes of newtons and of tenths come from the same hand, and small
ones at poses near each other are not alike for that. The median over the segments is subtracted
first: what they have in common does not distinguish a pull from hands. Forces and torques of a push
at one point hold the same twice, so only those count that favour a pull less. Nothing is decided
while poses are as near to each other as they are in time, which is then the same.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.calibrated import columns
from galen_model.estimation.evidence import (
    LOG_2PI,
    Prior,
    distance,
    log_density,
    log_evidence,
    posterior,
)
from galen_model.estimation.least_squares import Information
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.readings import single_load_design
from galen_model.load.verdict import Cause

_LOAD, _OFFSET, _DRIFT, _SAG = slice(0, 4), slice(4, 10), slice(10, 16), 16
_COUNT = 17
_LOOKS = 5


EXPLANATIONS = (Cause.FITS, Cause.LOAD, Cause.DRIFT, Cause.LOOSE_TOOL, Cause.UNEXPLAINED)


def _axes(force_n: float, torque_nm: float) -> Array:
    return np.repeat([force_n, torque_nm], 3)


# Standard deviations of the priors. What a file that fits may be off by:
_ALLOWED_OFFSET = _axes(0.05, 2e-3)
_ALLOWED_DRIFT_PER_H = _axes(0.2, 4e-3)
_ALLOWED_SHIFT_M = 1e-4
_SEGMENT_FLOOR = _axes(0.01, 3e-4)
# ... and what is wrong, if it is:
_WRONG_MASS_KG = 0.1
_WRONG_MOMENT_KGM = 0.01
_WRONG_OFFSET = _axes(0.5, 0.02)
_WRONG_DRIFT_PER_H = _axes(1.0, 0.02)
_WRONG_SHIFT_M = 0.01
_WRONG_SEGMENT = _axes(0.15, 0.006)
_CONTACT = _axes(3.0, 0.3)
_CONTACT_SHARE = 0.3
# Prior probabilities of the explanations, in their order.
_PRIOR = np.array([0.9, 0.04, 0.04, 0.01, 0.01])
# Of a pull: lengths (chords of gravity's unit vector), segments alike in time, sizes by axis.
_LENGTHS = (0.35, 0.7)
_SEGMENTS_ALIKE = 2.0
_SIZES = np.repeat([0.15, 0.006], 3)[:, None] * 2.0 ** np.arange(-2, 5)


@dataclass(frozen=True)
class Segments:
    """Segments (n,), oldest first.

    mean, std (n, 6): of the output, N and N.m; angles (n, k), rad; end_ns (n,).
    """

    mean: Array
    std: Array
    angles: Array
    end_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.end_ns)


@dataclass(frozen=True)
class Judgement:
    """The likeliest explanation of some segments.

    log_odds: of it against `FITS` (0 for `FITS` itself); values (17,) and covariance (17, 17): of
    all parameters; contact (n,): segments that count as contact; beyond (6,): root mean square over
    the others of what the explanation subtracts, N and N.m.
    """

    explanation: Cause
    log_odds: float
    values: Array
    covariance: Array
    contact: np.ndarray
    beyond: Array

    @property
    def load(self) -> Array:
        """The true load less the file's (4,), kg and kg.m."""
        return self.values[_LOAD]

    @property
    def mass_std_kg(self) -> float:
        """Standard deviation of the mass."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def offset(self) -> Array:
        """Offset (6,) at the newest segment, N and N.m."""
        return self.values[_OFFSET]

    @property
    def shift_m(self) -> float:
        """How far the tool sags."""
        return float(self.values[_SAG])


class FitEvidence:
    """Judges segments of one tool's file."""

    def __init__(self, tool: CalibrationFile, arm: Arm) -> None:
        self._arm = arm
        self._tool = tool
        self._gravity_m_s2 = float(np.linalg.norm(arm.gravity_m_s2))
        self._scale = float(np.linalg.norm(tool.gravity_m_s2)) / self._gravity_m_s2
        self._sag_mass_kg = float(tool.load.mass_kg)
        known = columns.moment_covariance(tool.load) + columns.moment_covariance(tool.adapter)
        sag = 1.0 / _WRONG_SHIFT_M**2
        tight = 1.0 / _ALLOWED_SHIFT_M**2
        wrong_load = 1.0 / np.array([_WRONG_MASS_KG, *[_WRONG_MOMENT_KGM] * 3]) ** 2
        precision = np.zeros((len(EXPLANATIONS), _COUNT, _COUNT))
        for k, what in enumerate(EXPLANATIONS):
            wide = what is Cause.DRIFT
            load = what is Cause.LOAD
            precision[k, _LOAD, _LOAD] = np.diag(wrong_load) if load else np.linalg.inv(known)
            offset = _WRONG_OFFSET if wide else _ALLOWED_OFFSET
            drift = _WRONG_DRIFT_PER_H if wide else _ALLOWED_DRIFT_PER_H
            precision[k, _OFFSET, _OFFSET] = np.diag(1.0 / offset**2)
            precision[k, _DRIFT, _DRIFT] = np.diag(1.0 / drift**2)
            precision[k, _SAG, _SAG] = sag if what is Cause.LOOSE_TOOL else tight
        self._prior = Prior.of_precision(precision)

    def design(self, segments: Segments) -> Array:
        """Return Phi of the parameters, see above.

        Args:
            segments: n segments, the newest last.

        Returns:
            (n, 6, 17), N and N.m for a unit of each parameter.

        """
        gravity = self._arm.gravity_in_sensor(segments.angles) * self._scale
        hours = (segments.end_ns - int(segments.end_ns[-1])) / 3.6e12
        return np.concatenate(
            [
                single_load_design(gravity),
                columns.drift(hours),
                columns.loose_tool(gravity, self._sag_mass_kg),
            ],
            axis=2,
        )

    def variance(self, segments: Segments) -> Array:
        """Return the noise's at each segment: sensor, the calibration's RMSE, a floor.

        Args:
            segments: n segments.

        Returns:
            (n, 6), N^2 and (N.m)^2.

        """
        return np.asarray(segments.std**2 + self._tool.rmse**2 + _SEGMENT_FLOOR**2)

    def fit_of_each(self, segments: Segments) -> tuple[Array, Array]:
        """Compare each segment with a file that fits.

        Args:
            segments: n segments, the newest last.

        Returns:
            Chi-square (n,) of 6 degrees of freedom, and log density (n,).

        """
        known = np.linalg.inv(self._prior.precision[0])
        return self._log_density(segments, np.zeros(_COUNT), known, 0)

    def log_contradiction(self, segments: Segments, judgement: Judgement) -> Array:
        """Return how much likelier each segment is with a file that fits than as predicted.

        Args:
            segments: n segments, the newest last.
            judgement: the prediction; these segments had no part in it.

        Returns:
            Log odds (n,).

        """
        k = EXPLANATIONS.index(judgement.explanation)
        predicted = self._log_density(segments, judgement.values, judgement.covariance, k)[1]
        return np.asarray(self.fit_of_each(segments)[1] - predicted)

    def log_contact(self, segments: Segments) -> Array:
        """Return the log density of each segment as contact, against none by prior odds.

        Args:
            segments: n segments.

        Returns:
            (n,).

        """
        return _log_contact(segments, self.variance(segments))

    def _log_density(
        self, segments: Segments, values: Array, covariance: Array, k: int
    ) -> tuple[Array, Array]:
        design = self.design(segments)
        spread = design @ covariance @ np.swapaxes(design, 1, 2)
        spread[:, range(6), range(6)] += self._noise(k, self.variance(segments))
        rest = segments.mean - design @ values
        return distance(rest, spread), log_density(rest, spread)

    def _noise(self, k: int, variance: Array) -> Array:
        unknown = EXPLANATIONS[k] is Cause.UNEXPLAINED
        return variance + _WRONG_SEGMENT**2 if unknown else variance

    def log_density_of(self, explanation: Cause, segments: Segments) -> float:
        """Return the log density of all means together under an explanation, none of them contact.

        Args:
            explanation: one of `EXPLANATIONS`.
            segments: n segments, the newest last.

        Returns:
            The logarithm of the evidence.

        """
        k = EXPLANATIONS.index(explanation)
        own = self._noise(k, self.variance(segments))[None]
        information = _information(self.design(segments), own, segments.mean).total()
        return float(log_evidence(information, self._prior)[k])

    def log_odds_of_pull(self, segments: Segments) -> float:
        """Return the log odds of a pull by the pose against hands.

        Args:
            segments: n segments, oldest first.

        Returns:
            The smaller one of forces' and torques'.

        """
        variance = self.variance(segments)
        means = segments.mean - np.median(segments.mean, axis=0)
        order = np.arange(len(segments))
        slow = np.exp(-np.abs(order[:, None] - order) / _SEGMENTS_ALIKE)
        density = _log_density(means, variance, np.array([*self._by_pose(segments), slow]))
        pulls = _log_mean(density[:-1], 0)
        hands = np.maximum(density[-1], _log_density_of_hands(means, variance))
        return float(np.min(pulls - hands))

    def log_density_of_pull(self, segments: Segments) -> float:
        """Return the log density of all means if a pull by the pose is all there is.

        Args:
            segments: n segments.

        Returns:
            Its logarithm, of forces and torques together.

        """
        density = _log_density(segments.mean, self.variance(segments), self._by_pose(segments))
        return float(np.sum(_log_mean(density, 0)))

    def _by_pose(self, segments: Segments) -> Array:
        """Kernels (lengths, n, n)."""
        unit = self._arm.gravity_in_sensor(segments.angles) / self._gravity_m_s2
        square = np.sum((unit[:, None] - unit) ** 2, axis=2)
        return np.array([np.exp(-square / (2.0 * length**2)) for length in _LENGTHS])

    def judge(self, segments: Segments) -> Generator[None, None, Judgement]:
        """Find the likeliest explanation of all segments.

        Args:
            segments: n segments, the newest last.

        Returns:
            The judgement, as the generator's value.

        Yields:
            None between pieces of work.

        """
        design, variance = self.design(segments), self.variance(segments)
        kinds, count = len(EXPLANATIONS), len(segments)
        own = np.array([self._noise(k, variance) for k in range(kinds)])
        contact_value = _log_contact(segments, variance)
        of_each = _information(design, own, segments.mean)
        free = np.ones((kinds, count), dtype=bool)
        best, best_free = np.full(kinds, -np.inf), free.copy()
        yield
        for _ in range(_LOOKS):
            information = _counted(of_each, free)
            values, covariance = posterior(information, self._prior)
            evidence = log_evidence(information, self._prior)
            evidence = evidence + np.sum(~free * contact_value, axis=1)
            better = evidence > best
            best[better], best_free[better] = evidence[better], free[better]
            predicted = _predicted(design, own, segments.mean, covariance, values)
            # The segments that contact explains best of those that still count: a contact's part
            # in the fit makes others look like contact, which a second look corrects.
            gain = np.where(free, contact_value[None] - predicted, 0.0)
            most = np.max(gain, axis=1, keepdims=True)
            yield
            if np.all(most <= 0.0):
                break
            free &= (gain <= 0.5 * most) | (most <= 0.0)
        evidence = best + np.log(_PRIOR)
        k = int(np.argmax(evidence))
        log_odds = float(evidence[k] - evidence[0])
        found = posterior(_counted(of_each, best_free), self._prior)
        value, covariance, free = found.values[k], found.covariance[k], best_free[k]
        unknown = EXPLANATIONS[k] is Cause.UNEXPLAINED
        explained = segments.mean[free] if unknown else design[free] @ value
        beyond = np.zeros(6) if not free.any() else np.sqrt(np.mean(explained**2, axis=0))
        return Judgement(EXPLANATIONS[k], log_odds, value, covariance, ~free, beyond)


def _information(design: Array, own: Array, mean: Array) -> Information:
    """Of each segment (n), under each of h noises own (h, n, 6)."""
    weighted = np.swapaxes(design[None] / own[..., None], -1, -2)
    return Information(
        weighted @ design,
        (weighted @ mean[..., None])[..., 0],
        np.sum(mean**2 / own + np.log(own) + LOG_2PI, axis=2),
    )


def _counted(of_each: Information, free: np.ndarray) -> Information:
    """Of the segments that count, free (h, n), together."""
    return Information(
        np.einsum("hn,hnpq->hpq", free, of_each.matrix),
        np.einsum("hn,hnp->hp", free, of_each.right),
        np.sum(free * of_each.rest, axis=1),
    )


def _log_contact(segments: Segments, variance: Array) -> Array:
    spread = variance + _CONTACT**2
    density = -0.5 * np.sum(segments.mean**2 / spread + np.log(spread) + LOG_2PI, axis=1)
    return np.asarray(density + np.log(_CONTACT_SHARE / (1.0 - _CONTACT_SHARE)))


def _predicted(design: Array, own: Array, mean: Array, covariance: Array, value: Array) -> Array:
    """Log density (h, n) of each segment as the others predict it.

    With V = S - Phi C Phi^T the covariance of a segment's residual rho in the fit with it, the
    others predict it with the density of rho under V, less log|S| - log|V|.
    """
    residual = mean[None] - np.moveaxis(design @ value.T, -1, 0)
    # Matrix products, which are many times as fast as the sum over all indices at once.
    half = (design.reshape(-1, _COUNT) @ covariance).reshape(len(value), *design.shape)
    spread = -half @ np.swapaxes(design, 1, 2)
    spread[:, :, range(6), range(6)] += own
    solved = np.linalg.solve(spread, residual[..., None])[..., 0]
    square = np.sum(residual * solved, axis=-1)
    log_det = np.linalg.slogdet(spread)[1]
    log_noise = np.sum(np.log(own), axis=2)
    return np.asarray(-0.5 * (square + 2.0 * log_noise - log_det + 6.0 * LOG_2PI))


def _log_density(means: Array, variance: Array, kernels: Array) -> Array:
    """Of means (n, 6) by each kernel (k, n, n), of forces and of torques: (k, 2).

    Sums over the kernel's own axes; noise is taken as the same at all segments.
    """
    values, modes = np.linalg.eigh(kernels)
    spread = np.maximum(values, 0.0)[:, None, None] * _SIZES[..., None] ** 2
    spread = spread + np.mean(variance, axis=0)[:, None, None]
    square = np.swapaxes(np.swapaxes(modes, 1, 2) @ means, 1, 2)[:, :, None] ** 2
    density = -0.5 * np.sum(square / spread + np.log(spread) + LOG_2PI, axis=3)
    return np.asarray(_log_mean(density, 2).reshape(-1, 2, 3).sum(axis=2))


def _log_density_of_hands(means: Array, variance: Array) -> Array:
    """Of means (n, 6), of forces and of torques (2,), each segment's of a size of its own."""
    spread = _SIZES**2 + variance[..., None]
    density = -0.5 * (means[..., None] ** 2 / spread + np.log(spread) + LOG_2PI)
    by_size = density.reshape(len(means), 2, 3, -1).sum(axis=2)
    return np.asarray(np.sum(_log_mean(by_size, 2), axis=0))


def _log_mean(values: Array, axis: int) -> Array:
    """Logarithm of the mean of exp(values): a tenth of what scipy's logsumexp takes."""
    most = np.max(values, axis=axis, keepdims=True)
    mean = np.mean(np.exp(values - most), axis=axis)
    return np.asarray(np.squeeze(most, axis=axis) + np.log(mean))
