"""Pictures of deflection: the report's figures 3 to 5, and measured over predicted.

| file | shows |
|---|---|
| `<name>_course_<model>.png` | measured and predicted over time, at the position where the models are worst |
| `<name>_over_predicted_<model>.png` | measured over predicted, all samples |
"""  # noqa: E501 - a table's row is a line

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
from matplotlib.figure import Figure

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import PredictedSamples
from galen_deflection.scoring.score import AXES

_MEASURED = "#8c8c8c"
_COLOURS = ("#c44e52", "#1f6f8b", "#55a868", "#8172b3", "#dd8452", "#937860", "#e377c2")
_UNITS = ("mm", "mm", "mm", "mrad", "mrad", "mrad")
_PAUSE_S = 0.5  # a gap between two segments is drawn as long
_SIGMAS = 2.0


def plot_models(
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    folder: Path,
    name: str,
) -> list[Path]:
    """Draw the module's pictures of predictions by models' names; returns the files.

    `name` begins the files' names and the titles. Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = _rejoined(samples)
    written = []
    position = _worst_position(samples, predictions)
    set_number = samples.set_number[samples.position == position][0]
    rows = (samples.position == position) & (samples.set_number == set_number)
    for model, predicted in predictions.items():
        written += [
            plot_course(
                samples.rows(rows),
                predicted.rows(rows),
                folder / f"{name}_course_{model}.png",
                f"{name}; {model}, position {position}: where the models are worst",
            ),
            plot_true_over_predicted(
                samples,
                predicted,
                folder / f"{name}_over_predicted_{model}.png",
                f"{name}; {model}, all that was checked",
            ),
        ]
    return written


def plot_course(
    samples: DeflectionSamples, predicted: PredictedSamples, path: Path, title: str = ""
) -> Path:
    """Draw measured and predicted translation over time, an axis a row; returns `path`.

    The band is two standard deviations of the prediction. Time between segments is left out.
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
    return _written(figure, title, path)


def plot_true_over_predicted(
    samples: DeflectionSamples, predicted: PredictedSamples, path: Path, title: str = ""
) -> Path:
    """Draw measured over predicted, six panels, a colour a position; returns `path`.

    A perfect prediction lies on the diagonal, within the noise: the band is two of its standard
    deviations. Crosses are samples that the model calls extrapolated.
    """
    figure, panels = plt.subplots(2, 3, figsize=(12, 8))
    outside = np.asarray(predicted.extrapolated, dtype=bool)
    for axis, panel in enumerate(panels.flat):
        across, up = 1e3 * predicted.mean[:, axis], 1e3 * samples.deflection[:, axis]
        for k, position in enumerate(np.unique(samples.position)):
            at = samples.position == position
            colour = _COLOURS[k % len(_COLOURS)]
            for rows, marker, size, what in (
                (at & ~outside, ".", 2.0, ""),
                (at & outside, "x", 3.0, ", extrapolated"),
            ):
                if rows.any():
                    panel.plot(across[rows], up[rows], marker, color=colour, ms=size,
                               label=f"position {position}{what}", rasterized=True)  # fmt: skip
        ends = np.array([min(across.min(), up.min()), max(across.max(), up.max())])
        width = _SIGMAS * 1e3 * float(samples.noise[axis])
        panel.fill_between(ends, ends - width, ends + width, color="black", alpha=0.12, lw=0)
        panel.plot(ends, ends, color="black", lw=0.8)
        panel.set_title(f"{AXES[axis]}, {_UNITS[axis]}", fontsize=10)
        panel.set_xlabel("predicted")
        panel.set_ylabel("measured")
    panels[0, 0].legend(frameon=False, fontsize=8, markerscale=2.0)
    return _written(figure, title, path)


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
    panel.plot(drawn_time, mean, color=_COLOURS[0], lw=1.1, label="predicted")
    width = _SIGMAS * 1e3 * np.sqrt(predicted.covariance[:, axis, axis])
    width = np.insert(width, breaks, np.nan)
    panel.fill_between(drawn_time, mean - width, mean + width, color=_COLOURS[0], alpha=0.18, lw=0)
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


def _written(figure: Figure, title: str, path: Path) -> Path:
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    figure.tight_layout()
    return save_figure(figure, path)
