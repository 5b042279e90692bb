"""What some still stops say of a tool's file: it fits, or what is wrong, by Bayes' rule.

With u_k gravity in the sensor's frame at stop k, t_k its time before the newest one, and the stop's
mean output r_k (6,),

    r_k = G(u_k) d + b + t_k c + L(u_k) s + noise_k

d: what the load (mass, first moment) differs from the file's (`galen_model.load.model`); b, c: an
offset and its drift; s: how far the tool sags in its mount, its centre moving by s times the x and
y parts of gravity's unit vector u^ (the contract's `loose_tool`), times its mass: with g = |u|

    L(u) s = (0, 0, 0; m (u^_x, u^_y, 0) x u^ g) s.

Every explanation allows all of it by a normal prior, and differs only in how wide: where the file
fits, d is as uncertain as the calibration's covariance, and b within an allowance for bias drift;
with another load d is wide, and so on. `UNEXPLAINED` allows an error at each stop of its own. The
likelihood of an explanation is then the density of all r_k with the parameters integrated out
(Kass and Raftery, *J. Am. Stat. Assoc.* 90, 1995), so that a wide prior costs what it should, also
for one stop. Any stop may have been touched: its r_k is then a force of newtons in any direction,
counted so where that is likelier than what the other stops under that explanation foretell, so
a hand on most stops proves nothing, and a load that turns with gravity from stop to stop does.

`galen_gravcomp.evaluate.residual_decomposition` takes hours apart by least squares, with the noise
from the scatter of many phases. Live, two or three stops must do, and their noise is known: by the
sensor, the calibration's covariance and its RMSE.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.evidence import columns
from galen_model.evidence.linear import (
    LOG_2PI,
    Information,
    Prior,
    distance,
    log_density,
    log_evidence,
    posterior,
)
from galen_model.evidence.verdict import Cause
from galen_model.files.calibration_file import CalibrationFile

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
_STOP_FLOOR = _axes(0.01, 3e-4)
# ... and what is wrong, if it is:
_WRONG_MASS_KG = 0.1
_WRONG_MOMENT_KGM = 0.01
_WRONG_OFFSET = _axes(0.5, 0.02)
_WRONG_DRIFT_PER_H = _axes(1.0, 0.02)
_WRONG_SHIFT_M = 0.01
_WRONG_STOP = _axes(0.15, 0.006)
_TOUCH = _axes(3.0, 0.3)
_TOUCHED_SHARE = 0.3
# Prior probabilities of the explanations, in their order.
_PRIOR = np.array([0.9, 0.04, 0.04, 0.01, 0.01])


@dataclass(frozen=True)
class Stops:
    """Stops (n,), oldest first.

    mean, std (n, 6): of the output, N and N.m; angles (n, 2): roll and tilt, rad; end_ns (n,).
    """

    mean: Array
    std: Array
    angles: Array
    end_ns: np.ndarray

    def __len__(self) -> int:
        return len(self.end_ns)

    def rows(self, rows: slice) -> Stops:
        """Some of them."""
        return Stops(self.mean[rows], self.std[rows], self.angles[rows], self.end_ns[rows])


@dataclass(frozen=True)
class Judgement:
    """The likeliest explanation of some stops.

    log_odds: of it against `FITS` (0 for `FITS` itself); values (17,) and
    covariance (17, 17): of all parameters; load (4,): kg and kg.m true less file's;
    offset (6,) at the newest stop, drift_per_h (6,), shift_m, each with standard deviations;
    touched (n,): stops that count as touched; beyond (6,): root mean square over the others of what
    the explanation takes off, N and N.m.
    """

    explanation: Cause
    log_odds: float
    values: Array
    covariance: Array
    load: Array
    load_std: Array
    offset: Array
    offset_std: Array
    drift_per_h: Array
    shift_m: float
    touched: np.ndarray
    beyond: Array


class FitEvidence:
    """Judges stops of one tool's file."""

    def __init__(self, tool: CalibrationFile) -> None:
        self._tool = tool
        self._scale = float(tool.gravity_m_s2[2] / GRAVITY_M_S2[2])
        self._mass_kg = float(tool.load.mass_kg + tool.adapter.mass_kg)
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

    def design(self, stops: Stops) -> Array:
        """Phi (n, 6, 17) of the parameters, see above."""
        gravity = gravity_in_sensor(stops.angles[:, 0], stops.angles[:, 1]) * self._scale
        hours = (stops.end_ns - int(stops.end_ns[-1])) / 3.6e12
        return np.concatenate(
            [
                columns.load_and_offset(gravity),
                columns.drift(hours),
                columns.loose_tool(gravity, self._sag_mass_kg),
            ],
            axis=2,
        )

    def variance(self, stops: Stops) -> Array:
        """Of the noise at each stop (n, 6): sensor, the calibration's RMSE, a floor."""
        return np.asarray(stops.std**2 + self._tool.rmse**2 + _STOP_FLOOR**2)

    def fit_of_each(self, stops: Stops) -> tuple[Array, Array]:
        """Of each stop on its own, with a file that fits: chi-square (n,) of 6, and log density."""
        known = np.linalg.inv(self._prior.precision[0])
        return self._log_density(stops, np.zeros(_COUNT), known, 0)

    def log_contradiction(self, stops: Stops, judgement: Judgement) -> Array:
        """Log odds (n,) by which each stop is likelier with a file that fits than as foretold.

        By a judgement that these stops had no part in.
        """
        k = EXPLANATIONS.index(judgement.explanation)
        foretold = self._log_density(stops, judgement.values, judgement.covariance, k)[1]
        return np.asarray(self.fit_of_each(stops)[1] - foretold)

    def log_touched(self, stops: Stops) -> Array:
        """Log density (n,) of each stop if it is touched, against untouched by prior odds."""
        return _log_touched(stops, self.variance(stops))

    def _log_density(
        self, stops: Stops, values: Array, covariance: Array, k: int
    ) -> tuple[Array, Array]:
        design = self.design(stops)
        spread = design @ covariance @ np.swapaxes(design, 1, 2)
        spread[:, range(6), range(6)] += self._noise(k, self.variance(stops))
        rest = stops.mean - design @ values
        return distance(rest, spread), log_density(rest, spread)

    def _noise(self, k: int, variance: Array) -> Array:
        unknown = EXPLANATIONS[k] is Cause.UNEXPLAINED
        return variance + _WRONG_STOP**2 if unknown else variance

    def log_density_of(self, explanation: Cause, stops: Stops) -> float:
        """Log density of all means together under an explanation, none of them touched."""
        k = EXPLANATIONS.index(explanation)
        own = self._noise(k, self.variance(stops))[None]
        information = _information(self.design(stops), own, stops.mean).total()
        return float(log_evidence(information, self._prior)[k])

    def judge(self, stops: Stops) -> Generator[None, None, Judgement]:
        """The likeliest explanation of all the stops together; yields between pieces of work."""
        design, variance = self.design(stops), self.variance(stops)
        kinds, count = len(EXPLANATIONS), len(stops)
        own = np.array([self._noise(k, variance) for k in range(kinds)])
        touched_value = _log_touched(stops, variance)
        of_each = _information(design, own, stops.mean)
        free = np.ones((kinds, count), dtype=bool)
        best, best_free = np.full(kinds, -np.inf), free.copy()
        yield
        for _ in range(_LOOKS):
            information = _counted(of_each, free)
            values, covariance = posterior(information, self._prior)
            evidence = log_evidence(information, self._prior)
            evidence = evidence + np.sum(~free * touched_value, axis=1)
            better = evidence > best
            best[better], best_free[better] = evidence[better], free[better]
            foretold = _foretold(design, own, stops.mean, covariance, values)
            # The stops that a touch explains best, of those that still count: what one touched stop
            # does to the fit makes others look touched, which a second look clears up.
            gain = np.where(free, touched_value[None] - foretold, 0.0)
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
        std = np.sqrt(np.diag(covariance))
        unknown = EXPLANATIONS[k] is Cause.UNEXPLAINED
        explained = stops.mean[free] if unknown else design[free] @ value
        beyond = np.zeros(6) if not free.any() else np.sqrt(np.mean(explained**2, axis=0))
        return Judgement(
            EXPLANATIONS[k],
            log_odds,
            value,
            covariance,
            value[_LOAD],
            std[_LOAD],
            value[_OFFSET],
            std[_OFFSET],
            value[_DRIFT],
            float(value[_SAG]),
            ~free,
            beyond,
        )


