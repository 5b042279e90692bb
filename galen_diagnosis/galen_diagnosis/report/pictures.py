"""Pictures of a diagnosis: where the gap is, and the residual in time, before and after.

Both states have the same scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle

from galen_diagnosis.answer.answer import Diagnosis
from galen_diagnosis.answer.localization import (
    LEVEL,
    View,
    by_regime_of_bag,
    cell_scores,
)
from galen_diagnosis.observation.rows import BAGS, CHANNELS, GROUPS, REGIMES, Stream, group_of
from galen_diagnosis.report.words import share_words

_AXES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
"""Okabe and Ito's: colour-blind people see the difference, too."""
_POINTS = 180
_UNITS = {
    "force": (1e3, "mN"),
    "torque": (1e3, "mN.m"),
    "tip translation": (1e6, "µm"),
    "tip rotation": (1e6, "µrad"),
}
_BEYOND = 1.15
_MAP = "YlOrBr"
_STATES = ("before", "after")
_LEAST_TOP = 3.0
_TICKS = (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000)
_DARK = 0.55
"""Beyond this part of the colours' range, text is white."""


def write_pictures(diagnosis: Diagnosis, folder: Path) -> dict[str, Path]:
    """Write all pictures that the recording has data for; their names to their files."""
    written = {"gap": save_figure(gap_figure(diagnosis), folder / "gap.png")}
    if diagnosis.streams_before:
        written["time"] = save_figure(_times_figure(diagnosis), folder / "time.png")
    return written


# Where


def gap_figure(diagnosis: Diagnosis) -> plt.Figure:
    """Draw the RMS residual over the noise: channels by regimes of bags, before and after.

    A black frame marks a cell beyond noise and a healthy arm's tolerances (p < 0.05, corrected for
    all cells of the map).
    """
    view = by_regime_of_bag(diagnosis.rows)
    residuals = (diagnosis.held_out_before, diagnosis.held_out_after)
    cells = [
        cell_scores(diagnosis.rows, residual, view, diagnosis.floor, diagnosis.healthy)
        for residual in residuals
    ]
    channels = list(dict.fromkeys(one["channel"] for one in view.details))
    channels.sort(key=CHANNELS.index)
    columns = _columns(view)
    top = max(_LEAST_TOP, *(float(np.sqrt(ratio).max(initial=1.0)) for _, ratio, _ in cells))
    height = 2.3 + 0.33 * len(channels)
    figure, axes = plt.subplots(1, 2, figsize=(4.0 + 1.05 * len(columns), height), sharey=True)
    norm = LogNorm(1.0, top)
    for axis, (_, ratio, p), state, residual in zip(axes, cells, _STATES, residuals, strict=True):
        rms = np.sqrt(np.mean(residual**2) / diagnosis.floor) if len(residual) else np.nan
        _draw_cells(axis, view, ratio, p, channels, columns, norm)
        axis.set_title(f"{state}: {rms:.2f} × noise over all", fontsize=12)
    axes[0].set_yticks(range(len(channels)), channels)
    _margins(figure, 0.6, 0.3, 0.95, 0.95, between_x=0.04)
    bar = figure.colorbar(plt.cm.ScalarMappable(norm=norm, cmap=_MAP), ax=axes, pad=0.02)
    ticks = [tick for tick in _TICKS if tick <= top]
    bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
    bar.ax.minorticks_off()
    bar.set_label("RMS residual over noise (1: noise alone)")
    figure.suptitle(_headline(diagnosis), fontsize=11)
    return figure


def _headline(diagnosis: Diagnosis) -> str:
    answer = diagnosis.answer
    causes = " + ".join(cause.label for cause in answer.causes)
    text = answer.verdict if not causes else f"{answer.verdict}: {causes}"
    if answer.gap.get("closed_fraction"):
        text += f"; {share_words(answer.gap['closed_fraction'])} of the gap closed"
    return f"{text}\nframed: beyond noise and tolerances (p < 0.05, corrected for all cells)"


def _columns(view: View) -> list[tuple[str, str]]:
    there = {(detail["bag"], detail["regime"]) for detail in view.details}
    return sorted(there, key=lambda one: (BAGS.index(one[0]), REGIMES.index(one[1])))


