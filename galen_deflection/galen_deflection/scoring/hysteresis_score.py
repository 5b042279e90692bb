"""Whether a prediction has the hysteresis that was measured: loops, and what is left at no load.

The area of a push's loop is the work of the wrench at the tip on the deflection, from no load to
no load, integral of w . d(delta): forces on translations and torques on rotations, J. It needs no
choice of an axis, and the loop closes along no load, whatever is left. It is positive where the arm
keeps energy, as friction does, and negative where the deflection runs ahead of the load. Stamps of
the tracker that are off against the wrench's open loops as well; but they leave nothing behind.

Noise of the deflection with the standard deviation s of one sample, independent from sample to
sample, gives the area of n samples the variance sum_k |s * c_k|^2, where c_k is what the area takes
of sample k: (w_(k-1) - w_(k+1)) / 2, and the mean over a pause of m samples s^2 / m. What a pause
holds in truth is what was measured, squared, less that: without this the noise would count as
hysteresis. What is measured includes the error of the registration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.pushes import Push
from galen_deflection.measurement.samples import DeflectionSamples

_MIN_REST_SAMPLES = 3
_TOLD_APART = 3.0  # standard deviations


@dataclass(frozen=True)
class LoopScore:
    """Areas of loops, J, a push each: measured (k,), predicted (k,); noise (k,) of the measured."""

    measured: Array
    predicted: Array
    noise: Array

    @property
    def share(self) -> float | None:
        """Predicted sum over measured sum; None if the measured one is lost in its noise."""
        total = float(self.measured.sum())
        if abs(total) <= _TOLD_APART * float(np.linalg.norm(self.noise)):
            return None
        return float(self.predicted.sum()) / total

    def to_dict(self) -> dict[str, Any]:
        """For JSON; areas in mJ (N.mm)."""
        return {
            "pushes": len(self.measured),
            "measured_sum_mJ": 1e3 * float(self.measured.sum()),
            "predicted_sum_mJ": 1e3 * float(self.predicted.sum()),
            "noise_of_sum_mJ": 1e3 * float(np.linalg.norm(self.noise)),
            "predicted_over_measured": self.share,
            "rms_error_mJ": 1e3 * _rms(self.predicted - self.measured),
            "rms_noise_mJ": 1e3 * _rms(self.noise),
        }


@dataclass(frozen=True)
class RestScore:
    """What is left at no load: means of the pauses after k pushes, m and rad.

    measured, predicted (k, 6), and the noise (k, 6) of the measured means.
    """

    measured: Array
    predicted: Array
    noise: Array

    @property
    def error(self) -> Array:
        """Root mean square (6,) of predicted less measured; the noise is in it."""
        return _rms(self.predicted - self.measured)

    def truth_rms(self, axes: slice = slice(0, 6)) -> float | None:
        """Root mean square length, over `axes` (m or rad), of what is left; noise taken out.

        None if it is lost in the noise: then there is no residual to predict.
        """
        square, noise = self._squares(self.measured, axes)
        spread = float(np.sqrt(2.0 * np.sum(self.noise[:, axes] ** 4)))
        if square - noise <= _TOLD_APART * spread:
            return None
        return float(np.sqrt((square - noise) / len(self.measured)))

    def error_share(self, axes: slice = slice(0, 6)) -> float | None:
        """RMS of the prediction's error over that of what is left, noise taken out of both."""
        truth = self.truth_rms(axes)
        if truth is None:
            return None
        square, noise = self._squares(self.predicted - self.measured, axes)
        return float(np.sqrt(max(square - noise, 0.0) / len(self.measured))) / truth

    def gain(self, axes: slice = slice(0, 6)) -> tuple[float, float] | None:
        """How much of what is left is predicted (1: all), and the noise of this number.

        sum(predicted * true) / sum(true^2), the denominator by the measured less its noise.
        """
        truth = self.truth_rms(axes)
        if truth is None:
            return None
        measured, predicted = self.measured[:, axes], self.predicted[:, axes]
        below = truth**2 * len(measured)
        value = float(np.sum(predicted * measured)) / below
        # Of both sums by the measured's noise e: (predicted - 2 gain measured) . e / below.
        taken = (predicted - 2.0 * value * measured) * self.noise[:, axes]
        return value, float(np.linalg.norm(taken)) / below

    def to_dict(self) -> dict[str, Any]:
        """For JSON, in mm and mrad."""
        result: dict[str, Any] = {"pauses": len(self.measured)}
        for name, axes, unit in (
            ("translation", slice(0, 3), "mm"),
            ("rotation", slice(3, 6), "mrad"),
        ):
            truth, gain = self.truth_rms(axes), self.gain(axes)
            result[name] = {
                f"measured_rms_{unit}": (1e3 * _rms(self.measured[:, axes])).tolist(),
                f"error_rms_{unit}": (1e3 * self.error[axes]).tolist(),
                f"noise_rms_{unit}": (1e3 * _rms(self.noise[:, axes])).tolist(),
                f"without_noise_rms_{unit}": None if truth is None else 1e3 * truth,
                "error_share": self.error_share(axes),
                "predicted_over_measured": None if gain is None else gain[0],
                "noise_of_predicted_over_measured": None if gain is None else gain[1],
            }
        return result

    def _squares(self, values: Array, axes: slice) -> tuple[float, float]:
        return float(np.sum(values[:, axes] ** 2)), float(np.sum(self.noise[:, axes] ** 2))


def score_loops(
    samples: DeflectionSamples, predicted: Array, at_tip: Array, pushes: Sequence[Push]
) -> LoopScore | None:
    """Compare loops; predicted (n, 6), at_tip (n, 6) in base_link. None without a push."""
    if not pushes:
        return None
    measured = [loop_area(at_tip[p.rows], samples.deflection[p.rows]) for p in pushes]
    modelled = [loop_area(at_tip[p.rows], predicted[p.rows]) for p in pushes]
    noise = [_area_noise(at_tip[p.rows], samples.noise) for p in pushes]
    return LoopScore(np.array(measured), np.array(modelled), np.array(noise))


def score_rests(
    samples: DeflectionSamples, predicted: Array, pushes: Sequence[Push]
) -> RestScore | None:
    """Compare what is left after pushes; predicted (n, 6). None without a pause to look at."""
    rests = [p.rest for p in pushes if p.rest.stop - p.rest.start >= _MIN_REST_SAMPLES]
    if not rests:
        return None
    return RestScore(
        np.array([samples.deflection[rest].mean(axis=0) for rest in rests]),
        np.array([predicted[rest].mean(axis=0) for rest in rests]),
        np.array([samples.noise / np.sqrt(rest.stop - rest.start) for rest in rests]),
    )


def loop_area(wrench: Array, deflection: Array) -> float:
    """Work of wrenches (n, 6) at the tip on deflections (n, 6), J; by trapezoids."""
    middle = 0.5 * (wrench[1:] + wrench[:-1])
    return float(np.sum(middle * np.diff(deflection, axis=0)))


def _area_noise(wrench: Array, noise: Array) -> float:
    middle = 0.5 * (wrench[1:] + wrench[:-1])
    nothing = np.zeros((1, 6))
    taken = np.concatenate([nothing, middle]) - np.concatenate([middle, nothing])
    return float(np.linalg.norm(taken * noise))


def _rms(values: Array) -> Any:
    """Root mean square over the first axis."""
    return np.sqrt(np.mean(values**2, axis=0))
