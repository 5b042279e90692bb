"""Pictures of deflection: the report's figures, and predicted against measured.

Of the report's figures only the captions and the text are known. Here they are:

| figure | shows | here |
|---|---|---|
| 3 | true and predicted deflection, independent axes, trained at the same joints | `plot_course` |
| 4 | the same, trained at other joints | `plot_course` |
| 5 | the same as 3, coupled axes | `plot_course` |
| 7 | the network's training | `plot_training` |
| 10, 11 | predicted and actual deflection along x, two examples | `plot_axis` |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from galen_deflection.measurement.pushes import tip_wrench
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import PredictedSamples
from galen_deflection.scoring.score import AXES

_MEASURED = "#8c8c8c"
_COLOURS = ("#c44e52", "#1f6f8b", "#55a868", "#8172b3", "#dd8452", "#937860", "#e377c2")
_UNITS = ("mm", "mm", "mm", "mrad", "mrad", "mrad")
_PAUSE_S = 0.5  # what a gap between two segments is drawn as
_SIGMAS = 2.0


def plot_course(
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    path: Path,
    title: str = "",
    axes: Sequence[int] = (0, 1, 2),
) -> Path:
    """Measured and predicted deflection over time, an axis a row; returns `path`.

    Predictions by their models' names; `axes` in the order of `AXES`. Time between segments is left
    out. One prediction alone has a band: two of its standard deviations.
    """
    figure, panels = plt.subplots(
        len(axes), 1, figsize=(12, 1.0 + 2.2 * len(axes)), sharex=True, squeeze=False
    )
    time, borders = _drawn_time(samples)
    for panel, axis in zip(panels[:, 0], axes, strict=True):
        _draw_course(panel, time, samples, predictions, axis)
        for border in borders:
            panel.axvline(border, color="black", lw=0.5, ls=":")
        panel.margins(x=0.0)
    panels[-1, 0].set_xlabel("time, s" + (" (dotted: time left out)" if borders else ""))
    _legend(panels[0, 0])
    return _written(figure, title, path)


def plot_axis(
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    path: Path,
    axis: int = 0,
    title: str = "",
) -> Path:
    """One axis from near: over time on the left, over the load along it on the right.

    The right panel shows the loops. `samples` should be few: some pushes. Returns `path`.
    """
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(13, 4.6), gridspec_kw={"width_ratios": (2.2, 1.0)}
    )
    time, borders = _drawn_time(samples)
    _draw_course(left, time, samples, predictions, axis)
    for border in borders:
        left.axvline(border, color="black", lw=0.5, ls=":")
    left.margins(x=0.0)
    left.set_xlabel("time, s")
    _legend(left)
    load = tip_wrench(samples)[:, axis]
    right.plot(load, 1e3 * samples.deflection[:, axis], ".", color=_MEASURED, ms=2.5)
    breaks = np.flatnonzero(np.diff(samples.segment)) + 1
    for colour, predicted in zip(_cycled(predictions), predictions.values(), strict=True):
        # A line over a border would be a load that was not applied.
        drawn = np.insert(1e3 * predicted.mean[:, axis], breaks, np.nan)
        right.plot(np.insert(load, breaks, np.nan), drawn, color=colour, lw=1.0)
    right.set_xlabel(f"{'force' if axis < 3 else 'torque'} along {AXES[axis][-1]} at the tip, "
                     f"{'N' if axis < 3 else 'N.m'}")  # fmt: skip
    right.set_ylabel(f"{AXES[axis]}, {_UNITS[axis]}")
    return _written(figure, title, path)


def plot_true_over_predicted(
    samples: DeflectionSamples, predicted: PredictedSamples, path: Path, title: str = ""
) -> Path:
    """Measured over predicted, six panels, a colour a position; returns `path`.

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
        low = min(float(across.min()), float(up.min()))
        high = max(float(across.max()), float(up.max()))
        ends = np.array([low, high])
        width = _SIGMAS * 1e3 * float(samples.noise[axis])
        panel.fill_between(ends, ends - width, ends + width, color="black", alpha=0.12, lw=0)
        panel.plot(ends, ends, color="black", lw=0.8)
        panel.set_title(f"{AXES[axis]}, {_UNITS[axis]}", fontsize=10)
        panel.set_xlabel("predicted")
        panel.set_ylabel("measured")
    panels[0, 0].legend(frameon=False, fontsize=8, markerscale=2.0)
    return _written(figure, title, path)


def plot_training(
    training_loss: Sequence[float],
    check_loss: Sequence[float],
    path: Path,
    best: int | None = None,
    unit: str = "root mean square error / noise",
    title: str = "",
) -> Path:
    """A network's training: its loss after every iteration, on what it learns and what it doesn't.

    Lists of equal length, or no `check_loss` where nothing was held out; `best` counts from 0, the
    iteration that was kept. Returns `path`. Raises ValueError for other lengths, or an empty list.
    """
    if len(check_loss) not in (0, len(training_loss)) or not len(training_loss):
        raise ValueError(
            f"{len(training_loss)} losses of training and {len(check_loss)} of checking"
        )
    figure, panel = plt.subplots(figsize=(9, 4.6))
    iterations = np.arange(1, len(training_loss) + 1)
    panel.plot(iterations, training_loss, color=_COLOURS[1], lw=1.2, label="training sets")
    if len(check_loss):
        panel.plot(iterations, check_loss, color=_COLOURS[0], lw=1.2, label="held out")
    if best is not None:
        panel.axvline(best + 1, color="black", lw=0.8, ls="--", label=f"kept: {best + 1}")
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_formatter("{x:g}")
    panel.set_xlabel("iteration")
    panel.set_ylabel(unit)
    panel.grid(which="both", alpha=0.25)
    panel.legend(frameon=False)
    return _written(figure, title, path)


# --- inside -------------------------------------------------------------------------------------


def _draw_course(
    panel: Axes,
    time: Array,
    samples: DeflectionSamples,
    predictions: Mapping[str, PredictedSamples],
    axis: int,
) -> None:
    panel.axhline(0.0, color="black", lw=0.6)
    panel.plot(time, 1e3 * samples.deflection[:, axis], ".", color=_MEASURED, ms=2.0,
               label="measured", rasterized=True)  # fmt: skip
    breaks = np.flatnonzero(np.diff(samples.segment)) + 1
    drawn_time = np.insert(time, breaks, np.nan)
    for colour, (name, predicted) in zip(_cycled(predictions), predictions.items(), strict=True):
        mean = np.insert(1e3 * predicted.mean[:, axis], breaks, np.nan)
        panel.plot(drawn_time, mean, color=colour, lw=1.1, label=name)
        if len(predictions) > 1:  # bands over bands can't be distinguished
            continue
        width = _SIGMAS * 1e3 * np.sqrt(predicted.covariance[:, axis, axis])
        width = np.insert(width, breaks, np.nan)
        panel.fill_between(drawn_time, mean - width, mean + width, color=colour, alpha=0.18, lw=0)
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


def _cycled(names: Mapping[str, object]) -> list[str]:
    return [_COLOURS[k % len(_COLOURS)] for k in range(len(names))]


def _legend(panel: Axes) -> None:
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=6, frameon=False,
                 markerscale=4.0, fontsize=9)  # fmt: skip


def _written(figure: Figure, title: str, path: Path) -> Path:
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    figure.tight_layout()
    return save_figure(figure, path)