def _draw_cells(
    axis: plt.Axes,
    view: View,
    ratios: Array,
    p_values: Array,
    channels: Sequence[str],
    columns: Sequence[tuple[str, str]],
    norm: LogNorm,
) -> None:
    values = np.full((len(channels), len(columns)), np.nan)
    marked = np.zeros(values.shape, dtype=bool)
    for detail, ratio, p in zip(view.details, ratios, p_values, strict=True):
        at = channels.index(detail["channel"]), columns.index((detail["bag"], detail["regime"]))
        values[at] = np.sqrt(ratio)
        marked[at] = p < LEVEL
    axis.set_facecolor("0.9")
    axis.imshow(np.clip(values, norm.vmin, None), norm=norm, cmap=_MAP, aspect="auto")
    for row, column in np.argwhere(np.isfinite(values)):
        value, bold = values[row, column], marked[row, column]
        dark = norm(max(value, 1.0)) > _DARK
        axis.text(
            column,
            row,
            f"{value:.1f}" if value < 99.5 else f"{value:.0f}",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if dark else "black" if bold else "0.55",
            fontweight="bold" if bold else "normal",
        )
        if bold:
            place = (column - 0.46, row - 0.44)
            axis.add_patch(Rectangle(place, 0.92, 0.88, fill=False, ec="black", lw=1.4))
    names = [f"{bag}\n{regime}" for bag, regime in columns]
    axis.set_xticks(range(len(columns)), names, fontsize=8, rotation=45)
    for row in range(1, len(channels)):
        if group_of(channels[row]) != group_of(channels[row - 1]):
            axis.axhline(row - 0.5, color="white", lw=3)


# In time


def _times_figure(diagnosis: Diagnosis) -> plt.Figure:
    """Draw a line of panels for each bag and group of channels, before and after."""
    lines = list(_lines(diagnosis))
    figure, axes = plt.subplots(
        len(lines),
        2,
        figsize=(13, 1.75 * len(lines) + 0.4),
        squeeze=False,
        sharey="row",
    )
    for row, (bag, group, before, after) in enumerate(lines):
        factor, unit = _UNITS[group]
        top = 0.0
        for axis, streams, state in zip(axes[row], (before, after), _STATES, strict=True):
            top = max(top, _draw(axis, streams, group, factor))
            axis.set_title(f"{bag}: {group}, {state}", fontsize=9, loc="left")
            axis.margins(x=0.01)
        axes[row, 0].set_ylim(-_BEYOND * top, _BEYOND * top)
        axes[row, 0].set_ylabel(unit)
        axes[row, 0].legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.97), ncol=3, fontsize=8, frameon=False
        )
    for axis in axes[-1]:
        axis.set_xlabel("time in the bag, s (grey: ± 2 σ of the noise of a point)")
    _margins(figure, 0.9, 0.15, 0.5, 0.3, between_x=0.05, between_y=0.5)
    return figure


def _lines(
    diagnosis: Diagnosis,
) -> Iterator[tuple[str, str, list[Stream], list[Stream]]]:
    bags = list(dict.fromkeys(stream.bag for stream in diagnosis.streams_before))
    for bag in bags:
        for group in GROUPS:
            if group not in _UNITS:
                continue
            before, after = (
                [
                    stream
                    for stream in streams
                    if stream.bag == bag and any(group_of(c) == group for c in stream.channels)
                ]
                for streams in (diagnosis.streams_before, diagnosis.streams_after)
            )
            if before:
                yield bag, group, before, after


def _draw(axis: plt.Axes, streams: Sequence[Stream], group: str, factor: float) -> float:
    """Draw means over even spans of time; returns the largest value, the band's at least."""
    top = 0.0
    for stream in streams:
        columns = [k for k, name in enumerate(stream.channels) if name in GROUPS[group]]
        at_s, mean, samples = _averaged(stream.at_s, stream.residual[:, columns])
        # One band for all axes: the widest.
        band = 2.0 * stream.noise[columns].max() * factor / np.sqrt(np.maximum(samples, 1))
        band[samples == 0] = np.nan
        axis.fill_between(at_s, -band, band, color="0.82", lw=0, step="mid")
        for colour, k, values in zip(_AXES, columns, mean.T, strict=False):
            axis.plot(
                at_s,
                values * factor,
                color=colour,
                lw=1.0,
                marker=".",
                ms=2.5,
                label=stream.channels[k],
            )
        shown = np.concatenate([np.abs(mean).ravel() * factor, band])
        top = max(top, float(np.nanmax(shown, initial=0.0)))
    axis.axhline(0.0, color="black", lw=0.5)
    return top


def _averaged(at_s: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return times, means (m, k) and samples of _POINTS even spans; NaN where there is nothing."""
    span_s = (at_s[-1] - at_s[0]) / _POINTS if len(at_s) else 1.0
    which = np.minimum(((at_s - at_s[0]) / max(span_s, 1e-9)).astype(int), _POINTS - 1)
    good = np.isfinite(values).all(axis=1)
    samples = np.bincount(which[good], minlength=_POINTS).astype(float)
    mean = np.full((_POINTS, values.shape[1]), np.nan)
    there = samples > 0
    for k, column in enumerate(values.T):
        sums = np.bincount(which[good], column[good], _POINTS)
        mean[there, k] = sums[there] / samples[there]
    return at_s[0] + (np.arange(_POINTS) + 0.5) * span_s, mean, samples


def _margins(
    figure: plt.Figure,
    left: float,
    right: float,
    bottom: float,
    top: float,
    between_x: float = 0.2,
    between_y: float = 0.2,
) -> None:
    """Set margins in inches: matplotlib's own layouts draw everything twice to find them.

    between_x, between_y: of panels, over their own size.
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=between_x,
        hspace=between_y,
    )
