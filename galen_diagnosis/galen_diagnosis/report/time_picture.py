"""The residual in time, before and after on the same scale, with the noise's band."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.answer.bands import GROUPS, group_of
from galen_diagnosis.observation.rows import Stream

if TYPE_CHECKING:
    from galen_diagnosis.answer.result import Diagnosis

BEFORE, AFTER = "#d55e00", "#0072b2"
"""Okabe and Ito's: told apart by colour-blind people too."""
_AXES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
_POINTS = 180
_UNITS = {
    "force": (1e3, "mN"),
    "torque": (1e3, "mN.m"),
    "tip translation": (1e6, "µm"),
    "tip rotation": (1e6, "µrad"),
}
_BEYOND = 1.15


def draw_times(diagnosis: Diagnosis) -> plt.Figure:
    """A line of panels for each bag and group of channels: before on the left, after right."""
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
        for axis, streams, state in zip(
            axes[row], (before, after), ("before", "after"), strict=True
        ):
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
    margins(figure, 0.9, 0.15, 0.5, 0.3, between_x=0.05, between_y=0.5)
    return figure


def margins(
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
    """Times, means (m, k) and samples of _POINTS even spans; NaN where there is nothing."""
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
