# SPDX-License-Identifier: Apache-2.0
"""The report's figures 3 to 5: measured and predicted deflection over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.axes import Axes

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import PredictedSamples
from galen_deflection.scoring.score import AXES

_MEASURED = "#8c8c8c"
_PREDICTED = "#c44e52"
_UNITS = ("mm", "mm", "mm", "mrad", "mrad", "mrad")
_PAUSE_S = 0.5  # a gap between two segments is drawn as long
_SIGMAS = 2.0


def plot_models(
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    folder: Path,
    name: str,
) -> list[Path]:
    """Draw a course of each model where the models are worst.

    Args:
        samples: n samples.
        predictions: of these samples, by model.
        folder: where the pictures go; made if need be.
        name: begins the files' names and the titles.

    Returns:
        The files written, one for each model.

    Raises:
        OSError: a picture can't be written.

    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = _rejoined(samples)
    written = []
    position = _worst_position(samples, predictions)
    set_number = samples.set_number[samples.position == position][0]
    rows = (samples.position == position) & (samples.set_number == set_number)
    for model, predicted in predictions.items():
        written.append(
            plot_course(
                samples.rows(rows),
                predicted.rows(rows),
                folder / f"{name}_course_{model}.png",
                f"{name}: {model} at position {position}, where the models are worst",
            )
        )
    return written


def plot_course(
    samples: DeflectionSamples, predicted: PredictedSamples, path: Path, title: str
) -> Path:
    """Draw measured and predicted translation over time, an axis a row.

    The band is two standard deviations of the prediction. Time between segments is left out.

    Args:
        samples: n samples.
        predicted: their predictions.
        path: picture to write.
        title: line above the picture.

    Returns:
        `path`.

    Raises:
        OSError: the picture can't be written.

    """
    figure, panels = plt.subplots(3, 1, figsize=(12, 7.6), sharex=True)
    time, borders = _drawn_time(samples)
    for axis, panel in enumerate(panels):
        _draw_course(panel, time, samples, predicted, axis)
        for border in borders:
            panel.axvline(border, color="black", lw=0.5, ls=":")
        panel.margins(x=0.0)
    panels[-1].set_xlabel("time, s" + (" (dotted: time left out)" if borders else ""))
    panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=6, frameon=False,
                     markerscale=4.0, fontsize=9)  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    figure.tight_layout()
    return save_figure(figure, path)


def _draw_course(
    panel: Axes, time: Array, samples: DeflectionSamples, predicted: PredictedSamples, axis: int
) -> None:
    panel.axhline(0.0, color="black", lw=0.6)
    panel.plot(time, 1e3 * samples.deflection[:, axis], ".", color=_MEASURED, ms=2.0,
               label="measured", rasterized=True)  # fmt: skip
    # A line over a border would be a deflection that was not predicted.
    breaks = np.flatnonzero(np.diff(samples.segment)) + 1
    drawn_time = np.insert(time, breaks, np.nan)
    mean = np.insert(1e3 * predicted.mean[:, axis], breaks, np.nan)
    panel.plot(drawn_time, mean, color=_PREDICTED, lw=1.1, label="predicted")
    width = _SIGMAS * 1e3 * np.sqrt(predicted.covariance[:, axis, axis])
    width = np.insert(width, breaks, np.nan)
    panel.fill_between(drawn_time, mean - width, mean + width, color=_PREDICTED, alpha=0.18, lw=0,
                       label="± 2 standard deviations of the prediction")  # fmt: skip
    panel.set_ylabel(f"{AXES[axis]}, {_UNITS[axis]}")


def _drawn_time(samples: DeflectionSamples) -> tuple[Array, list[float]]:
    """Time (n,) from 0 on, s, with all gaps between segments alike, and where they are."""
    time = (samples.stamp_ns - samples.stamp_ns[0]) * 1e-9
    starts = np.flatnonzero(np.diff(samples.segment)) + 1
    borders = []
    for start in starts:
        time[start:] += time[start - 1] + _PAUSE_S - time[start]
        borders.append(float(time[start] - 0.5 * _PAUSE_S))
    return time, borders


def _rejoined(samples: DeflectionSamples) -> DeflectionSamples:
    """With segments that end only where time does, and not where a split cut them."""
    step_ns = np.diff(samples.stamp_ns)
    within = np.abs(step_ns) <= 2.5 * np.median(np.abs(step_ns)) if len(step_ns) else step_ns == 0
    same = (np.diff(samples.segment) == 0) | within
    return replace(samples, segment=np.concatenate([[0], np.cumsum(~same)]))


def _worst_position(samples: DeflectionSamples, predictions: Mapping[str, PredictedSamples]) -> int:
    """Where the models' errors over the noise, each in units of that model's own, are largest."""
    positions = np.unique(samples.position)
    total = np.zeros(len(positions))
    for predicted in predictions.values():
        square = np.mean(((predicted.mean - samples.deflection) / samples.noise) ** 2, axis=1)
        total += [square[samples.position == p].mean() / square.mean() for p in positions]
    return int(positions[np.argmax(total)])
