# SPDX-License-Identifier: Apache-2.0
"""How well a deflection is predicted: errors over the noise, coverage, residuals at no load.

The residual at no load is what hysteresis leaves: the mean deflection of the pause after a push.
The noise of a mean over m samples is s / sqrt(m), s that of one sample. The true mean square is the
measured less that noise's: without this the noise would count as hysteresis. What is measured
includes the error of the registration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf, normal_ppf

from galen_deflection.measurement.samples import (
    DeflectionError,
    DeflectionSamples,
    LoadCycle,
    find_pushes,
    no_load,
)
from galen_deflection.models.interface import PredictedSamples
from galen_deflection.models.springs import tip_wrench

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Order of a deflection: translation, then rotation vector, in base_link."""

TRANSLATION, ROTATION = slice(0, 3), slice(3, 6)

_CONFIDENCE = 0.95
_MIN_REST_SAMPLES = 3
_SIGNIFICANT = 3.0  # standard deviations


@dataclass(frozen=True)
class RestScore:
    """Residuals at no load: means of the pauses after k pushes, m and rad.

    measured, predicted (k, 6), and the noise (k, 6) of the measured means.
    """

    measured: Array
    predicted: Array
    noise: Array

    def truth_rms(self, axes: slice = slice(0, 6)) -> float | None:
        """Return the residuals' root mean square length over some axes, less the noise.

        Args:
            axes: of `AXES`; of one unit.

        Returns:
            m or rad; None if it is lost in the noise: then there is no residual to predict.

        """
        square, noise = self._squares(self.measured, axes)
        spread = float(np.sqrt(2.0 * np.sum(self.noise[:, axes] ** 4)))
        if square - noise <= _SIGNIFICANT * spread:
            return None
        return float(np.sqrt((square - noise) / len(self.measured)))

    def error_share(self, axes: slice = slice(0, 6)) -> float | None:
        """Return the RMS of the prediction's error over that of the residual, both less the noise.

        Args:
            axes: of `AXES`; of one unit.

        Returns:
            0 for a perfect prediction; None if the residual is lost in the noise.

        """
        truth = self.truth_rms(axes)
        if truth is None:
            return None
        square, noise = self._squares(self.predicted - self.measured, axes)
        return float(np.sqrt(max(square - noise, 0.0) / len(self.measured))) / truth

    def gain(self, axes: slice = slice(0, 6)) -> tuple[float, float] | None:
        """Return how much of the residual is predicted.

        sum(predicted * true) / sum(true^2), the denominator by the measured less its noise.

        Args:
            axes: of `AXES`; of one unit.

        Returns:
            The share (1: all), and the noise of this number; None if the residual is lost in the
            noise.

        """
        truth = self.truth_rms(axes)
        if truth is None:
            return None
        measured, predicted = self.measured[:, axes], self.predicted[:, axes]
        below = truth**2 * len(measured)
        value = float(np.sum(predicted * measured)) / below
        # Of both sums by the measured's noise e: (predicted - 2 gain measured) . e / below.
        by_noise = (predicted - 2.0 * value * measured) * self.noise[:, axes]
        return value, float(np.linalg.norm(by_noise)) / below

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers in mm and mrad."""
        result: dict[str, Any] = {"pauses": len(self.measured)}
        for name, axes, unit in (
            ("translation", TRANSLATION, "mm"),
            ("rotation", ROTATION, "mrad"),
        ):
            truth, gain = self.truth_rms(axes), self.gain(axes)
            result[name] = {
                f"without_noise_rms_{unit}": None if truth is None else 1e3 * truth,
                "error_share": self.error_share(axes),
                "predicted_over_measured": None if gain is None else gain[0],
                "noise_of_predicted_over_measured": None if gain is None else gain[1],
            }
        return result

    def _squares(self, values: Array, axes: slice) -> tuple[float, float]:
        return float(np.sum(values[:, axes] ** 2)), float(np.sum(self.noise[:, axes] ** 2))


@dataclass(frozen=True)
class Score:
    """Of one model's prediction of `samples` samples; arrays (6,) in the order of `AXES`.

    rmse, percentile95: of predicted less measured, m and rad. noise: of one measured deflection, m
    and rad; what a perfect prediction leaves. coverage: share of the measured ones inside the 95 %
    interval of the model's variance and the noise; coverage_joint: inside its 95 % ellipsoid.
    extrapolated: share of samples that the model calls so. rests: None without pushes.
    """

    samples: int
    rmse: Array
    percentile95: Array
    noise: Array
    coverage: Array
    coverage_joint: float
    extrapolated: float
    rests: RestScore | None

    @property
    def ratio(self) -> Array:
        """RMSE over noise (6,); 1 is the floor."""
        return self.rmse / self.noise

    def ratio_of(self, axes: slice = slice(0, 6)) -> float:
        """Return the RMSE over noise of axes together: root of the mean square of `ratio`.

        Args:
            axes: of `AXES`.

        Returns:
            1 is the floor.

        """
        return float(np.sqrt(np.mean(self.ratio[axes] ** 2)))

    def to_json(self) -> dict[str, Any]:
        """Return lists of three axes in mm and mrad; no NaN."""
        result: dict[str, Any] = {"samples": self.samples}
        for name, values in (
            ("rmse", self.rmse),
            ("percentile95", self.percentile95),
            ("noise", self.noise),
        ):
            result[f"{name}_mm"] = (1e3 * values[TRANSLATION]).tolist()
            result[f"{name}_mrad"] = (1e3 * values[ROTATION]).tolist()
        return result | {
            "rmse_over_noise": dict(zip(AXES, self.ratio.tolist(), strict=True)),
            "rmse_over_noise_all": self.ratio_of(),
            "rmse_over_noise_translation": self.ratio_of(TRANSLATION),
            "rmse_over_noise_rotation": self.ratio_of(ROTATION),
            "coverage95": dict(zip(AXES, self.coverage.tolist(), strict=True)),
            "coverage95_joint": self.coverage_joint,
            "extrapolated": self.extrapolated,
            "rests": None if self.rests is None else self.rests.to_json(),
        }


def score(
    samples: DeflectionSamples,
    predicted: PredictedSamples,
    limits: tuple[float, float] | None = None,
) -> Score:
    """Score a prediction.

    Args:
        samples: n samples, at least one.
        predicted: of these samples.
        limits: force (N) and torque (N.m) that are no load; None: as `find_pushes` chooses them.

    Returns:
        Errors in base_link, m and rad.

    Raises:
        DeflectionError: there are no samples, shapes don't fit, a value is not finite, or the noise
            is not positive.

    """
    _check(samples, predicted)
    error = predicted.mean - samples.deflection
    covariance = predicted.covariance + np.diag(samples.noise**2)
    pushes = find_pushes(samples, tip_wrench(samples), limits)
    width = normal_ppf(0.5 + 0.5 * _CONFIDENCE)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return Score(
        samples=len(samples),
        rmse=np.sqrt(np.mean(error**2, axis=0)),
        percentile95=np.percentile(np.abs(error), 95.0, axis=0),
        noise=np.asarray(samples.noise, dtype=float),
        coverage=np.mean(error**2 <= width**2 * variance, axis=0),
        coverage_joint=_joint_coverage(error, covariance),
        extrapolated=float(np.mean(predicted.extrapolated)),
        rests=_score_rests(samples, predicted.mean, pushes),
    )


def by_position(samples: DeflectionSamples, predicted: PredictedSamples) -> dict[int, Score]:
    """Return the score of each position's samples by itself.

    Args:
        samples: n samples.
        predicted: of these samples.

    Returns:
        Scores by the position's number.

    Raises:
        DeflectionError: as of `score`.

    """
    limits = no_load(tip_wrench(samples))
    found = {}
    for position in np.unique(samples.position).tolist():
        rows = samples.position == position
        found[position] = score(samples.rows(rows), predicted.rows(rows), limits)
    return found


def _score_rests(
    samples: DeflectionSamples, predicted: Array, pushes: Sequence[LoadCycle]
) -> RestScore | None:
    """Of the pauses after pushes; predicted (n, 6). None without a pause to look at."""
    rests = [p.rest for p in pushes if p.rest.stop - p.rest.start >= _MIN_REST_SAMPLES]
    if not rests:
        return None
    return RestScore(
        np.array([samples.deflection[rest].mean(axis=0) for rest in rests]),
        np.array([predicted[rest].mean(axis=0) for rest in rests]),
        np.array([samples.noise / np.sqrt(rest.stop - rest.start) for rest in rests]),
    )


def _joint_coverage(error: Array, covariance: Array) -> float:
    try:
        # Of a matrix that is no covariance there is no root.
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as reason:
        raise DeflectionError(
            "a prediction's covariance is none: with the noise added it isn't positive"
        ) from reason
    scaled = np.linalg.solve(root, error[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(scaled**2, axis=1) <= chi2_ppf(_CONFIDENCE, 6)))


def _check(samples: DeflectionSamples, predicted: PredictedSamples) -> None:
    count = len(samples)
    if not count:
        raise DeflectionError("there are no samples to score")
    if np.shape(samples.noise) != (6,) or not np.all(np.asarray(samples.noise) > 0.0):
        raise DeflectionError(f"the noise of the samples is {samples.noise}, but must be positive")
    for name, values, shape in (
        ("measured deflections", samples.deflection, (count, 6)),
        ("predicted deflections", predicted.mean, (count, 6)),
        ("covariances", predicted.covariance, (count, 6, 6)),
        ("extrapolated", predicted.extrapolated, (count,)),
    ):
        if np.shape(values) != shape:
            raise DeflectionError(
                f"{name} have the shape {np.shape(values)}, but must have {shape}"
            )
        bad = ~np.isfinite(np.reshape(values, (count, -1)).astype(float)).all(axis=1)
        if bad.any():
            raise DeflectionError(f"{name}: sample {int(np.argmax(bad))} is not finite")
