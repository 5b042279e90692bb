"""How well a deflection is predicted: errors against the noise, coverage, hysteresis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf, normal_ppf
from galen_model.errors import GalenError

from galen_deflection.measurement.pushes import PushLimits, find_pushes, tip_wrench
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import PredictedSamples
from galen_deflection.scoring.hysteresis_score import LoopScore, RestScore, score_loops, score_rests

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Order of a deflection: translation, then rotation vector, in base_link."""

_CONFIDENCE = 0.95


class ScoreError(GalenError):
    """A prediction that can't be scored; the message says why."""


@dataclass(frozen=True)
class Score:
    """Of one model's prediction of `samples` samples; arrays (6,) in the order of `AXES`.

    rmse, percentile95: of predicted less measured, m and rad. noise: of one measured deflection, m
    and rad; what a perfect prediction leaves. coverage: share of the measured ones inside the 95 %
    interval of the model's variance and the noise; coverage_joint: inside its 95 % ellipsoid.
    extrapolated: share of samples for which the model says so. loops, rests: None without pushes.
    """

    samples: int
    rmse: Array
    percentile95: Array
    noise: Array
    coverage: Array
    coverage_joint: float
    extrapolated: float
    loops: LoopScore | None
    rests: RestScore | None

    @property
    def ratio(self) -> Array:
        """RMSE over noise (6,); 1 is the floor."""
        return self.rmse / self.noise

    @property
    def ratio_all(self) -> float:
        """RMSE over noise of all axes together: root of the mean square of `ratio`."""
        return self.ratio_of(slice(0, 6))

    def ratio_of(self, axes: slice) -> float:
        """The same of some axes: 0 to 3 translation, 3 to 6 rotation."""
        return float(np.sqrt(np.mean(self.ratio[axes] ** 2)))

    @property
    def beyond_noise(self) -> float | None:
        """The prediction's own error over the noise, all axes; None if it is lost in the noise.

        What is measured is off by both, which add as squares: sqrt(ratio_all^2 - 1).
        """
        square = self.ratio_all**2 - 1.0
        return float(np.sqrt(square)) if square > 0.0 else None

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lists of three axes in mm and mrad; no NaN."""
        result: dict[str, Any] = {"samples": self.samples}
        for name, values in (
            ("rmse", self.rmse),
            ("percentile95", self.percentile95),
            ("noise", self.noise),
        ):
            result[f"{name}_mm"] = (1e3 * values[:3]).tolist()
            result[f"{name}_mrad"] = (1e3 * values[3:]).tolist()
        return result | {
            "rmse_over_noise": dict(zip(AXES, self.ratio.tolist(), strict=True)),
            "rmse_over_noise_all": self.ratio_all,
            "error_beyond_noise_over_noise": self.beyond_noise,
            "rmse_over_noise_translation": self.ratio_of(slice(0, 3)),
            "rmse_over_noise_rotation": self.ratio_of(slice(3, 6)),
            "coverage95": dict(zip(AXES, self.coverage.tolist(), strict=True)),
            "coverage95_joint": self.coverage_joint,
            "extrapolated": self.extrapolated,
            "loops": None if self.loops is None else self.loops.to_dict(),
            "rests": None if self.rests is None else self.rests.to_dict(),
        }


def score(
    samples: DeflectionSamples, predicted: PredictedSamples, limits: PushLimits | None = None
) -> Score:
    """Score a prediction of these samples.

    Raises ScoreError if there are none, if the shapes don't fit, if something is not finite, or if
    the noise is not positive.
    """
    _check(samples, predicted)
    error = predicted.mean - samples.deflection
    covariance = predicted.covariance + np.diag(samples.noise**2)
    at_tip = tip_wrench(samples)
    pushes = find_pushes(samples, at_tip, limits)
    return Score(
        samples=len(samples),
        rmse=np.sqrt(np.mean(error**2, axis=0)),
        percentile95=np.percentile(np.abs(error), 95.0, axis=0),
        noise=np.asarray(samples.noise, dtype=float),
        coverage=_coverage(error, covariance),
        coverage_joint=_joint_coverage(error, covariance),
        extrapolated=float(np.mean(predicted.extrapolated)),
        loops=score_loops(samples, predicted.mean, at_tip, pushes),
        rests=score_rests(samples, predicted.mean, pushes),
    )


def _coverage(error: Array, covariance: Array) -> Array:
    width = normal_ppf(0.5 + 0.5 * _CONFIDENCE)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.asarray(np.mean(error**2 <= width**2 * variance, axis=0))


def _joint_coverage(error: Array, covariance: Array) -> float:
    try:
        # Of a matrix that is no covariance there is no root.
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as reason:
        raise ScoreError(
            "a prediction's covariance is none: with the noise added it isn't positive"
        ) from reason
    scaled = np.linalg.solve(root, error[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(scaled**2, axis=1) <= chi2_ppf(_CONFIDENCE, 6)))


def _check(samples: DeflectionSamples, predicted: PredictedSamples) -> None:
    count = len(samples)
    if not count:
        raise ScoreError("there are no samples to score")
    if np.shape(samples.noise) != (6,) or not np.all(np.asarray(samples.noise) > 0.0):
        raise ScoreError(f"the noise of the samples is {samples.noise}, but must be positive")
    for name, values, shape in (
        ("measured deflections", samples.deflection, (count, 6)),
        ("predicted deflections", predicted.mean, (count, 6)),
        ("covariances", predicted.covariance, (count, 6, 6)),
        ("extrapolated", predicted.extrapolated, (count,)),
    ):
        if np.shape(values) != shape:
            raise ScoreError(f"{name} have the shape {np.shape(values)}, but must have {shape}")
        bad = ~np.isfinite(np.reshape(values, (count, -1)).astype(float)).all(axis=1)
        if bad.any():
            raise ScoreError(f"{name}: sample {int(np.argmax(bad))} is not finite")