def _information(design: Array, own: Array, mean: Array) -> Information:
    """Of each stop (n), under each of h noises own (h, n, 6)."""
    weighted = np.swapaxes(design[None] / own[..., None], -1, -2)
    return Information(
        weighted @ design,
        (weighted @ mean[..., None])[..., 0],
        np.sum(mean**2 / own + np.log(own) + LOG_2PI, axis=2),
    )


def _counted(of_each: Information, free: np.ndarray) -> Information:
    """Of the stops that count, free (h, n), together."""
    return Information(
        np.einsum("hn,hnpq->hpq", free, of_each.matrix),
        np.einsum("hn,hnp->hp", free, of_each.right),
        np.sum(free * of_each.rest, axis=1),
    )


def _log_touched(stops: Stops, variance: Array) -> Array:
    """Log density (n,) of stops that are touched, against untouched ones by prior odds."""
    spread = variance + _TOUCH**2
    density = -0.5 * np.sum(stops.mean**2 / spread + np.log(spread) + LOG_2PI, axis=1)
    return np.asarray(density + np.log(_TOUCHED_SHARE / (1.0 - _TOUCHED_SHARE)))


def _foretold(design: Array, own: Array, mean: Array, covariance: Array, value: Array) -> Array:
    """Log density (h, n) of each stop as the others foretell it.

    With V = S - Phi C Phi^T the covariance of a stop's residual rho in the fit that holds it, the
    others foretell it with the density of rho under V, less log|S| - log|V|.
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
